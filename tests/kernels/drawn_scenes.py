"""Scenes that hypothesis makes: every Gaussian has one of some shapes, at one of some places, of some opacity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import strategies as st

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.splat.gaussians import Gaussians
from tests.kernels.scenes import Scene

SHAPES = ("plain", "needle", "disc", "ball", "nearly equal", "huge", "tiny")
PLACES = ("plain", "on a border", "near", "at the edge", "behind")
OPACITIES = ("plain", "faint", "opaque")

Kind = tuple[str, str, str]


def log_scales_of(shape: str, rng: np.random.Generator) -> np.ndarray:
    """Log of meters, [3], in any order."""
    s = rng.normal(-1.6, 0.5, 3)
    if shape == "needle":
        s = np.array([rng.uniform(-1, 1), *rng.uniform(-8, -4, 2)])
    elif shape == "disc":
        s = np.array([s[0], s[0], -9.0])
    elif shape == "ball":
        s = np.full(3, s[0])
    elif shape == "nearly equal":  # from the last digit of a float32 to a hundredth
        s = s[0] + s[0] * 10.0 ** rng.uniform(-7, -2, 3)
    elif shape == "huge":
        s = rng.uniform(1.5, 4.0, 3)
    elif shape == "tiny":  # far below a pixel: only the blur is left
        s = rng.uniform(-14.0, -6.0, 3)
    return rng.permutation(s)


def place_of(place: str, camera: PinholeCamera, rng: np.random.Generator) -> np.ndarray:
    """Pixel and depth, [u, v, z]."""
    size = np.array([camera.width, camera.height])
    uv, z = rng.uniform(-0.5, size - 0.5), rng.uniform(1.5, 4.0)
    if place == "on a border":  # of pixels, 4x4 blocks and 16x16 tiles, and on their first pixels
        step = rng.choice([1, 4, 16])
        uv = step * rng.integers(0, size // step + 1) - rng.choice([0.0, 0.5])
    elif place == "near":
        z = rng.uniform(0.02, 0.3)
    elif place == "at the edge":  # around the edge of the image, and beyond where J is linearized
        uv = size / 2 + size * rng.choice([-1, 1], 2) * rng.uniform(0.4, 1.0, 2)
    elif place == "behind":
        z = rng.choice([-1.0, 0.005]) * rng.uniform(0.1, 1.9)
    return np.array([*uv, z])


def logit_of(opacity: str, rng: np.random.Generator) -> float:
    if opacity == "faint":
        return rng.uniform(-6.5, -3.0)  # 1/255 is -5.54
    if opacity == "opaque":
        return rng.uniform(4.0, 12.0)  # 0.999 is 6.9
    return rng.normal(0.5, 1.2)


def made_scene(seed: int, kinds: Sequence[Kind], camera: PinholeCamera, turned: bool = True) -> Scene:
    """The scene of some kinds of Gaussians. Pose and camera are float32 numbers, for the kernels take them as such."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(scale=0.3, size=6) * turned).astype(np.float32).astype(np.float64)
    n = len(kinds)
    uvz = np.array([place_of(place, camera, rng) for _, place, _ in kinds]).reshape(n, 3)
    rays = (uvz[:, :2] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    means_camera = np.concatenate([rays, np.ones((n, 1))], axis=1) * uvz[:, 2:]
    length = 10.0 ** rng.uniform(-2, 2, (n, 1))  # of quaternions: any
    gaussians = Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n),
        means=(means_camera - T[:3, 3]) @ T[:3, :3],
        quats_wxyz=rng.normal(size=(n, 4)) * length,
        log_scales=np.array([log_scales_of(shape, rng) for shape, _, _ in kinds]).reshape(n, 3),
        colors=rng.uniform(-0.2, 1.2, (n, 3)),  # training may leave 0..1
        opacity_logits=np.array([logit_of(opacity, rng) for _, _, opacity in kinds]),
    )
    return Scene(gaussians, camera, T, tuple(rng.random(3).astype(np.float32).tolist()))


def crowded_scene(seed: int, n: int, camera: PinholeCamera) -> Scene:
    """n Gaussians with their centers in one pixel, so faint that many of them count."""
    rng = np.random.default_rng(seed)
    kinds = [("plain", "plain", "faint")] * n
    scene = made_scene(seed, kinds, camera)
    uv = np.array([rng.integers(camera.width), rng.integers(camera.height)])
    rays = (uv + rng.uniform(-0.5, 0.5, (n, 2)) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    means_camera = np.concatenate([rays, np.ones((n, 1))], axis=1) * rng.uniform(1.0, 5.0, (n, 1))
    T = scene.T_camera_map
    gaussians = scene.gaussians.replace(
        means=(means_camera - T[:3, 3]) @ T[:3, :3],
        log_scales=rng.normal(-2.5, 0.7, (n, 3)),
        opacity_logits=rng.uniform(-5.5, -1.5, n),
    )
    return Scene(gaussians, camera, T, scene.background)


def float32(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32)


@st.composite
def cameras(draw: st.DrawFn, longest: int = 40) -> PinholeCamera:
    """Images of one pixel up to a few tiles; the principal point may lie outside."""
    width, height = draw(st.integers(1, longest)), draw(st.integers(1, longest))
    return PinholeCamera(
        width,
        height,
        draw(float32(8.0, 64.0)),
        draw(float32(8.0, 64.0)),
        draw(float32(-0.5, 1.5)) * width,
        draw(float32(-0.5, 1.5)) * height,
    )


kinds = st.tuples(st.sampled_from(SHAPES), st.sampled_from(PLACES), st.sampled_from(OPACITIES))
seeds = st.integers(0, 2**32 - 1)


@st.composite
def mixed_scenes(draw: st.DrawFn) -> Scene:
    """Up to 40 Gaussians of any kinds."""
    return made_scene(draw(seeds), draw(st.lists(kinds, max_size=40)), draw(cameras()), draw(st.booleans()))


@st.composite
def crowded_scenes(draw: st.DrawFn, most: int) -> Scene:
    """Hundreds to thousands of Gaussians on one pixel."""
    return crowded_scene(draw(seeds), draw(st.integers(200, most)), draw(cameras(longest=6)))
