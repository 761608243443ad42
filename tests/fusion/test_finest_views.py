"""Whose Gaussians draw a surface in the final map: a wall 2 m ahead, that robots saw from different distances."""

import numpy as np
import pytest

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.finest_views import finest_resolution, from_finest_views
from duagc.pipeline.fusion.fuse import OwnMap
from duagc.pipeline.splat.gaussians import Gaussians
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


def at(z_m, x_m=0.0):
    """One keyframe that looks at the wall."""
    T = np.eye(4)[None].copy()
    T[0, :3, 3] = x_m, 0, z_m
    return T


def known(name, gaussians, information):
    """Evidence in the world on all Gaussians."""
    bare = Evidence.from_map(name, gaussians, None, np.eye(4)[None])
    n = len(gaussians)
    return Evidence(name, bare.ids, bare.anchors, bare.theta, np.full((n, 31), information)).in_world(
        np.eye(4)[None]
    )


def final_map(poses, finer=1.5, walls=None, robot="alpha", information=1.0):
    """The first Gaussians of a robot's final map, and how many of each peer are in it."""
    maps = {name: wall() for name in poses} | (walls or {})
    evidence = {n: known(n, g, information) for n, g in maps.items()}
    config = FusionConfig(finer=finer)
    origin = np.eye(4)[None]
    began = fused(
        OwnMap(robot, maps[robot], origin, origin),
        evidence=evidence,
        T_world_keyframe=dict.fromkeys(poses, origin),
        pairs={},
        config=config,
        depth_images=[(0, MEASURED_M)],
    )
    return from_finest_views(
        began,
        robot,
        {n: e for n, e in evidence.items() if n != robot},
        poses,
        MapContext(CAMERA, config, MATCHING),
        factor=finer,
        depth_images=[(0, MEASURED_M - np.float32(poses[robot][0, 2, 3]))],
        depth_kinds=dict.fromkeys(poses, "blended"),
    )


def seen_from(pose):
    """Which Gaussians of the wall a keyframe sees: their centers fall on one of its pixels."""
    x, y, z = (wall().means - pose[0, :3, 3]).T
    u, v = np.rint(CAMERA.fx * x / z + CAMERA.cx), np.rint(CAMERA.fy * y / z + CAMERA.cy)
    return (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)


def test_a_peer_that_stood_nearer_draws_what_it_saw():
    poses = {"alpha": at(0.0), "bravo": at(1.0)}
    found, near = final_map(poses), seen_from(poses["bravo"])
    n = len(wall())
    own = found.ids < n
    np.testing.assert_array_equal(found.ids[own], np.flatnonzero(~near))
    np.testing.assert_allclose(found.means[~own], wall().means[near], atol=1e-6)
    np.testing.assert_array_equal(found.ids[~own], n + np.arange(near.sum()))
    assert 100 < near.sum() < n - 100


@pytest.mark.parametrize(("z_m", "finer"), [(1.0, 2.5), (0.0, 1.0), (-1.0, 1.0)])
def test_where_no_peer_saw_finer_the_own_map_stays(z_m, finer):
    found = final_map({"alpha": at(0.0), "bravo": at(z_m)}, finer)
    seen = np.flatnonzero(seen_from(at(0.0)))
    assert np.isin(seen, found.ids).all()
    theirs = found.means[found.ids >= len(wall())]
    assert not {tuple(p) for p in theirs} & {tuple(p) for p in wall().means[seen]}


def test_without_information_nothing_is_imported():
    found = final_map({"alpha": at(0.0), "bravo": at(1.0)}, information=0.0)
    assert (found.ids < len(wall())).all()


def test_of_two_peers_the_nearer_draws_and_of_equal_ones_the_first():
    own, near, nearer = at(0.0), at(0.8), at(1.2)
    found = final_map({"alpha": own, "bravo": near, "charlie": nearer})
    assert len(found) == len(wall())  # every place once
    assert sum(seen_from(near)) > sum(seen_from(nearer))
    theirs = found.means[found.ids >= len(wall())]
    assert len(theirs) == sum(seen_from(near))
    equal = final_map({"alpha": own, "bravo": nearer, "charlie": nearer}, walls={"charlie": wall(1.99)})
    np.testing.assert_allclose(equal.means[equal.ids >= len(wall()), 2], 2.0)


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
