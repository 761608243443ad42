"""The layout of TUM RGB-D, which other datasets use as well: lists of images with times, poses with times."""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from duagc.converters.layouts.image_files import check_near
from duagc.converters.layouts.image_folder import LAST_NS, FrameFiles, LengthOptions
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.decimal_seconds import nanoseconds_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.config.base import Config
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.pipeline.recording.pairing import TOLERANCE_KEY, TOLERANCE_NS, nearest_indices

LISTS = "rgb.txt", "depth.txt"
QUATERNION = re.compile(r"\bq_?([wxyz])\b")  # components that a comment names


class AssociationOptions(Config):
    """Which depth image belongs to which color image, and where the camera was."""

    association: Literal["all", "official", "nearest"] = "all"
    """`all`: every color image, with the nearest depth image as of its own time, which may be used twice; a run moves
    it by the motion of the camera. `official`: closest pairs first, each image once, as the dataset's associate.py.
    `nearest`: for each color image the nearest depth image, which may be used twice, as most published loaders do. Both
    take depth as of the time of color."""
    max_difference_s: float = Field(0.0, ge=0.0, le=3600.0)
    """Largest difference of their times; 0: 0.1 for `all`, its most, 0.02 for `official`, 0.08 for `nearest`."""
    max_pose_gap_s: float = Field(0.1, gt=0.0, le=3600.0)
    """Poses are interpolated between two measured ones that are no further apart; never beyond the ends."""

    @model_validator(mode="after")
    def _near(self) -> Self:
        if self.keeps_depth_time and self.limit_ns > TOLERANCE_NS:
            raise ValueError(
                f"max_difference_s = {self.max_difference_s:g} with association=all, expected at most "
                f"{TOLERANCE_NS / NANOSECONDS:g}, or --set association=nearest"
            )
        return self

    @property
    def keeps_depth_time(self) -> bool:
        """Whether depth is written as of its own time; if not, as of that of its color."""
        return self.association == "all"

    @property
    def notes(self) -> dict[str, str]:
        """What the metadata of a log say of it: how near depth must be, if nearer than by default."""
        if not self.keeps_depth_time or self.limit_ns == TOLERANCE_NS:
            return {}
        return {TOLERANCE_KEY: repr(self.limit_ns / NANOSECONDS)}

    @property
    def limit_ns(self) -> int:
        """Largest difference of times of color and depth."""
        default = {"all": TOLERANCE_NS / NANOSECONDS, "official": 0.02, "nearest": 0.08}[self.association]
        return round((self.max_difference_s or default) * NANOSECONDS)


class SequenceOptions(AssociationOptions, LengthOptions):
    """Association, and how much of a sequence is converted."""


@dataclass(frozen=True)
class Listed:
    """One line of a list: time and file."""

    stamp_ns: int
    path: Path


def nanoseconds(text: str, where: str) -> int:
    """Decimal seconds as integer nanoseconds, exactly.

    Args:
        text: such as 1305031102.175304.
        where: begins the line of an error.

    Raises:
        DuagError: it is no number, or a time after 2115 or before 1824.
    """
    try:
        time_ns = nanoseconds_of(text)
    except ValueError as error:
        raise DuagError(f"{where}: {text[:60]!r}, expected a time in seconds") from error
    except OverflowError:
        time_ns = LAST_NS
    if abs(time_ns) < LAST_NS:
        return time_ns
    sound = "after the year 1823" if time_ns < 0 else "before the year 2116"
    raise DuagError(f"{where}: {text[:60]!r}, expected a time in seconds {sound}")


