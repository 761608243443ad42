"""Images whose rows were taken one after the other, as a shutter would have taken them that opens for all at once.

A rolling shutter reads a row at a time: while the camera turns at 60 degrees a second and is read for 26 ms, the last
row sees the scene 1.6 degrees away from where the first row would have. A log may state how long its images are read
(`COLOR_READOUT_KEY`, `DEPTH_READOUT_KEY`); with the motion of the tracked camera every pixel is then looked up in the
row that saw its point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.depth_sources import DepthImage

Image = NDArray[np.float32]
COLOR_READOUT_KEY, DEPTH_READOUT_KEY = "rolling_shutter_s", "depth_rolling_shutter_s"
"""In the metadata of a log: seconds from the first to the last row of an image, the stamp in the middle of them."""
LONGEST_S = 0.2
LEAST_MOVE_PX = 0.25  # of a pixel between the middle row and its own: less is not worth to interpolate for
STEP_PX = 16  # between the pixels whose motion is computed; that of the others is interpolated
SAMPLE_PX = 4  # between the depths that a mean over a neighborhood is taken of
ROUNDS = 3  # of looking up the row of a pixel; each brings it nearer by as much as the motion changes by row


@dataclass(frozen=True)
class Readout:
    """How long the images of a log are read, seconds; 0: all rows at once.

    Attributes:
        color_s: of color.
        depth_s: of depth.
    """

    color_s: float = 0.0
    depth_s: float = 0.0

    @staticmethod
    def stated(metadata: Mapping[str, str], where: str) -> Readout:
        """As the metadata of a log states it.

        Args:
            metadata: of the log.
            where: its path, for errors.

        Raises:
            DuagError: a time that no camera takes.
        """
        found: list[float] = []
        for key in (COLOR_READOUT_KEY, DEPTH_READOUT_KEY):
            text = metadata.get(key, "0")
            try:
                seconds = float(text)
            except ValueError:
                seconds = math.nan
            if not 0 <= seconds <= LONGEST_S:
                raise DuagError(f"{where}: {key} is {text!r}, expected 0 to {LONGEST_S:g} seconds")
            found.append(seconds)
        return Readout(*found)

    @property
    def rolls(self) -> bool:
        """Whether rows are read one after the other."""
        return self.color_s > 0 or self.depth_s > 0


def row_times_ns(height: int, readout_s: float) -> NDArray[np.int64]:
    """Times [h] of the rows of an image from that of its middle.

    Args:
        height: of the image.
        readout_s: from the first to the last row.
    """
    return np.rint(1e9 * readout_s * (np.arange(height) / max(height - 1, 1) - 0.5)).astype(np.int64)


class Unrolling:
    """Where in a rolling image each pixel of a still one is."""

    def __init__(self, camera: PinholeCamera, T_middle_row: Array, depth_m: Image) -> None:
        """Set up.

        Args:
            camera: of the images.
            T_middle_row: [h, 4, 4], from the camera when a row was taken to the camera in the middle of the readout.
            depth_m: depth [h, w] of about that time, 0 = unknown: parallax is that of its means over a neighborhood.
        """
        self._camera, self._T_row_middle = camera, se3.inverse(T_middle_row)
        rows, columns = _steps(camera.height), _steps(camera.width)
        u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        points = rays / _mean_inverse(depth_m, rows, columns)[..., None]
        found_u, found_v = u, v
        for _ in range(ROUNDS):
            T = self._T_row_middle[np.clip(np.rint(found_v), 0, camera.height - 1).astype(np.int64)]
            there = np.einsum("...ij,...j->...i", T[..., :3, :3], points) + T[..., :3, 3]
            found_u = camera.fx * there[..., 0] / there[..., 2] + camera.cx
            found_v = camera.fy * there[..., 1] / there[..., 2] + camera.cy
        moved = np.stack([found_u - u, found_v - v], axis=-1)
        self.move_px = float(np.median(np.hypot(moved[..., 0], moved[..., 1])))
        self._u, self._v = _interpolated(moved.astype(np.float32), camera.height, camera.width)

    @property
    def is_needed(self) -> bool:
        """Whether pixels move by more than interpolation costs."""
        return self.move_px >= LEAST_MOVE_PX

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colors [h, w, 3], interpolated; beyond the border those at the border.

        Args:
            image: as it was read.
        """
        import cv2

        return np.asarray(
            cv2.remap(image, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )

    def usable(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        """Pixels [h, w] that the rolling image shows, all of whose neighbors there may be used.

        Args:
            mask: bool [h, w]; None: all may.
        """
        import cv2

        shown = np.ones((self._camera.height, self._camera.width), np.float32)
        if mask is not None:
            shown = mask.astype(np.float32)
        return np.asarray(cv2.remap(shown, self._u, self._v, cv2.INTER_LINEAR) > 0.999)

    def depth(self, depth: DepthImage) -> DepthImage:
        """Depth along z of the camera in the middle of the readout; that of the nearest pixel, which mixes no surfaces.

        Args:
            depth: as it was read.
        """
        import cv2

        camera = self._camera

        def nearest(image: Image) -> Image:
            return np.asarray(cv2.remap(image, self._u, self._v, cv2.INTER_NEAREST), dtype=np.float32)

        x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)[None]
        y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)[:, None]
        # z when the row was read, of a point now
        third = self._T_row_middle[:, 2].astype(np.float32)[..., None]
        read_m = nearest(depth.depth_m)
        z = (read_m - third[:, 3]) / (third[:, 0] * x + third[:, 1] * y + third[:, 2])
        found = np.where((read_m > 0) & (z > 0), z, np.float32(0)).astype(np.float32)
        sigma = None if depth.sigma_m is None else np.where(found > 0, nearest(depth.sigma_m), np.float32(0))
        return DepthImage(found, sigma)


