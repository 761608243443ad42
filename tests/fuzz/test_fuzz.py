"""A sample of the fuzzing in tests/fuzz/run.py; all of it: `make check-full`, or `python -m tests.fuzz.run`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.readers import READERS
from tests.fuzz.run import run

QUICK = 4  # cases of each reader
FULL = 5000


@pytest.mark.parametrize("name", READERS)
def test_damaged_input_ends_with_one_line_or_a_sound_result(name: str) -> None:
    code = "from tests.fuzz.test_fuzz import quick; quick(%r)"
    out = subprocess.run(
        [sys.executable, "-c", code % name], cwd=Path(__file__).parents[2], capture_output=True, text=True
    )
    assert out.returncode == 0, out.stdout[-3000:] + out.stderr[-3000:]


def quick(name: str) -> None:
    """In a process that has neither the threads nor the memory of the tests before."""
    outcomes, failures = run(READERS[name], int(os.environ.get("DUAGC_FUZZ", QUICK)))
    assert not failures, "\n".join(failures)
    assert outcomes.total() > 0
