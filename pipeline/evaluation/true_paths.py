"""Estimated paths next to the true ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.evaluation import groundtruth, trajectory_errors
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired, TeamError
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder


@dataclass(frozen=True)
class TruePaths:
    """Estimates paired with ground truth, by robot: after and before consensus; and the joint alignment of the team.

    component_of: the robots that share a robot's world, itself among them, by its name.
    """

    after: Mapping[str, Paired | Absent]
    before: Mapping[str, Paired | Absent]
    team: TeamError | Absent
    component_of: Mapping[str, tuple[str, ...]]

    @staticmethod
    def of(run: RunFolder, source: Recording) -> TruePaths:
        """Of a run.

        Args:
            run: the run.
            source: its recording.
        """
        after, before = {}, {}
        for name, robot in run.robots.items():
            true = groundtruth.trajectory(source, name)
            rotations = groundtruth.knows_rotations(source, name)
            after[name] = _paired(true, robot.trajectory, rotations)
            before[name] = _paired(true, robot.odometry, rotations)
        known = {r: p for r in run.largest_component if not isinstance(p := after[r], Absent)}
        missing = [p for r in run.largest_component if isinstance(p := after[r], Absent)]
        alone = len({robot_of(r) for r in run.largest_component}) < 2
        team = missing[0] if missing and not alone else trajectory_errors.team_error(known)
        return TruePaths(after, before, team, {name: robot.component for name, robot in run.robots.items()})

    def T_gt_world(self, robot: str) -> NDArray[np.float64] | Absent:  # noqa: N802 (a transform)
        """[4, 4]: the joint alignment of all robots with ground truth in the component of a robot that has it too.

        Args:
            robot: its name.
        """
        pairs, component = self.after[robot], self.component_of[robot]
        if isinstance(pairs, Absent):
            return pairs
        members = [self.after[name] for name in sorted(self.after) if self.component_of[name] == component]
        return trajectory_errors.alignment([p for p in members if not isinstance(p, Absent)])


def _paired(true: Trajectory | Absent, estimated: Trajectory, rotations: bool) -> Paired | Absent:
    if isinstance(true, Absent):
        return true
    pairs = replace(trajectory_errors.pair(true, estimated), positions_only=not rotations)
    return pairs if len(pairs) else Absent("no frame has a ground-truth pose within 20 ms")
