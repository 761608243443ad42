"""What whole runs take for every second of log: stage by stage, for teams of several sizes, next to another version.

Processor time counts all processes of a stage together, and all robots' seconds of log; wall time is that of the whole
command, per second of the longest log: below 1 a team is mapped faster than it recorded. Open3D's odometry, which only
tracks, is a row of its own.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.progress import track
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.bench.whole_runs import THIS, Finished, execute, part_of, seconds_of
from duagc.pipeline.recording import Recording

SCHEMA = 1
OPEN3D = "Open3D, hybrid odometry"
FRONT_END = {
    "tracking": ("tracking_s",),
    "poses": ("refinement_s", "model_s"),
    "mapping": ("mapping_s",),
    "final": ("final_refinement_s",),
}
"""Columns of a front end, and the parts of timing.json that they are made of."""
STAGES = ("information", "exchange", "fusion", "evaluation", "report", "rrd")
COLUMNS = (*FRONT_END, *STAGES)


@dataclass(frozen=True)
class RealtimePlan:
    """What is run.

    Attributes:
        recording: of a team.
        robots: sizes of the teams; the first robots by name.
        threads: processors that a run may use.
        other: `duagc` of another version, that runs the same; None: there is none.
        open3d: whether Open3D's odometry is measured, on the first robot.
        seconds: of every log; None: all of it.
        options: more words for `duagc run`.
    """

    recording: Path
    robots: tuple[int, ...]
    threads: tuple[int, ...]
    other: Path | None = None
    open3d: bool = True
    seconds: float | None = None
    options: tuple[str, ...] = ()

    def versions(self) -> dict[str, Sequence[str]]:
        """Commands by name."""
        return {"this": THIS} | ({} if self.other is None else {"other": (str(self.other),)})


def run(plan: RealtimePlan) -> dict[str, Any]:
    """Run and measure; ready for JSON.

    Args:
        plan: what.

    Raises:
        DuagError: the recording has fewer robots, a command fails, or there is no such command.
    """
    from duagc.pipeline.bench.peaks import cpu_name

    source = Recording(plan.recording)
    if plan.other is not None and not os.access(plan.other, os.X_OK):
        raise DuagError(f"{plan.other}: no such command, expected `duagc` of another version")
    if max(plan.robots) > len(source.robots):
        raise DuagError(
            f"{plan.recording}: has {len(source.robots)} robots, expected {max(plan.robots)} or more"
        )
    rows = list(track(_rows(plan, source), "bench realtime", _count(plan)))
    return {
        "schema": SCHEMA,
        "machine": {"cpu": cpu_name(), "cores": processors(), "load_average": os.getloadavg()[0]},
        "recording": source.name,
        "rows": rows,
    }


def _count(plan: RealtimePlan) -> int:
    return len(plan.robots) * len(plan.threads) * len(plan.versions()) + plan.open3d


def _rows(plan: RealtimePlan, source: Recording) -> Iterator[dict[str, Any]]:
    """Runs one after the other, versions in turn, so that what else the machine does meets them alike."""
    with tempfile.TemporaryDirectory(prefix="duagc-bench-") as name:
        folder = Path(name)
        for robots in plan.robots:
            part = part_of(source, robots, plan.seconds, folder / f"recording{robots}")
            for threads in plan.threads:
                for version, command in plan.versions().items():
                    out = folder / f"{version}-{robots}-{threads}"
                    done = execute(command, part.path, out, processors=threads, options=plan.options)
                    yield {"version": version, "robots": robots, "threads": threads} | row_of(
                        done, seconds_of(part)
                    )
        if plan.open3d:
            yield _open3d(part_of(source, 1, plan.seconds, folder / "recording"))


def row_of(done: Finished, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Seconds of processor for every second of log, by column; wall time; the largest memory of a stage.

    Args:
        done: a whole run.
        seconds: of the robots' logs.
    """
    total = sum(seconds.values())
    taken = dict.fromkeys(COLUMNS, 0.0)
    for stage in done.stages.values():
        if stage["stage"] in STAGES:
            taken[stage["stage"]] += stage["cpu_s"]
        elif "parts" in stage:
            parts = stage["parts"]
            share = stage["cpu_s"] / max(sum(parts.values()), 1e-9)  # parts are wall times of one thread
            for column, names in FRONT_END.items():
                taken[column] += share * sum(parts.get(part, 0.0) for part in names)
    whole = sum(stage["cpu_s"] for stage in done.stages.values())
    return {
        "cpu_s_per_s": {column: round(taken[column] / total, 4) for column in COLUMNS}
        | {"whole": round(whole / total, 4)},
        "wall_s_per_s": round(done.wall_s / max(seconds.values()), 4),
        "peak_memory_mb": max(stage["peak_rss_mb"] for stage in done.stages.values()),
    }


def _open3d(recording: Recording) -> dict[str, Any]:
    from duagc.pipeline.bench.frontend import measure_open3d

    robot = recording.robots[0]
    with worker_pool(1) as pool:  # a process of its own, for its memory
        found = pool.submit(measure_open3d, recording.log(robot), "Hybrid").result()
    seconds = seconds_of(recording)[robot]
    frame = found["times"]["frame"]
    frames = len(found["stamps_ns"])
    return {
        "version": OPEN3D,
        "robots": 1,
        "threads": None,
        "cpu_s_per_s": {"tracking": round(frame["cpu_ms"] * 1e-3 * frames / seconds, 4)},
        "wall_s_per_s": round(frame["wall_ms"] * 1e-3 * frames / seconds, 4),
        "peak_memory_mb": found["peak_memory_mb"],
    }


def format_table(result: dict[str, Any]) -> str:
    """The rows as a table in Markdown, with ratios of this version to the other one.

    Args:
        result: of `run`.
    """
    head = ["version", "robots", "threads", *COLUMNS, "whole", "wall", "MB"]
    rows = [
        [row["version"], row["robots"], row["threads"]]
        + [_two(row["cpu_s_per_s"].get(column)) for column in (*COLUMNS, "whole")]
        + [_two(row["wall_s_per_s"]), f"{row['peak_memory_mb']:.0f}"]
        for row in result["rows"]
    ]
    by_case = {(r["version"], r["robots"], r["threads"]): r for r in result["rows"]}
    for (version, *case), row in by_case.items():
        other = by_case.get(("other", *case))
        if version == "this" and other is not None:
            rows.append(["this : other", *case, *_ratios(row, other)])
    title = "Processor seconds for every second of log; wall: of the command, for every second of the longest log."
    return "\n".join([title, "", *markdown(head, rows)])


def _ratios(row: dict[str, Any], other: dict[str, Any]) -> list[str | None]:
    pairs = [(row["cpu_s_per_s"].get(c), other["cpu_s_per_s"].get(c)) for c in (*COLUMNS, "whole")] + [
        (row[key], other[key]) for key in ("wall_s_per_s", "peak_memory_mb")
    ]
    return [f"{a / b:.2f}x" if a is not None and b else None for a, b in pairs]


def _two(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"
