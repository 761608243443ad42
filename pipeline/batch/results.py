"""What the cells of a suite came to: one table, and one page that compares configurations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc.pipeline.base.component_names import submap_of
from duagc.pipeline.base.files import new_file, read_json
from duagc.pipeline.base.templates import filled
from duagc.pipeline.batch.cell import CellState, read_state, run_folder
from duagc.pipeline.batch.suite import BatchCell, Suite
from duagc.pipeline.comparison.summary import metrics_of

TABLE, PAGE = "results.parquet", "index.html"


@dataclass(frozen=True)
class Column:
    """A number that the page compares.

    Attributes:
        name: of it in the table.
        title: for people.
        scale: shown are its values times this.
        digits: after the point.
        better: 1 if more is better, -1 if less is, 0 if neither.
    """

    name: str
    title: str
    scale: float = 1.0
    digits: int = 2
    better: int = 0


COLUMNS = (
    Column("team.ate_rmse_m", "team ATE (mm)", 1e3, 2, -1),
    Column("team.ate_rmse_m_mean_of_robots", "ATE of robots (mm)", 1e3, 2, -1),
    Column("rendering.own.held_out.psnr_db", "own map, held-out PSNR (dB)", 1.0, 2, 1),
    Column("rendering.refined.held_out.psnr_db", "final map, held-out PSNR (dB)", 1.0, 2, 1),
    Column("rendering.refined.peers.psnr_db", "final map, peers' views PSNR (dB)", 1.0, 2, 1),
    Column("exchange.bytes_sent", "bytes sent (MB)", 1e-6, 3, -1),
    Column("time.cpu_s", "processor time (s)", 1.0, 1, -1),
    Column("time.wall_s", "stages, wall time (s)", 1.0, 1, -1),
)


def numbers_of(run: Path) -> dict[str, float | str | None]:
    """Every metric of a run, and what its stages took when they were computed.

    Args:
        run: folder of the run.
    """
    out: dict[str, float | str | None] = {}
    for name, value in metrics_of(run).items():
        out[name] = value if value is None or isinstance(value, str) else float(value)  # type: ignore[arg-type]
    path = run / "timing.json"
    if path.is_file():
        rows = list(read_json(path, "the times of a run")["stages"].values())
        for name in ("wall_s", "cpu_s"):
            out[f"time.{name}"] = round(math.fsum(row[name] for row in rows), 3)
        out["time.peak_rss_mb"] = max(row["peak_rss_mb"] for row in rows)
        frames = [v for k, v in out.items() if _counts_frames(k)]
        known = [value for value in frames if isinstance(value, float) and value > 0]
        if known and any("parts" in row for row in rows):
            out["time.tracking_ms_per_frame"] = round(1e3 * _tracking_s(rows) / math.fsum(known), 3)
    return out


def _counts_frames(name: str) -> bool:
    """Whether a number counts the frames of a log; every component of a robot has all of its robot's."""
    section, _, rest = name.partition(".")
    robot, _, last = rest.rpartition(".")
    return section == "robots" and last == "frames" and submap_of(robot) is None


def _tracking_s(rows: Sequence[Mapping[str, Any]]) -> float:
    """Processor time of tracking, of the front ends: parts are wall times, which share that of their stage."""
    parts = [(row["cpu_s"], row["parts"]) for row in rows if "parts" in row]
    return math.fsum(cpu_s * of["tracking_s"] / max(math.fsum(of.values()), 1e-9) for cpu_s, of in parts)


def gather(suite: Suite, out: Path) -> dict[str, dict[str, float | str | None]]:
    """Write the table and the page of all cells that are done.

    Args:
        suite: the suite.
        out: folder of the batch.

    Returns:
        The numbers of every cell that is done, by name.
    """
    states = {name: read_state(out, name) for name in suite.cells}
    done = {name: numbers_of(run_folder(out, name)) for name in suite.cells if states[name].state == "done"}
    _write_table(suite, states, done, out / TABLE)
    with new_file(out / PAGE) as part:
        part.write_text(page(suite, states, done), encoding="utf-8")
    return done


