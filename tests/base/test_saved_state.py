"""A state is read back as it was written, to the last bit, or not at all."""

import os
import pickle
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base import saved_state
from duagc.pipeline.base.saved_state import DamagedStateError, StateFile, write_state
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.registration import Level
from tests.fixtures.room import CAMERA


@dataclass(frozen=True)
class Foreign:
    """A data class of another package."""

    value: int


class Runs:
    """Runs something when it is read."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("made",)


def nothing(obj: Any) -> None:
    """No object stands elsewhere."""


def there_and_back(value: Any, folder: Path, *allowed: type) -> Any:
    write_state(folder / "state", value, dict, nothing)
    return StateFile(folder / "state").value(nothing, allowed)


def level() -> Level:
    image = np.linspace(0, 1, CAMERA.width * CAMERA.height, dtype=np.float32)
    return Level(
        CAMERA, image.reshape(CAMERA.height, CAMERA.width), image.reshape(CAMERA.height, CAMERA.width)
    )


def test_arrays_come_back_to_the_last_bit_and_can_be_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = [
        rng.normal(size=(7, 3)).astype(np.float32),
        np.asfortranarray(rng.normal(size=(5, 4))),
        np.zeros((0, 6)),
        np.array([np.nan, -0.0, np.inf]),
        rng.integers(0, 255, (9, 128)).astype(np.uint8),
        rng.normal(size=6) > 0,
    ]
    found = there_and_back((arrays, np.float64(1 / 3), {(1, 2): Reason.JUMP}), tmp_path)
    assert found[1:] == (np.float64(1 / 3), {(1, 2): Reason.JUMP})
    for before, after in zip(arrays, found[0], strict=True):
        assert (before.dtype, before.shape) == (after.dtype, after.shape)
        assert before.flags.f_contiguous == after.flags.f_contiguous
        assert before.tobytes("A") == after.tobytes("A")
        after[...] = 0


def test_what_is_shared_stays_shared_and_what_is_cached_is_left_out(tmp_path: Path) -> None:
    one = level()
    bare = write_state(tmp_path / "bare", one, dict, nothing)
    size = (tmp_path / "bare").stat().st_size
    assert one.points.size
    assert write_state(tmp_path / "cached", one, dict, nothing) == bare
    first, second = there_and_back([one, one], tmp_path)
    assert first is second
    assert (tmp_path / "state").stat().st_size < 1.1 * size
    np.testing.assert_array_equal(first.points, one.points)


def test_an_object_that_stands_elsewhere_is_not_written(tmp_path: Path) -> None:
    one = level()
    write_state(tmp_path / "state", [one, 2], dict, lambda obj: "one" if obj is one else None)
    assert (tmp_path / "state").stat().st_size < 1000
    assert StateFile(tmp_path / "state").value({"one": one}.__getitem__, ())[0] is one


@pytest.mark.parametrize("value", [Runs(), Foreign(1), os.mkdir, Path("a")])
def test_what_is_no_state_is_refused(value: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DamagedStateError, match="expected a class of a state"):
        there_and_back(value, tmp_path)
    assert not (tmp_path / "made").exists()


def test_a_class_of_this_package_is_refused_if_it_is_no_value(tmp_path: Path) -> None:
    class Writes:
        def __reduce__(self) -> Any:
            return saved_state.StateFile, (tmp_path / "state",)

    with pytest.raises(DamagedStateError, match="StateFile"):
        there_and_back(Writes(), tmp_path)


@pytest.mark.parametrize("at", [0, 30, -100, -1])
def test_a_changed_bit_is_found(at: int, tmp_path: Path) -> None:
    path = tmp_path / "state"
    write_state(path, level(), dict, nothing)
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedStateError, match="has digest"):
        StateFile(path)


def test_a_torn_file_is_found_and_one_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "state"
    write_state(path, level(), dict, nothing)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(DamagedStateError):
        StateFile(path)
    path.write_bytes(b"")
    with pytest.raises(DamagedStateError):
        StateFile(path)
    with pytest.raises(OSError, match="full"):
        write_state(path, level(), raises, nothing)
    assert [p.name for p in tmp_path.iterdir()] == ["state"]


def raises() -> None:
    raise OSError(28, "the disk is full")


def test_a_lambda_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises((pickle.PicklingError, AttributeError)):
        write_state(tmp_path / "state", lambda: 0, dict, nothing)


class Cached:
    """No data class: what it has is all of it."""

    @cached_property
    def value(self) -> int:
        return 1


def test_only_caches_of_data_classes_are_left_out(tmp_path: Path) -> None:
    one = Cached()
    assert one.value == 1
    assert vars(there_and_back(one, tmp_path, Cached)) == {"value": 1}
