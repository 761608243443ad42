"""TUM RGB-D: handheld and robot sequences with motion capture, Kinect v1; and others in this layout.

SRC is a sequence, for example `rgbd_dataset_freiburg1_desk`: `rgb.txt`, `depth.txt` (time, file), `groundtruth.txt`
(pose of the color camera). Depth is registered to the distorted color image: it is undistorted here, color when it is
read. Of other cameras the intrinsics are in `calibration.txt` (`fx fy cx cy`, as ETH3D has it) or an option.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from duagc.converters.layouts import image_folder, tum_layout
from duagc.converters.layouts.image_files import image_size, options_of
from duagc.converters.layouts.image_folder import Clip
from duagc.converters.layouts.kinect import KINECT_READOUT
from duagc.converters.layouts.sound_camera import check_camera
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.rolling_shutter import Readout

DEPTH_SCALE = 1 / 5000
KINECT = "Kinect v1"
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


class Options(tum_layout.SequenceOptions):
    """Camera and association."""

    camera: Literal["auto", "freiburg1", "freiburg2", "freiburg3"] = "auto"
    """Which Kinect; auto takes it from the name of the folder."""
    intrinsics: str = ""
    """Of another camera, `fx fy cx cy` (px) and its distortion `k1 k2 p1 p2 k3` if it has one; before
    `calibration.txt`."""
    depth_scale: float = Field(DEPTH_SCALE, gt=0)
    """Meters per unit of depth."""
    undistort: bool = True
    """Take the lens distortion out of depth, and of color on reading; without, a pinhole camera does not describe
    them."""
    rolling_shutter: Literal["auto", "none"] = "auto"
    """Readout of the images that the log states: auto is that of a first Kinect where the camera is one, none that all
    rows are read at once."""


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert a sequence, cut into contiguous parts.

    Args:
        src: folder of the sequence.
        out: folder of the recording.
        robots: how many parts.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "tum")
    frames, _, warnings = tum_layout.frames_of(src, settings)
    camera, distortion, sensor = _camera(src, settings, frames[0].color)
    if sensor != KINECT and "depth_scale" not in settings.model_fields_set:
        warnings.append(
            f"depth is taken as {DEPTH_SCALE} m per unit, as of a Kinect; expected --set depth_scale=METERS"
        )
    readout = KINECT_READOUT.notes() if sensor == KINECT else {}
    if settings.rolling_shutter == "none":
        readout = Readout().notes()
    clip = Clip(
        "",
        frames,
        camera,
        settings.depth_scale,
        distortion=distortion if settings.undistort else (),
        sensors={"depth": f"{sensor}, registered to color by the dataset"} | readout | settings.notes,
    )
    image_folder.write_parts(
        out, "tum", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def _camera(src: Path, settings: Options, image: Path) -> tuple[PinholeCamera, tuple[float, ...], str]:
    """Camera, distortion and name of the sensor: by the options, its calibration.txt, or the name of the folder."""
    match = re.search(r"(freiburg|(?<![a-z])fr)[123](?!\d)", src.resolve().name)
    stated = src / "calibration.txt"
    if settings.intrinsics:
        return *_stated(settings.intrinsics, "intrinsics", image), "depth camera"
    if settings.camera != "auto":
        return *CAMERAS[settings.camera], KINECT
    if stated.is_file():
        return *_stated(read_text(stated, "fx fy cx cy"), str(stated), image), "depth camera"
    if match:
        return *CAMERAS[f"freiburg{match[0][-1]}"], KINECT
    raise DuagError(
        f"{src}: its name holds none of {', '.join(CAMERAS)}, and it has no calibration.txt; expected "
        "--set intrinsics='fx fy cx cy', or camera=NAME with one of these"
    )


def _stated(text: str, where: str, image: Path) -> tuple[PinholeCamera, tuple[float, ...]]:
    """Camera and distortion by the numbers of a text; the size is that of an image."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 8, 9) or not np.all(np.isfinite(numbers)):
        raise DuagError(
            f"tum: {where}: {text.strip()[:60]!r}, expected fx fy cx cy, or these and k1 k2 p1 p2 k3"
        )
    camera = PinholeCamera(*image_size(image), *numbers[:4])
    check_camera(camera, f"tum: {where}")
    return camera, tuple(numbers[4:])
