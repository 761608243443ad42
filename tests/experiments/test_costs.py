"""The table of costs: means over runs, a robot's share, and what is not known."""

import json
import math
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from duagc.pipeline.batch.results import TABLE, numbers_of
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
            row("plain", seed, "time.tracking_ms_per_frame", 12.0 + seed),
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


def test_tracking_is_its_share_of_the_front_ends(tmp_path: Path) -> None:
    """Half of 3 s and a quarter of 4 s, for 100 frames; stages without parts are none of it."""
    (tmp_path / "metrics.json").write_text(json.dumps({"robots": {"a": {"frames": 60}, "b": {"frames": 40}}}))
    times = {"wall_s": 9.0, "peak_rss_mb": 1.0}
    stages = {
        "frontend a": times | {"cpu_s": 3.0, "parts": {"tracking_s": 4.0, "mapping_s": 4.0}},
        "frontend b": times | {"cpu_s": 4.0, "parts": {"tracking_s": 2.0, "mapping_s": 6.0}},
        "fusion": times | {"cpu_s": 50.0},
    }
    (tmp_path / "timing.json").write_text(json.dumps({"stages": stages}))
    assert numbers_of(tmp_path)["time.tracking_ms_per_frame"] == 25.0
    (tmp_path / "timing.json").write_text(json.dumps({"stages": {"fusion": stages["fusion"]}}))
    assert "time.tracking_ms_per_frame" not in numbers_of(tmp_path)


def test_costs_are_means_of_a_robot(tmp_path: Path) -> None:
    plain, other = costs_of(table(tmp_path / "mine"))
    assert (plain.configuration, plain.runs, plain.robots) == ("plain", 2, 2.0)
    assert (plain.cpu_s, plain.memory_mb, plain.sent_bytes, plain.gaussians) == (6.0, 500.0, 1.5e6, 20.0)
    assert plain.tracking_ms == 12.5
    assert math.isnan(plain.rounds)
    assert math.isnan(other.tracking_ms)
    assert (other.runs, other.robots) == (1, 4.0), "a run that failed counts nothing"
    write_costs(tmp_path, ["mine", "nowhere"])
    lines = (tmp_path / COSTS).read_text().splitlines()
    assert lines[-2] == "| mine | `plain` | 2 | 2 | 6.0 | 12.5 | 500 | 1.500 | – | 20 |"
    assert lines[-1].startswith("| mine | `other` | 1 | 4 | – | – |")
