"""A session that is killed begins again, takes what was slow from its checkpoints, and writes the same bytes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from duagc.pipeline.base import recall
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange import keyframe_database, loop_closure_verifier, sharing
from duagc.pipeline.exchange.rectified_search import RectifiedSearch
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.recording import content_digest

SLOW: dict[Any, tuple[str, ...]] = {
    keyframe_database: ("extract", "extract_rectified"),
    loop_closure_verifier: ("verify",),
    RectifiedSearch: ("compare",),
    sharing: ("own_records", "match_pairs"),
}


class KilledError(Exception):
    """In place of a signal."""


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the slow functions, as they are called; however fast they are, each result is kept by itself."""
    made: list[str] = []

    def counted(name: str, function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            made.append(name)
            return function(*args, **kwargs)

        return call

    for owner, names in SLOW.items():
        for name in names:
            monkeypatch.setattr(owner, name, counted(name, getattr(owner, name)))
    monkeypatch.setattr(recall, "WORTH_S", 0.0)
    monkeypatch.setattr(keyframe_database, "KEYFRAMES_TOGETHER", 1)
    return made


@pytest.mark.parametrize(
    ("turn_rad", "slow"),
    [
        (0.6, {"extract", "verify", "own_records", "match_pairs"}),
        (3.0, {"extract", "extract_rectified", "compare", "own_records"}),
    ],
    ids=["joined", "strangers"],
)
def test_nothing_slow_is_computed_twice(
    make_robot: Any, tmp_path: Path, calls: list[str], turn_rad: float, slow: set[str]
) -> None:
    team = [make_robot(name, turn_rad * i, keyframes=4)[0] for i, name in enumerate(("alpha", "bravo"))]
    said: list[str] = []

    def meet(folder: Path, most: float, checkpoints: Path | None) -> str | None:
        """Digest of both logs; None if it was killed after so many results."""
        folder.mkdir(exist_ok=True)

        def report(part: str, done: int, total: int, shown: object) -> None:
            if done > most:
                raise KilledError

        save = Checkpoints(checkpoints, say=said.append, every_s=0.0, largest_share=math.inf, report=report)
        logs = folder / "exchange.mcap", folder / "consensus.mcap"
        try:
            run_session_of(
                team,
                ExchangeConfig(),
                seed=0,
                exchange_path=logs[0],
                consensus_path=logs[1],
                checkpoints=save,
            )
        except KilledError:
            return None
        return " ".join(map(content_digest, logs))

    expected = meet(tmp_path / "undisturbed", math.inf, None)
    once = sorted(calls)
    assert set(once) == slow
    calls.clear()
    killed = [meet(tmp_path / "killed", most, tmp_path / "saved") for most in (3, 8, len(once) - 1)]
    assert killed == [None] * 3
    assert meet(tmp_path / "killed", math.inf, tmp_path / "saved") == expected
    assert len(calls) == len(once) + 3  # what a kill falls into is not saved
    assert said[-1] == f"session: goes on with {len(once) - 1} results"
