"""One color image with its depth, as it is read from a log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks


@dataclass(frozen=True)
class RgbdFrame:
    """One color image with its depth.

    index: position in the log. stamp_ns: when the color was taken. color: uint8 [H, W, 3], RGB; where the mask forbids
    a pixel that of a usable one next to it. depth: float32 [H, W], meters along z, 0 where nothing was measured and
    where the camera never shows the scene. mask: bool [H, W], True = usable, False = not of the scene (the rim of an
    undistorted image, the robot itself), a moving object or otherwise to be ignored; None = all usable.
    depth_offset_ns: how much later the depth was taken. depth_moved: whether it was moved from there into the time of
    the color. depth_sigma: float32 [H, W], standard deviation of the depth in meters, 0 where there is no depth; None =
    unknown. T_camera_moment: after `open_shutter`, [k, 4, 4], k odd, where the camera is meanwhile, seen from the
    middle; None = it stands still.
    """

    index: int
    stamp_ns: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_] | None = None
    depth_offset_ns: int = 0
    depth_sigma: NDArray[np.float32] | None = None
    depth_moved: bool = False
    T_camera_moment: NDArray[np.float64] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the images."""
        images = self.color, self.depth, self.mask, self.depth_sigma
        return sum(image.nbytes for image in images if image is not None)

    @property
    def usable_depth(self) -> NDArray[np.float32]:
        """The depth, 0 also where the mask forbids the pixel."""
        return masks.masked_depth(self.depth, self.mask)
