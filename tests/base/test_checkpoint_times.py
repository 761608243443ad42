"""When checkpoints are saved."""

from __future__ import annotations

import errno
import math
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from duagc.pipeline.base import checkpoints
from duagc.pipeline.base.checkpoints import Checkpoints


def test_what_was_saved_before_the_disk_was_full_is_still_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said, sound = list[str](), checkpoints.write_state

    def full(*args: Any) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    save = Checkpoints(tmp_path / "checkpoints", say=said.append, every_s=0.0, largest_share=math.inf)
    save.at("part", 1, 3, lambda: "first")
    monkeypatch.setattr(checkpoints, "write_state", full)
    save.at("part", 2, 3, lambda: "second")
    save.at("part", 3, 3, lambda: "third")
    assert len(said) == 1
    assert said[0].endswith("the computation goes on without checkpoints")
    monkeypatch.setattr(checkpoints, "write_state", sound)
    assert Checkpoints(tmp_path / "checkpoints").resume("part") == (1, "first")


@pytest.mark.parametrize(
    ("cost_s", "between_s"),
    [(0.01, 5.0), (0.12, 6.0), (0.7, 8.0), (2.0, 20.0)],  # 2 % of the time; 8 s; a tenth of the time
)
def test_the_time_between_them_follows_what_one_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cost_s: float, between_s: float
) -> None:
    clock, saved_s = SimpleNamespace(now_s=0.0), list[float]()

    def write(path: Path, value: Any, head: Any, named: Any) -> str:
        saved_s.append(clock.now_s)
        clock.now_s += cost_s
        return "0"

    times = SimpleNamespace(perf_counter=lambda: clock.now_s, process_time=lambda: clock.now_s)
    monkeypatch.setattr(checkpoints, "time", times)
    monkeypatch.setattr(checkpoints, "write_state", write)
    save = Checkpoints(tmp_path / "checkpoints")
    for step in range(10_000):
        clock.now_s += 0.01
        save.at("part", step + 1, 10_000, lambda: None)
    gaps_s = [b - a - cost_s for a, b in pairwise(saved_s)]
    assert len(gaps_s) >= 3
    assert gaps_s == pytest.approx([between_s] * len(gaps_s), abs=0.02)
