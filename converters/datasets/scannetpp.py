"""ScanNet++: rooms photographed with a DSLR camera, depth rendered from a laser scan.

SRC is a scene. Used are `dslr/nerfstudio/transforms_undistorted.json` and, next to it, `dslr/undistorted_images` and
`dslr/undistorted_depths` (16 bit, millimeters), which are not shipped: make them with the dataset's toolbox. Poses are
camera to world with OpenGL axes. Photographs are not a video: consecutive ones may be far apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from duagc.converters.layouts import image_folder
from duagc.converters.layouts.image_files import options_of, rigid
from duagc.converters.layouts.image_folder import Clip, FrameFiles, stamps_of
from duagc.converters.layouts.sound_camera import check_camera
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_json
from duagc.pipeline.geometry.camera import PinholeCamera

DEPTH_SCALE = 0.001
LENS = "k1", "k2", "k3", "k4", "p1", "p2"  # coefficients of a lens in the notation of nerfstudio
STRAIGHT = "PINHOLE", "SIMPLE_PINHOLE", "OPENCV"  # camera models that are pinholes where these are 0
OPENCV_OF_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Options(image_folder.LengthOptions):
    """Time and choice of images."""

    rate_hz: int = Field(1, gt=0, le=1000)
    """Frames per second; photographs have none."""
    bad: bool = False
    """Take images too that the dataset marks as bad."""


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert a scene, cut into contiguous parts, test images included.

    Args:
        src: folder of the scene.
        out: folder of the recording.
        robots: how many parts.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "scannetpp")
    path = src / "dslr" / "nerfstudio" / "transforms_undistorted.json"
    try:
        content = read_json(path, "cameras and poses of ScanNet++")
        size = int(content["w"]), int(content["h"])
        camera = PinholeCamera(
            *size,
            *(float(content[name]) for name in ("fl_x", "fl_y")),
            *(float(content[name]) - 0.5 for name in ("cx", "cy")),
        )
        rows = [*content["frames"], *content.get("test_frames", [])]
        entries = sorted(
            (
                (
                    str(row["file_path"]),
                    np.array(row["transform_matrix"], dtype=np.float64).reshape(4, 4),
                    row.get("is_bad", False),
                )
                for row in rows
            ),
            key=lambda entry: entry[0],
        )
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise DuagError(
            f"{path}: {type(error).__name__} {error}, expected w, h, fl_x, fl_y, cx, cy and frames"
        ) from error
    _check_undistorted(content, path)
    check_camera(camera, str(path))
    names = Counter(Path(name).name for name, _, _ in entries)  # that of their files here
    for name, count in names.items():
        if count > 1:
            raise DuagError(f"{path}: found {name} {count} times, expected every image once")
    for name, _, is_bad in entries:
        if not isinstance(is_bad, bool):
            raise DuagError(f"{path}: is_bad of {name} is {is_bad!r}, expected true or false")
    taken = [e for e in entries if settings.bad or not e[2]]
    if not taken:
        raise DuagError(f"{path}: names no usable image, expected frames")
    bad = len(entries) - len(taken)
    taken = settings.first(taken)
    stamps = stamps_of(range(len(taken)), settings.rate_hz, str(path))
    frames = [
        FrameFiles(
            number,
            stamp,
            _made(src / "dslr" / "undistorted_images" / Path(name).name),
            _made(src / "dslr" / "undistorted_depths" / f"{Path(name).stem}.png"),
            rigid(T @ OPENCV_OF_OPENGL, f"{path}: {name}"),
        )
        for number, (stamp, (name, T, _)) in enumerate(zip(stamps, taken, strict=True))
    ]
    warnings = ["photographs, not a video: consecutive frames may be far apart", "no time stamps"]
    if bad:
        warnings.append(f"{bad} images are marked as bad and were left out")
    clip = Clip("", frames, camera, DEPTH_SCALE, sensors={"depth": "rendered from a laser scan"})
    image_folder.write_parts(
        out, "scannetpp", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def _check_undistorted(content: Mapping[str, Any], path: Path) -> None:
    """Refuse the camera of images as they were taken."""
    model = content.get("camera_model", STRAIGHT[0])
    if model not in STRAIGHT:
        raise DuagError(
            f"{path}: camera_model is {model!r}, expected {STRAIGHT[0]!r}, as of undistorted images"
        )
    for name in LENS:
        if (value := content.get(name, 0)) != 0:
            raise DuagError(f"{path}: {name} is {value!r}, expected 0, as of undistorted images")


def _made(path: Path) -> Path:
    """A file that the user had to make."""
    if not path.is_file():
        raise DuagError(
            f"{path}: not found; undistorted images and depths are not shipped, expected them from the toolbox of "
            "ScanNet++"
        )
    return path
