"""What two recordings have besides their logs: a description, and the true geometry of the scene."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.files import read_bytes
from duagc.pipeline.comparison.fields import unequal
from duagc.pipeline.recording import RECORDING_FILE, Recording

MADE_BY = ("source", "converter", "parameters", "options_file")
"""Fields that explain differences, and are none."""
PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}


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
    """Values of the vertices of a binary .ply, by property; of a .ply of another kind its bytes.

    Args:
        path: of the file.
    """
    data = read_bytes(path, "the geometry of a scene")
    head, _, body = data.partition(b"end_header\n")
    rows = re.findall(r"^property (\w+) (\w+)$", head.decode("ascii", errors="replace"), re.MULTILINE)
    if not rows or any(kind not in PLY_TYPES for kind, _ in rows) or b"binary_little_endian" not in head:
        return {"bytes": data}
    row = np.dtype([(name, PLY_TYPES[kind]) for kind, name in rows])
    if len(body) % row.itemsize or head.count(b"\nelement ") != 1:
        return {"bytes": data}
    vertices = np.frombuffer(body, dtype=row)
    return {name: vertices[name] for _, name in rows}


def _without(row: Any, *names: str) -> Any:
    return {k: v for k, v in row.items() if k not in names} if isinstance(row, dict) else row
