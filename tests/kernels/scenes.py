"""Small scenes for the kernels; each exists to reach one corner of them."""

from dataclasses import dataclass

import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.splat.gaussians import Gaussians

BACKGROUND = (0.2, 0.7, 0.4)


@dataclass(frozen=True)
class Scene:
    gaussians: Gaussians
    camera: PinholeCamera
    T_camera_map: np.ndarray
    background: tuple[float, float, float] = BACKGROUND

    def image(self, seed: int, *channels: int, low: float | None = None) -> np.ndarray:
        """An image of normal numbers, or of uniform ones from `low` to 1e3."""
        rng, shape = np.random.default_rng(seed), (self.camera.height, self.camera.width, *channels)
        values = rng.normal(size=shape) if low is None else rng.uniform(low, 1e3, shape)
        return values.astype(np.float32)


def random_gaussians(n: int, seed: int) -> Gaussians:
    """n Gaussians of about 20 cm, 1.5 to 4 m in front of the origin."""
    rng = np.random.default_rng(seed)
    means = np.stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-0.8, 0.8, n), rng.uniform(1.5, 4, n)], axis=1)
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n, dtype=np.int32),
        means=means,
        quats_wxyz=rng.normal(size=(n, 4)),
        log_scales=rng.normal(-1.6, 0.4, (n, 3)),
        colors=rng.random((n, 3)),
        opacity_logits=rng.normal(0.5, 1.2, n),
    )


def make_scene(kind: str, n: int = 24, seed: int = 4) -> Scene:
    gaussians = random_gaussians(n, seed)
    # 19x13: neither side is a multiple of a block or of a tile
    camera = PinholeCamera(19, 13, 11.0, 10.5, 9.1, 5.7)
    T = se3.exp([0.05, -0.02, 0.1, 0.02, 0.1, -0.03])
    s = gaussians.log_scales.copy()
    if kind == "discs":  # two equal scales, the third thin
        s[:, 1], s[:, 2] = s[:, 0], -6.0
    elif kind == "nearly discs":  # equal to the last digits: divided differences must not divide by them
        s[:, 1], s[:, 2] = s[:, 0] * np.float32(1 + 1e-6), -3.0
    elif kind == "spheres":
        s[:] = s[:, :1]
    elif kind == "needles":
        s[:, 0], s[:, 1:] = 0.5, -5.0
    gaussians = gaussians.replace(log_scales=s)
    if kind == "opaque":  # alpha reaches its clamp, pixels close
        gaussians = gaussians.replace(opacity_logits=np.linspace(4, 12, n), log_scales=s + 0.5)
    elif kind == "faint":
        gaussians = gaussians.replace(opacity_logits=np.linspace(-9, -2, n))
    elif kind == "behind":  # half of them behind the camera or far outside its field
        means = gaussians.means.copy()
        means[: n // 2, 2] *= -1
        means[n // 2 : n // 2 + 4, 0] += 20
        gaussians = gaussians.replace(means=means)
    elif kind == "wide":  # six tiles
        gaussians = gaussians.select(slice(0, 12))
        camera = PinholeCamera(33, 17, 20.0, 21.0, 15.3, 7.9)
    return Scene(gaussians, camera, T)


KINDS = ("plain", "discs", "nearly discs", "spheres", "needles", "opaque", "faint", "behind", "wide")
