"""What a session is compared with: everything sent to everybody."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.runs.robot_data import RobotData


@dataclass(frozen=True)
class RawAlternative:
    """Bytes of sending everything to every other robot once, without any protocol.

    Attributes:
        maps_and_information: every Gaussian (14 float32) with the part of its information that fusion needs (31
            float32), and every relative pose (40 bytes): the least that would allow the same fusion.
        maps_only: without the information, which allows to render the neighbors' maps and not to fuse them.
    """

    maps_and_information: int
    maps_only: int

    @staticmethod
    def of(data: Sequence[RobotData]) -> RawAlternative:
        """What it takes for a team; components of one robot count as that robot.

        Args:
            data: of all robots, or of their components.
        """
        others = len({robot_of(d.robot) for d in data}) - 1
        gaussians, factors = sum(len(d.gaussians) for d in data), sum(len(d.registrations) for d in data)
        return RawAlternative(
            others * (4 * (14 + 31) * gaussians + 40 * factors), others * (4 * 14 * gaussians + 40 * factors)
        )
