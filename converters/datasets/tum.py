"""TUM RGB-D: handheld and robot sequences with motion capture, Kinect v1.

SRC is a sequence, for example `rgbd_dataset_freiburg1_desk`: `rgb.txt`, `depth.txt` (time, file), `groundtruth.txt`
(pose of the color camera). Depth is registered to the distorted color image, so both are undistorted together.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from duagc.converters.layouts import image_folder, tum_layout
from duagc.converters.layouts.image_files import options_of
from duagc.converters.layouts.image_folder import Clip
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera

DEPTH_SCALE = 1 / 5000
CAMERAS = {  # intrinsics and (k1, k2, p1, p2, k3), as the dataset's page gives them
    "freiburg1": (
        PinholeCamera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "freiburg2": (
        PinholeCamera(640, 480, 520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "freiburg3": (PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6), ()),
}


class Options(tum_layout.AssociationOptions):
    """Camera and association."""

    camera: Literal["auto", "freiburg1", "freiburg2", "freiburg3"] = "auto"
    """Which Kinect; auto takes it from the name of the folder."""
    undistort: bool = True
    """Take the lens distortion out of color and depth together; without, images stay as they are and a pinhole camera
    does not describe them."""


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert a sequence, cut into `robots` contiguous parts.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "tum")
    camera, distortion = CAMERAS[_which(src, settings)]
    frames, _, warnings = tum_layout.frames_of(src, settings)
    clip = Clip(
        "",
        frames,
        camera,
        DEPTH_SCALE,
        distortion=distortion if settings.undistort else (),
        sensors={"depth": "Kinect v1, registered to color by the dataset"},
    )
    image_folder.write_parts(
        out, "tum", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def _which(src: Path, settings: Options) -> str:
    if settings.camera != "auto":
        return settings.camera
    match = re.search(r"freiburg[123]|fr[123]", src.resolve().name)
    if not match:
        raise DuagError(
            f"{src}: its name holds none of {', '.join(CAMERAS)}, expected --set camera=NAME with one of them"
        )
    return f"freiburg{match[0][-1]}"
