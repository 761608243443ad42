"""Points in .ply files: read as they were written; what is no such file is one line."""

from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.ply_points import read_points, write_points

PROPERTIES = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))


def test_points_are_read_as_they_were_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(2, 5, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (5, 3), dtype=np.uint8)
    write_points(tmp_path / "a.ply", points, normals, colors, sigma_m=np.array([1, 2, 3, 4, np.nan]))
    rows = read_points(tmp_path / "a.ply")
    assert rows.dtype.names == ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "sigma_m")
    for names, values in ((("x", "y", "z"), points), (("nx", "ny", "nz"), normals)):
        np.testing.assert_array_equal(np.stack([rows[name] for name in names], axis=1), values)
    np.testing.assert_array_equal(np.stack([rows[n] for n in ("red", "green", "blue")], axis=1), colors)
    np.testing.assert_array_equal(rows["sigma_m"], np.float32([1, 2, 3, 4, np.nan]))


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("element vertex 0\n", "has properties"),
        ("element\n" + PROPERTIES, "has elements"),
        ("element vertex\n" + PROPERTIES, "has elements"),
        ("element vertex 0\nelement face 0\n" + PROPERTIES, "has elements"),
        ("element vertex 0\nproperty\n" + PROPERTIES, "has properties"),
        ("element vertex 0\n" + PROPERTIES + "property float x\n", "has properties"),
        ("element vertex 0\n" + PROPERTIES + "property list uchar int x\n", "has properties"),
        ("element vertex 2\n" + PROPERTIES, "0 bytes of vertices, expected 48"),
        ("", "has elements"),
    ],
)
def test_what_is_no_file_of_points_is_one_line(tmp_path: Path, head: str, words: str) -> None:
    path = tmp_path / "a.ply"
    path.write_text(f"ply\nformat binary_little_endian 1.0\n{head}end_header\n")
    with pytest.raises(DuagError, match=rf"a\.ply: {words}"):
        read_points(path)
