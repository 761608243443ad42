"""What a robot imports from its neighbors: what its own keyframes and its own map do not explain, once."""

from dataclasses import replace

import numpy as np

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.coverage import explained
from duagc.pipeline.fusion.fuse import OwnMap
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import LOG_COVARIANCE, MEAN
from tests.fixtures.gaussian_worlds import (
    CAMERA,
    CONFIG,
    N,
    World,
    fused,
    information,
)

WALL = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 40), np.linspace(-1.2, 1.2, 40)), axis=-1).reshape(-1, 2)


def wall(opacity_logits):
    """Own splats on a wall 2 m in front of the origin."""
    n = len(WALL)
    return Gaussians(
        np.arange(n),
        np.zeros(n),
        np.concatenate([WALL, np.full((n, 1), 2.0)], axis=1),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.log(np.tile([0.06, 0.06, 0.001], (n, 1))),
        np.full((n, 3), 0.5),
        opacity_logits,
    )


def test_neighbors_unmatched_gaussians_fill_only_unseen_space():
    """An own keyframe at the origin measured a wall 2 m away on the left half of its image, nothing on the right."""
    world = World(12, robots=2)
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    depth[:, :32] = 2.0
    points = np.array(
        [[-0.5, 0, 1.0], [-0.5, 0, 2.1], [-0.5, 0, 2.5], [0.5, 0, 1.0], [0, 0, -1.0], [9, 0, 1.0]]
    )
    seen = explained(points, np.eye(4)[None], [(0, depth)], CAMERA, config=CONFIG)
    # in front of the wall, at it, behind it, where nothing was measured, behind the camera, outside the image
    assert seen.tolist() == [True, True, False, False, False, False]
    theta = np.zeros((6, 13))
    theta[:, MEAN], theta[:, LOG_COVARIANCE] = points, -8 * np.array([1, 1, 1, 0, 0, 0])
    rng = np.random.default_rng(13)
    neighbor = Evidence("bravo", np.arange(6), np.zeros(6), theta, information(rng, 6))
    given = {
        "evidence": {"alpha": world.evidence["alpha"], "bravo": neighbor},
        "pairs": {},
        "T_world_keyframe": {"alpha": np.tile(np.eye(4), (3, 1, 1)), "bravo": np.eye(4)[None]},
    }
    found = world.fuse("alpha", depth_images=[(0, depth)], **given)
    assert found.added == 4
    new = found.gaussians.select(slice(N, None))
    np.testing.assert_allclose(new.means, points[2:], atol=1e-6)
    np.testing.assert_array_equal(found.source_ids[N:], [2, 3, 4, 5])
    assert [found.robots[s] for s in found.source[N:]] == ["bravo"] * 4
    assert len(np.unique(found.gaussians.ids)) == N + 4
    outside = np.array([[0.05, 0, 1.0], [0.3, 0, 1.0]])  # 2 and 15 pixels from the wall's outline
    for px, count in ((4, 1), (0, 2)):
        imported = theta[:2].copy()
        imported[:, MEAN] = outside
        near = given["evidence"] | {
            "bravo": Evidence("bravo", np.arange(2), np.zeros(2), imported, information(rng, 2))
        }
        config = CONFIG.model_copy(update={"explained_px": px})
        assert world.fuse("alpha", config, [(0, depth)], **(given | {"evidence": near})).added == count
    overlap = CONFIG.model_copy(update={"coverage": "overlap"})
    assert world.fuse("alpha", overlap, [(0, depth)], **given).added == 0
    capped = world.fuse("alpha", CONFIG.model_copy(update={"max_added": 2}), [(0, depth)], **given)
    assert capped.added == 2
    assert set(capped.source_ids[N:]) <= {2, 3, 4, 5}
    unknown = given["evidence"] | {
        "bravo": Evidence("bravo", np.arange(6), np.zeros(6), theta, np.zeros((6, 31)))
    }
    assert world.fuse("alpha", depth_images=[(0, depth)], **(given | {"evidence": unknown})).added == 0


def test_the_own_map_explains_where_depth_is_missing():
    """A wall of own splats at 2 m without depth: a neighbor's splats at and before it are no news."""
    own = wall(np.full(40 * 40, 4.0))
    n = len(own)
    theta = np.zeros((3, 13))
    theta[:, MEAN] = [[0, 0, 1.0], [0.1, 0, 2.05], [0, 0.1, 3.0]]
    theta[:, LOG_COVARIANCE] = -8 * np.array([1, 1, 1, 0, 0, 0])
    origin = np.eye(4)[None]
    evidence = {
        "alpha": Evidence.from_map("alpha", own, None, origin),
        "bravo": Evidence("bravo", np.arange(3), np.zeros(3), theta, np.ones((3, 31))),
    }
    poses, nothing = {"alpha": origin, "bravo": origin}, np.zeros((CAMERA.height, CAMERA.width), np.float32)
    imported = {
        opacity: fused(
            OwnMap("alpha", own, origin, origin),
            evidence=evidence,
            T_world_keyframe=poses,
            pairs={},
            config=CONFIG.model_copy(update={"explained_opacity": opacity}),
            depth_images=[(0, nothing)],
        )
        .source_ids[n:]
        .tolist()
        for opacity in (0.5, 1.0)
    }
    assert imported == {0.5: [2], 1.0: [0, 1, 2]}


def test_a_surface_that_the_own_map_hardly_draws_is_not_explained():
    """Where own splats are thin, a neighbor's on the measured wall fill it, and only there."""
    own = wall(np.where(WALL[:, 0] < 0, 4.0, -4.0))
    n = len(own)
    theta = np.zeros((2, 13))
    theta[:, MEAN] = [[-0.6, 0, 2.0], [0.6, 0, 2.0]]
    theta[:, LOG_COVARIANCE] = -8 * np.array([1, 1, 1, 0, 0, 0])
    origin = np.eye(4)[None]
    evidence = {
        "alpha": Evidence.from_map("alpha", own, None, origin),
        "bravo": Evidence("bravo", np.arange(2), np.zeros(2), theta, np.ones((2, 31))),
    }
    measured = [(0, np.full((CAMERA.height, CAMERA.width), 2.0, np.float32))]
    still = {"alpha": origin, "bravo": origin}
    found = fused(
        OwnMap("alpha", own, origin, origin),
        evidence=evidence,
        T_world_keyframe=still,
        pairs={},
        config=FusionConfig(),
        depth_images=measured,
    )
    assert found.source_ids[n:].tolist() == [1]


def test_what_two_neighbors_share_is_imported_once():
    world = World(14)
    pair = {("bravo", "charlie"): world.pairs["bravo", "charlie"]}
    known = world.evidence["bravo"]
    world.evidence["bravo"] = replace(known, information=100 * known.information)
    found = world.fuse("alpha", pairs=pair)  # bravo's, with what charlie says about them
    assert (found.matched, found.added) == (0, N)
    assert [found.robots[s] for s in found.source[N:]] == ["bravo"] * N
    both = world.fuse("bravo", evidence={n: world.evidence[n] for n in ("bravo", "charlie")}, pairs=pair)
    np.testing.assert_allclose(found.gaussians.means[N:], both.gaussians.means, atol=2e-6)
    np.testing.assert_array_equal(found.members[N:], 2)
