"""Every example runs as it stands, and prints what it promises."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PRINTED = {
    "01_render.py": r"largest \|d loss / d means\|: [\d.]+e-\d+",
    "02_track_two_frames.py": r"error 0\.\d+ mm",
    "03_pose_graph.py": r"converged: True",
    "04_two_robots.py": r"alpha: team alpha, bravo; \d+ own Gaussians, \d+ after fusion",
}


def test_every_numbered_example_is_tested() -> None:
    assert {path.name for path in (ROOT / "examples").glob("[0-9]*.py")} == set(PRINTED)


TEAM = "04_two_robots.py"  # starts processes itself


@pytest.mark.parametrize("name", sorted(set(PRINTED) - {TEAM}))
def test_example_runs(name: str, tmp_path: Path) -> None:
    out = subprocess.run(
        [sys.executable, ROOT / "examples" / name],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert out.returncode == 0, out.stderr
    assert re.search(PRINTED[name], out.stdout), out.stdout


def test_the_example_of_a_team_runs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, which has imported everything and baked the room."""
    monkeypatch.setattr(sys, "argv", [TEAM])
    runpy.run_path(str(ROOT / "examples" / TEAM), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(PRINTED[TEAM], printed), printed
