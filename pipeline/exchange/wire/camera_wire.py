"""Bytes of a camera: others need it to know what a keyframe sees, and how finely. Strict as `reader`."""

from __future__ import annotations

import math
import struct

from duagc.pipeline.exchange.wire.reader import Reader
from duagc.pipeline.geometry.camera import MAX_SIDE_PX, PinholeCamera
from duagc.pipeline.network.packets import MalformedError

_CAMERA = struct.Struct("<HHdddd")
MAX_FOCAL_PX = 1e6
"""Of any camera: a telescope."""
LEAST_FOCAL = 0.1
"""Of a side of the image: no pinhole camera sees more than 157 degrees."""


def camera_bytes(camera: PinholeCamera) -> bytes:
    """Bytes of a camera: 36.

    Args:
        camera: pinhole; its size in px, focal lengths and principal point in px.
    """
    return _CAMERA.pack(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def read_camera(reader: Reader) -> PinholeCamera:
    """The camera that comes next.

    Args:
        reader: stands before the 36 bytes; it then stands after them.

    Raises:
        MalformedError: no camera is like that.
    """
    width, height, fx, fy, cx, cy = reader.fields(_CAMERA)
    sides = min(width, height) >= 1 and max(width, height) <= MAX_SIDE_PX
    fields = zip((fx, fy), (width, height), strict=True)
    focal = all(math.isfinite(f) and LEAST_FOCAL * side <= f <= MAX_FOCAL_PX for f, side in fields)
    # a principal point outside the image is that of a part of a larger one
    center = all(math.isfinite(c) and abs(c) <= MAX_SIDE_PX for c in (cx, cy))
    if not (sides and focal and center):
        raise MalformedError(f"{reader.what}: an impossible camera")
    return PinholeCamera(width, height, fx, fy, cx, cy)
