"""The tutorial "Your bag", step by step on a small room, up to the run."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.pipeline.cli import app
from duagc.pipeline.recording import Recording, open_rgbd

ROOT = Path(__file__).parents[2]
FRAMES = 12


def duagc(*words: str | Path) -> str:
    """What a command prints; it must not fail."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output or done.exception
    return done.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated recording and its bags."""
    folder = tmp_path_factory.mktemp("tutorial")
    small = ("--width", "96", "--height", "72", "--noise", "kinect", "--workers", "1")
    duagc("simulate", "--robots", "2", "--frames", str(FRAMES), *small, "--out", folder / "room")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["recording_to_bags.py", str(folder / "room"), str(folder / "bags")])
        runpy.run_path(str(ROOT / "examples" / "recording_to_bags.py"), run_name="__main__")
    return folder


def test_info_says_what_would_be_converted(folder: Path) -> None:
    text = duagc("info", folder / "bags")
    for robot in ("alpha", "bravo"):
        assert f"robot {robot}: " in text
    page = (ROOT / "docs" / "tutorial" / "your-bag.md").read_text(encoding="utf-8")
    shown = page.partition("```text\nrobot alpha: bags/alpha.bag\n")[2].partition("```")[0].splitlines()
    assert len(shown) == 5
    for line in shown:
        assert line.replace("100 frames", f"{FRAMES} frames") in text.splitlines()


def test_check_warns_of_the_unit_of_depth_until_it_is_right(folder: Path) -> None:
    duagc("convert", "ros", folder / "bags", "--out", folder / "mine")
    assert "depth scale" in duagc("check", folder / "mine")
    duagc(
        "convert", "ros", folder / "bags", "--set", "depth_scale=0.0002", "--out", folder / "mine", "--force"
    )
    assert "depth scale" not in duagc("check", folder / "mine")


def test_the_file_of_options_converts_to_the_same(folder: Path) -> None:
    options = duagc("info", folder / "bags", "--toml")
    (folder / "mine.toml").write_text(f"depth_scale = 0.0002\n{options}")
    duagc("convert", "ros", folder / "mine.toml", "--out", folder / "by_file")
    source = Recording(folder / "room")
    for robot in source.robots:
        with (
            open_rgbd(source.log(robot)) as before,
            open_rgbd(Recording(folder / "by_file").log(robot)) as after,
        ):
            assert before.camera == after.camera
            for k in range(FRAMES):
                assert np.array_equal(before.frame(k).color, after.frame(k).color)
                assert np.allclose(before.frame(k).depth, after.frame(k).depth, rtol=0, atol=1e-6)
