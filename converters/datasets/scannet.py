"""ScanNet v2 as its own SensReader exports it: rooms scanned with a tablet, poses by BundleFusion.

SRC is a scan with `color/N.jpg` (1296x968), `depth/N.png` (640x480, millimeters), `pose/N.txt` (camera to world; -inf
where tracking was lost) and `intrinsic/`, or with all of these in `frames/`. Color is resampled into the camera of
the depth, which lies in the same place.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from duagc.converters.layouts import image_folder
from duagc.converters.layouts.image_files import add_numbered, options_of, rigid
from duagc.converters.layouts.image_folder import Clip, FrameFiles, stamps_of
from duagc.converters.layouts.sound_camera import check_camera
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image, read_bytes, read_text
from duagc.pipeline.geometry.camera import PinholeCamera

DEPTH_SCALE = 0.001
OFF_CENTER = 0.25  # share of the side: intrinsics of images that were scaled are farther off


class Options(image_folder.LengthOptions):
    """Time; exported scans have none."""

    rate_hz: int = Field(30, gt=0, le=1000)
    """Frames per second."""


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert a scan, cut into contiguous parts. Frames without a pose are kept, without ground truth.

    Args:
        src: folder of the scan.
        out: folder of the recording.
        robots: how many parts.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "scannet")
    root = src / "frames" if (src / "frames").is_dir() else src
    color, depth, pose = (_numbered(root / kind) for kind in ("color", "depth", "pose"))
    numbers = sorted(set(color) & set(depth))
    if not numbers:
        raise DuagError(f"{root}: no number is both in color/ and in depth/, expected N.jpg and N.png")
    numbers = settings.first(numbers)
    warnings = [f"no time stamps: made from frame numbers at {settings.rate_hz} Hz"]
    alone = len(set(color) ^ set(depth))
    if alone:
        warnings.append(f"{alone} images have no partner and were left out")
    camera = _camera(root / "intrinsic" / "intrinsic_depth.txt", depth[numbers[0]])
    color_camera = _camera(root / "intrinsic" / "intrinsic_color.txt", color[numbers[0]])
    frames = [
        FrameFiles(n, stamp, color[n], depth[n], _read_pose(pose[n]) if n in pose else None)
        for n, stamp in zip(numbers, stamps_of(numbers, settings.rate_hz, str(root)), strict=True)
    ]
    clip = Clip("", frames, camera, DEPTH_SCALE, color_camera=color_camera)
    image_folder.write_parts(
        out, "scannet", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def _numbered(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise DuagError(
            f"{folder}: no such folder, expected files named by number, as SensReader/python of ScanNet exports a .sens"
        )
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.stem.isdecimal():
            add_numbered(found, int(path.stem), path)
    return found


def _camera(path: Path, image: Path) -> PinholeCamera:
    """Intrinsics of a 4x4 file, with the size of an image."""
    import cv2

    try:
        K = np.array(read_text(path, "4x4 intrinsics").split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise DuagError(f"{path}: {error}, expected 4x4 numbers") from error
    pixels = decode_image(read_bytes(image, "an image"), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise DuagError(f"{image}: no decoder reads it, expected an image")
    height, width = pixels.shape[:2]
    center = K[0, 2] / width, K[1, 2] / height
    if not all(0.5 - OFF_CENTER < share < 0.5 + OFF_CENTER for share in center):
        raise DuagError(
            f"{path}: center {K[0, 2]:g}, {K[1, 2]:g} px, expected that of images of {width}x{height}, as {image.name}"
        )
    camera = PinholeCamera(width, height, *(float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))))
    check_camera(camera, str(path))
    return camera


def _read_pose(path: Path) -> np.ndarray | None:
    """T_world_camera [4, 4]; None where tracking was lost."""
    try:
        T = np.array(read_text(path, "4x4 numbers").split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise DuagError(f"{path}: {error}, expected 4x4 numbers") from error
    return rigid(T, str(path)) if np.all(np.isfinite(T)) else None
