"""Ground truth of a part of a log takes no view from the measures that need none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.evaluation import map_agreement
from duagc.pipeline.evaluation.map_agreement import MatchedViews
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired
from tests.fixtures.room import CAMERA, detailed, pose

TRUE = {10 * k: pose(x=-0.4 + 0.1 * k, z=-0.9, yaw=0.3 - 0.05 * k) for k in range(7)}
HELD_OUT = {k: 10 * k for k in range(7)}


@pytest.fixture(autouse=True)
def _rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def opened(_: Path) -> Iterator[Any]:
        def frame(index: int) -> Any:
            color, depth = detailed(TRUE[HELD_OUT[index]])
            return SimpleNamespace(usable_depth=depth, color=color, mask=None)

        def usable_depth(index: int) -> Any:
            return frame(index).usable_depth

        yield SimpleNamespace(
            camera=CAMERA, frame=frame, usable_depth=usable_depth, move_depth_by=lambda _: None
        )

    monkeypatch.setattr(map_agreement, "open_rgbd", opened)


def section(truth: int, matched: MatchedViews | None = None) -> dict[str, Any]:
    """Of all views, with truth for the first of them."""
    stamps = np.array([10 * k for k in range(truth)])
    poses = np.array([TRUE[int(t)] for t in stamps]).reshape(-1, 4, 4)
    true = Paired(stamps, poses, poses) if truth else Absent("none")
    paths = {"": TRUE, "_before_consensus": TRUE}
    return map_agreement.section(Path(), HELD_OUT, paths, true, frontend=Path(), matched=matched)


@pytest.mark.parametrize("truth", [0, 2, 6, 7])
def test_truth_of_a_part_changes_no_other_measure(truth: int) -> None:
    full, found = section(7), section(truth)
    assert full["feature_agreement_pairs"] > 10
    for name in full:
        if not name.endswith("_of_truth"):
            assert found[name] == full[name]
    assert list(found) == list(full) or truth < 7
    assert set(found) == set(full)
    assert isinstance(found["depth_agreement_m_of_truth"], Absent) == (truth < 6)  # 2 views are one pair


@pytest.mark.parametrize("truth", [6, 7])
def test_views_that_were_matched_before_are_not_matched_again(
    truth: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, every = section(truth), []
    matched = map_agreement.matched_views(Path(), list(HELD_OUT), frontend=Path())
    assert matched.frames == tuple(HELD_OUT)
    again = map_agreement.matched_pairs
    monkeypatch.setattr(map_agreement, "matched_pairs", lambda c, *a: every.append(len(c)) or again(c, *a))
    assert section(truth, matched) == before
    assert every == ([6] if truth == 6 else [])  # the views that have truth are others


def test_views_matched_before_that_are_others_count_for_nothing() -> None:
    others = map_agreement.matched_views(Path(), list(HELD_OUT)[:4], frontend=Path())
    assert section(7, others) == section(7)
