"""Datasets that are folders of images with a list of poses: what all of their converters share.

A converter says which files make which robot (`Clip`); `write` checks, undistorts and writes them, and moves depth by
the poses as a self-check.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from duagc.converters.layouts.image_files import kept_color, read_color, read_depth
from duagc.converters.layouts.self_check import ReprojectionCheck
from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter, robot_names
from duagc.pipeline.base import determinism
from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import encode_png
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.base.progress import track
from duagc.pipeline.config.base import Config
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, Maps, rectified, seen_by_source
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.pipeline.recording.greatest_depth import unmeasured

Item = TypeVar("Item")
LAST_NS = 1 << 62  # about the year 2116
LOOKED_AT, LOOKED_AT_EVERY = 8, 8  # depth images, the first of a robot, and how far apart


@dataclass(frozen=True)
class FrameFiles:
    """One frame of a dataset.

    Attributes:
        number: in the dataset.
        stamp_ns: time of the color.
        color: file.
        depth: file; None where no depth was taken near in time. Several frames may have the same.
        T_world_camera: [4, 4] where known.
        depth_stamp_ns: time of the depth; None: that of the color.
        T_world_depth: [4, 4], of the camera at that time; None: unknown, or the same as T_world_camera.
    """

    number: int
    stamp_ns: int
    color: Path
    depth: Path | None
    T_world_camera: Array | None = None
    depth_stamp_ns: int | None = None
    T_world_depth: Array | None = None


class LengthOptions(Config):
    """How much of a sequence is converted."""

    frame_limit: int = Field(0, ge=0)
    """Most frames of a sequence, from its first, before it is cut into the parts of robots; 0: all."""

    def first(self, frames: list[Item]) -> list[Item]:
        """The frames that are converted.

        Args:
            frames: of the sequence.
        """
        return frames[: self.frame_limit or None]


@dataclass(frozen=True)
class Clip:
    """What one robot saw.

    Attributes:
        label: in the dataset; of messages and recording.json, not of the log.
        camera: of the depth images, and of the color images unless `color_camera` is given; then color is
            resampled into `camera` (same place, same axes).
        depth_scale: meters per unit.
        no_depth: values that mean none.
        distortion: (k1, k2, p1, p2, k3) of color and depth alike: removed from depth, stated of color; empty: none.
    """

    label: str
    frames: list[FrameFiles]
    camera: PinholeCamera
    depth_scale: float
    no_depth: tuple[int, ...] = (0,)
    distortion: tuple[float, ...] = ()
    color_camera: PinholeCamera | None = None
    sensors: Mapping[str, str] = field(default_factory=dict)

    def cut(self, robots: int, src: Path) -> list[Clip]:
        """Contiguous parts of equal length.

        Args:
            robots: how many parts.
            src: named in the error.

        Raises:
            DuagError: there are fewer frames than robots, or more robots than names.
        """
        robot_names(robots)
        n = len(self.frames)
        if n < robots:
            raise DuagError(f"{src}: found {n} frames, expected at least {robots} for {robots} robots")
        cuts = [i * n // robots for i in range(robots + 1)]
        return [replace(self, frames=self.frames[a:b]) for a, b in pairwise(cuts)]


def stamps_of(numbers: Sequence[int], rate_hz: int, where: str = "the dataset") -> list[int]:
    """Times (ns) of frames of a dataset that has none, from their numbers.

    Args:
        numbers: of the frames; number 0 is at time 0.
        rate_hz: frames per second.
        where: begins the line of an error.

    Raises:
        DuagError: a number is so large that no time is.
    """
    stamps = [number * NANOSECONDS // rate_hz for number in numbers]
    if max(stamps, default=0) >= LAST_NS:
        raise DuagError(f"{where}: frame {max(numbers)} at {rate_hz} Hz, expected one within 146 years")
    return stamps


def write_parts(
    out: Path,
    dataset: str,
    src: Path,
    clip: Clip,
    *,
    robots: int,
    options: Config,
    warnings: Sequence[str],
    force: bool,
) -> None:
    """Write a recording of one sequence, cut into contiguous parts of one robot each.

    Args:
        out: folder of the recording.
        dataset: its name.
        src: where its files are.
        clip: the whole sequence.
        robots: number of parts.
        options: the settings it was made with.
        warnings: what users should know about the recording.
        force: replace a recording that is there.
    Raises:
        DuagError: a file is not what it should be, or depth and poses do not belong together.
    """
    parameters = {"robots": robots, **options.model_dump()}
    write(out, dataset, src, clip.cut(robots, src), parameters=parameters, warnings=warnings, force=force)


def write(
    out: Path,
    dataset: str,
    src: Path,
    clips: Sequence[Clip],
    *,
    parameters: Mapping[str, Any],
    warnings: Sequence[str],
    force: bool,
    names: Sequence[str] = (),
) -> None:
    """Write a recording of clips, one robot each; all start at time 0, as if they had moved together.

    Args:
        out: folder of the recording.
        dataset: its name.
        src: where its files are.
        clips: one for each robot.
        parameters: the settings it was made with.
        warnings: what users should know about the recording.
        force: replace a recording that is there.
        names: of the robots; alpha, bravo, ... by default.
    Raises:
        DuagError: a file is not what it should be, or depth and poses do not belong together.
    """
    determinism.configure_opencv()
    source = {"dataset": dataset, "folder": src.resolve().name, "parts": [c.label for c in clips if c.label]}
    with RecordingWriter(out, "", source, dataset, parameters=dict(parameters), force=force) as recording:
        recording.warnings += warnings
        for name, clip in zip(names or robot_names(len(clips)), clips, strict=True):
            # names of folders are no content; empty, as of a dataset of one clip, whose digest stays what it was
            sensors = {"part": "", **clip.sensors}
            greatest, share = _unmeasured(clip)
            if greatest:
                clip = replace(clip, no_depth=(*clip.no_depth, greatest))
                recording.warnings.append(
                    f"{name}: {share:.0%} of the depth is exactly {greatest * clip.depth_scale:.3f} m, the greatest: "
                    "taken for none"
                )
            with recording.robot(name, clip.camera, clip.depth_scale, sensors) as robot:
                images = _Images(clip)
                robot.set_lens(images.lens)
                robot.set_valid(images.valid)
                check = _write_clip(robot, clip, images, f"{src}: {clip.label}" if clip.label else str(src))
            numbers = {"first_frame": clip.frames[0].number, "last_frame": clip.frames[-1].number}
            recording.checks[name] = {**numbers, **check}
            without = sum(frame.T_world_camera is None for frame in clip.frames)
            if without:
                recording.warnings.append(f"{name}: {without} of {len(clip.frames)} frames have no true pose")


def _unmeasured(clip: Clip) -> tuple[int, float]:
    """The depth, in units, that a camera gives where it measures nothing, and its share; 0: it gives none."""
    held_out = {frame.depth for index, frame in enumerate(clip.frames) if is_held_out(index)}
    files = list(
        dict.fromkeys(f.depth for f in clip.frames if f.depth is not None and f.depth not in held_out)
    )
    some = files[: LOOKED_AT_EVERY * LOOKED_AT : LOOKED_AT_EVERY]
    size = clip.camera.width, clip.camera.height
    greatest, share = unmeasured([read_depth(path, size, no_depth=clip.no_depth) for path in some])
    return int(greatest), share


def _write_clip(robot: RobotWriter, clip: Clip, images: _Images, label: str) -> dict[str, Any]:
    """Write all frames of a robot; returns what the self-check measured."""
    check = ReprojectionCheck(clip.camera, len(clip.frames))
    empty = count = 0
    size = clip.camera.width, clip.camera.height
    start_ns = _start_ns(clip)
    seen: NDArray[np.uint16] | None = None

    def read(task: tuple[FrameFiles, bool]) -> tuple[bytes, str, NDArray[np.uint16] | None]:
        files, new_depth = task
        raw = None
        if new_depth and files.depth is not None:
            raw = images.depth(read_depth(files.depth, size, no_depth=clip.no_depth))
        return *images.color(files.color), raw

    tasks = list(zip(clip.frames, _with_new_depth(clip.frames), strict=True))
    found = zip(clip.frames, in_order(read, tasks), strict=True)
    titled = track(found, f"convert {robot.name}", total=len(tasks))
    for index, (files, (color, color_format, raw)) in enumerate(titled):
        if raw is not None:
            empty, count, seen = empty + int((raw == 0).sum()), count + 1, raw
        if files.depth is not None:
            assert seen is not None
            at_color = files.depth_stamp_ns is None
            T_world_depth = files.T_world_camera if at_color else files.T_world_depth
            if check.needs(index, T_world_depth):
                check.add(index, seen.astype(np.float64) * clip.depth_scale, T_world_depth)
        robot.add_frame(
            files.stamp_ns - start_ns,
            color,
            color_format,
            raw,
            T_world_camera=files.T_world_camera,
            depth_stamp_ns=None if files.depth_stamp_ns is None else files.depth_stamp_ns - start_ns,
        )
    if not count:
        raise DuagError(f"{label}: none of {len(clip.frames)} images has depth near in time, expected some")
    pixels = count * size[0] * size[1]
    return {"without_depth": empty / pixels, **check.result(label)}


def _with_new_depth(frames: Sequence[FrameFiles]) -> list[bool]:
    """Whether the depth of each frame is written with it.

    Depth is written once at its own time, or with every frame that takes it as of the frame's time; frames that share
    it come one after the other.
    """
    written: set[Path] = set()
    new = []
    for files in frames:
        new.append(files.depth is not None and (files.depth not in written or files.depth_stamp_ns is None))
        if files.depth is not None and files.depth_stamp_ns is not None:
            written.add(files.depth)
    return new


def _start_ns(clip: Clip) -> int:
    """The time of the dataset that becomes 0: of the first image of color or depth."""
    stamps = [files.stamp_ns for files in clip.frames[:1]]
    stamps += [files.depth_stamp_ns for files in clip.frames if files.depth_stamp_ns is not None]
    return min(stamps)


class _Images:
    """Color and depth of a clip as they are written: depth without distortion, color in the camera of the depth.

    lens: with which color is taken that is kept as it is; None: it is that of the clip's camera.
    valid: bool [H, W], pixels that are made of pixels of the source where color is resampled here; None: all.
    """

    def __init__(self, clip: Clip) -> None:
        source = clip.color_camera or clip.camera
        self._size = source.width, source.height
        self._maps: Maps | None = None
        self._depth_too = bool(clip.distortion)
        self.lens: Lens | None = None
        self.valid: Mask | None = None
        if clip.distortion or clip.color_camera is not None:
            lens = Lens(source, clip.distortion)
            self._maps = lens.maps(clip.camera)
            if self._size == (clip.camera.width, clip.camera.height):
                self.lens = lens
            else:
                self.valid = seen_by_source(self._maps, *self._size)

    def depth(self, raw: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Depth [H, W]; never interpolated."""
        import cv2

        if self._maps is None or not self._depth_too:
            return raw
        return np.asarray(cv2.remap(raw, *self._maps, cv2.INTER_NEAREST), dtype=np.uint16)

    def color(self, path: Path) -> tuple[bytes, str]:
        """Encoded color: the file's own bytes, or a PNG of an image that got another size."""
        if self._maps is None or self.lens is not None:
            return kept_color(path, self._size)
        return encode_png(rectified(read_color(path, self._size), self._maps)), "png"
