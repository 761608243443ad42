"""INRIA-style .ply: what is written is what every viewer expects, and what is broken is refused."""

import struct
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base import files
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.ply import PROPERTIES, SH_DEGREE_0, gaussians_in_ply, read_ply, write_ply


def some(n: int = 7, seed: int = 0) -> Gaussians:
    r = np.random.default_rng(seed)
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n),
        means=r.normal(size=(n, 3)),
        quats_wxyz=r.normal(size=(n, 4)),
        log_scales=r.normal(-4, 1, (n, 3)),
        colors=r.uniform(-0.1, 1.1, (n, 3)),
        opacity_logits=r.normal(size=n),
    )


def test_the_file_is_laid_out_as_viewers_expect(tmp_path: Path) -> None:
    gaussians = some(2)
    write_ply(tmp_path / "map.ply", gaussians)
    data = (tmp_path / "map.ply").read_bytes()
    header, body = data.split(b"end_header\n", 1)
    dc, scale, rot = (
        [f"{name}_{k}" for k in range(n)] for name, n in (("f_dc", 3), ("scale", 3), ("rot", 4))
    )
    names = [*"xyz", "nx", "ny", "nz", *dc, "opacity", *scale, *rot]
    expected = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert header.decode().splitlines() == expected + [f"property float {name}" for name in names]
    second = dict(zip(names, struct.unpack("<17f", body[68:]), strict=True))
    assert second["z"] == gaussians.means[1, 2]
    assert (second["nx"], second["ny"], second["nz"]) == (0.0, 0.0, 0.0)
    assert second["f_dc_1"] * SH_DEGREE_0 + 0.5 == pytest.approx(gaussians.colors[1, 1], abs=1e-6)
    assert second["opacity"] == gaussians.opacity_logits[1]
    assert second["scale_2"] == gaussians.log_scales[1, 2]
    unit = gaussians.quats_wxyz[1] / np.linalg.norm(gaussians.quats_wxyz[1])
    assert second["rot_0"] == pytest.approx(unit[0], abs=1e-6)


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_round_trip(tmp_path: Path, n: int) -> None:
    gaussians = some(n)
    write_ply(tmp_path / "map.ply", gaussians)
    back = read_ply(tmp_path / "map.ply")
    assert (len(back), gaussians_in_ply(tmp_path / "map.ply")) == (n, n)
    for name in ("means", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gaussians, name))
    np.testing.assert_allclose(back.colors, gaussians.colors, atol=2e-7)  # two float32 roundings
    norms = np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True)
    np.testing.assert_allclose(back.quats_wxyz, gaussians.quats_wxyz / norms, atol=2e-7)
    write_ply(tmp_path / "again.ply", back)
    again = read_ply(tmp_path / "again.ply")
    np.testing.assert_array_equal(again.means, back.means)


def test_a_map_may_be_larger_than_a_whole_file_that_is_read_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "LARGEST_BYTES", 10_000)
    write_ply(tmp_path / "map.ply", some(1000))
    assert len(read_ply(tmp_path / "map.ply")) == 1000


def test_a_refused_map_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, some(3))
    before = path.read_bytes()
    broken = some(3)
    broken.means[1, 1] = np.nan
    with pytest.raises(DuagError, match=r"map\.ply: not written"):
        write_ply(path, broken)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"binary_little_endian", b"ascii", "expected binary_little_endian"),
        (b"element vertex 3", b"element vertex 4", "bytes of vertices, expected 272"),
        (b"element vertex 3", b"element vertex " + b"3" * 5000, "expected 'element vertex N'"),
        (b"property float opacity", b"property float alpha", "properties differ"),
        (b"ply\n", b"PLY\n", "not a .ply file"),
        (b"end_header\n", b"end_header\nx", "bytes of vertices"),
    ],
)
def test_files_that_are_no_such_ply(tmp_path: Path, old: bytes, new: bytes, words: str) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, some(3))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(DuagError, match=words) as error:
        read_ply(path)
    assert str(error.value).startswith(f"{path}: ")  # two runs have files of one name


def test_activated_values_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, some(3))
    header, body = path.read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(body, "<f4").reshape(-1, len(PROPERTIES)).copy()
    table[:, 13:17] *= 3.0
    path.write_bytes(header + b"end_header\n" + table.tobytes())
    with pytest.raises(DuagError, match=r"rot_0\.\.3 has length"):
        read_ply(path)


def test_exponentiated_scales_and_opacities_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, some(3))
    header, body = path.read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(body, "<f4").reshape(-1, len(PROPERTIES)).copy()
    table[:, 9] = 1 / (1 + np.exp(-table[:, 9]))
    table[:, 10:13] = np.exp(table[:, 10:13])
    path.write_bytes(header + b"end_header\n" + table.tobytes())
    with pytest.raises(DuagError, match="were they activated"):
        read_ply(path)
