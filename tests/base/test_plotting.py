"""Figures are the same whatever settings of matplotlib a user has, and a user without a home has no line about it."""

import os
import subprocess
import sys
from pathlib import Path

from tests.fixtures.commands import ROOT

DRAW = """
from duagc.pipeline.report import figures, pictures
print(figures.bars(["a", "b"], {"packets": [1.0, 2.0]}, "packets"), pictures.scale_uri("viridis"))
"""


def drawn(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A figure, drawn by a process in a folder."""
    known = {
        name: value for name, value in os.environ.items() if name not in ("MPLCONFIGDIR", "MATPLOTLIBRC")
    }
    return subprocess.run(
        [sys.executable, "-c", DRAW],
        env=known | {"PYTHONPATH": str(ROOT)} | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )


def test_figures_ignore_what_a_user_has_set(tmp_path: Path) -> None:
    usual = drawn(tmp_path).stdout
    assert "<svg" in usual
    (tmp_path / "matplotlibrc").write_text("xtick.direction: in\nfont.size: 20\npatch.linewidth: 9\n")
    assert drawn(tmp_path, MPLBACKEND="of nobody").stdout == usual


def test_a_user_who_may_write_no_home_has_one_folder_and_no_line(tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    (tmp_path / "home").write_text("a file, in which root makes no folder either")
    for _ in range(2):
        result = drawn(temporary, HOME=str(tmp_path / "home"), TMPDIR=str(temporary))
        assert result.stderr == ""
        assert [path.name for path in temporary.iterdir()] == [f"duagc-matplotlib-{os.getuid()}"]
