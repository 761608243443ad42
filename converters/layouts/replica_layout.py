"""The layout of the iMAP / NICE-SLAM renders of Replica, which other datasets use as well.

A part is a folder with `results/frameNNNNNN.jpg`, `results/depthNNNNNN.png` (16 bit) and `traj.txt`: one line of 16
numbers per frame, camera to world, x right, y down, z forward. There are no time stamps.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from duagc.converters.layouts.image_files import add_numbered, options_of, rigid
from duagc.converters.layouts.image_folder import Clip, FrameFiles, LengthOptions, stamps_of, write
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry.camera import PinholeCamera

FILE = re.compile(r"(frame|depth)(\d+)\.(jpg|jpeg|png)")


class LayoutOptions(LengthOptions):
    """Time; the dataset has none."""

    rate_hz: int = Field(30, gt=0, le=1000)
    """Frames per second; the dataset has no time stamps."""
    frame_limit: int = Field(0, ge=0)
    """Most frames of each part; 0: all. Published runs on Office-0 of ReplicaMultiagent stop at 1500."""


class TeamOptions(LayoutOptions):
    """Time, length and size of images."""

    size: str = ""
    """Of the images, WIDTHxHEIGHT, if they were scaled; the camera is that of the published size, scaled."""


@dataclass(frozen=True)
class TeamDataset:
    """What all scenes of a dataset have in common that holds a folder for each robot.

    Attributes:
        name: of the dataset.
        folder: pattern of the folders' names; its first group is their number.
        camera: of images of the published size.
        depth_scale: meters per unit of the depth images.
        sensors: what is known about the sensors.
        warnings: what users should know about every recording.
    """

    name: str
    folder: re.Pattern[str]
    camera: PinholeCamera
    depth_scale: float
    sensors: Mapping[str, str]
    warnings: tuple[str, ...] = ()


def convert_team(
    dataset: TeamDataset, src: Path, out: Path, robots: int, *, force: bool, options: Mapping[str, Any]
) -> None:
    """Convert a scene with a folder for each robot.

    Args:
        dataset: what its scenes have in common.
        src: the folder of the scene.
        out: the folder to write.
        robots: how many folders are expected.
        force: replace a recording that is there.
        options: of `TeamOptions`.
    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(TeamOptions, options, dataset.name)
    part, camera = dataset.folder, dataset.camera
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected folders {part.pattern} in it")
    folders: dict[int, Path] = {}
    for folder in sorted(src.iterdir()):
        if (match := part.fullmatch(folder.name)) and folder.is_dir():
            add_numbered(folders, int(match[1]), folder)
    if robots != len(folders):
        raise DuagError(
            f"{src}: found {len(folders)} folders {part.pattern} for {robots} robots, "
            f"expected --robots {len(folders)}"
            if folders
            else f"{src}: found no folder {part.pattern}, expected one for each robot"
        )
    if settings.size:
        camera = _scaled(camera, settings.size, dataset.name)
    clips, notes = [], list(dataset.warnings)
    for number in sorted(folders):
        clip, remarks = read_part(
            folders[number], folders[number].name, camera, dataset.depth_scale, options=settings
        )
        clips.append(replace(clip, sensors=dataset.sensors))
        notes += remarks
    write(
        out,
        dataset.name,
        src,
        clips,
        parameters={"robots": robots, **settings.model_dump()},
        warnings=notes,
        force=force,
    )


def _scaled(camera: PinholeCamera, size: str, dataset: str) -> PinholeCamera:
    """The camera of images of another size, given as WIDTHxHEIGHT."""
    width, cross, height = size.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise DuagError(f"{dataset}: size = {size!r}, expected WIDTHxHEIGHT")
    return camera.scaled(int(width), int(height))


def read_part(
    folder: Path, label: str, camera: PinholeCamera, depth_scale: float, *, options: LayoutOptions
) -> tuple[Clip, list[str]]:
    """The clip of one part, and warnings about what does not fit together.

    Args:
        folder: with results/ and traj.txt.
        label: of the part in the dataset; empty: it is the only one.
        camera: of color and depth.
        depth_scale: meters per unit of depth images.
        options: frame rate, and which frames are taken.

    Raises:
        DuagError: files are missing or broken.
    """
    results, path = folder / "results", folder / "traj.txt"
    if not results.is_dir():
        raise DuagError(f"{results}: no such folder, expected frameNNNNNN.jpg and depthNNNNNN.png in it")
    files: dict[str, dict[int, Path]] = {"frame": {}, "depth": {}}
    for file in sorted(results.iterdir()):
        if match := FILE.fullmatch(file.name):
            add_numbered(files[match[1]], int(match[2]), file)
    color, depth = files["frame"], files["depth"]
    for number in sorted(set(color) ^ set(depth)):
        there, kind = (color[number], "depth") if number in color else (depth[number], "frame")
        raise DuagError(f"{there}: has no partner, expected {kind}{number:06d}.* in the same folder")
    if not color:
        raise DuagError(f"{results}: found no frameNNNNNN.jpg, expected images")
    poses = _read_poses(path)
    numbers = sorted(color)
    usable = [n for n in numbers if n < len(poses)]
    warnings = [f"{label or folder.name}: no time stamps: made from frame numbers at {options.rate_hz} Hz"]
    if len(usable) < len(numbers):
        raise DuagError(f"{path}: has {len(poses)} poses, expected one for frame {numbers[-1]} as well")
    if len(poses) != numbers[-1] + 1:
        warnings.append(f"{label or folder.name}: {len(poses)} poses for frames up to {numbers[-1]}")
    numbers = options.first(numbers)
    stamps = stamps_of(numbers, options.rate_hz, str(results))
    frames = [
        FrameFiles(n, stamp, color[n], depth[n], poses[n]) for n, stamp in zip(numbers, stamps, strict=True)
    ]
    return Clip(label, frames, camera, depth_scale), warnings


def _read_poses(path: Path) -> list[np.ndarray]:
    poses = []
    for number, line in enumerate(read_text(path, "a line of 16 numbers per frame").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            T = np.array(line.split(), dtype=np.float64).reshape(4, 4)
        except ValueError as error:
            raise DuagError(f"{path}:{number}: {error}, expected 16 numbers") from error
        poses.append(rigid(T, f"{path}:{number}"))
    return poses
