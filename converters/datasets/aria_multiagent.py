"""AriaMultiagent (MAGiC-SLAM): clips of Aria Digital Twin, three robots in one apartment, rendered depth.

SRC is a room, for example `AriaMultiagent/room0`, with folders `agent_0`, `agent_1`, `agent_2`. Color is real, with a
rolling shutter; depth is rendered from the scene's model, without moving things, and beyond 10 m its 16 bits have
wrapped round. The clips were not taken at the same time.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from duagc.converters.layouts import replica_layout
from duagc.pipeline.geometry.camera import PinholeCamera

DATASET = replica_layout.TeamDataset(
    "aria-multiagent",
    re.compile(r"agent_(\d+)"),
    PinholeCamera(512, 512, 280.0, 280.0, 255.5, 255.5),
    depth_scale=10 / 65535,
    sensors={"color": "rolling shutter", "depth": "rendered ground truth"},
    warnings=("the robots were not recorded at the same time",),
)
Options = replica_layout.TeamOptions


def convert(src: Path, out: Path, robots: int = 3, force: bool = False, **options: Any) -> None:
    """Convert a scene, one robot for each folder; see `replica_layout.convert_team`.

    Args:
        src: folder of the room.
        out: folder of the recording.
        robots: how many folders are expected.
        force: replace a recording that is there.
        options: of `TeamOptions`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    replica_layout.convert_team(DATASET, src, out, robots, force=force, options=options)
