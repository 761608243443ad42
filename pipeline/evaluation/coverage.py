"""How much of every robot's log has a pose, in how many submaps and components, and what was lost and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.evaluation import trajectory_errors
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired
from duagc.pipeline.runs.folder import RobotRun, RunFolder

NO_PIXEL = "no_pixel"


@dataclass(frozen=True)
class LostStretch:
    """Frames in a row of one robot that have no pose, for one reason.

    Attributes:
        robot: whose they are.
        first: index of the first frame.
        last: index of the last frame.
        duration_s: from the first frame to the one after the last.
        reason: as in the log; of a log without a map, that of most of its frames.
    """

    robot: str
    first: int
    last: int
    duration_s: float
    reason: str


def of_robots(run: RunFolder) -> dict[str, dict[str, float | Absent]]:
    """Counts and shares of every robot, its components taken together; of those that have no map too.

    Args:
        run: the run.
    """
    out: dict[str, dict[str, float | Absent]] = {}
    for robot, parts in _parts(run).items():
        frames = run.robots[robot].frames
        hidden = sum(frame.reason == NO_PIXEL for frame in frames)
        posed = len(_posed(parts))
        shown = len(frames) - hidden
        out[robot] = {
            "frames": len(frames),
            "frames_without_pixel": hidden,
            "posed": posed,
            "coverage": posed / shown if shown else Absent("no frame shows anything"),
            "submaps": max(sum(len(part.submaps) for part in parts), 1),
            "components": len({part.component for part in parts}),
        }
    for robot, log in run.unmapped.items():
        hidden = log.frames_without_pixel
        out[robot] = {
            "frames": log.frames,
            "frames_without_pixel": hidden,
            "posed": 0,
            "coverage": 0.0 if hidden < log.frames else Absent("no frame shows anything"),
            "submaps": 0,
            "components": 0,
        }
    return dict(sorted(out.items()))


def of_components(run: RunFolder, paired: Mapping[str, Paired | Absent]) -> dict[str, dict[str, Any]]:
    """Size and error of every component of the team, by the names of its members, joined by +.

    Args:
        run: the run.
        paired: estimates after consensus with their truth, by name.
    """
    total = sum(row["frames"] - row["frames_without_pixel"] for row in _numbers(of_robots(run)))
    out: dict[str, dict[str, Any]] = {}
    for component in sorted({robot.component for robot in run.robots.values()}):
        members = [
            name for name in component if name in run.robots and run.robots[name].component == component
        ]
        posed = sum(frame.status != "lost" for name in members for frame in run.robots[name].frames)
        out["+".join(members)] = {
            "robots": len({robot_of(name) for name in members}),
            "posed": posed,
            "coverage": posed / total if total else Absent("no frame shows anything"),
            "ate_rmse_m": _error([paired[name] for name in members]),
        }
    return out


def lost_stretches(run: RunFolder) -> list[LostStretch]:
    """All frames without a pose in any component, robot by robot, in the order of time.

    Args:
        run: the run.
    """
    out = []
    for robot, parts in _parts(run).items():
        frames, posed = run.robots[robot].frames, _posed(parts)
        reasons = ["" if frame.frame_index in posed else frame.reason or "unknown" for frame in frames]
        first = 0
        for reason, stretch in groupby(reasons):
            after = first + len(list(stretch))
            if reason:
                end = frames[min(after, len(frames) - 1)]
                duration_s = 1e-9 * (end.stamp_ns - frames[first].stamp_ns)
                out.append(LostStretch(robot, first, after - 1, duration_s, reason))
            first = after
    for robot, log in run.unmapped.items():
        out.append(LostStretch(robot, 0, log.frames - 1, log.duration_s, log.reasons[0]))
    return out


def _parts(run: RunFolder) -> dict[str, list[RobotRun]]:
    """The components of every robot, its largest one first."""
    parts: dict[str, list[RobotRun]] = {}
    for name, robot in run.robots.items():
        parts.setdefault(robot_of(name), []).append(robot)
    return parts


def _posed(parts: Sequence[RobotRun]) -> set[int]:
    """Indices of the frames that have a pose in some component of a robot."""
    return {frame.frame_index for part in parts for frame in part.frames if frame.status != "lost"}


def _numbers(rows: Mapping[str, Mapping[str, float | Absent]]) -> list[dict[str, float]]:
    return [{k: v for k, v in row.items() if not isinstance(v, Absent)} for row in rows.values()]


def _error(paired: list[Paired | Absent]) -> float | Absent:
    """Root mean squared position error of members under one alignment."""
    known = [p for p in paired if not isinstance(p, Absent)]
    if len(known) < len(paired):
        return next(p for p in paired if isinstance(p, Absent))
    T_gt_world = trajectory_errors.alignment(known)
    if isinstance(T_gt_world, Absent):
        return T_gt_world
    squared = [trajectory_errors.squared_errors_m2(p, T_gt_world) for p in known]
    return float(np.sqrt(np.mean(np.concatenate(squared))))
