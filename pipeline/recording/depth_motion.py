"""The motion of a camera around a frame, as a curve through the poses of the frames near it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording.gyro_calibration import FEWEST, GyroCorrection, Turn
from duagc.pipeline.recording.motion import GyroPrior
from duagc.pipeline.recording.read import log_metadata

KIND_KEY = "motion_curves"
"""In the metadata of a front end's log: its `CurveKind` as JSON; without it, parabolas."""
REACH_NS = 250_000_000  # from a frame to those by which its motion is known
FRAMES_AROUND = 3  # of these, before and after it
DEGREE, DEGREE_OF_SHAKES = 2, 4  # of the curve through their poses
COMPARED_FRAMES = 100  # of a part, by which the degree is chosen
SHAKES_FROM = 2.0  # times the errors of the higher degree, of a parabola: most of these are motion then


@dataclass(frozen=True)
class CurveKind:
    """How the motion around frames is described.

    Attributes:
        degree: of the curves.
        gyro: correction of the gyroscope that gives the rotations; None: the curves do.
    """

    degree: int = DEGREE
    gyro: GyroCorrection | None = None

    @staticmethod
    def of(part: Trajectory, gyro: GyroPrior | None) -> CurveKind:
        """The kind by how far poses are from curves through those around them.

        Args:
            part: T_map_camera of tracked frames, all in one frame.
            gyro: of the log; None: it has none.
        """
        some = [int(k) for k in evenly_spaced(len(part), min(COMPARED_FRAMES, len(part)))]
        off: dict[int, list[Array]] = {DEGREE: [], DEGREE_OF_SHAKES: []}
        for at in some:
            chosen = _around(part, at)
            if len(chosen) == 2 * FRAMES_AROUND + 1 and chosen[FRAMES_AROUND] == at:
                for degree, of_degree in off.items():
                    of_degree.append(_fitted(part, at, chosen[chosen != at], degree)[-1])
        if not off[DEGREE]:
            return CurveKind()
        degree = _degree_by(off, slice(6))
        correction, off_rad = (None, np.inf) if gyro is None else _compared(part, gyro, some)
        if off_rad < np.median(np.linalg.norm(np.array(off[degree])[:, 3:], axis=1)):
            return CurveKind(_degree_by(off, slice(3)), correction)
        return CurveKind(degree)

    @staticmethod
    def found(frontend: Path) -> CurveKind:
        """As a front end used it.

        Args:
            frontend: frontend.mcap of a robot, or of a component.

        Raises:
            DuagError: the metadata of the log say something else.
        """
        text = log_metadata(frontend).get(KIND_KEY)
        if text is None:
            return CurveKind()
        try:
            said = json.loads(text)
            gyro = None
            if said["gyro"] is not None:
                R, bias = (np.array(said["gyro"][key], dtype=np.float64) for key in ("R_camera_gyro", "bias"))
                gyro = GyroCorrection(R.reshape(3, 3), bias.reshape(3))
            return CurveKind({str(d): d for d in (DEGREE, DEGREE_OF_SHAKES)}[str(said["degree"])], gyro)
        except (KeyError, TypeError, ValueError):
            raise DuagError(f"{frontend}: {KIND_KEY} is {text!r}, expected degree and gyro") from None

    def notes(self) -> dict[str, str]:
        """What the metadata of a log say of it."""
        if self.degree == DEGREE and self.gyro is None:
            return {}
        gyro = None
        if self.gyro is not None:
            R, bias = self.gyro.R_camera_gyro, self.gyro.bias_rad_s
            gyro = {"R_camera_gyro": R.tolist(), "bias": bias.tolist()}
        return {KIND_KEY: json.dumps({"degree": self.degree, "gyro": gyro})}


class DepthMotion:
    """How the camera moved between the times of color and depth, by the poses of its frames.

    A pose that was found with color and depth of different times lies between the two. So the motion is that of a
    smooth curve through the poses of the frames around, not that from one to the next. A parabola would be smoother
    than a camera that shakes: where a curve of higher degree predicts poses from those around them clearly better, what
    a parabola leaves is motion, not the errors of poses.

    A gyroscope that knows the turns between frames better than the curve does gives the rotations, and the curve the
    translations alone.
    """

    def __init__(
        self, *parts: Trajectory, gyro: GyroPrior | None = None, kind: CurveKind | None = None
    ) -> None:
        """Keep the poses; the curve around a frame is fitted when it is first needed.

        Args:
            parts: T_map_camera of the tracked frames; of every part that has a frame of its own.
            gyro: of the log; None: it has none.
            kind: of all curves; None: for each part, that which describes its poses best.
        """
        self._parts, self._gyro, self._kind = parts, gyro, kind
        self._kinds: dict[int, CurveKind] = {}  # by the number of a part
        self._curves: dict[int, _Curve | None] = {}  # by the time of a frame

    def between(self, color_ns: int, depth_ns: int) -> Array | None:
        """T_color_depth [4, 4], from the camera when depth was taken to the camera when color was.

        Args:
            color_ns: time of a frame.
            depth_ns: time of its depth.

        Returns:
            The motion; None where the poses do not say.
        """
        found = self.at(color_ns, np.array([depth_ns], dtype=np.int64))
        return None if found is None else found[0]

    def at(self, color_ns: int, times_ns: NDArray[np.int64]) -> Array | None:
        """T_color_then [n, 4, 4], from the camera at some times to the camera when a color image was taken.

        Args:
            color_ns: time of a frame.
            times_ns: [n], near it.

        Returns:
            The motions; None where the poses do not say.
        """
        if color_ns not in self._curves:
            self._curves[color_ns] = self._curve(color_ns)
        if (found := self._curves[color_ns]) is None:
            return None
        T = found.along(color_ns, times_ns)
        if self._gyro is not None and found.kind.gyro is not None:
            turns = self._gyro.turns(color_ns, times_ns, found.kind.gyro)
            if turns is not None:
                T[:, :3, :3] = turns
        return T

    def _curve(self, color_ns: int) -> _Curve | None:
        """The curve around a frame: by its pose and those near it, or, if it has none, by those before and after it."""
        between = None
        for number, part in enumerate(self._parts):
            after = int(np.searchsorted(part.stamps_ns, color_ns))
            if after < len(part.stamps_ns) and part.stamps_ns[after] == color_ns:
                return self._curve_in(number, after)
            if 0 < after < len(part.stamps_ns) and between is None:
                nearest = min(after - 1, after, key=lambda k: abs(int(part.stamps_ns[k]) - color_ns))
                reached = part.stamps_ns[after] - part.stamps_ns[after - 1] <= 2 * REACH_NS
                between = (number, nearest) if reached else None
        return None if between is None else self._curve_in(*between)

    def _curve_in(self, number: int, at: int) -> _Curve | None:
        """The curve around a frame of a part that has a pose."""
        part = self._parts[number]
        if number not in self._kinds:
            self._kinds[number] = self._kind or CurveKind.of(part, self._gyro)
        kind = self._kinds[number]
        curve = _curve_in(part, at, kind.degree)
        return None if curve is None else _Curve(kind, int(part.stamps_ns[at]), curve)


