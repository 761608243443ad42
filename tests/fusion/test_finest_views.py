"""Whose Gaussians draw a surface in the final map: a wall 2 m ahead, that robots saw from different distances."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.finest_views import finest_resolution, from_finest_views
from duagc.pipeline.fusion.fuse import OwnMap
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.map_cells import MapCells
from tests.fixtures.gaussian_worlds import CAMERA, MATCHING, MapContext, fused

COLUMNS, ROWS = np.meshgrid(np.linspace(-1.5, 1.5, 40), np.linspace(-1.2, 1.2, 32))
MEASURED_M = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)


def wall(depth_m=2.0):
    """Opaque discs at `depth_m`, larger than what a camera 2 m away sees of it."""
    means = np.stack([COLUMNS, ROWS, np.full_like(COLUMNS, depth_m)], axis=-1).reshape(-1, 3)
    n = len(means)
    shapes = np.log(np.tile([0.05, 0.05, 0.001], (n, 1)))
    turned = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(np.arange(n), np.zeros(n), means, turned, shapes, np.full((n, 3), 0.5), np.full(n, 6.0))


def at(z_m):
    """One keyframe that looks at the wall."""
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = z_m
    return T


def known(name, gaussians, information):
    """Evidence in the world on all Gaussians."""
    bare = Evidence.from_map(name, gaussians, None, np.eye(4)[None])
    n = len(gaussians)
    return Evidence(name, bare.ids, bare.anchors, bare.theta, np.full((n, 31), information)).in_world(
        np.eye(4)[None]
    )


def final_map(poses, finer=1.5, walls=None, information=1.0, camera=CAMERA):
    """Of alpha's final map: the places in alpha's view that its own Gaussians draw, and those that each peer's do."""
    maps = {name: wall() for name in poses} | (walls or {})
    evidence = {n: known(n, g, information * (k + 1)) for k, (n, g) in enumerate(maps.items())}
    config = FusionConfig(finer=finer, explained_px=0)
    origin, measured = np.eye(4)[None], [(0, MEASURED_M - np.float32(poses["alpha"][0, 2, 3]))]
    began = fused(
        OwnMap("alpha", maps["alpha"], origin, origin),
        evidence=evidence,
        T_world_keyframe=dict.fromkeys(poses, origin),
        pairs={},
        config=config,
        depth_images=measured,
    )
    found = from_finest_views(
        began,
        {n: e for n, e in evidence.items() if n != "alpha"},
        poses,
        MapContext(CAMERA, config, MATCHING),
        robot="alpha",
        factor=finer,
        depth_images=measured,
        depth_kinds=dict.fromkeys(poses, "blended"),
        cameras=dict.fromkeys(poses, camera),
    )
    gaussians = found.gaussians
    assert len(np.unique(gaussians.ids)) == len(gaussians)
    own = gaussians.ids < len(wall())
    assert np.array_equal(found.taken, gaussians.ids[gaussians.ids > began.gaussians.ids.max()])
    assert_information_of_owners(found, evidence)
    view = seen_from(poses["alpha"])
    return [places(gaussians.means[rows]) & set(np.flatnonzero(view)) for rows in (own, ~own)]


def assert_information_of_owners(found, evidence):
    """What is stated of the Gaussians that come in is what a peer stated; they come peer by peer."""
    stated = found.information[:, 0]
    by_peers = [e.information[0, 0] for name, e in evidence.items() if name != "alpha" and len(e)]
    assert np.isin(stated, by_peers).all()
    assert np.all(np.diff(stated) >= 0)
    assert np.all(found.information == stated[:, None])


def places(means):
    """Rows of the wall's Gaussians at some means."""
    rows = {tuple(xy): row for row, xy in enumerate(wall().means[:, :2].round(4).tolist())}
    found = [rows[tuple(xy)] for xy in means[:, :2].round(4).tolist()]
    return set(found)


