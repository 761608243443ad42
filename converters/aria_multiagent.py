"""AriaMultiagent (MAGiC-SLAM): clips of Aria Digital Twin, three robots in one apartment, rendered depth.

SRC is a room, for example `AriaMultiagent/room0`, with folders `agent_0`, `agent_1`, `agent_2`. Colour is real, with a
rolling shutter; depth is rendered from the scene's model, without moving things, and beyond 10 m its 16 bits have
wrapped round. The clips were not taken at the same time.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from converters import image_folder, replica_layout
from converters.image_files import options_of
from converters.replica_multiagent import scaled
from pipeline.errors import DuagError
from pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(512, 512, 280.0, 280.0, 255.5, 255.5)
DEPTH_SCALE = 10 / 65535
AGENT = re.compile(r"agent_(\d+)")


class Options(replica_layout.LayoutOptions):
    """Time and length."""

    size: str = f"{CAMERA.width}x{CAMERA.height}"
    """Of the images; the camera is that of 512x512, scaled."""


def convert(src: Path, out: Path, robots: int = 3, force: bool = False, **options: Any) -> None:
    """Convert a room, one robot for each agent.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "aria-multiagent")
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected a room with folders agent_0, agent_1, ...")
    agents = {int(m[1]): p for p in sorted(src.iterdir()) if (m := AGENT.fullmatch(p.name)) and p.is_dir()}
    if not agents:
        raise DuagError(f"{src}: found no folder agent_N, expected the agents of a room")
    if robots != len(agents):
        raise DuagError(
            f"{src}: found {len(agents)} agents for {robots} robots, expected --robots {len(agents)}"
        )
    camera = scaled(CAMERA, settings.size, "aria-multiagent")
    clips, warnings = [], ["the robots were not recorded at the same time"]
    for number in sorted(agents):
        folder = agents[number]
        clip, notes = replica_layout.read_part(folder, folder.name, camera, DEPTH_SCALE, settings)
        clips.append(replace(clip, sensors={"color": "rolling shutter", "depth": "rendered ground truth"}))
        warnings += notes
    parameters = {"robots": robots, **settings.model_dump()}
    image_folder.write(out, "aria-multiagent", src, clips, parameters, warnings, force)
