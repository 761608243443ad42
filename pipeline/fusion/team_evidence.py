"""Evidence of a team as it is fused: all robots' rows one after the other, in colors common to the team."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import row_blocks
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.consensus.colors import TeamColors, team_colors
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import Pairs
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.splat.information import INFORMATION_SIZE

Index = NDArray[np.int64]


@dataclass(frozen=True)
class TeamEvidence:
    """Evidence of all robots in common colors, one robot after the other, in order of name.

    Attributes:
        robot: the receiver.
        names: of all robots.
        evidence: by name, world frame, common colors.
        cameras: how the robots' colors relate.
        theta: [rows, 13], of all evidence.
        information: [rows, 31], likewise.
        start: int64 [r + 1], first row of every robot, and the number of rows.
    """

    robot: str
    names: tuple[str, ...]
    evidence: dict[str, Evidence]
    cameras: TeamColors
    theta: Array
    information: Array
    start: Index

    @staticmethod
    def of(robot: str, evidence: Mapping[str, Evidence], pairs: Pairs, context: MapContext) -> TeamEvidence:
        """Bring the evidence of all robots into common colors.

        Args:
            robot: the receiver.
            evidence: by robot, in the world frame, the receiver's own included.
            pairs: (robot a, robot b) -> ids int64 [m, 2] of matched Gaussians, by which colors are compared.
            context: camera and settings.
        """
        names = tuple(sorted(evidence))
        cameras = team_colors(evidence, pairs, context.matching.colors)
        start = np.concatenate([[0], np.cumsum([len(evidence[n]) for n in names])]).astype(np.int64)
        information = np.empty((start[-1], INFORMATION_SIZE))
        for k, name in enumerate(names):
            for rows in row_blocks(len(evidence[name])):
                part = slice(start[k] + rows.start, start[k] + rows.stop)
                information[part] = cameras.to_common(name).of(evidence[name].select(rows)).information
                SHELF.sweep()  # of a long log these are some hundred megabytes, and not looked at again
        information = SHELF.put(information)
        SHELF.sweep(heap=True)
        of_robots = [cameras.to_common(name).parameters(evidence[name]) for name in names]
        theta = SHELF.put(np.concatenate(of_robots))
        del of_robots
        SHELF.sweep(heap=True)
        common_evidence = {
            n: replace(
                evidence[n],
                theta=theta[start[k] : start[k + 1]],
                information=information[start[k] : start[k + 1]],
            )
            for k, n in enumerate(names)
        }
        return TeamEvidence(
            robot, names, common_evidence, cameras, theta=theta, information=information, start=start
        )

    @property
    def own_rows(self) -> Index:
        """Rows of the receiver."""
        me = self.names.index(self.robot)
        return np.arange(self.start[me], self.start[me + 1])

    @property
    def owner(self) -> Index:
        """Index of the robot of every row."""
        return np.repeat(np.arange(len(self.names)), np.diff(self.start))
