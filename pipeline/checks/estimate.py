"""What `duagc run` on a recording will take, from runs that were measured."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from duagc.pipeline.cache import durations
from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.config.mapping import MappingConfig

RANGE = 1.5  # times and part of the expected time, where the keyframes are known
KEYFRAMES = ("keyframes_from", "keyframes_to")
WORKERS = 2  # robots at a time, as `duagc run` has them by default, each with a processor to itself
BYTES_PER_GAUSSIAN = 1450  # of its robot's map: maps, information, what crossed the network, Rerun file
BYTES_PER_ROBOT = 1_000_000  # report
COPIES = 2  # in the folder of the run, and in the store


def estimate(
    robots: Mapping[str, Mapping[str, Any]], ratios: Mapping[str, float] = MappingProxyType({})
) -> dict[str, float]:
    """Seconds (from, to) of a run on two idle processors and bytes on disk.

    Args:
        robots: `frames`, `pixels` of an image, `keyframes` and `moved` of every robot; `keyframes_from` and
            `keyframes_to`, unless they are known.
        ratios: what stages take on this machine, as a share of what is predicted, by their names.
    """
    rows = list(robots.values())
    fewest, most = ([{**r, "keyframes": r.get(key, r["keyframes"])} for r in rows] for key in KEYFRAMES)
    seconds = _seconds(rows, ratios)
    shorter, longer = (
        math.exp(math.hypot(math.log(RANGE), math.log(_seconds(other, ratios) / seconds)))
        for other in (fewest, most)
    )
    size = sum(
        BYTES_PER_ROBOT + BYTES_PER_GAUSSIAN * durations.gaussians(row, MappingConfig()) for row in rows
    )
    return {"seconds_from": seconds / shorter, "seconds_to": seconds * longer, "bytes": float(COPIES * size)}


def _seconds(rows: Sequence[Mapping[str, Any]], ratios: Mapping[str, float]) -> float:
    """Expected time of a run."""

    def side_by_side_s(stage: str, seconds: Iterable[float]) -> float:
        return ratios.get(stage, 1.0) * durations.side_by_side_s((), list(seconds), WORKERS)

    seconds = durations.REPORT_S + durations.VIEW_S
    prepared = (durations.front_end_s(row) + durations.information_s(row) for row in rows)
    seconds += side_by_side_s("frontend", prepared)
    seconds += side_by_side_s("evaluation", (durations.evaluation_s(row, len(rows)) for row in rows))
    if len(rows) > 1:
        seconds += durations.exchange_s(rows) + durations.evaluation_of_team_s(len(rows))
        seconds += side_by_side_s("fusion", map(durations.fusion_s, rows))
    return seconds


def check_disk(folder: Path, needed: float) -> Iterator[Finding]:
    """A finding if the disk of a folder has too little room.

    Args:
        folder: whose disk is looked at.
        needed: bytes for a run and its store.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        yield Finding(
            Severity.WARNING,
            "disk",
            "",
            f"{free / 1e6:.0f} MB are free where the recording is",
            f"{needed / 1e6:.0f} MB for a run and its store",
            "free some space, or give `duagc run` an --out on another disk",
        )
