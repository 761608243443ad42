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


@pytest.mark.parametrize(
    ("processor", "expected"),
    [
        ("processor : 0\nflags\t\t: fpu avx2 avx512f avx512dq avx512cd avx512bw avx512vl\n", "AVX512-SKX"),
        ("processor : 0\nflags\t\t: fpu avx2 avx512f avx512cd\n", ""),
        ("processor : 0\nflags\t\t: fpu sse4_2 avx2 fma\nbugs : avx512f\n", ""),
        ("processor : 0\nFeatures : fp asimd\n", ""),
        ("", ""),
    ],
    ids=["server", "part of AVX-512", "AVX2", "ARM", "unknown"],
)
def test_opencv_is_asked_to_leave_out_only_what_the_processor_has(processor: str, expected: str) -> None:
    """On a processor without AVX-512 OpenCV would begin every command with a line on standard error."""
    assert determinism.opencv_paths_to_disable(processor) == expected


def test_opencv_loads_without_a_word_and_leaves_ipp_out_in_all_threads() -> None:
    """IPP computes the angles of SIFT another way on every family of processors."""
    code = """
import duagc, cv2
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(1) as pool:
    print(cv2.useOptimized(), cv2.ipp.useIPP(), pool.submit(cv2.ipp.useIPP).result())
"""
    result = python("-c", code)
    assert (result.stdout.strip(), result.stderr) == ("True False False", "")
