"""How long a camera's shutter is open: as its log states it, or as the front end found it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from duagc.pipeline.recording.read import log_metadata
from duagc.pipeline.recording.stated_times import stated_seconds

STATED_KEY = "exposure_s"
"""In the metadata of a robot's log: seconds, the stamp of an image in the middle of them."""
FOUND_KEY = "shutter_s"
"""In the metadata of a front end's log: seconds; without it, images are drawn sharp."""
LONGEST_S = 1.0


def stated_shutter_s(metadata: Mapping[str, str], where: str) -> float | None:
    """How long the shutter is open by the metadata of a robot's log, seconds; None if they do not say.

    Args:
        metadata: of the log.
        where: its path, for errors.

    Raises:
        DuagError: a time that no video camera takes.
    """
    return stated_seconds(metadata, STATED_KEY, where, most_s=LONGEST_S)


def found_shutter_s(frontend: Path) -> float:
    """How long the shutter is open as the front end used it, seconds; 0: images are sharp.

    Args:
        frontend: frontend.mcap of a robot, or of a component.

    Raises:
        DuagError: a time that no video camera takes.
    """
    return stated_seconds(log_metadata(frontend), FOUND_KEY, str(frontend), most_s=LONGEST_S) or 0.0