def seen_from(pose, camera=CAMERA):
    """Which Gaussians of the wall a keyframe sees: their centers fall on one of its pixels."""
    x, y, z = (wall().means - pose[0, :3, 3]).T
    u, v = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
    return (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


IN_VIEW = set(np.flatnonzero(seen_from(at(0.0))))


def test_a_peer_that_stood_nearer_draws_what_it_saw():
    poses = {"alpha": at(0.0), "bravo": at(1.0)}
    near = set(np.flatnonzero(seen_from(poses["bravo"])))
    assert final_map(poses) == [IN_VIEW - near, near]
    assert 100 < len(near) < len(IN_VIEW) - 100


@pytest.mark.parametrize(("z_m", "finer"), [(1.0, 2.5), (0.0, 1.0), (-1.0, 1.0)])
def test_where_no_peer_saw_finer_the_own_map_stays(z_m, finer):
    assert final_map({"alpha": at(0.0), "bravo": at(z_m)}, finer) == [IN_VIEW, set()]


def test_a_peer_with_a_longer_lens_draws_what_it_saw_from_as_far():
    poses = {"alpha": at(0.0), "bravo": at(0.0)}
    longer = replace(CAMERA, fx=2 * CAMERA.fx, fy=2 * CAMERA.fy)
    seen = set(np.flatnonzero(seen_from(poses["bravo"], longer)))
    assert final_map(poses, camera=longer) == [IN_VIEW - seen, seen]
    assert 100 < len(seen) < len(IN_VIEW) - 100


def test_a_peer_that_stood_nearer_with_a_shorter_lens_saw_no_more():
    poses = {"alpha": at(0.0), "bravo": at(1.0)}
    assert final_map(poses, camera=replace(CAMERA, fx=CAMERA.fx / 2, fy=CAMERA.fy / 2)) == [IN_VIEW, set()]


def test_what_a_peer_has_not_got_stays():
    """Bravo saw the wall from near, and has sent the left half of it."""
    left = np.flatnonzero(wall().means[:, 0] < 0)
    poses = {"alpha": at(0.0), "bravo": at(1.0)}
    own, theirs = final_map(poses, walls={"bravo": wall().select(left)})
    assert own | theirs == IN_VIEW
    assert theirs <= set(left)
    assert len(theirs) > 50


def test_without_information_nothing_comes_in():
    assert final_map({"alpha": at(0.0), "bravo": at(1.0)}, information=0.0)[1] == set()


def test_of_two_peers_the_nearer_draws_and_of_equal_ones_the_first():
    near, nearer = at(0.8), at(1.2)
    own, theirs = final_map({"alpha": at(0.0), "bravo": near, "charlie": nearer})
    assert theirs == set(np.flatnonzero(seen_from(near)))
    assert own == IN_VIEW - theirs
    empty = wall().select(slice(0, 0))
    alone = final_map({"alpha": at(0.0), "bravo": nearer, "charlie": nearer}, walls={"charlie": empty})
    assert final_map({"alpha": at(0.0), "bravo": nearer, "charlie": nearer}) == alone


def test_a_place_behind_what_a_keyframe_sees_is_not_seen():
    pose = at(0.0)
    context = MapContext(CAMERA, FusionConfig(), MATCHING)
    points = np.array([[0, 0, 1.0], [0, 0, 2.05], [0, 0, 2.6], [0, 0, -1.0], [9.0, 0, 1.0]])
    found = finest_resolution({"any": points}, pose, [(0, MEASURED_M)], context)["any"]
    np.testing.assert_allclose(found, [CAMERA.fx, CAMERA.fx / 2.05, 0, 0, 0])
    twice = finest_resolution(
        {"any": points}, np.concatenate([at(1.0), pose]), [(1, MEASURED_M), (0, MEASURED_M - 1)], context
    )["any"]
    assert twice[1] == pytest.approx(CAMERA.fx / 1.05)


def test_only_what_may_be_in_an_image_is_looked_at_in_large_maps():
    context = MapContext(CAMERA, FusionConfig(), MATCHING)
    aside = wall().replace(means=wall().means + np.float32([6.0, 0, 0]))
    both = Gaussians.concatenate([wall(), aside])
    cells = {"any": MapCells.of(both)}
    assert len(cells["any"].in_image(at(0.5)[0], CAMERA)) <= len(wall())
    means = {"any": both.means.astype(np.float64)}
    surfaces = [(0, MEASURED_M)]
    found = finest_resolution(means, at(0.5), surfaces, context, cells=cells)["any"]
    assert (found > 0).any()
    assert np.array_equal(found, finest_resolution(means, at(0.5), surfaces, context)["any"])
