"""How much light of a scene ends up in an image: automatic exposure, drift of the white balance, vignette.

All three are factors of the light; image values are its power 1 / GAMMA.
"""

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ, Degradations
from duagc.converters.simulate.sensors.rig import GAMMA
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.color_comparison import GRAY_OF_RGB

DRIFT_PERIODS_S = (2.5, 7.0)


def metered(color: NDArray[np.uint8]) -> float:
    """Mean light of an image, 0 to 1, as an exposure meter sees it that weighs all pixels alike.

    Args:
        color: [h, w, 3], RGB.
    """
    return float(((color / 255.0) ** GAMMA @ GRAY_OF_RGB).mean())


def exposure_gains(light: Array, degradations: Degradations) -> Array:
    """Gains [n] of an automatic exposure, factors of the light.

    The gain follows, as a first-order low pass of its logarithm, what would make the image before as bright as the mean
    of all; these wishes are scaled such that the largest is the dial. At the first frame it has settled.

    Args:
        light: [n], mean light of every frame at gain 1 (`metered`), 1 / FRAME_RATE_HZ apart.
        degradations: with the dial and the lag.
    """
    wish = np.mean(np.log(np.maximum(light, 1e-6))) - np.log(np.maximum(light, 1e-6))
    largest = np.abs(wish).max()
    if degradations.auto_exposure == 0 or largest < 1e-9:
        return np.ones(len(light))
    wish = np.log1p(degradations.auto_exposure) / largest * wish
    follow = 1.0
    if degradations.exposure_lag_s > 0:
        follow = 1 - np.exp(-1 / (FRAME_RATE_HZ * degradations.exposure_lag_s))
    gains = np.empty(len(light))
    gains[0] = wish[0]
    for i in range(1, len(light)):
        gains[i] = gains[i - 1] + follow * (wish[i - 1] - gains[i - 1])
    return np.exp(gains)


def white_balance_gains(frames: int, degradations: Degradations, seed: int, robot: str) -> Array:
    """Gains [frames, 3] of red, green and blue: red and blue drift slowly, one up as the other goes down.

    Args:
        frames: 1 / FRAME_RATE_HZ apart.
        degradations: with the dial.
        seed: of the drift.
        robot: whose camera.
    """
    if degradations.white_balance == 0:
        return np.ones((frames, 3))
    rng = random_streams.generator(seed, "simulate.white_balance", robot=robot)
    periods_s, phases = rng.uniform(*DRIFT_PERIODS_S, 2), rng.uniform(0, 2 * np.pi, 2)
    times_s = np.arange(frames) / FRAME_RATE_HZ
    drift = np.sin(2 * np.pi * times_s[:, None] / periods_s + phases).mean(axis=1)
    stops = np.log1p(degradations.white_balance) * drift
    return np.exp(np.stack([stops, np.zeros(frames), -stops], axis=1))


def vignette(camera: PinholeCamera, share: float) -> Array:
    """Light [h, w] that a lens lets through: 1 on its axis, falling with the square of the distance from it.

    Args:
        camera: whose principal point is the axis.
        share: of the light that the farthest corner loses.
    """
    u, v = np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy
    distance2 = v[:, None] ** 2 + u**2
    return np.asarray(1 - share * distance2 / distance2.max())


def with_light(color: NDArray[np.uint8], gains: Array, through: Array | None = None) -> NDArray[np.uint8]:
    """An image [h, w, 3] in other light; what is too bright is white.

    Args:
        color: the image.
        gains: [3], factors of the light of red, green and blue.
        through: [h, w], factor of the light at every pixel; None: 1.
    """
    factor = np.broadcast_to(gains, color.shape) if through is None else through[..., None] * gains
    return np.clip(np.rint(color * factor ** (1 / GAMMA)), 0, 255).astype(np.uint8)
