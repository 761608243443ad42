"""Trajectories: TUM files, association, alignment, absolute and relative errors."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array, rows_not_finite
from duagc.pipeline.base.decimal_seconds import nanoseconds_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file, read_text
from duagc.pipeline.geometry import se3, so3

LENGTHS = 1e-3, 1e3  # of a quaternion: below it has no direction, above it is none


@dataclass(frozen=True)
class Trajectory:
    """Poses of one body over time.

    Attributes:
        stamps_ns: int64 [n], strictly increasing.
        poses: T_reference_body float64 [n, 4, 4].
    """

    stamps_ns: NDArray[np.int64]
    poses: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> Array:
        """Meters, [n, 3]."""
        return self.poses[:, :3, 3]


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as `timestamp tx ty tz qx qy qz qw`: seconds with nine decimals, full double precision.

    Args:
        path: file to write; it appears when it is complete.
        trajectory: T_reference_body over time, meters.
    Raises:
        ValueError: a pose is not finite.
    """
    _check_finite("trajectory.poses", trajectory.poses)
    quats = so3.to_quat_wxyz(trajectory.poses[:, :3, :3])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, t, q in zip(trajectory.stamps_ns.tolist(), trajectory.positions, quats, strict=True):
        values = " ".join(f"{v:.17g}" for v in (*t, q[1], q[2], q[3], q[0]))
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {values}")
    with new_file(Path(path)) as part:
        part.write_text("\n".join(lines) + "\n")


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory.

    Args:
        path: text file with lines `timestamp tx ty tz qx qy qz qw`; `#` starts a comment.
    Returns:
        T_reference_body over time, meters.
    Raises:
        DuagError: the file cannot be read, a line is not eight finite numbers, or a quaternion is zero or huge.
    """
    stamps, rows = [], []
    text = read_text(Path(path), "a TUM trajectory")
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            row = [float(f) for f in fields[1:]]
            stamp = nanoseconds_of(fields[0])
        except (ValueError, OverflowError):
            row = []
        if len(row) != 7 or not np.all(np.isfinite(row)):
            raise DuagError(f"{path}: line {number} is {line.strip()[:60]!r}, expected eight finite numbers")
        if not LENGTHS[0] <= math.hypot(*row[3:]) <= LENGTHS[1]:
            found = " ".join(fields[4:])
            raise DuagError(f"{path}: line {number} has the quaternion {found}, expected one of length 1")
        stamps.append(stamp)
        rows.append(row)
    if not rows:
        raise DuagError(f"{path}: found no pose, expected lines `timestamp tx ty tz qx qy qz qw`")
    values = np.array(rows)
    poses = se3.from_quat_translation(values[:, [6, 3, 4, 5]], values[:, :3])
    # files of motion capture repeat times, and some go back: of one time the last pose counts, as for the TUM tools
    times, last = np.unique(np.array(stamps, dtype=np.int64)[::-1], return_index=True)
    return Trajectory(times, poses[::-1][last])


def associate(a: Trajectory, b: Trajectory, tolerance_ns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (into a, into b) of paired poses: for each pose of a the nearest of b.

    Every pose of a is in at most one pair. With the shorter trajectory as a, this is the rule of the evo package.

    Args:
        a: whose poses are paired.
        b: where their partners are sought; one may be the nearest of several.
        tolerance_ns: pairs further apart are left out.
    """
    after = np.clip(np.searchsorted(b.stamps_ns, a.stamps_ns), 1, max(len(b) - 1, 1))
    neighbors = np.minimum(np.stack([after - 1, after]), len(b) - 1)
    gaps = np.abs(b.stamps_ns[neighbors] - a.stamps_ns)
    nearest = neighbors[np.argmin(gaps, axis=0), np.arange(len(a))]
    close = np.flatnonzero(np.min(gaps, axis=0) <= tolerance_ns)
    return close, nearest[close]


def align(points_a: ArrayLike, points_b: ArrayLike) -> Array:
    """T_a_b [4, 4] that minimizes sum |a - T_a_b b|^2 over paired points (Horn; no scale).

    Args:
        points_a: [n, 3], meters, frame a.
        points_b: [n, 3], the same points in frame b.

    Raises:
        DuagError: fewer than three pairs, or points on one line: the rotation is not determined.
        ValueError: a position is not finite.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    _check_finite("points_a", a)
    _check_finite("points_b", b)
    if len(a) < 3:
        raise DuagError(f"alignment needs at least 3 paired positions, found {len(a)}")
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    U, S, Vt = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    if S[1] <= 1e-12 * max(S[0], 1e-300):
        raise DuagError("alignment is not determined: the positions lie on one line")
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    return se3.from_rotation_translation(R, mean_a - R @ mean_b)


def ate_rmse_m(positions_true: ArrayLike, positions_estimated: ArrayLike) -> float:
    """Absolute trajectory error after SE(3) alignment: root of the mean squared distance, meters.

    Args:
        positions_true: [n, 3], meters.
        positions_estimated: [n, 3], meters, at the same times, in any frame.
    Raises:
        DuagError: the alignment is not determined.
        ValueError: positions are not finite, not [n, 3], or not as many true ones as estimated ones.
    """
    true, estimated = np.asarray(positions_true), np.asarray(positions_estimated)
    for name, points in (("positions_true", true), ("positions_estimated", estimated)):
        if len(points) and points.shape != (len(true), 3):
            raise ValueError(f"{name} has shape {points.shape}, expected {(len(true), 3)}")
        _check_finite(name, points)
    T = align(true, estimated)
    return float(np.sqrt(np.mean(np.sum((true - se3.transform(T, estimated)) ** 2, axis=1))))


def _check_finite(name: str, rows: Array) -> None:
    """Refuse poses or positions [n, ...] of which some are not finite."""
    bad = rows_not_finite(rows)
    if len(bad):
        raise ValueError(f"{name}: {len(bad)} of {len(rows)} are not finite, the first is {bad[0]}")


def rpe_rmse(poses_true: ArrayLike, poses_estimated: ArrayLike, step: int = 1) -> tuple[float, float]:
    """Relative pose error over `step` poses: RMSE of translation (m) and rotation (rad).

    Args:
        poses_true: [n, 4, 4], n > step.
        poses_estimated: [n, 4, 4] of the same times, in a frame of their own.
        step: number of poses from one to the other.
    """
    true, estimated = np.asarray(poses_true), np.asarray(poses_estimated)
    d_true = se3.inverse(true[:-step]) @ true[step:]
    d_estimated = se3.inverse(estimated[:-step]) @ estimated[step:]
    translation, rotation = se3.distance(d_true, d_estimated)
    return float(np.sqrt(np.mean(translation**2))), float(np.sqrt(np.mean(rotation**2)))
