"""ICL-NUIM: rendered living room and office, exact depth and poses.

SRC is a sequence in the TUM-compatible form, for example `living_room_traj0_frei_png`: `associations.txt` (number and
file of depth, then of color) and `*.gt.freiburg`. The poses are of a world with y up while the images are top-down:
both are reflected at the xz plane, T' = S T S with S = diag(1, -1, 1, 1). The offices and the first living room have
no pose for their first image, which is kept without one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from duagc.converters.layouts import image_folder
from duagc.converters.layouts.image_files import options_of
from duagc.converters.layouts.image_folder import Clip, FrameFiles, stamps_of
from duagc.converters.layouts.tum_layout import Poses
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.messages.parts import NANOSECONDS

DEPTH_SCALE = 1 / 5000
CAMERA = PinholeCamera(640, 480, 481.20, 480.00, 319.50, 239.50)
S = np.diag([1.0, -1.0, 1.0, 1.0])


class Options(image_folder.LengthOptions):
    """Time and numbering."""

    rate_hz: int = Field(30, gt=0, le=1000)
    """Frames per second; the dataset numbers its frames."""
    first_pose: Literal["auto", "0", "1"] = "auto"
    """Number of the pose of image 0: some archives count images from 0 and poses from 1. auto: 0 if every image then
    has a pose, else 1; 0 too if only the first image has none."""


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
    settings = options_of(Options, options, "icl-nuim")
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected associations.txt and *.gt.freiburg in it")
    images = _read_associations(src / "associations.txt")
    poses, path = _read_poses(src)
    shift = _shift(images, poses, settings, path)
    numbers = settings.first(sorted(images))
    stamps = stamps_of(numbers, settings.rate_hz, str(src))
    frames = [
        FrameFiles(n, stamp, images[n][1], images[n][0], poses.get(n + shift))
        for n, stamp in zip(numbers, stamps, strict=True)
    ]
    warnings = [f"no time stamps: made from frame numbers at {settings.rate_hz} Hz"]
    if shift:
        warnings.append("poses count from 1, images from 0")
    clip = Clip("", frames, CAMERA, DEPTH_SCALE, sensors={"depth": "rendered"})
    image_folder.write_parts(
        out, "icl-nuim", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def _read_associations(path: Path) -> dict[int, tuple[Path, Path]]:
    """Number of the color image -> files of depth and color."""
    images = {}
    for number, line in enumerate(read_text(path, "number and file, of depth and color").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 4 or not words[2].isdecimal():
            raise DuagError(
                f"{path}:{number}: {line.strip()[:60]!r}, expected number and file of depth, then of color"
            )
        if int(words[2]) in images:
            raise DuagError(f"{path}:{number}: found image {int(words[2])} again, expected every image once")
        images[int(words[2])] = path.parent / words[1], path.parent / words[3]
    if not images:
        raise DuagError(f"{path}: lists no image, expected number and file of depth, then of color")
    return images


def _read_poses(src: Path) -> tuple[dict[int, np.ndarray], Path]:
    """Poses of the images' world by their number."""
    found = sorted(src.glob("*.gt.freiburg"))
    if len(found) != 1:
        raise DuagError(f"{src}: found {len(found)} files *.gt.freiburg, expected one")
    poses = Poses.read(found[0])
    numbers = (poses.stamps_ns // NANOSECONDS).tolist()
    if len(again := set(numbers)) < len(numbers):
        raise DuagError(
            f"{found[0]}: {len(numbers)} poses have {len(again)} numbers, expected whole numbers of images, not times"
        )
    return dict(zip(numbers, S @ poses.T_world_body @ S, strict=True)), found[0]


def _shift(images: dict[int, Any], poses: dict[int, Any], settings: Options, path: Path) -> int:
    """What to add to the number of an image to get that of its pose; the first image may have none."""
    shifts = (0, 1) if settings.first_pose == "auto" else (int(settings.first_pose),)
    numbers = sorted(images)
    for without in (0, 1):
        for shift in shifts:
            if len(numbers) > without and all(n + shift in poses for n in numbers[without:]):
                return shift
    missing = next(n for n in numbers if n + shifts[-1] not in poses)
    raise DuagError(
        f"{path}: has no pose for image {missing}, expected one for every image but the first (--set first_pose=0 "
        "or 1: number of the pose of image 0)"
    )
