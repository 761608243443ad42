"""What a run costs, and how good it is, as its logs get longer: the same recording, cut after more and more minutes."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from duagc.pipeline.base.component_names import submap_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.bench.whole_runs import THIS, execute, part_of, seconds_of
from duagc.pipeline.recording import RECORDING_FILE, Recording, content_digest

SCHEMA = 1


@dataclass(frozen=True)
class LengthPlan:
    """What is run.

    Attributes:
        recording: of a team.
        seconds: lengths of the logs, from the beginning.
        threads: processors that a run may use.
        options: more words for `duagc run`.
        keep: folder where parts of the recording and runs stay: what is there already is not run again, and what was
            stopped goes on. None: nothing stays.
    """

    recording: Path
    seconds: tuple[float, ...]
    threads: int = 2
    options: tuple[str, ...] = ()
    keep: Path | None = None


def run(plan: LengthPlan) -> dict[str, Any]:
    """Run and measure; ready for JSON.

    Args:
        plan: what.

    Raises:
        DuagError: the logs are shorter than the longest length, or a run fails.
    """
    from duagc.pipeline.bench.peaks import cpu_name

    source = Recording(plan.recording)
    longest = min(seconds_of(source).values())
    if max(plan.seconds) > longest + 1e-6:
        raise DuagError(
            f"{plan.recording}: its shortest log has {longest:.1f} s, expected {max(plan.seconds):g} s or more"
        )
    rows = list(track(_rows(plan, source), "bench length", len(set(plan.seconds))))
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
    with ExitStack() as stack:
        folder = plan.keep
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="duagc-bench-")))
        for seconds in sorted(set(plan.seconds)):
            yield _row(plan, source, seconds, folder)


def _row(plan: LengthPlan, source: Recording, seconds: float, folder: Path) -> dict[str, Any]:
    """The figures of one run.

    Args:
        plan: what is run.
        source: the whole recording.
        seconds: of its logs.
        folder: where the part of the recording and the run go.

    Raises:
        DuagError: a part of another recording is there, or a run that was made otherwise.
    """
    path, out = folder / f"recording{seconds:g}", folder / f"run{seconds:g}"
    part = _part(source, seconds, path)
    _check_made_so(plan, out)
    begun = out.exists() or out.with_name(f"{out.name}.part").exists()
    done = execute(THIS, part.path, out, processors=plan.threads, options=plan.options)
    front = [row for row in done.stages.values() if row["stage"] == "frontend"]
    parts, team = done.metrics["robots"], done.metrics["team"]
    robots = [row for name, row in parts.items() if submap_of(name) is None]
    own = done.metrics["rendering"]["own"]["held_out"]
    frames = sum(row["frames"] for row in robots)  # each component has all frames of its log
    return {
        "seconds": seconds,
        "frames": frames,
        "keyframes": sum(row["keyframes"] for row in parts.values()),
        "cpu_s": round(sum(row["cpu_s"] for row in done.stages.values()) / len(robots), 3),
        "frontend_cpu_s": round(sum(row["cpu_s"] for row in front) / len(front), 3),
        "tracking_ms": round(1e3 * sum(row["parts"]["tracking_s"] for row in front) / frames, 3),
        "wall_s": None if begun else round(done.wall_s, 3),
        "frontend_peak_mb": max(row["peak_rss_mb"] for row in front),
        "peak_memory_mb": max(row["peak_rss_mb"] for row in done.stages.values()),
        "gaussians": sum(row["gaussians"] for row in parts.values()),
        "sent_mb": round(1e-6 * done.metrics["exchange"]["bytes_sent"], 3),
        "joined": team["robots_in_largest_component"],
        "ate_m": team["ate_rmse_m"],
        "psnr_db": own["psnr_db"],
        "depth_l1_m": own["depth_l1_m"],
    }


def _check_made_so(plan: LengthPlan, out: Path) -> None:
    """Note how a run is made before it is; one that is there was made so."""
    stays = out.with_name(f"{out.name}.made.json")
    made = {"threads": plan.threads, "options": list(plan.options)}
    if out.exists() or out.with_name(f"{out.name}.part").exists():
        found = json.loads(stays.read_text(encoding="utf-8")) if stays.is_file() else "nothing that is known"
        if found != made:
            raise DuagError(f"{out}: was made with {found}, expected {made}; choose another --keep")
        return
    stays.parent.mkdir(parents=True, exist_ok=True)
    with new_file(stays) as unfinished:
        unfinished.write_text(json.dumps(made), encoding="utf-8")


def _part(source: Recording, seconds: float, path: Path) -> Recording:
    """The recording that its logs begin with; taken from where it stays, if it is of this recording."""
    stays = path.with_name(f"{path.name}.of.json")
    rows = source.description["robots"]
    of = {name: row.get("digests") or content_digest(source.log(name)) for name, row in rows.items()}
    if (path / RECORDING_FILE).is_file():
        if not stays.is_file() or json.loads(stays.read_text(encoding="utf-8")) != of:
            raise DuagError(
                f"{path}: is not known to be of {source.path}, expected so; choose another --keep"
            )
        return Recording(path)
    shutil.rmtree(path, ignore_errors=True)  # a part that was not finished
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(stays) as unfinished:
        unfinished.write_text(json.dumps(of), encoding="utf-8")
    return part_of(source, len(source.robots), seconds, path)


def format_table(result: dict[str, Any]) -> str:
    """The rows as a table in Markdown.

    Args:
        result: of `run`.
    """
    head = ["s of log", "frames", "keyframes", "cpu s a robot", "more, s per s", "front end", "tracking ms"]
    head += ["wall s", "front end MB", "MB", "Gaussians", "sent MB", "joined", "team ATE mm", "PSNR dB"]
    head += ["depth L1 mm"]
    return "\n".join(
        markdown(
            head,
            (
                [
                    f"{row['seconds']:g}",
                    row["frames"],
                    row["keyframes"],
                    f"{row['cpu_s']:.1f}",
                    _digits(row.get("more_cpu_s_per_s"), 2),
                    f"{row['frontend_cpu_s']:.1f}",
                    f"{row['tracking_ms']:.1f}",
                    _digits(row["wall_s"], 1),
                    f"{row['frontend_peak_mb']:.0f}",
                    f"{row['peak_memory_mb']:.0f}",
                    row["gaussians"],
                    f"{row['sent_mb']:.1f}",
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
