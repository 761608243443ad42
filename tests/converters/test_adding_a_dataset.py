"""The example of docs/howto/dataset.md is a converter: it is run as it stands there, on files as it describes them."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters import registry
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from duagc.pipeline.recording import open_rgbd, read_log
from tests.fixtures.box_room import path, render, save
from tests.fixtures.dataset_example import CAMERA, DOC


@pytest.fixture
def example(tmp_path: Path) -> Path:
    """The example as a file."""
    (text,) = [block.split("```")[0] for block in DOC.read_text().split("```python\n")[1:]]
    (tmp_path / "mine.py").write_text(text)
    return tmp_path / "mine.py"


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """A dataset in the files that the example describes."""
    src = tmp_path / "walk_01"
    poses = path(12)
    for k, T in enumerate(poses):
        color, z = render(CAMERA, T)
        save(src / "color" / f"{k:06d}.png", color)
        save(src / "depth" / f"{k:06d}.png", np.rint(z * 1000).astype(np.uint16))
    (src / "camera.txt").write_text("160 120 140 140 79.5 59.5\n")
    np.savetxt(src / "poses.txt", np.reshape(poses, (-1, 16)), fmt="%.12f")
    return src


def test_the_example_converts(example: Path, walk: Path, tmp_path: Path) -> None:
    arguments = [
        "convert",
        str(example),
        str(walk),
        "--robots",
        "2",
        "--set",
        "rate_hz=15",
        "--out",
        str(tmp_path / "rec"),
    ]
    out = CliRunner().invoke(app, arguments)
    assert out.exit_code == 0, out.exception
    description = json.loads((tmp_path / "rec" / "recording.json").read_text())
    assert description["warnings"] == ["no times in the files: 15 Hz from frame numbers"]
    assert description["checks"]["bravo"]["reprojection_median_m"] < 0.01
    truth = read_log(tmp_path / "rec" / "bravo.groundtruth.mcap", ["/bravo/groundtruth/pose"])
    assert np.allclose([m.unpack_pose_in_frame(r.proto()) for r in truth], path(12)[6:], atol=1e-9)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        color, z = render(CAMERA, path(12)[1])
        assert log.frame(1).stamp_ns == 10**9 // 15
        assert np.array_equal(log.frame(1).color, color)
        assert np.abs(log.frame(1).depth - z).max() <= 0.0005 + 1e-6


def test_its_mistakes_are_one_line(example: Path, walk: Path, tmp_path: Path) -> None:
    def fails(message: str, dataset: Path = example, options: tuple[str, ...] = ()) -> None:
        with pytest.raises(DuagError, match=message) as caught:
            registry.convert(str(dataset), walk, tmp_path / "rec", options=options)
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "rec").exists()

    fails("walks: rate is no option; expected perhaps rate_hz", options=("rate=15",))
    fails("other.py: no such file", dataset=tmp_path / "other.py")
    for text, message in (
        ("import nothing_such", "ModuleNotFoundError"),
        ("def", "SyntaxError"),
        ("", "no `convert`"),
    ):
        (tmp_path / "other.py").write_text(text)
        fails(message, dataset=tmp_path / "other.py")
    poses = (walk / "poses.txt").read_text()
    (walk / "poses.txt").write_text(poses.replace(poses.split()[0], "oops", 1))
    fails("poses.txt:1: .*expected 16 numbers")
    (walk / "poses.txt").write_text(poses)
    (walk / "color" / "000003.png").unlink()
    fails("000003.png: No such file")
    with pytest.raises(DuagError, match="dataset 'replcia', expected perhaps replica"):
        registry.convert("replcia", walk, tmp_path / "rec")


def test_a_converter_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def convert(src, out, robots=1, force=False):\n    pass\n")
    with pytest.raises(DuagError, match=r"mine\.py: wrote no .*/recording\.json, expected a recording"):
        registry.convert(str(tmp_path / "mine.py"), tmp_path / "src", tmp_path / "out")
