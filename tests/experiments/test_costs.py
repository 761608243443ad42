"""The table of costs: means over runs, a robot's share, and what is not known."""

import math
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from duagc.pipeline.batch.results import TABLE
from duagc.pipeline.experiments.costs import COSTS, costs_of, write_costs


def row(
    configuration: str, seed: int, name: str, value: float | None, state: str = "done"
) -> dict[str, object]:
    return {
        "recording": f"seed_{seed}",
        "configuration": configuration,
        "seed": seed,
        "state": state,
        "name": name,
        "value": value,
        "text": None,
    }


def table(path: Path) -> Path:
    rows = []
    for seed, cpu_s in ((0, 10.0), (1, 14.0)):
        rows += [row("plain", seed, "time.cpu_s", cpu_s), row("plain", seed, "team.robots", 2.0)]
        rows += [
            row("plain", seed, "exchange.bytes_sent", 3e6),
            row("plain", seed, "time.peak_rss_mb", 500.0),
        ]
        rows += [
            row("plain", seed, f"robots.{name}.gaussians_fused", n) for name, n in (("a", 10), ("b", 30))
        ]
    rows += [
        row("other", 0, "seed", 0.0),
        row("other", 0, "team.robots", 4.0),
        row("other", 0, "exchange.rounds", None),
    ]
    rows += [row("other", 1, "team.robots", 100.0, state="failed")]
    path.mkdir()
    pq.write_table(pa.Table.from_pylist(rows), path / TABLE)
    return path


def test_costs_are_means_of_a_robot(tmp_path: Path) -> None:
    plain, other = costs_of(table(tmp_path / "mine"))
    assert (plain.configuration, plain.runs, plain.robots) == ("plain", 2, 2.0)
    assert (plain.cpu_s, plain.memory_mb, plain.sent_bytes, plain.gaussians) == (6.0, 500.0, 1.5e6, 20.0)
    assert math.isnan(plain.rounds)
    assert (other.runs, other.robots) == (1, 4.0), "a run that failed counts nothing"
    write_costs(tmp_path, ["mine", "nowhere"])
    lines = (tmp_path / COSTS).read_text().splitlines()
    assert lines[-2] == "| mine | `plain` | 2 | 2 | 6.0 | 500 | 1.500 | – | 20 |"
    assert lines[-1].startswith("| mine | `other` | 1 | 4 | – |")
