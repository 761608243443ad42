"""Which Gaussians and matches are chosen, rule by rule: what is seen, what comes first, what is near enough."""

from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import gaussian_distance
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.coverage import explained, known_surfaces, select_unseen
from duagc.pipeline.fusion.finest_views import _belongs
from duagc.pipeline.fusion.most_drawn import _drawn, _others
from duagc.pipeline.fusion.peer_validation import _near, _true_pairs
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import MEAN, OPACITY
from tests.fixtures.gaussian_worlds import CAMERA, MATCHING, information

ORIGIN = np.eye(4)[None]
SIZE = CAMERA.height, CAMERA.width


def evidence(name, ids, theta=None, stated=None):
    n = len(ids)
    theta = np.zeros((n, 13)) if theta is None else theta
    stated = np.ones((n, 31)) if stated is None else stated
    return Evidence(name, np.asarray(ids), np.zeros(n, np.int32), theta, stated)


def discs(depth_m, logits=6.0, scales=(0.3, 0.3, 0.001)):
    """A row of discs across the axis."""
    means = np.array([[x, 0.0, depth_m] for x in (-0.3, 0.0, 0.3)])
    return Gaussians(
        np.arange(3), np.zeros(3), means, np.tile([1.0, 0, 0, 0], (3, 1)),
        np.log(np.tile(scales, (3, 1))), np.full((3, 3), 0.5), np.full(3, logits),
    )  # fmt: skip


def test_the_farther_a_surface_is_the_more_may_lie_behind_it():
    config = FusionConfig(explained_m=0.05, explained_relative=0.02)
    depth = np.full(SIZE, 4.0, np.float32)
    points = np.array([[0, 0, z] for z in (4.04, 4.12, 4.14)])  # up to (4 + 0.05) / 0.98
    found = explained(points, ORIGIN, [(0, depth)], CAMERA, config=config)
    np.testing.assert_array_equal(found, [True, True, False])


def test_of_too_many_those_that_are_known_best_are_imported():
    rng = np.random.default_rng(0)
    stated = information(rng, 8)
    theta = np.zeros((8, 13))
    context = MapContext(CAMERA, FusionConfig(max_added=3), MATCHING)
    rows = select_unseen(theta, stated, T_world_keyframe=ORIGIN, surfaces=(), context=context)
    known = stated[:, 0] + stated[:, 3] + stated[:, 5]  # the trace of the packed 3x3
    np.testing.assert_array_equal(rows, np.sort(np.argsort(-known)[:3]))


def test_a_surface_is_where_it_was_measured_and_where_it_was_not_where_it_is_drawn():
    own, middle = discs(2.0), (CAMERA.height // 2, CAMERA.width // 2)
    context = MapContext(CAMERA, FusionConfig(explained_px=0, explained_opacity=0.5), MATCHING)
    measured = np.full(SIZE, 2.4, np.float32)
    for depth, expected in ((measured, 2.4), (np.zeros(SIZE, np.float32), 2.0)):
        ((keyframe, surface),) = known_surfaces(own, ORIGIN, [(0, depth)], context)
        assert keyframe == 0
        assert surface[middle] == pytest.approx(expected, abs=0.01)
        assert surface[0, 0] == 0  # the own map draws nothing there


@pytest.mark.parametrize(
    ("own", "bravo", "charlie", "drawn_by"),
    [(10, 16, 14, "bravo"), (10, 14, 16, "charlie"), (10, 16, 16, "bravo"), (10, 14, 14, ""), (0, 90, 0, "")],
)
def test_a_place_is_drawn_by_one_peer_at_most(own, bravo, charlie, drawn_by):
    resolution = {"alpha": np.array([own]), "bravo": np.array([bravo]), "charlie": np.array([charlie])}
    drawing = [name for name in ("bravo", "charlie") if _belongs(resolution, name, "alpha", 1.5)[0]]
    assert "".join(drawing) == drawn_by


def test_what_a_gaussian_draws_counts_by_its_two_larger_axes():
    shown = Gaussians.concatenate([discs(2.0), discs(2.2, scales=(0.05, 0.4, 0.002))])
    shown = shown.replace(ids=np.arange(6))
    view = PosedRgbd(np.zeros((*SIZE, 3), np.uint8), np.zeros(SIZE, np.float32), ORIGIN[0])
    context = MapContext(CAMERA, FusionConfig(), MATCHING)
    rasterizer = Rasterizer()
    rasterizer.forward(shown, CAMERA, ORIGIN[0])
    weight = rasterizer.contributions()[0]
    extent = np.repeat([0.3 * 0.3, 0.05 * 0.4], 3)
    np.testing.assert_allclose(_drawn(shown, [view, view], context), 2 * weight * extent, rtol=1e-5)


def test_whichever_end_of_a_pair_a_peer_is_its_own_matched_gaussians_are_left_out():
    """Bravo's map stands for alpha's 1 and charlie's 22; alpha's 3 stands for charlie's 23."""
    peers = {"alpha": evidence("alpha", [1, 2, 3]), "charlie": evidence("charlie", [21, 22, 23])}
    pairs = {
        ("alpha", "bravo"): np.array([[1, 13]]),
        ("bravo", "charlie"): np.array([[21, 22]]),
        ("alpha", "charlie"): np.array([[3, 23], [99, 21]]),
    }
    fused = SimpleNamespace(
        robots=("alpha", "bravo", "charlie"), source=np.array([1]), source_ids=np.array([7])
    )
    context = MapContext(CAMERA, FusionConfig(), MATCHING)
    found = {
        name: rows.tolist() for name, rows in _others(fused, peers, pairs, robot="bravo", context=context)
    }
    assert found == {"alpha": [1, 2], "charlie": [0]}


def test_gaussians_that_are_far_apart_are_no_match_however_alike():
    theta = np.zeros((3, 13))
    theta[:, MEAN] = [[0, 0, 0], [0, 0, 0.099], [0, 0, 0.101]]
    a, b = evidence("alpha", [5, 6, 7]), evidence("bravo", [15, 16, 17], theta)
    pairs = np.array([[5, 15], [6, 16], [7, 17], [8, 15]])
    np.testing.assert_array_equal(_near(a, b, pairs, 0.1), pairs[:2])


def test_matches_may_differ_by_a_factor_more_than_neighbors_do():
    """In opacity alone; the limit of the own map is 1."""
    theta = np.zeros((3, 13))
    theta[:, OPACITY] = [1.0, 2.7, 2.9]
    a, b = evidence("alpha", [5, 6, 7]), evidence("bravo", [15, 16, 17], theta)
    pairs = np.array([[5, 15], [6, 16], [7, 17]])
    apart = gaussian_distance(a, np.arange(3), b, np.arange(3), config=MATCHING)
    np.testing.assert_allclose(apart, np.sqrt(0.5) * theta[:, OPACITY])
    found = _true_pairs(
        {"alpha": a, "bravo": b}, {("alpha", "bravo"): pairs}, MATCHING,
        radius_m=0.1, factor=2.0, own_threshold=1.0,
    )  # fmt: skip
    np.testing.assert_array_equal(found["alpha", "bravo"], pairs[:2])
