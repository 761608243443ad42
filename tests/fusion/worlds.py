"""Small teams whose robots hold the same Gaussians."""

import numpy as np

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import MatchingConfig
from duagc.pipeline.consensus.weighting import in_world
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import OwnMap, fuse
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import pack_information

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
CONFIG = FusionConfig(
    explained_opacity=0.0
)  # what was measured explains, though these maps draw hardly anything
# every robot ends with the same Gaussian
ALIKE = FusionConfig(
    association="members", scatter_position_m=0.004, scatter_log_covariance=0.14, explained_opacity=0.0
)
MATCHING = MatchingConfig()
NAMES = ("alpha", "bravo", "charlie")
N = 30


def random_pose(rng):
    return se3.from_quat_translation(rng.normal(size=4), rng.normal(size=3))


def information(rng, n):
    """Blocks of full rank with a contrast of about ten per axis."""
    blocks = []
    for d, scale in ((3, 1e5), (6, 10.0)):
        A = rng.normal(size=(n, d, d)) + 2 * np.eye(d)
        blocks.append(scale * A @ A.swapaxes(-1, -2))
    return pack_information(*blocks, rng.uniform(100, 1000, (n, 3)), rng.uniform(1, 10, n))


def fused(
    own,
    *,
    evidence,
    T_world_keyframe,
    pairs,
    config,
    self_information=None,
    matching=MATCHING,
    depth_images=(),
):
    """`fuse` of evidence in anchor frames; the own evidence is also the self-information if no other is given."""
    splats = evidence[own.robot] if self_information is None else self_information
    return fuse(
        own,
        {name: in_world(e, T_world_keyframe[name], "block") for name, e in evidence.items()},
        pairs,
        MapContext(CAMERA, config, matching),
        self_information=in_world(splats, T_world_keyframe[own.robot], "block"),
        depth_images=depth_images,
    )


class World:
    """Robots that each hold one Gaussian per place, in anchor frames, with all places matched."""

    def __init__(self, seed, robots=3, keyframes=3):
        rng = np.random.default_rng(seed)
        self.names = NAMES[:robots]
        truth = rng.normal(size=(N, 3))
        self.T_world, self.maps, self.T_map, self.evidence = {}, {}, {}, {}
        for k, name in enumerate(self.names):
            T_world_map = random_pose(rng)
            self.T_map[name] = np.array([random_pose(rng) for _ in range(keyframes)])
            self.T_world[name] = T_world_map @ self.T_map[name]
            means_world = truth + 0.005 * rng.normal(size=(N, 3))
            self.maps[name] = Gaussians(
                100 * k + np.arange(N),
                rng.integers(keyframes, size=N),
                se3.transform(se3.inverse(T_world_map), means_world),
                rng.normal(size=(N, 4)),
                rng.uniform(-5, -3.5, size=(N, 3)),
                rng.uniform(size=(N, 3)),
                rng.normal(size=N),
            )
            bare = Evidence.from_map(name, self.maps[name], None, self.T_map[name])
            self.evidence[name] = Evidence(name, bare.ids, bare.anchors, bare.theta, information(rng, N))
        self.pairs = {
            (a, b): np.stack([self.maps[a].ids, self.maps[b].ids], axis=1)
            for i, a in enumerate(self.names)
            for b in self.names[i + 1 :]
        }

    def fuse(self, robot, config=CONFIG, depth_images=(), **changes):
        given = {"evidence": self.evidence, "pairs": self.pairs, "T_world_keyframe": self.T_world} | changes
        own = OwnMap(robot, self.maps[robot], self.T_map[robot], given["T_world_keyframe"][robot])
        return fused(own, depth_images=depth_images, config=config, **given)

    def without_information(self, name):
        e = self.evidence[name]
        return Evidence(name, e.ids, e.anchors, e.theta, np.zeros_like(e.information))


def assert_same_map(a, b, atol=0.0):
    np.testing.assert_array_equal(a.gaussians.ids, b.gaussians.ids)
    for name in ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits"):
        np.testing.assert_allclose(getattr(a.gaussians, name), getattr(b.gaussians, name), rtol=0, atol=atol)
    np.testing.assert_allclose(a.information, b.information, rtol=0, atol=atol * 1e6)