@dataclass(frozen=True)
class _Curve:
    """Tangents from a frame as a polynomial of seconds, [degree + 1, 6]; around it or, without a pose, next to it."""

    kind: CurveKind
    from_ns: int
    tangents: Array

    def along(self, color_ns: int, times_ns: NDArray[np.int64]) -> Array:
        """T_color_then [n, 4, 4]."""
        here, then = (
            np.vander(1e-9 * (ns - self.from_ns), len(self.tangents)) @ self.tangents
            for ns in (np.array([color_ns]), times_ns)
        )
        return np.asarray(se3.inverse(se3.exp(here)) @ se3.exp(then))


def _around(part: Trajectory, at: int) -> NDArray[np.intp]:
    """Indices of the frames by whose poses the motion of a frame is known, itself among them."""
    near = np.flatnonzero(np.abs(part.stamps_ns - part.stamps_ns[at]) <= REACH_NS)
    first = max(int(np.searchsorted(near, at)) - FRAMES_AROUND, 0)
    first = max(min(first, len(near) - 2 * FRAMES_AROUND - 1), 0)
    return near[first : first + 2 * FRAMES_AROUND + 1]


def _fitted(part: Trajectory, at: int, chosen: NDArray[np.intp], degree: int) -> Array:
    """Tangents from a frame, through the poses of others, as a polynomial of seconds, [degree + 1, 6]."""
    seconds = 1e-9 * (part.stamps_ns[chosen] - part.stamps_ns[at])
    motions = se3.log(se3.inverse(part.poses[at]) @ part.poses[chosen])
    return np.asarray(np.linalg.lstsq(np.vander(seconds, degree + 1), motions, rcond=None)[0])


def _curve_in(part: Trajectory, at: int, degree: int = DEGREE) -> Array | None:
    """Tangents from a frame as a polynomial of seconds, [degree + 1, 6]; None without other frames near it."""
    chosen = _around(part, at)
    if len(chosen) < 2:
        return None
    if len(chosen) <= 2 * FRAMES_AROUND:
        degree = DEGREE if len(chosen) > 3 else 1
    return _fitted(part, at, chosen, degree)


def _degree_by(off: Mapping[int, Sequence[Array]], of_tangents: slice) -> int:
    """Degree of the curves, by how far poses are from those of either degree (m, and rad as if at 1 m)."""
    medians = {
        degree: np.median(np.linalg.norm(np.array(of_degree)[:, of_tangents], axis=1))
        for degree, of_degree in off.items()
    }
    return DEGREE_OF_SHAKES if medians[DEGREE] > SHAKES_FROM * medians[DEGREE_OF_SHAKES] else DEGREE


def _compared(part: Trajectory, gyro: GyroPrior, some: Sequence[int]) -> tuple[GyroCorrection | None, float]:
    """The correction of a gyroscope by turns between frames, and the median of what is left of them, rad."""
    found = []
    for at in some[:-1] if some[-1] == len(part) - 1 else some:
        start_ns, stop_ns = (int(t) for t in part.stamps_ns[at : at + 2])
        motion = gyro.between(start_ns, stop_ns) if stop_ns - start_ns <= REACH_NS else None
        if motion is not None:
            by_images = part.poses[at, :3, :3].T @ part.poses[at + 1, :3, :3]
            found.append((1e-9 * (stop_ns - start_ns), motion.T_start_stop[:3, :3], by_images))
    if len(found) < FEWEST:
        return None, np.inf
    turns = [Turn(so3.log(by_gyro) / s, so3.log(by_images) / s) for s, by_gyro, by_images in found]
    correction = GyroCorrection.of(turns, 0.0)
    left = [so3.log(by_images.T @ correction.corrected(by_gyro, s)) for s, by_gyro, by_images in found]
    return correction, float(np.median(np.linalg.norm(left, axis=1)))
