"""ReplicaMultiagent (CP-SLAM, MAGiC-SLAM): two robots in one of four Replica scenes, in one world.

SRC is a scene, for example `ReplicaMultiagent/Office-0`, with folders `office_0_part1` and `office_0_part2`. Camera
and depth scale are nowhere in the files; they are those that every published loader uses.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from duagc.converters.layouts import replica_layout
from duagc.pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE = 1 / 6553.5
PART = re.compile(r".*_part(\d+)")
SENSORS = {"depth": "rendered"}
WARNINGS: tuple[str, ...] = ()
Options = replica_layout.TeamOptions


def convert(src: Path, out: Path, robots: int = 2, force: bool = False, **options: Any) -> None:
    """Convert a scene, one robot for each folder; see `replica_layout.convert_team`."""
    replica_layout.convert_team(
        "replica-multiagent", src, out, robots, force, options, PART, CAMERA, DEPTH_SCALE, SENSORS, WARNINGS
    )
