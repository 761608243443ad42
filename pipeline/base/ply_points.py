"""Points with normals in a binary .ply: the geometry of a scene, and point clouds for other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import MOST_OF_LINE, new_file

_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}
MOST_DIGITS = 18  # of a number of vertices; Python refuses to read thousands


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
    counted = [words[:1] for words in elements] == [["vertex"]] and elements[0][-1].isdecimal()
    if not counted or len(elements[0][-1]) > MOST_DIGITS:
        raise DuagError(f"{path}: has elements {str(elements)[:MOST_OF_LINE]}, expected only 'vertex N'")
    names = [words[1] for words in properties if len(words) == 2 and words[0] in _TYPES]
    missing = {"x", "y", "z", "nx", "ny", "nz"} - set(names)
    if missing or len(set(names)) < len(properties):
        raise DuagError(f"{path}: has properties {properties}, expected scalars with x, y, z, nx, ny, nz")
    row = np.dtype([(name, _TYPES[kind]) for kind, name in properties])
    expected = int(elements[0][-1]) * row.itemsize
    if len(body) != expected:
        raise DuagError(f"{path}: {len(body)} bytes of vertices, expected {expected}")
    return np.frombuffer(body, dtype=row)


def write_points(
    path: Path,
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    colors: NDArray[np.uint8],
    **further: NDArray[np.floating],
) -> None:
    """Write a binary little-endian .ply whose only element is `vertex`; floating-point numbers in float32.

    Args:
        path: the file to write.
        points: [n, 3], m.
        normals: [n, 3], unit length, in the frame of the points.
        colors: [n, 3], RGB.
        further: [n] each, by the name of the property.

    Raises:
        DuagError: it cannot be written there.
    """
    properties = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [(name, "u1") for name in ("red", "green", "blue")]
    properties += [(name, "<f4") for name in further]
    rows = np.zeros(len(points), dtype=properties)
    columns = [*points.T, *normals.T, *colors.T, *further.values()]
    for (name, _), values in zip(properties, columns, strict=True):
        rows[name] = values
    words = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property {words[kind]} {name}" for name, kind in properties),
        "end_header\n",
    ]
    with new_file(path) as part:
        part.write_bytes("\n".join(header).encode() + rows.tobytes())
