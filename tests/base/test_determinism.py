"""Results do not depend on what a program imported before it called the library."""

from pathlib import Path

import pytest

from duagc.pipeline.base import determinism
from tests.fixtures.late_program import python, run_late

LATE = """
import numpy  # before anything can say under which settings
from duagc.pipeline.base import determinism
determinism.configure_determinism()
print(determinism.is_deterministic())
"""


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


def test_an_error_in_the_child_process_is_the_error_of_the_caller(tmp_path: Path) -> None:
    """What the child computes: test_pipeline.py."""
    called = run_late(tmp_path / "nothing", tmp_path / "out")
    assert called.returncode != 0
    assert "DuagError" in called.stderr.splitlines()[-1]
    assert str(tmp_path / "nothing") in called.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()
