"""How far the turns by a gyroscope agree with those by the images, and what corrects them: its bias, how it is mounted.

A log states how its IMU is mounted and says nothing of the bias. Both are often wrong, and rates in degrees look like
rates. So every frame that the images alone determine is compared with the gyroscope, and the last of them correct it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import so3

FEWEST = 10  # turns that a correction needs
MOST = 60  # last turns that are compared
REMOUNTED = 0.5  # of the deviation without it, at most, with a mounting that is estimated
KEPT = 0.9  # of the turns: what frames were registered wrongly is left out
STILL_SIGMAS = 3.0  # of a stated rate: slower turns tell no more of the mounting
LEAST_SPREAD = 0.2  # of the second direction of the rates, by the first: they tell the mounting from there on


@dataclass(frozen=True)
class Turn:
    """A turn between two frames, as mean rates [3] about axes of the camera, rad/s: by gyroscope and by images."""

    by_gyro: Array
    by_images: Array


@dataclass(frozen=True)
class GyroCorrection:
    """What takes turns by the gyroscope to those by the images: rate = R rate - bias.

    Attributes:
        R_camera_gyro: [3, 3], rotation that the stated mounting lacks.
        bias_rad_s: [3], in axes of the camera.
        sigma_rad_s: standard deviation of a corrected rate, each axis, rad/s; 0: not known.
        helps: whether corrected rates predict a turn better than the one before does.
    """

    R_camera_gyro: Array = field(default_factory=lambda: np.eye(3))
    bias_rad_s: Array = field(default_factory=lambda: np.zeros(3))
    sigma_rad_s: float = 0.0
    helps: bool = True

    def corrected(self, R: Array, elapsed_s: float) -> Array:
        """A rotation [3, 3] in some time, as the images would have it.

        Args:
            R: by the gyroscope.
            elapsed_s: the time.
        """
        return np.asarray(so3.exp(self.R_camera_gyro @ so3.log(R) - self.bias_rad_s * elapsed_s))

    def is_still(self, turn: Turn, stated_sigma_rad_s: float) -> bool:
        """Whether neither sensor saw more of a turn than noise.

        Args:
            turn: between two frames.
            stated_sigma_rad_s: standard deviation of a rate that is expected, rad/s.
        """
        rates = self.R_camera_gyro @ turn.by_gyro - self.bias_rad_s, turn.by_images
        return all(float(np.linalg.norm(rate)) < STILL_SIGMAS * stated_sigma_rad_s for rate in rates)

    @staticmethod
    def of(turns: Sequence[Turn], stated_sigma_rad_s: float) -> GyroCorrection:
        """By the last turns; with few of them, none.

        The mounting is corrected only if the turns have more than one axis and agree far better with another one.

        Args:
            turns: in order of time.
            stated_sigma_rad_s: standard deviation of a rate that is expected, rad/s; a gyroscope that keeps it helps.
        """
        if len(turns) < FEWEST:
            return GyroCorrection()
        gyro = np.array([turn.by_gyro for turn in turns])
        images = np.array([turn.by_images for turn in turns])
        found = _with_bias(np.eye(3), gyro, images)
        spread = np.linalg.svd(images - images.mean(axis=0), compute_uv=False)
        if spread[1] > LEAST_SPREAD * spread[0]:
            turned = _with_bias(_mounting(gyro, images), gyro, images)
            found = turned if turned.sigma_rad_s < REMOUNTED * found.sigma_rad_s else found
        steady = _spread(np.diff(images, axis=0))
        return found if found.sigma_rad_s < max(steady, stated_sigma_rad_s) else GyroCorrection(helps=False)


def _mounting(gyro: Array, images: Array) -> Array:
    """Rotation [3, 3] that takes rates to others, each about their mean (Kabsch 1976); then without the worst."""
    kept = np.ones(len(gyro), dtype=bool)
    for _ in range(2):
        center_gyro, center_images = gyro[kept].mean(axis=0), images[kept].mean(axis=0)
        U, _, Vt = np.linalg.svd((images[kept] - center_images).T @ (gyro[kept] - center_gyro))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        off = np.sum(((gyro - center_gyro) @ R.T - (images - center_images)) ** 2, axis=1)
        kept = off <= np.quantile(off, KEPT)
    return np.asarray(R)


def _with_bias(R: Array, gyro: Array, images: Array) -> GyroCorrection:
    """The bias for a mounting, and what is left."""
    off = gyro @ R.T - images
    bias = np.median(off, axis=0)
    return GyroCorrection(R, bias, _spread(off - bias))


def _spread(rates: Array) -> float:
    """Root mean square of rates [n, 3], each axis, without the largest."""
    squares = np.sort(np.sum(rates * rates, axis=1))
    kept = squares[: max(1, int(np.ceil(KEPT * len(squares))))]
    return float(np.sqrt(np.mean(kept) / 3))
