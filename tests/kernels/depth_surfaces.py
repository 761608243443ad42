"""A depth image of slanted planes at steps, with holes, and its camera: of any size."""

import numpy as np

from duagc.pipeline.geometry.camera import PinholeCamera

SIZES = {"odd": (37, 23), "wide": (300, 40), "one pixel": (1, 1), "one row": (64, 1), "one column": (1, 64)}


def camera_of(width: int, height: int) -> PinholeCamera:
    return PinholeCamera(width, height, 0.9 * width + 3, 0.8 * width + 3, 0.47 * width, 0.55 * height)


def surfaces(camera: PinholeCamera, holes: float = 0.1) -> np.ndarray:
    """Inverse depth [h, w], 1/m, 0 in holes."""
    rng = np.random.default_rng(camera.width)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    inverse = 0.4 + 0.3 * u / camera.width + 0.2 * v / camera.height + 0.9 * ((u // 7 + v // 9) % 3 == 0)
    return np.where(rng.random(inverse.shape) < holes, 0, inverse)
