"""One number for axes, direction of the poses, scale, intrinsics and association: depth moved by the poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.geometry.statistics import MAD_TO_SIGMA

GAP = 10  # frames
PAIRS = 8
STRIDE = 6  # pixels
MIN_PIXELS = 200
MAX_RATIO = 0.02  # of the median depth
ROUGH = 0.5  # of the difference without a motion, below which poses are right and rough: no other convention does that


class ReprojectionCheck:
    """Moves the depth of a frame into a later one by the poses and compares."""

    def __init__(self, camera: PinholeCamera, frames: int, gap: int = GAP) -> None:
        """Choose evenly spread pairs of frames; none is compared yet.

        Args:
            camera: of the depth images.
            frames: how many there are.
            gap: frames between the two of a pair; more where the true poses are known to be rough.
        """
        self._camera = camera
        gap = min(gap, frames - 1)
        starts: list[int] = []
        if gap > 0:
            starts = np.linspace(0, frames - 1 - gap, PAIRS).astype(int).tolist()
        self._second = {start + gap: start for start in starts}  # second frame of a pair -> first
        self._kept: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        self._residuals: list[NDArray[np.float64]] = []
        self._unmoved: list[NDArray[np.float64]] = []
        self._depths: list[NDArray[np.float64]] = []
        self._noise: list[NDArray[np.float64]] = []
        self._stated: list[NDArray[np.float64]] = []
        self._apart_m: list[float] = []  # of the places of pairs with depth

    def needs(self, index: int, T_world_camera: NDArray[np.float64] | None) -> bool:
        """Whether a frame is compared with another.

        Args:
            index: of the frame.
            T_world_camera: its pose, [4, 4]; None: not known.
        """
        return T_world_camera is not None and (index in self._second or index in self._second.values())

    def add(
        self,
        index: int,
        depth_m: NDArray[np.float64],
        T_world_camera: NDArray[np.float64] | None,
        sigma_m: NDArray[np.floating] | None = None,
    ) -> None:
        """Take a frame.

        Args:
            index: of the frame.
            depth_m: [H, W], 0 = none.
            T_world_camera: [4, 4]; None: there is none.
            sigma_m: [H, W], standard deviation of the depth where the sensor states it: neighbors may share errors.
        """
        if T_world_camera is None:
            return
        if index in self._second.values():
            self._kept[index] = (depth_m, T_world_camera)
        if index in self._second and self._second[index] in self._kept:
            first, T_world_first = self._kept.pop(self._second[index])
            self._compare(first, T_world_first, depth_m, T_world_camera)
            if sigma_m is not None:
                self._stated.append(sigma_m[depth_m > 0].astype(np.float64))

    def _compare(
        self,
        first: NDArray[np.float64],
        T_world_first: NDArray[np.float64],
        second: NDArray[np.float64],
        T_world_second: NDArray[np.float64],
    ) -> None:
        points = self._camera.back_project(first)[::STRIDE, ::STRIDE].reshape(-1, 3)
        T_second_first = se3.inverse(T_world_second) @ T_world_first
        points = se3.transform(T_second_first, points[points[:, 2] > 0])
        if len(points) >= MIN_PIXELS <= int(np.count_nonzero(second)):
            self._apart_m.append(float(np.linalg.norm(T_second_first[:3, 3])))
        index, u, v = visible(self._camera, points)
        found, expected = second[v, u], points[index, 2]
        self._residuals.append(np.abs(found - expected)[found > 0])
        self._depths.append(found[found > 0])
        still = np.abs(second - first)[::STRIDE, ::STRIDE]
        self._unmoved.append(still[((first > 0) & (second > 0))[::STRIDE, ::STRIDE]])
        self._noise.append(_noise(second[::STRIDE, ::STRIDE]))

    def result(self, label: str, max_ratio: float = MAX_RATIO) -> dict[str, Any]:
        """Median residual and median depth in meters, None where too little overlaps; and whether poses are rough.

        Where images with depth show too little of each other, "apart_m" says how far they are apart (median).

        Args:
            label: of the source, for the message.
            max_ratio: largest residual as a share of the depth; more where the true poses are known to be
                rough.
        Raises:
            DuagError: the residual is too large, more than the noise of the depth explains, and not far less than
                without a motion: poses, depth and intrinsics do not belong together.
        """
        residuals = np.concatenate([*self._residuals, np.zeros(0)])
        if len(residuals) < MIN_PIXELS:
            apart = {"apart_m": float(np.median(self._apart_m))} if self._apart_m else {}
            return {"reprojection_median_m": None, "median_depth_m": None, **apart}
        residual, depth = float(np.median(residuals)), float(np.median(np.concatenate(self._depths)))
        found: dict[str, Any] = {"reprojection_median_m": residual, "median_depth_m": depth}
        if residual <= max_ratio * depth:
            return found
        noise = max(
            _median(self._noise), np.sqrt(2) / MAD_TO_SIGMA * _median(self._stated)
        )  # of a difference
        wrong = _without(residual, noise)
        if wrong <= max_ratio * depth:
            return found
        if wrong > ROUGH * _without(_median(self._unmoved), noise):
            raise DuagError(
                f"{label}: depth moved by the poses differs by {residual:.3f} m at {depth:.2f} m (medians), expected "
                f"less than {max_ratio:.0%}: poses, intrinsics and depth do not belong together"
            )
        return found | {"rough": True}


def _median(parts: list[NDArray[np.float64]]) -> float:
    values = np.concatenate([*parts, np.zeros(0)])
    return float(np.median(values)) if len(values) else 0.0


def _without(size: float, noise: float) -> float:
    """What is left of a difference without that of noise alone."""
    return float(np.sqrt(max(size**2 - noise**2, 0.0)))


def _noise(depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sizes of the differences that two measurements of samples have by noise alone, as rows are rougher than planes.

    Inverse depth of a plane is linear in the image: the second difference of three samples is noise, but at edges.

    Args:
        depth_m: [h, w], 0 = none.
    """
    inverse = 1 / np.where(depth_m > 0, depth_m, np.nan)
    rough = np.abs(inverse[:, 2:] - 2 * inverse[:, 1:-1] + inverse[:, :-2]) * depth_m[:, 1:-1] ** 2
    return rough[np.isfinite(rough)] * np.sqrt(2 / 6)
