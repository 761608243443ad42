"""Results do not depend on what a program imported before it called the library."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base import determinism
from duagc.pipeline.runs.digest import digest

ROOT = Path(__file__).parents[2]
OVERRIDES = (
    "frontend.mapping.max_gaussians=1500",
    "frontend.mapping.support_views=0",
    "exchange.max_rounds=400",
    "fusion.refine.steps_per_view=1",
)
LATE = """
import numpy  # before anything can say under which settings
from duagc.pipeline.base import determinism
determinism.configure_determinism()
print(determinism.is_deterministic())
"""
RUN_LATE = """
import sys
from pathlib import Path
import numpy
import cv2

if __name__ == "__main__":
    from duagc.pipeline.base.determinism import is_deterministic
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.runner import run

    recording, out, *overrides = sys.argv[1:]
    lines = []
    run(Path(recording), Path(out), load_config(RunConfig, overrides=overrides), workers=1, log=lines.append)
    assert not is_deterministic()
    print(*lines, sep="\\n")
"""


def bare_environment() -> dict[str, str]:
    """The environment of a user's shell: without the settings that this test process runs under."""
    return {name: value for name, value in os.environ.items() if name not in determinism.SETTINGS}


def python(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=bare_environment() | {"PYTHONPATH": str(ROOT)} | environment,
        check=False,
    )


def test_this_process_was_configured_in_time() -> None:
    assert determinism.is_deterministic()


@pytest.mark.parametrize(
    ("code", "environment", "expected"),
    [
        (LATE, {}, "False"),
        (LATE, determinism.SETTINGS, "True"),
        (LATE.replace("import numpy", "import json"), {}, "True"),
        (LATE.replace("determinism.configure_determinism()", ""), {}, "False"),
    ],
    ids=["numpy first", "numpy first, in a configured environment", "in time", "never configured"],
)
def test_a_process_knows_how_its_libraries_were_loaded(
    code: str, environment: dict[str, str], expected: str
) -> None:
    result = python("-c", code, **environment)
    assert (result.stdout.strip(), result.stderr) == (expected, "")


def test_a_program_that_imports_numpy_first_gets_the_results_of_the_command(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    simulate(recording, robots=2, frames=10, size=(160, 120), seed=3, overlap=0.9, workers=1)
    script = tmp_path / "late.py"
    script.write_text(RUN_LATE)
    called = python(script, recording, tmp_path / "called", *OVERRIDES)
    assert called.returncode == 0, called.stderr
    assert called.stdout.splitlines()[0].startswith("front end and information: 2 robots")
    settings = [word for override in OVERRIDES for word in ("--set", override)]
    command = "from duagc.pipeline.cli import main; main()"
    commanded = python("-c", command, "run", recording, "--out", tmp_path / "commanded", *settings)
    assert commanded.returncode == 0, commanded.stderr
    assert digest(tmp_path / "called") == digest(tmp_path / "commanded")
    manifests = [json.loads((tmp_path / n / "manifest.json").read_text()) for n in ("called", "commanded")]
    assert manifests[0]["outputs"] == manifests[1]["outputs"]


def test_an_error_in_the_child_process_is_the_error_of_the_caller(tmp_path: Path) -> None:
    script = tmp_path / "late.py"
    script.write_text(RUN_LATE)
    called = python(script, tmp_path / "nothing", tmp_path / "out")
    assert called.returncode != 0
    assert "DuagError" in called.stderr.splitlines()[-1]
    assert str(tmp_path / "nothing") in called.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()