def _steps(size: int) -> NDArray[np.int64]:
    """Rows or columns whose motion is computed."""
    return np.unique(np.r_[np.arange(0, size, STEP_PX), size - 1])


@lru_cache(maxsize=4)
def _grids(height: int, width: int) -> tuple[tuple[Image, Image], tuple[Image, Image]]:
    """Columns and rows [h, w] of all pixels, and where these are among those whose motion is computed."""
    sizes = width, height
    at = [np.interp(np.arange(n), _steps(n), np.arange(len(_steps(n)))) for n in sizes]
    pixels, steps = (
        np.meshgrid(*(values.astype(np.float32) for values in two))
        for two in ([np.arange(n) for n in sizes], at)
    )
    return (pixels[0], pixels[1]), (steps[0], steps[1])


def _interpolated(moved: Image, height: int, width: int) -> tuple[Image, Image]:
    """Columns and rows [h, w] in the rolling image of all pixels, by the motion [k, l, 2] of some."""
    import cv2

    pixels, steps = _grids(height, width)
    found = [
        whole + cv2.remap(part, *steps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for whole, part in zip(pixels, cv2.split(moved), strict=True)
    ]
    return found[0], found[1]


def _mean_inverse(depth_m: Image, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    """Mean inverse depth around some pixels; where there is none that of the image, and of 1 m without any."""
    import cv2

    sampled = depth_m[::SAMPLE_PX, ::SAMPLE_PX]
    side = (2 * STEP_PX // SAMPLE_PX + 1,) * 2
    known = sampled > 0
    inverse = np.where(known, 1 / np.where(known, sampled, 1), 0).astype(np.float32)
    share = cv2.blur(known.astype(np.float32), side)
    mean = cv2.blur(inverse, side) / np.maximum(share, 1e-6)
    middle = float(np.median(inverse[known])) if known.any() else 1.0
    around = np.ix_(rows // SAMPLE_PX, columns // SAMPLE_PX)
    return np.where(share > 0.05, mean, middle)[around].astype(np.float64)
