"""True geometry of a scene as a .ply file."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.files import new_file


def write_points(
    path: Path, points: NDArray[np.float64], normals: NDArray[np.float64], colors: NDArray[np.uint8]
) -> None:
    """Write a binary .ply of points.

    Args:
        path: the file to write.
        points: [n, 3], m, world frame.
        normals: [n, 3], unit length.
        colors: [n, 3], RGB.
    """
    row = np.dtype([("points", "<f4", 3), ("normals", "<f4", 3), ("colors", "u1", 3)])
    rows = np.zeros(len(points), dtype=row)
    rows["points"], rows["normals"], rows["colors"] = points, normals, colors
    properties = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *properties,
        "end_header",
        "",
    ]
    with new_file(path) as part:
        part.write_bytes("\n".join(header).encode() + rows.tobytes())
