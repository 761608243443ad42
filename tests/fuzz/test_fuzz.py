"""Samples of the fuzzing in tests/fuzz/run.py; all of it: `make fuzz`."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.readers import READERS


def fuzz(count: int, *names: str) -> None:
    """In a process that has neither the threads nor the memory of the tests before."""
    command = [sys.executable, "-m", "tests.fuzz.run", "--count", str(count), *names]
    out = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert out.returncode == 0, out.stdout[-3000:] + out.stderr[-3000:]


def test_damaged_input_ends_with_one_line_or_a_sound_result() -> None:
    fuzz(3)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(READERS))
def test_more_damaged_input(name: str) -> None:
    fuzz(200, name)
