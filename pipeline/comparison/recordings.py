"""What two recordings have besides their logs: a description, and the true geometry of the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_bytes
from duagc.pipeline.base.ply_points import read_points
from duagc.pipeline.comparison.fields import unequal
from duagc.pipeline.recording import RECORDING_FILE, Recording

MADE_BY = ("source", "converter", "parameters", "options_file")
"""Fields that explain differences, and are none."""


def files_of(recording: Path) -> list[str]:
    """Names of the files of a recording that are compared.

    Args:
        recording: its folder.
    """
    return [p.name for p in recording.iterdir() if p.suffix in (".mcap", ".ply") or p.name == RECORDING_FILE]


def description_of(recording: Path) -> dict[str, Any]:
    """What recording.json says of the content.

    Its own name and that of the recording it was calibrated from are left out, like digests: the logs are compared.

    Args:
        recording: its folder.
    """
    found = {k: v for k, v in Recording(recording).description.items() if k not in ("name", *MADE_BY)}
    found["robots"] = {robot: _without(row, "digests") for robot, row in found["robots"].items()}
    if "calibration" in found:
        found["calibration"] = _without(found["calibration"], "recording", "digests")
    return found


def made_otherwise(first: Path, second: Path) -> list[str]:
    """How differently two recordings were made, a line each.

    Args:
        first: folder of a recording.
        second: that of another one.
    """
    sides = [Recording(path).description for path in (first, second)]
    one, other = ({name: side.get(name) for name in MADE_BY} for side in sides)
    return [f"{RECORDING_FILE} {found.text()}" for found in unequal(one, other)]


def points_of(path: Path) -> dict[str, Any]:
    """Values of the points of a .ply, by property; of a .ply of another kind its bytes.

    Args:
        path: of the file.
    """
    try:
        points = read_points(path)
    except DuagError:
        return {"bytes": read_bytes(path, "the geometry of a scene")}
    return {name: points[name] for name in points.dtype.names or ()}


def _without(row: Any, *names: str) -> Any:
    return {k: v for k, v in row.items() if k not in names} if isinstance(row, dict) else row
