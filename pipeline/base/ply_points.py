"""Points with normals in a binary .ply, as the geometry of a scene is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError

_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}


def read_points(path: Path) -> NDArray[np.void]:
    """Vertices [n] of a binary little-endian .ply whose only element is `vertex`, by name of the property.

    Args:
        path: of the file.

    Raises:
        DuagError: another kind of .ply, without normals, or cut short.
    """
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if not mark or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise DuagError(f"{path}: not a binary little-endian .ply, expected points with normals")
    elements = [words[1:] for words in lines if words[0] == "element"]
    properties = [words[1:] for words in lines if words[0] == "property"]
    if len(elements) != 1 or elements[0][0] != "vertex" or not elements[0][-1].isdigit():
        raise DuagError(f"{path}: has elements {elements}, expected only 'vertex N'")
    missing = {"x", "y", "z", "nx", "ny", "nz"} - {words[-1] for words in properties}
    if missing or any(words[0] not in _TYPES for words in properties):
        raise DuagError(f"{path}: has properties {properties}, expected scalars with x, y, z, nx, ny, nz")
    row = np.dtype([(words[-1], _TYPES[words[0]]) for words in properties])
    expected = int(elements[0][-1]) * row.itemsize
    if len(body) != expected:
        raise DuagError(f"{path}: {len(body)} bytes of vertices, expected {expected}")
    return np.frombuffer(body, dtype=row)
