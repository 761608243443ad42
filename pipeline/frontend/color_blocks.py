"""A frame as its colors are compared with those of others: means over square blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import RgbdFrame, RgbdLog

CLIPPED = (2, 253)
"""Colors of 8 bits beyond are black or saturated: they tell nothing of the gain."""
SAME_SURFACE = 0.03
"""Relative difference of depth up to which two frames show the same surface."""
SMOOTH = 0.02
"""Relative standard deviation of the inverse depth in a block up to which it shows one surface."""
LEAST_WHOLE = 0.7
"""Share of the blocks that show one surface of which every pixel has a depth; below, holes are scattered over the
whole image, and pixels without depth are left out."""
LEAST_KNOWN = 0.5
"""Share of the pixels of a block that then have a depth."""
MOST_ROWS = 16_384
"""Of an image that OpenCV is given: it takes less than 32,767."""
MOST_KEPT_BYTES = 80 << 20
"""Of blocks that are kept: those of a thousand frames with the usual width."""
UNIT_COLORS = np.arange(256, dtype=np.float32) * np.float32(1 / 255)
UNIT_COLORS[: CLIPPED[0]] = UNIT_COLORS[CLIPPED[1] + 1 :] = np.nan
"""Of 8 bits; NaN where they are clipped."""


@dataclass(frozen=True)
class ColorBlocks:
    """A frame as its colors are compared: means over square blocks.

    Attributes:
        camera: of the blocks.
        color: float32 [h, w, 3], 0..1; NaN where a pixel of the block is clipped or masked.
        inverse_depth: float32 [h, w], 1/m; NaN where the block does not show one surface, or is not known.
    """

    camera: PinholeCamera
    color: NDArray[np.float32]
    inverse_depth: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """Bytes of the images."""
        return self.color.nbytes + self.inverse_depth.nbytes

    @staticmethod
    def of(frame: RgbdFrame, camera: PinholeCamera, width_px: int) -> ColorBlocks:
        """Of a whole frame.

        Args:
            frame: color and depth.
            camera: of the frame.
            width_px: about so many columns are left.
        """
        import cv2

        side = max(1, round(camera.width / width_px))
        width, height = camera.width // side, camera.height // side
        rows, columns = slice(height * side), slice(width * side)

        def mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))

        taken = frame.color[rows, columns]
        color = np.asarray(cv2.LUT(taken, UNIT_COLORS), dtype=np.float32)
        scaled = PinholeCamera(
            width=width,
            height=height,
            fx=camera.fx / side,
            fy=camera.fy / side,
            cx=(camera.cx + 0.5) / side - 0.5,
            cy=(camera.cy + 0.5) / side - 0.5,
        )
        if frame.mask is not None:
            color[~frame.mask[rows, columns]] = np.nan
        return ColorBlocks(scaled, mean(color), _inverse_depth(frame.usable_depth[rows, columns], mean))

    def shared_with(self, other: ColorBlocks, T_self_other: Array) -> tuple[Array, Array]:
        """Colors [n, 3] of both frames where they show the same surface.

        Args:
            other: the other frame.
            T_self_other: [4, 4].
        """
        import cv2

        v, u = np.nonzero(np.isfinite(self.inverse_depth) & np.isfinite(self.color).all(axis=2))
        z = 1 / self.inverse_depth[v, u].astype(np.float64)
        there = se3.transform(se3.inverse(T_self_other), projection.back_project(self.camera, u, v, z))
        front = there[:, 2] > projection.NEAR_M
        u, v, there = u[front], v[front], there[front]
        if not len(there):
            return np.zeros((0, 3)), np.zeros((0, 3))
        at = other.camera.project(there).astype(np.float32)
        channels = np.concatenate([other.color, other.inverse_depth[..., None]], axis=2)
        found = np.concatenate(
            [
                cv2.remap(
                    channels,
                    part[:, :1],
                    part[:, 1:],
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_CONSTANT,
                    borderValue=(np.nan,) * 4,
                ).reshape(-1, 4)
                for part in np.split(at, range(MOST_ROWS, len(at), MOST_ROWS))
            ]
        )
        with np.errstate(invalid="ignore"):
            same = np.abs(found[:, 3] * there[:, 2] - 1) < SAME_SURFACE
        same &= np.isfinite(found).all(axis=1)
        return self.color[v[same], u[same]].astype(np.float64), found[same, :3].astype(np.float64)


def _inverse_depth(
    depth_m: NDArray[np.float32], mean: Callable[[NDArray[np.float32]], NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Inverse depth [h, w] of blocks, 1/m, by means over blocks; where holes are scattered, of the pixels without."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth_m > 0, 1 / depth_m, np.float32(np.nan)).astype(np.float32)
        whole = _smooth(mean(inverse), mean(inverse * inverse))
        known = mean((depth_m > 0).astype(np.float32))
        known[known < LEAST_KNOWN] = np.nan
        inverse[depth_m <= 0] = 0
        without_holes = _smooth(mean(inverse) / known, mean(inverse * inverse) / known)
        scattered = np.count_nonzero(whole > 0) < LEAST_WHOLE * np.count_nonzero(without_holes > 0)
    return without_holes if scattered else whole


def _smooth(mean: NDArray[np.float32], mean_square: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of inverse depth over blocks; NaN where a block does not show one surface."""
    same = mean_square - mean * mean <= (SMOOTH * mean) ** 2
    return np.where(same, mean, np.float32(np.nan))


class BlocksOfLog:
    """Blocks of the frames of a log; those of frames that are read for something else are kept.

    Rows that were read one after the other stay so: they move by less than a block. So a frame shows the same when it
    is read again, unless its depth is of another time than its color, and is moved by what is known of the motion then.
    """

    def __init__(self, log: RgbdLog, width_px: int) -> None:
        """Begin with none.

        Args:
            log: of the robot.
            width_px: about so many columns.
        """
        self._log, self._width_px = log, width_px
        self._kept = dict[tuple[int, int], ColorBlocks]()
        self._kept_bytes = 0

    def keep(self, frame: RgbdFrame) -> None:
        """Keep the blocks of a frame, if they may be asked for and are not too many.

        Args:
            frame: of the log, as it was read.
        """
        if (
            self._kept_bytes < MOST_KEPT_BYTES
            and not self._log.frame_offset_ns(frame.index)
            and not is_held_out(frame.index)
        ):
            self._kept[self._log.depth_delay_ns, frame.index] = blocks = self._of(frame)
            self._kept_bytes += blocks.nbytes

    def of(self, index: int) -> ColorBlocks:
        """Blocks of a frame, which are not kept any longer.

        Args:
            index: of the frame in the log.
        """
        kept = self._taken(index)
        return self._of(self._log.frame(index, still=False)) if kept is None else kept

    def forget(self, indices: Iterable[int]) -> None:
        """Keep the blocks of some frames no longer.

        Args:
            indices: of the frames in the log.
        """
        for index in indices:
            self._taken(index)

    def _taken(self, index: int) -> ColorBlocks | None:
        blocks = self._kept.pop((self._log.depth_delay_ns, index), None)
        if blocks is not None:
            self._kept_bytes -= blocks.nbytes
        return blocks

    def _of(self, frame: RgbdFrame) -> ColorBlocks:
        return ColorBlocks.of(frame, self._log.camera, self._width_px)