def _write_table(
    suite: Suite,
    states: Mapping[str, CellState],
    done: Mapping[str, Mapping[str, float | str | None]],
    path: Path,
) -> None:
    """recording, configuration, seed, state, name, value (null: absent), text (of values that are none)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = []
    for name, cell in suite.cells.items():
        common = {
            "recording": cell.recording,
            "configuration": cell.configuration,
            "seed": cell.seed,
            "state": states[name].state,
        }
        for key, value in (done.get(name) or {"": None}).items():
            text = value if isinstance(value, str) else None
            number = value if isinstance(value, float | int) else None
            rows.append(common | {"name": key, "value": number, "text": text})
    schema = pa.schema(
        [
            ("recording", pa.string()),
            ("configuration", pa.string()),
            ("seed", pa.int64()),
            ("state", pa.string()),
            ("name", pa.string()),
            ("value", pa.float64()),
            ("text", pa.string()),
        ]
    )
    with new_file(path) as part:
        pq.write_table(pa.Table.from_pylist(rows, schema), part)


@dataclass(frozen=True)
class PairedDifference:
    """A configuration against the first one, on the same recordings with the same seeds.

    Attributes:
        mean: of the differences.
        low: the least.
        high: the greatest.
        pairs: how many.
    """

    mean: float
    low: float
    high: float
    pairs: int


def paired(
    suite: Suite, done: Mapping[str, Mapping[str, Any]], name: str, *, recording: str, configuration: str
) -> PairedDifference | None:
    """Paired differences of a number; None if there is no pair.

    Args:
        suite: the suite.
        done: numbers by cell.
        name: of the number.
        recording: the recording.
        configuration: that is compared with the first one.
    """
    base = suite.configurations[0]
    found = {
        (c.configuration, c.seed): value
        for c in _cells_of(suite, recording)
        if isinstance(value := done.get(c.name, {}).get(name), float | int)
    }
    seeds = [seed for of, seed in found if of == configuration and (base, seed) in found]
    gaps = [found[configuration, seed] - found[base, seed] for seed in seeds]
    if not gaps:
        return None
    return PairedDifference(math.fsum(gaps) / len(gaps), min(gaps), max(gaps), len(gaps))


def _cells_of(suite: Suite, recording: str) -> Iterator[BatchCell]:
    return (cell for cell in suite.cells.values() if cell.recording == recording)


def page(suite: Suite, states: Mapping[str, CellState], done: Mapping[str, Mapping[str, Any]]) -> str:
    """The page: a table for every recording, a row for every configuration.

    Args:
        suite: the suite.
        states: of the cells.
        done: numbers of those that are done.
    """
    recordings = list(dict.fromkeys(cell.recording for cell in suite.cells.values()))
    counted = {state: sum(s.state == state for s in states.values()) for state in ("done", "failed")}
    return filled(
        "duagc.pipeline.batch",
        "page.html.j2",
        title=suite.path.stem,
        subtitle=f"{counted['done']} of {len(suite.cells)} runs done, {counted['failed']} failed",
        base=suite.configurations[0],
        columns=[column.title for column in COLUMNS],
        tables=[{"recording": r, "rows": _rows(suite, done, r)} for r in recordings],
        failed=[(name, state.error) for name, state in states.items() if state.state == "failed"],
    )


def _rows(suite: Suite, done: Mapping[str, Mapping[str, Any]], recording: str) -> list[dict[str, Any]]:
    rows = []
    for configuration in suite.configurations:
        cells = [c for c in _cells_of(suite, recording) if c.configuration == configuration]
        if cells:
            rows.append(
                {
                    "configuration": configuration,
                    "runs": sum(c.name in done for c in cells),
                    "cells": [_shown(suite, done, cells, column) for column in COLUMNS],
                }
            )
    return rows


def _shown(
    suite: Suite, done: Mapping[str, Mapping[str, Any]], cells: Sequence[BatchCell], column: Column
) -> dict[str, str]:
    """The mean over the seeds, and the paired difference to the first configuration."""
    values = [
        value for cell in cells if isinstance(value := done.get(cell.name, {}).get(column.name), float | int)
    ]
    if not values:
        return {"value": "–", "gap": "", "verdict": ""}
    value = f"{math.fsum(values) / len(values) * column.scale:.{column.digits}f}"
    cell = cells[0]
    gap = paired(suite, done, column.name, recording=cell.recording, configuration=cell.configuration)
    if gap is None or cell.configuration == suite.configurations[0]:
        return {"value": value, "gap": "", "verdict": ""}
    mean, low, high = (x * column.scale for x in (gap.mean, gap.low, gap.high))
    span = f" ({low:+.{column.digits}f} to {high:+.{column.digits}f})" if gap.pairs > 1 else ""
    clear = column.better * (1 if low > 0 else -1 if high < 0 else 0)
    verdict = {1: "better", -1: "worse", 0: ""}[clear]
    return {"value": value, "gap": f"{mean:+.{column.digits}f}{span}", "verdict": verdict}
