"""Estimated paths next to the true ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.evaluation import groundtruth, trajectory_errors
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired, TeamError
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder


@dataclass(frozen=True)
class TruePaths:
    """Estimates paired with ground truth, by robot: after and before consensus; and the joint alignment of the team."""

    after: Mapping[str, Paired | Absent]
    before: Mapping[str, Paired | Absent]
    team: TeamError | Absent

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
        alone = len(run.largest_component) < 2
        team = missing[0] if missing and not alone else trajectory_errors.team_error(known)
        return TruePaths(after, before, team)

    def T_gt_world(self, robot: str) -> NDArray[np.float64] | Absent:  # noqa: N802 (a transform)
        """[4, 4]: the joint alignment for robots of the largest component, its own for any other robot.

        Args:
            robot: its name.
        """
        if not isinstance(self.team, Absent) and robot in self.team.ate_rmse_m_of:
            return self.team.T_gt_world
        pairs = self.after[robot]
        return pairs if isinstance(pairs, Absent) else trajectory_errors.alignment([pairs])


def _paired(true: Trajectory | Absent, estimated: Trajectory, rotations: bool) -> Paired | Absent:
    if isinstance(true, Absent):
        return true
    pairs = replace(trajectory_errors.pair(true, estimated), positions_only=not rotations)
    return pairs if len(pairs) else Absent("no frame has a ground-truth pose within 20 ms")