def read_list(path: Path) -> list[Listed]:
    """A list of images, in order of time.

    Args:
        path: lines of time (s) and file name, the latter from the folder of the list; # begins a comment.

    Raises:
        DuagError: a line is not a time and a file name, or a time comes twice.
    """
    listed = []
    for number, line in enumerate(read_text(path, "lines of time and file name").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 2:
            raise DuagError(f"{path}:{number}: {line.strip()[:60]!r}, expected a time and a file name")
        listed.append(Listed(nanoseconds(words[0], f"{path}:{number}"), path.parent / words[1]))
    listed.sort(key=lambda entry: entry.stamp_ns)
    for before, after in pairwise(listed):
        if before.stamp_ns == after.stamp_ns:
            raise DuagError(f"{path}: {after.path.name} has the time of {before.path.name}, expected its own")
    if not listed:
        raise DuagError(f"{path}: lists no image, expected lines of time and file name")
    return listed


def associate(
    color: list[Listed], depth: list[Listed], options: AssociationOptions
) -> list[tuple[Listed, Listed]]:
    """Pairs of color and depth, in order of the color's time.

    Args:
        color: in order of time.
        depth: in order of time.
        options: which pairs are taken, and their largest difference of time.
    """
    limit = options.limit_ns
    times = [d.stamp_ns for d in depth]
    if not times:
        return []
    if options.association != "official":
        best = nearest_indices(_array([c.stamp_ns for c in color]), _array(times))
        near = [(c, depth[j]) for c, j in zip(color, best.tolist(), strict=True)]
        return [(c, d) for c, d in near if abs(d.stamp_ns - c.stamp_ns) <= limit]
    candidates = []
    for i, c in enumerate(color):
        first, last = bisect_left(times, c.stamp_ns - limit), bisect_left(times, c.stamp_ns + limit + 1)
        candidates += [(abs(times[j] - c.stamp_ns), i, j) for j in range(first, last)]
    candidates.sort()
    taken_color: set[int] = set()
    taken_depth: set[int] = set()
    pairs = []
    for _, i, j in candidates:
        if i in taken_color or j in taken_depth:
            continue
        taken_color.add(i)
        taken_depth.add(j)
        pairs.append((i, j))
    return [(color[i], depth[j]) for i, j in sorted(pairs)]


def _array(times_ns: list[int]) -> NDArray[np.int64]:
    return np.array(times_ns, dtype=np.int64)


def nearest_s(times_ns: list[int], others_ns: list[int]) -> float:
    """The least difference between sorted times and sorted others, seconds.

    Args:
        times_ns: sorted.
        others_ns: sorted.
    """
    times, others = _array(times_ns), _array(others_ns)
    return float(np.abs(others[nearest_indices(times, others)] - times).min()) / NANOSECONDS


@dataclass(frozen=True)
class Poses:
    """Measured poses: stamps_ns int64 [n], increasing, T_world_body [n, 4, 4]; how many lines were no pose."""

    stamps_ns: NDArray[np.int64]
    T_world_body: Array
    unusable: int

    @staticmethod
    def read(path: Path) -> Poses:
        """From lines `timestamp tx ty tz qx qy qz qw`, also with commas; those that hold no pose are only counted.

        Args:
            path: of the file; times in seconds, positions in meters. Of one time the last pose counts.

        Raises:
            DuagError: a line is not eight numbers, is too far away, or there is no pose; or a comment names qw before
                qx: the angles between such poses would be right, and their axes wrong.
        """
        rows: dict[int, list[float]] = {}
        unusable = 0
        for number, line in enumerate(read_text(path, "lines of time and pose").splitlines(), start=1):
            words = line.replace(",", " ").split()
            where = f"{path}:{number}"
            if not words or words[0].startswith("#"):
                if QUATERNION.findall(line.lower()) == ["w", "x", "y", "z"]:
                    raise DuagError(
                        f"{where}: names qw qx qy qz, expected time (s) x y z qx qy qz qw: put qw last in every line"
                    )
                continue
            try:
                values = [float(word) for word in words[1:]]
            except ValueError:
                values = []
            if len(values) != 7:
                raise DuagError(
                    f"{where}: {line.strip()[:60]!r}, expected eight numbers: time (s) x y z qx qy qz qw"
                )
            if np.all(np.isfinite(values)) and 0.5 < math.hypot(*values[3:]) < 2.0:
                check_near(values[:3], where)
                rows[nanoseconds(words[0], where)] = values
            else:
                unusable += 1
        if not rows:
            raise DuagError(f"{path}: found no pose, expected lines `timestamp tx ty tz qx qy qz qw`")
        stamps = sorted(rows)
        values_of = np.array([rows[s] for s in stamps])
        T = se3.from_quat_translation(values_of[:, [6, 3, 4, 5]], values_of[:, :3])
        return Poses(np.array(stamps, dtype=np.int64), T, unusable)

    def at(self, stamp_ns: int, max_gap_s: float) -> Array | None:
        """Pose [4, 4] at a time: interpolated between two measured ones; None where there are none near.

        Args:
            stamp_ns: by the clock of the poses.
            max_gap_s: largest time between the two measured ones, seconds.
        """
        k = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if k < len(self.stamps_ns) and self.stamps_ns[k] == stamp_ns:
            return self.T_world_body[k]
        if k in (0, len(self.stamps_ns)):
            return None
        before, after = int(self.stamps_ns[k - 1]), int(self.stamps_ns[k])
        if after - before > max_gap_s * NANOSECONDS:
            return None
        share = (stamp_ns - before) / (after - before)
        a, b = self.T_world_body[k - 1], self.T_world_body[k]
        R = a[:3, :3] @ so3.exp(share * so3.log(a[:3, :3].T @ b[:3, :3]))
        return se3.from_rotation_translation(R, a[:3, 3] + share * (b[:3, 3] - a[:3, 3]))

    def missing_words(self, frames_ns: Sequence[int], max_gap_s: float, remedy: str) -> str:
        """Why frames have no pose: by the times of both.

        Args:
            frames_ns: times of the frames, at least one.
            max_gap_s: between poses that are interpolated.
            remedy: for poses of another clock.
        """
        first, last = min(frames_ns), max(frames_ns)
        count = int(((self.stamps_ns >= first) & (self.stamps_ns <= last)).sum())
        ends = (first, last, *self.stamps_ns[[0, -1]].tolist())
        spans = "images are of {:.3f} to {:.3f} s, poses of {:.3f} to {:.3f} s".format(
            *(float(t) / NANOSECONDS for t in ends)
        )
        text = f"{spans}, {count} of {len(self.stamps_ns)} of them among the images"
        if self.stamps_ns[0] > last or self.stamps_ns[-1] < first:
            return f"{text}; expected one clock, or {remedy}"
        after = np.searchsorted(self.stamps_ns, np.setdiff1d(frames_ns, self.stamps_ns))
        inner = after[(after > 0) & (after < len(self.stamps_ns))]
        gaps_s = (self.stamps_ns[inner] - self.stamps_ns[inner - 1]) / NANOSECONDS
        if len(wide_s := gaps_s[gaps_s > max_gap_s]):
            text = f"{text}, {len(wide_s)} images between poses that are {np.median(wide_s):.3f} s apart"
            return f"{text}; expected at most {max_gap_s:g} s, or --set max_pose_gap_s=SECONDS"
        return text


def frames_of(src: Path, options: SequenceOptions) -> tuple[list[FrameFiles], Poses | None, list[str]]:
    """Frames of a sequence with the pose of its body, the poses, and warnings.

    Args:
        src: folder with rgb.txt, depth.txt and, if there is ground truth, groundtruth.txt.
        options: of association and times, and which frames are taken.

    Raises:
        DuagError: a file is missing or broken, or nothing in them belongs together.
    """
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected rgb.txt, depth.txt and groundtruth.txt in it")
    for name in LISTS:
        if not (src / name).is_file():
            found = ", ".join(sorted(path.name for path in src.glob("*.txt"))) or "no list"
            raise DuagError(
                f"{src / name}: No such file, but {found}; expected {' and '.join(LISTS)}, as TUM has them"
            )
    color, depth = options.first(read_list(src / LISTS[0])), read_list(src / LISTS[1])
    pairs: list[tuple[Listed, Listed | None]] = list(associate(color, depth, options))
    if not pairs:
        raise DuagError(
            f"{src / 'depth.txt'}: no image within {options.limit_ns / NANOSECONDS:g} s of one in rgb.txt, "
            "expected pairs"
        )
    warnings = []
    if len(pairs) < len(color):
        warnings.append(f"{len(color) - len(pairs)} of {len(color)} color images have no depth near in time")
    if options.keeps_depth_time:
        partner = {c.stamp_ns: d for c, d in pairs}
        pairs = [(c, partner.get(c.stamp_ns)) for c in color]
    truth = src / "groundtruth.txt"
    poses = Poses.read(truth) if truth.is_file() else None
    if poses is None:
        warnings.append("no groundtruth.txt: no ground truth")
    elif poses.unusable:
        warnings.append(f"{poses.unusable} lines of groundtruth.txt hold no pose")
    frames = [
        FrameFiles(
            number,
            c.stamp_ns,
            c.path,
            None if d is None else d.path,
            T_world_camera=None if poses is None else poses.at(c.stamp_ns, options.max_pose_gap_s),
            depth_stamp_ns=d.stamp_ns if options.keeps_depth_time and d is not None else None,
            T_world_depth=None
            if poses is None or d is None
            else poses.at(d.stamp_ns, options.max_pose_gap_s),
        )
        for number, (c, d) in enumerate(pairs)
    ]
    if poses is not None and all(frame.T_world_camera is None for frame in frames):
        remedy = f"times of {truth.name} by that of rgb.txt"
        times = [frame.stamp_ns for frame in frames]
        warnings.append(
            f"no image has a true pose: {poses.missing_words(times, options.max_pose_gap_s, remedy)}"
        )
    return frames, poses, warnings
