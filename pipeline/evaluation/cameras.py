"""How the robots' cameras see the same colors, as the robots found out (docs/explanation/fusion.md, "Colors")."""

from __future__ import annotations

from typing import Any

from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.runs.folder import RobotRun
from duagc.pipeline.runs.peer_colors import read_peer_colors

CHANNELS = ("red", "green", "blue")
VALUES = ("gain", "offset", "sigma_gain", "sigma_offset")


def section(robot: RobotRun) -> dict[str, Any]:
    """What this robot's camera makes of a color c of the first robot of its component: gain * c + offset.

    Args:
        robot: whose camera it is.

    Returns:
        Gain and offset per channel (colors 0..1) with their standard deviations, and "matches"; Absent
        without a first robot to compare with.
    """
    first = robot.component[0]
    names = [f"{value}_{channel}" for value in VALUES for channel in CHANNELS]
    seen = read_peer_colors(robot.folder / "fused.mcap", robot.robot).get(first)
    if len(robot.component) < 2:
        reason = Absent("this robot met no other robot")
    elif first == robot.robot:
        reason = Absent("the others' cameras are compared with this one")
    else:
        reason = Absent("the run has not recorded how cameras differ")
    if seen is None:
        return dict.fromkeys(names, reason) | {"matches": reason}
    values = [float(x) for value in VALUES for x in getattr(seen, value)]
    return dict(zip(names, values, strict=True)) | {"matches": seen.matches}
