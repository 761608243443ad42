"""Arrays in files: equal, read-only, given back, and in memory where there is no room."""

import subprocess
import sys
import tracemalloc
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base import shelf


@dataclass(frozen=True)
class _Picture:
    name: str
    pixels: np.ndarray
    mask: np.ndarray | None
    parts: tuple["_Picture", ...] = ()


def _picture(seed: int) -> _Picture:
    rng = np.random.default_rng(seed)
    part = _Picture("part", rng.normal(size=(50, 7)).astype(np.float32), None)
    return _Picture("whole", rng.normal(size=(100, 300))[:, ::2], np.zeros((0, 3), bool), (part,))


def _resident_kb() -> int:
    status = Path("/proc/self/status").read_text().split()
    return int(status[status.index("RssFile:") + 1])


def test_what_is_put_on_the_shelf_is_equal_and_cannot_be_written() -> None:
    value, kept = _picture(0), shelf.Shelf()
    found = kept.put(value)
    assert found.name == value.name
    assert found.mask is value.mask
    for a, b in ((found, value), (found.parts[0], value.parts[0])):
        assert np.array_equal(a.pixels, b.pixels)
        assert a.pixels.dtype == b.pixels.dtype
        assert not a.pixels.flags.writeable
    assert len(kept) == 1
    del found, a
    assert len(kept) == 0  # the file is gone with what was in it


def test_pages_are_given_back_and_come_again() -> None:
    kept = shelf.Shelf()
    values = [kept.put((np.full(1_000_000, k, np.float64),)) for k in range(5)]
    assert [float(value[0].sum()) for value in values] == [1e6 * k for k in range(5)]
    before = _resident_kb()
    kept.sweep()
    assert _resident_kb() < before - 30_000
    assert [float(value[0].sum()) for value in values] == [1e6 * k for k in range(5)]


def test_an_array_is_not_copied_in_memory_to_be_written() -> None:
    value = (np.ones((1_000_000, 4)), np.array(3.0), np.arange(5)[::-1])
    tracemalloc.start()
    found = shelf.Shelf().put(value)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < value[0].nbytes / 10
    assert all(np.array_equal(a, b) and a.shape == b.shape for a, b in zip(found, value, strict=True))


def test_what_is_in_a_file_is_not_written_again() -> None:
    kept = shelf.Shelf()
    first = kept.put(_Picture("first", np.ones((300, 300)), None))
    second = kept.put(replace(first, name="second", mask=np.ones((300, 300), bool)))
    assert second.pixels is first.pixels
    assert second.mask is not None
    assert not second.mask.flags.writeable
    assert kept.put(second).mask is second.mask
    assert len(kept) == 2


def test_what_is_in_a_dictionary_is_put_there_too() -> None:
    value = {"a": np.ones((300, 300)), "b": (np.arange(30_000), "text")}
    found = shelf.Shelf().put(value)
    assert list(found) == ["a", "b"]
    assert np.array_equal(found["a"], value["a"])
    assert not found["a"].flags.writeable
    assert not found["b"][0].flags.writeable
    assert found["b"][1] == "text"
    assert value["a"].flags.writeable


def test_what_was_freed_between_arrays_in_use_is_given_back() -> None:
    """In a process of its own, whose heap nothing else has used."""
    program = """
from pathlib import Path
import numpy as np
from duagc.pipeline.base import shelf
from duagc.pipeline.base.determinism import configure_determinism
def kb():
    status = Path("/proc/self/status").read_text().split()
    return int(status[status.index("RssAnon:") + 1])
configure_determinism()
arrays = [np.ones(1 << 17) for _ in range(100)]
most = kb()
del arrays[1::2]
kept = shelf.Shelf()
kept.sweep()
left = kb()
kept.sweep(heap=True)
print((most - left) >> 10, (most - kb()) >> 10, all((array == 1).all() for array in arrays))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    pages, heap, equal = done.stdout.split()
    assert int(pages) < 10
    assert int(heap) > 40  # MiB, of 50
    assert equal == "True"


def test_small_objects_stay_in_memory() -> None:
    value, kept = (np.zeros(10),), shelf.Shelf()
    assert kept.put(value) is value
    assert len(kept) == 0


def test_without_room_it_says_so_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(shelf.tempfile, "tempdir", str(tmp_path / "gone"))
    value, kept = _picture(0), shelf.Shelf()
    assert kept.put(value) is value
    assert kept.put(value) is value
    assert capsys.readouterr().err.count("stay in memory") == 1


def test_a_list_gives_back_what_was_looked_at() -> None:
    kept = shelf.Shelf()
    values = shelf.ShelvedList(((np.full(250_000, k, np.float64),) for k in range(40)), kept)
    for _ in range(2):
        before = _resident_kb()
        assert [float(value[0].mean()) for value in values] == list(range(40))
        assert _resident_kb() - before < 2.5 * shelf.SWEEP_AFTER * 2000  # of 40 x 2000 kB
    assert [float(value[0][0]) for value in values[30::5]] == [30.0, 35.0]
    assert float(values[-1][0][0]) == 39.0


def test_more_objects_fit_than_a_process_may_usually_open() -> None:
    """In a process of its own, whose limit is low as on most systems."""
    program = """
import resource
import numpy as np
from duagc.pipeline.base import shelf
_, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))
kept = shelf.Shelf()
values = [kept.put((np.full(10_000, k, np.float64),)) for k in range(200)]
print(len(kept), sum(int(value[0][7]) for value in values))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["200", str(sum(range(200)))]
    assert done.stderr == ""
