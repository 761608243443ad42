"""Which Gaussians a merge keeps: walls ahead of a camera, left and right of its axis."""

import numpy as np
import pytest

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import OwnMap
from duagc.pipeline.fusion.most_drawn import most_drawn
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.splat.gaussians import Gaussians
from tests.fixtures.gaussian_worlds import CAMERA, MATCHING, fused

ORIGIN = np.eye(4)[None]


def wall(depth_m, columns=8, half_m=0.4, size_m=0.06, across_m=-0.6):
    """Opaque discs in a square at a depth, left or right of the axis."""
    x, y = np.meshgrid(*[np.linspace(-half_m, half_m, columns)] * 2)
    means = np.stack([x + across_m, y, np.full_like(x, depth_m)], axis=-1).reshape(-1, 3)
    n = len(means)
    shapes = np.log(np.tile([size_m, size_m, 0.001], (n, 1)))
    turned = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(np.arange(n), np.zeros(n), means, turned, shapes, np.full((n, 3), 0.5), np.full(n, 6.0))


def together(*parts):
    whole = Gaussians.concatenate(parts)
    return whole.replace(ids=np.arange(len(whole)))


def known(name, gaussians, information=1.0):
    """Evidence in the world on all Gaussians."""
    bare = Evidence.from_map(name, gaussians, None, ORIGIN)
    blocks = np.full((len(gaussians), 31), information)
    return Evidence(name, bare.ids, bare.anchors, bare.theta, blocks).in_world(ORIGIN)


def start(own, peers, *, pairs=None, information=1.0, most=None):
    """Alpha's start: its Gaussians at the origin, which fusion left as they were, and its peers'."""
    evidence = {"alpha": known("alpha", own)}
    evidence |= {name: known(name, g, information) for name, g in peers.items()}
    config = FusionConfig(most_final=most, coverage="overlap")
    began = fused(
        OwnMap("alpha", own, ORIGIN, ORIGIN),
        evidence=evidence,
        T_world_keyframe=dict.fromkeys(evidence, ORIGIN),
        pairs={},
        config=config,
    )
    assert len(began.gaussians) == len(own)
    size = CAMERA.height, CAMERA.width
    view = PosedRgbd(np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32), ORIGIN[0])
    context = MapContext(CAMERA, config, MATCHING)
    others = {name: evidence[name] for name in peers}
    found = most_drawn(began, others, pairs or {}, context, robot="alpha", views=[view, view])
    gaussians = found.gaussians
    assert len(np.unique(gaussians.ids)) == len(gaussians)
    assert np.array_equal(found.taken, gaussians.ids[gaussians.ids > own.ids.max()])
    assert np.all(found.information == information)
    return gaussians


def test_what_is_hidden_gives_way_to_what_a_peer_draws():
    front, hidden = wall(2.0), wall(2.5, columns=5, across_m=-0.75)
    right = wall(2.0, columns=5, across_m=0.6)
    found = start(together(front, hidden), {"bravo": right})
    assert len(found) == len(front) + len(hidden)
    assert found.ids.tolist() == [*range(64), *range(89, 89 + 25)], (
        "the own wall, then what bravo has right of it"
    )
    np.testing.assert_allclose(found.means[64:], right.means, atol=1e-6)


def test_of_what_draws_alike_the_larger_stays():
    """Bravo's wall is half as far and half as large: the same on the image."""
    far, near = wall(2.0), wall(1.0, half_m=0.2, size_m=0.03, across_m=0.3)
    assert start(near, {"bravo": far}).ids.tolist() == list(range(64, 128))
    assert start(far, {"bravo": near}).ids.tolist() == list(range(64))


def test_what_the_fused_map_stands_for_does_not_come_again():
    hidden = together(wall(2.0), wall(2.5, across_m=-0.75))
    right = wall(2.0, across_m=0.6)
    both = np.stack([np.arange(64), np.arange(64)], axis=1)
    assert start(hidden, {"bravo": right}, pairs={("alpha", "bravo"): both}).ids.max() < 128
    assert start(hidden, {"bravo": right}, information=0.0).ids.max() < 128
    once = start(hidden, {"bravo": right, "charlie": right}, pairs={("bravo", "charlie"): both})
    assert len(once) == len(hidden)
    assert np.sum(once.means[:, 0] > 0) == len(right), "matched peers' Gaussians count once"


@pytest.mark.parametrize("missing", ["bravo", "charlie"])
def test_what_is_not_here_takes_nothing_else_out(missing):
    """Nothing is here of one of two peers that are matched with each other: own images contradict it."""
    right = wall(2.0, across_m=0.6)
    both = np.stack([np.arange(64), np.arange(64)], axis=1)
    peers = {name: right.select(slice(0, 0 if name == missing else None)) for name in ("bravo", "charlie")}
    found = start(wall(2.0), peers, pairs={("bravo", "charlie"): both}, most=1000)
    assert np.sum(found.means[:, 0] > 0) == np.sum(start(wall(2.0), {"bravo": right}).means[:, 0] > 0) > 0


@pytest.mark.parametrize("most", [50, 1000])
def test_the_map_is_no_larger_than_allowed(most):
    found = start(wall(2.0), {"bravo": wall(2.0, across_m=0.6)}, most=most)
    assert len(found) == min(most, 64)
