"""ReplicaMultiagent (CP-SLAM, MAGiC-SLAM): two robots in one of four Replica scenes, in one world.

SRC is a scene, for example `ReplicaMultiagent/Office-0`, with folders `office_0_part1` and `office_0_part2`. Camera
and depth scale are nowhere in the files; they are those that every published loader uses.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from converters import image_folder, replica_layout
from converters.image_files import options_of
from pipeline.errors import DuagError
from pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE = 1 / 6553.5
PART = re.compile(r".*_part(\d+)")


class Options(replica_layout.LayoutOptions):
    """Time and length."""

    size: str = f"{CAMERA.width}x{CAMERA.height}"
    """Of the images; the camera is that of 1200x680, scaled."""


def convert(src: Path, out: Path, robots: int = 2, force: bool = False, **options: Any) -> None:
    """Convert a scene, one robot for each part.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "replica-multiagent")
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected a scene with folders *_part1, *_part2")
    parts = {int(m[1]): p for p in sorted(src.iterdir()) if (m := PART.fullmatch(p.name)) and p.is_dir()}
    if not parts:
        raise DuagError(f"{src}: found no folder *_partN, expected the parts of a scene")
    if robots != len(parts):
        raise DuagError(
            f"{src}: found {len(parts)} parts for {robots} robots, expected --robots {len(parts)}"
        )
    camera = scaled(CAMERA, settings.size, "replica-multiagent")
    clips, warnings = [], []
    for number in sorted(parts):
        folder = parts[number]
        clip, notes = replica_layout.read_part(folder, folder.name, camera, DEPTH_SCALE, settings)
        clips.append(clip)
        warnings += notes
    parameters = {"robots": robots, **settings.model_dump()}
    image_folder.write(out, "replica-multiagent", src, clips, parameters, warnings, force)


def scaled(camera: PinholeCamera, size: str, dataset: str) -> PinholeCamera:
    """The camera of images of another size, given as WIDTHxHEIGHT."""
    width, cross, height = size.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise DuagError(f"{dataset}: size = {size!r}, expected WIDTHxHEIGHT")
    return camera.scaled(int(width), int(height))
