"""Gaussians as an INRIA-style .ply, the file that every splat viewer reads.

binary_little_endian 1.0, one `element vertex N`, all `property float`, in this order: x y z nx ny nz f_dc_0..2
opacity scale_0..2 rot_0..3 (degree 0: no f_rest). Scales are logarithms of meters, opacity is a logit, rot is a
unit quaternion wxyz, color = 0.5 + 0.28209479 f_dc, normals are zero; x right, y down, z forward, meters, in the
frame of the Gaussians that were given. ids and anchors are not part of the format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import MOST_OF_LINE, check_file, new_file
from duagc.pipeline.base.ply_points import MOST_DIGITS
from duagc.pipeline.splat.gaussians import Gaussians

SH_DEGREE_0 = 0.28209479177387814  # color = 0.5 + SH_DEGREE_0 * coefficient
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_HEADER_LIMIT_BYTES = 1 << 16


def write_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians to `path` atomically; the file is re-read and checked before it takes its name.

    Args:
        path: file to write, in the degree-0 layout that 3DGS viewers read.
        gaussians: n Gaussians; ids and anchors are not kept.
    Raises:
        DuagError: a parameter is not finite or a quaternion has no length; the message names the file.
    """
    path = Path(path)
    norms = np.linalg.norm(gaussians.quats_wxyz.astype(np.float64), axis=1, keepdims=True)
    table = np.zeros((len(gaussians), len(PROPERTIES)), dtype="<f4")
    table[:, 0:3] = gaussians.means
    table[:, 6:9] = (gaussians.colors.astype(np.float64) - 0.5) / SH_DEGREE_0
    table[:, 9] = gaussians.opacity_logits
    table[:, 10:13] = gaussians.log_scales
    table[:, 13:17] = gaussians.quats_wxyz / np.where(norms > 0, norms, 1.0)
    if not np.isfinite(table).all() or not (norms > 0).all():
        raise DuagError(
            f"{path.name}: not written, a Gaussian has a value that is not finite or no orientation"
        )
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(gaussians)}",
            *(f"property float {name}" for name in PROPERTIES),
            "end_header\n",
        ]
    )
    with new_file(path) as part:
        with part.open("wb") as file:
            file.write(header.encode("ascii"))
            file.write(table.tobytes())
        if not np.array_equal(_read_table(part), table):
            raise DuagError(f"{path.name}: what was written reads back differently; is the disk full?")


def read_ply(path: str | Path) -> Gaussians:
    """Read a degree-0 3DGS .ply; ids count from 0 in file order and every anchor is 0.

    Args:
        path: file to read.
    Raises:
        DuagError: not such a file, or values out of range (scales or opacity that were already activated).
    """
    path = Path(path)
    table = _read_table(path)
    norms = np.linalg.norm(table[:, 13:17].astype(np.float64), axis=1)
    if not np.isfinite(table).all():
        raise DuagError(f"{path}: has values that are not finite")
    if len(table) and np.abs(norms - 1.0).max() > 1e-3:
        raise DuagError(f"{path}: rot_0..3 has length {norms.min():.3g}..{norms.max():.3g}, expected 1")
    if len(table) and table[:, 10:13].max() > np.log(1e4):
        raise DuagError(f"{path}: scale_0..2 reach {table[:, 10:13].max():.3g}, expected log of meters")
    opacity = table[:, 9]
    if len(table) and table[:, 10:13].min() > 0 and opacity.min() >= 0 and opacity.max() <= 1:
        raise DuagError(
            f"{path}: scale_0..2 are {table[:, 10:13].min():.3g} or more and opacity is "
            f"{opacity.min():.3g}..{opacity.max():.3g}, expected log of meters and logits: were they activated?"
        )
    return Gaussians(
        ids=np.arange(len(table), dtype=np.int64),
        anchors=np.zeros(len(table), np.int32),
        means=table[:, 0:3],
        quats_wxyz=table[:, 13:17],
        log_scales=table[:, 10:13],
        colors=(0.5 + SH_DEGREE_0 * table[:, 6:9].astype(np.float64)).astype(np.float32),
        opacity_logits=table[:, 9],
    )


def gaussians_in_ply(path: Path) -> int:
    """How many Gaussians a degree-0 3DGS .ply says that it holds; only its header is read.

    Args:
        path: of the file.
    Raises:
        DuagError: it is not such a file.
    """
    return _layout(path)[0]


def _read_table(path: Path) -> NDArray[np.float32]:
    """The vertices as float32 [n, 17] after a strict check of the header and of the file's length."""
    count, start, size = _layout(path)
    expected = count * 4 * len(PROPERTIES)
    if size - start != expected:
        raise DuagError(f"{path}: {size - start} bytes of vertices, expected {expected}")
    try:
        table = np.fromfile(path, dtype="<f4", offset=start)
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected a map") from error
    return table.reshape(-1, len(PROPERTIES))


def _layout(path: Path) -> tuple[int, int, int]:
    """How many vertices a file says that it holds, at which byte they begin, and its size in bytes."""
    size = check_file(path, "a map")
    try:
        with path.open("rb") as file:
            return *_head(file.read(_HEADER_LIMIT_BYTES), path), size
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected a map") from error


def _head(data: bytes, path: Path) -> tuple[int, int]:
    """How many vertices follow a strictly checked header, and at which byte."""
    end = data.find(b"end_header\n", 0, _HEADER_LIMIT_BYTES)
    if not data.startswith(b"ply\n") or end < 0:
        raise DuagError(f"{path}: not a .ply file, expected a map of Gaussians")
    lines = data[:end].decode("ascii", errors="replace").splitlines()[1:]
    lines = [line for line in lines if not line.startswith(("comment", "obj_info"))]
    if len(lines) < 2 or lines[0] != "format binary_little_endian 1.0":
        raise DuagError(f"{path}: format is {lines[:1]}, expected binary_little_endian 1.0")
    words = lines[1].split()
    counted = len(words) == 3 and words[:2] == ["element", "vertex"] and words[2].isdigit()
    if not counted or len(words[2]) > MOST_DIGITS:
        raise DuagError(f"{path}: first element is '{lines[1][:MOST_OF_LINE]}', expected 'element vertex N'")
    if lines[2:] != [f"property float {name}" for name in PROPERTIES]:
        raise DuagError(f"{path}: properties differ from {' '.join(PROPERTIES)}, all float, in this order")
    return int(words[2]), end + len(b"end_header\n")
