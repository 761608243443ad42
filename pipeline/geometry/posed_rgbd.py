"""An RGB-D image with the pose it was taken from: what maps are trained, measured and compared on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.exposure import Exposure, unit_color
from duagc.pipeline.geometry.masks import masked_depth


@dataclass(frozen=True)
class PosedRgbd:
    """A registered color and depth image of one camera, with its pose.

    Attributes:
        color: uint8 [H, W, 3], RGB.
        depth_m: float32 [H, W], meters, 0 where nothing was measured.
        T_world_camera: [4, 4], pose of the camera in the frame of the map at hand, a robot's own or the team's.
        mask: bool [H, W], pixels that may be used; None: all.
        depth_sigma_m: float32 [H, W], standard deviation of the depth; None: not known pixel by pixel.
        exposure: of the image; None: as the map.
        T_camera_moment: [k, 4, 4], k odd: where the camera is while its shutter is open, seen from the middle; None: it
            stands still.
        camera: that took it; None: the one at hand.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_world_camera: NDArray[np.float64]
    mask: NDArray[np.bool_] | None = None
    depth_sigma_m: NDArray[np.float32] | None = None
    exposure: Exposure | None = None
    T_camera_moment: NDArray[np.float64] | None = None
    camera: PinholeCamera | None = None

    @property
    def unit_color(self) -> NDArray[np.float32]:
        """float32 [H, W, 3], RGB in the colors of the map, 0..1 and above."""
        return unit_color(self.color, self.exposure)

    @property
    def usable_depth(self) -> NDArray[np.float32]:
        """Depth [H, W] where the mask allows; 0 elsewhere."""
        return masked_depth(self.depth_m, self.mask)
