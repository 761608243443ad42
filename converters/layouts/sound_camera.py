"""Intrinsics that come from files: refused where no camera has them."""

from __future__ import annotations

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import MAX_SIDE_PX, MIN_SIDE_PX, PinholeCamera

MAX_FOCAL_PX = 1e6


def check_camera(camera: PinholeCamera, where: str) -> None:
    """Refuse intrinsics that no camera has.

    Args:
        camera: by the numbers of a file.
        where: begins the line of an error.
    """
    sides, focals = (camera.width, camera.height), (camera.fx, camera.fy)
    sound = all(MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in sides)
    sound = sound and all(0 < focal < MAX_FOCAL_PX for focal in focals)
    sound = sound and all(abs(center) < MAX_FOCAL_PX for center in (camera.cx, camera.cy))
    if not sound:
        raise DuagError(
            f"{where}: camera {camera}, expected sides of {MIN_SIDE_PX} to {MAX_SIDE_PX} px and sound intrinsics"
        )
