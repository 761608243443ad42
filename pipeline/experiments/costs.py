"""One table of costs: what every configuration of the experiments in a folder took, on the machine that computed it.

Times and memory are no result: they differ when they are measured again, so no rule may name them and they stand in a
file of their own.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline.base.files import new_file
from duagc.pipeline.batch.results import TABLE
from duagc.pipeline.experiments.statistics import mean

COSTS = "costs.md"
HEAD = """---
kind: results
generated: true
---
# Costs

Made by `duagc experiment report DIR` of the [experiments](experiments.md).
Means over the runs of each configuration; robots share a machine.
Times are those of the stages when they were computed, memory is that of the largest process.

| experiment | configuration | runs | robots | processor time (s a robot) | of it tracking (ms a frame) | \
memory (MB) | sent (MB a robot) | rounds | Gaussians of a fused map |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
"""


@dataclass(frozen=True)
class Cost:
    """What a configuration took; NaN: not known.

    Attributes:
        experiment: name of it.
        configuration: name of it.
        runs: that are done.
        robots: of a run.
        cpu_s: of all stages, of each robot.
        tracking_ms: processor time of a frame in tracking.
        memory_mb: of the largest process.
        sent_bytes: by each robot.
        rounds: of the session.
        gaussians: of a fused map.
    """

    experiment: str
    configuration: str
    runs: int
    robots: float
    cpu_s: float
    tracking_ms: float
    memory_mb: float
    sent_bytes: float
    rounds: float
    gaussians: float


def costs_of(path: Path) -> list[Cost]:
    """What the configurations of one experiment took, in the order of its table.

    Args:
        path: folder of the experiment.
    """
    import pyarrow.parquet as pq

    found: dict[str, dict[str, list[float]]] = {}
    cells: dict[str, set[tuple[str, int]]] = defaultdict(set)
    for row in pq.read_table(path / TABLE).to_pylist():
        if row["state"] == "done" and row["value"] is not None:
            found.setdefault(row["configuration"], defaultdict(list))[_key(row["name"])].append(row["value"])
            cells[row["configuration"]].add((row["recording"], row["seed"]))
    return [_cost(path.name, name, len(cells[name]), numbers) for name, numbers in found.items()]


def write_costs(out: Path, experiments: Sequence[str]) -> None:
    """Write the table of all experiments of a folder.

    Args:
        out: the folder.
        experiments: their names.
    """
    costs = [cost for name in experiments if (out / name / TABLE).is_file() for cost in costs_of(out / name)]
    with new_file(out / COSTS) as part:
        part.write_text(
            HEAD + "".join(f"| {' | '.join(_cells(cost))} |\n" for cost in costs), encoding="utf-8"
        )


def _key(name: str) -> str:
    """Numbers of all robots count alike."""
    parts = name.split(".")
    return f"robots.*.{parts[-1]}" if parts[0] == "robots" else name


def _cost(experiment: str, configuration: str, runs: int, numbers: dict[str, list[float]]) -> Cost:
    def of(name: str) -> float:
        return mean(numbers[name]) if numbers.get(name) else math.nan

    robots = of("team.robots")
    return Cost(
        experiment=experiment,
        configuration=configuration,
        runs=runs,
        robots=robots,
        cpu_s=of("time.cpu_s") / robots,
        tracking_ms=of("time.tracking_ms_per_frame"),
        memory_mb=of("time.peak_rss_mb"),
        sent_bytes=of("exchange.bytes_sent") / robots,
        rounds=of("exchange.rounds"),
        gaussians=of("robots.*.gaussians_fused"),
    )


def _cells(cost: Cost) -> Iterator[str]:
    yield from (cost.experiment, f"`{cost.configuration}`", str(cost.runs))
    shown = (
        (cost.robots, 0),
        (cost.cpu_s, 1),
        (cost.tracking_ms, 1),
        (cost.memory_mb, 0),
        (cost.sent_bytes / 1e6, 3),
        (cost.rounds, 1),
        (cost.gaussians, 0),
    )
    yield from ("–" if math.isnan(value) else f"{value:.{digits}f}" for value, digits in shown)
