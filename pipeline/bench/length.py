"""What a run costs, and how good it is, as its logs get longer: the same recording, cut after more and more minutes."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.bench.whole_runs import THIS, execute, part_of, seconds_of
from duagc.pipeline.recording import Recording

SCHEMA = 1


@dataclass(frozen=True)
class LengthPlan:
    """What is run.

    Attributes:
        recording: of a team.
        seconds: lengths of the logs, from the beginning.
        threads: processors that a run may use.
        options: more words for `duagc run`.
    """

    recording: Path
    seconds: tuple[float, ...]
    threads: int = 2
    options: tuple[str, ...] = ()


def run(plan: LengthPlan) -> dict[str, Any]:
    """Run and measure; ready for JSON.

    Args:
        plan: what.

    Raises:
        DuagError: the logs are shorter than the longest length, or a run fails.
    """
    from duagc.pipeline.bench.raster import cpu_name

    source = Recording(plan.recording)
    longest = min(seconds_of(source).values())
    if max(plan.seconds) > longest + 1e-6:
        raise DuagError(
            f"{plan.recording}: its shortest log has {longest:.1f} s, expected {max(plan.seconds):g} s or more"
        )
    rows = list(track(_rows(plan, source), "bench length", len(plan.seconds)))
    for before, row in pairwise(rows):
        seconds = row["seconds"] - before["seconds"]
        row["more_cpu_s_per_s"] = round((row["cpu_s"] - before["cpu_s"]) / seconds, 3)
    return {
        "schema": SCHEMA,
        "machine": {"cpu": cpu_name(), "cores": processors(), "load_average": os.getloadavg()[0]},
        "recording": source.name,
        "rows": rows,
    }


def _rows(plan: LengthPlan, source: Recording) -> Iterator[dict[str, Any]]:
    with tempfile.TemporaryDirectory(prefix="duagc-bench-") as name:
        folder = Path(name)
        for number, seconds in enumerate(sorted(plan.seconds)):
            part = part_of(source, len(source.robots), seconds, folder / f"recording{number}")
            out = folder / f"run{number}"
            done = execute(THIS, part.path, out, processors=plan.threads, options=plan.options)
            front = [row for row in done.stages.values() if row["stage"] == "frontend"]
            own = done.metrics["rendering"]["own"]["held_out"]
            team = done.metrics["team"]
            yield {
                "seconds": seconds,
                "frames": sum(row["frames"] for row in done.metrics["robots"].values()),
                "cpu_s": round(sum(row["cpu_s"] for row in done.stages.values()) / len(source.robots), 3),
                "frontend_cpu_s": round(sum(row["cpu_s"] for row in front) / len(front), 3),
                "wall_s": round(done.wall_s, 3),
                "frontend_peak_mb": max(row["peak_rss_mb"] for row in front),
                "peak_memory_mb": max(row["peak_rss_mb"] for row in done.stages.values()),
                "gaussians": sum(row["gaussians"] for row in done.metrics["robots"].values()),
                "joined": team["robots_in_largest_component"],
                "ate_m": team["ate_rmse_m"],
                "psnr_db": own["psnr_db"],
                "depth_l1_m": own["depth_l1_m"],
            }


def format_table(result: dict[str, Any]) -> str:
    """The rows as a table in Markdown.

    Args:
        result: of `run`.
    """
    head = ["s of log", "frames", "cpu s a robot", "more, s per s", "front end", "wall s"]
    head += ["front end MB", "MB", "Gaussians", "joined", "team ATE mm", "PSNR dB", "depth L1 mm"]
    return "\n".join(
        markdown(
            head,
            (
                [
                    f"{row['seconds']:g}",
                    row["frames"],
                    f"{row['cpu_s']:.1f}",
                    _digits(row.get("more_cpu_s_per_s"), 2),
                    f"{row['frontend_cpu_s']:.1f}",
                    f"{row['wall_s']:.1f}",
                    f"{row['frontend_peak_mb']:.0f}",
                    f"{row['peak_memory_mb']:.0f}",
                    row["gaussians"],
                    row["joined"],
                    _digits(row["ate_m"], 2, 1e3),
                    _digits(row["psnr_db"], 2),
                    _digits(row["depth_l1_m"], 2, 1e3),
                ]
                for row in result["rows"]
            ),
        )
    )


def _digits(value: float | None, digits: int, scale: float = 1.0) -> str | None:
    return None if value is None else f"{scale * value:.{digits}f}"
