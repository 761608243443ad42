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

DATASET = replica_layout.TeamDataset(
    "replica-multiagent",
    re.compile(r".*_part(\d+)"),
    PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5),
    depth_scale=1 / 6553.5,
    sensors={"depth": "rendered"},
)
Options = replica_layout.TeamOptions


def convert(src: Path, out: Path, robots: int = 2, force: bool = False, **options: Any) -> None:
    """Convert a scene, one robot for each folder; see `replica_layout.convert_team`.

    Args:
        src: folder of the scene.
        out: folder of the recording.
        robots: how many folders are expected.
        force: replace a recording that is there.
        options: of `TeamOptions`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    replica_layout.convert_team(DATASET, src, out, robots, force=force, options=options)
