"""The images of one frame, as tracking and registration take them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import RgbdFrame
from duagc.pipeline.registration import RgbdPyramid

Image = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class RgbdImages:
    """Color and depth of one frame.

    Attributes:
        frame_index: in the log.
        stamp_ns: time of the frame.
        image: color [h, w, 3], uint8 or 0..1, or gray [h, w], 0..1.
        depth_m: [h, w], meters, 0 = unknown.
        mask: bool [h, w], False where a pixel must not be used, neither its depth nor its color; None = all may.
        depth_sigma_m: [h, w], standard deviation of the depth, meters; None: that of the sensor model.
        depth_offset_ns: how much later the depth was taken.
        depth_moved: whether it was moved from there; if not, depth of a time too far for a keyframe is moved by the
            velocity of the camera, or left out where that is unknown. What is nearer stays: with most cameras the
            depth of the keyframe is as late.
    """

    frame_index: int
    stamp_ns: int
    image: Image
    depth_m: Image
    mask: NDArray[np.bool_] | None = None
    depth_sigma_m: Image | None = None
    depth_offset_ns: int = 0
    depth_moved: bool = False

    @staticmethod
    def of(frame: RgbdFrame) -> RgbdImages:
        """The images of a frame of a log.

        Args:
            frame: of the log.
        """
        return RgbdImages(
            frame_index=frame.index,
            stamp_ns=frame.stamp_ns,
            image=frame.color,
            depth_m=frame.depth,
            mask=frame.mask,
            depth_sigma_m=frame.depth_sigma,
            depth_offset_ns=frame.depth_offset_ns,
            depth_moved=frame.depth_moved,
        )


def pyramid_of(frame: RgbdFrame, camera: PinholeCamera, levels: int) -> RgbdPyramid:
    """The image pyramid of a frame of a log, without the pixels that its mask forbids.

    Args:
        frame: of the log.
        camera: of the log.
        levels: of the pyramid.
    """
    return RgbdPyramid.build(
        frame.color,
        frame.usable_depth,
        camera,
        levels,
        depth_sigma_m=frame.depth_sigma,
        mask=frame.mask,
    )
