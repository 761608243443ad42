"""`duagc bench frontend`: it runs the stage itself, times what it names, and measures against the ground truth."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.bench import frontend as bench
from duagc.pipeline.bench import frontend_tables, stopwatch
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.report import figures

MAPPING = {
    "mapping.final_iterations": 2,
    "mapping.final_iterations_view": 0,
    "mapping.iterations": 8,
    "mapping.support_views": 2,
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench") / "room"
    simulate(out, robots=2, frames=14, size=(160, 120), workers=1)
    return out


class ThisProcess:
    """Instead of a pool: what each run imports and allocates is of no interest here."""

    def submit(self, function: Callable, *arguments: Any, **named: Any) -> Future:
        done: Future = Future()
        done.set_result(function(*arguments, **named))
        return done


@pytest.fixture(scope="module")
def result(recording: Path) -> dict:
    config = bench.changed(FrontendConfig(), MAPPING)
    with pytest.MonkeyPatch.context() as patch:  # the runs of other tests have processes of their own
        patch.setattr(bench, "worker_pool", lambda workers: nullcontext(ThisProcess()))
        return bench.run(bench.Plan(recording, config, caps=(1000, 3000), robots=("bravo",)))


def test_every_run_is_there_and_measured(result: dict) -> None:
    rows = result["rows"]
    assert [row["name"] for row in rows] == ["map", "map", *bench.ABLATION, *bench.OPEN3D]
    assert {row["robot"] for row in rows} == {"bravo"}
    for row in rows:
        assert row["frames"] == 14
        assert row["times"]["frame"]["calls"] == 14
        assert row["times"]["frame"]["cpu_ms"] > 0
        assert 20 < row["peak_memory_mb"] < 4000
        assert 0 < row["ate_rmse_m"] < 0.2
    json.dumps(result, allow_nan=False)


def test_maps_are_scored_and_their_times_add_up(result: dict) -> None:
    maps = [row for row in result["rows"] if row["name"] == "map"]
    assert [row["max_gaussians"] for row in maps] == [1000, 3000]
    assert 0 < maps[0]["gaussians"] <= 1000 < maps[1]["gaussians"] <= 3000
    for row in maps:
        assert row["refined"]["views"] == row["unrefined"]["views"] == 2  # frames 4 and 12
        assert 10 < row["refined"]["psnr_db"] < 60
        assert row["refined"]["depth_l1_exact_m"] == pytest.approx(row["refined"]["depth_l1_m"])
        for whole in ("frame", "keyframe"):
            times = row["times"][whole]
            parts = times["parts_cpu_ms"]
            assert sum(parts.values()) == pytest.approx(times["cpu_ms"])
            assert all(value > 0 for value in parts.values())
        assert row["times"]["keyframe"]["calls"] == row["keyframes"]
        assert row["times"]["keyframe"]["gaussians_drawn"] > 100
        assert "model" not in row["times"]  # depth is exact: no frame is registered to the map
    assert maps[1]["refined"]["psnr_db"] > maps[0]["refined"]["psnr_db"]


def test_tracking_is_the_same_with_and_without_maps(result: dict) -> None:
    both = [row for row in result["rows"] if row["name"] in ("map", bench.WITHOUT_MAP)]
    for name in ("keyframes", "lost", "frames"):
        assert len({row[name] for row in both}) == 1
    # Gauss-Newton steps are counted in tracking alone, and are the same on every machine
    assert len({row["times"]["frame"]["steps"] for row in both}) == 1
    assert both[0]["times"]["frame"]["steps"] > 3
    ablated = {row["name"]: row["ate_rmse_m"] for row in result["rows"] if row["name"] in bench.ABLATION}
    assert ablated["point-to-plane only"] != ablated[bench.WITHOUT_MAP] != ablated["photometric only"]


def table_of(result: dict) -> str:
    """Without the spaces that make columns equally wide."""
    return " ".join(frontend_tables.format_tables(result).split())


def test_tables_hold_every_row(result: dict) -> None:
    text = table_of(result)
    for name in (*bench.ABLATION, *bench.OPEN3D):
        assert text.count(f"| bravo | {name} |") >= 1
    assert "| bravo | 1000 |" in text
    agreement = text.split("Agreement of held-out views")[1].split("Mapping")[0]
    assert agreement.count("| bravo |") == 2 + len(bench.ABLATION)  # Open3D has no held-out views
    assert "None" not in text


def test_the_curve_over_the_caps_is_drawn_from_the_rows(result: dict) -> None:
    robots = bench.by_cap(result | {"rows": result["rows"][::-1]})
    assert [row["cap"] for row in robots["bravo"]] == [1000, 3000]
    assert robots["bravo"][1]["psnr_db"] == result["rows"][1]["refined"]["psnr_db"]
    drawn = figures.map_sizes(robots)
    assert drawn == figures.map_sizes(robots)
    for words in ("3k", "PSNR", "one layer", "peak memory"):
        assert words in drawn
    robots["bravo"][0]["depth_l1_m"] = None
    assert _points(figures.map_sizes(robots)) == _points(drawn) - 1


def _points(svg: str) -> int:
    """Markers of an image by matplotlib; unlike ticks they are clipped."""
    return sum(group.count("<use ") for group in re.findall(r"<g clip-path[^>]*>(.*?)</g>", svg, re.DOTALL))


def test_two_held_out_views_are_too_few_to_agree(result: dict) -> None:
    for row in result["rows"]:
        if row["name"] not in bench.OPEN3D:
            assert row["depth_agreement_m"] is row["feature_agreement_px_of_truth"] is None
            assert row["depth_agreement_pairs"] <= 1


def test_without_ground_truth_errors_are_absent(recording: Path, tmp_path: Path) -> None:
    copy = tmp_path / "rec"
    copy.mkdir()
    for path in recording.iterdir():
        if "groundtruth" not in path.name:
            (copy / path.name).write_bytes(path.read_bytes())
    plan = bench.Plan(copy, FrontendConfig(), ablation=False, open3d=False, robots=("alpha",))
    result = bench.run(plan)
    (row,) = result["rows"]
    assert row["ate_rmse_m"] is None
    assert "no ground truth" in result["reasons"]["rows.0.ate_rmse_m"]
    assert "| alpha | " + bench.WITHOUT_MAP + " |" in table_of(result)
    assert " | - | - | - | " in table_of(result)  # no errors of the trajectory


def test_the_command_prints_json(recording: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "from duagc.pipeline.cli import main; main()",
        "bench",
        "frontend",
        str(recording),
    ]
    command += ["--robot", "alpha", "--caps", "none", "--no-ablation", "--no-open3d", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    (row,) = json.loads(done.stdout)["rows"]
    assert (row["robot"], row["name"], row["lost"]) == ("alpha", bench.WITHOUT_MAP, 0)
    assert "psnr" not in done.stdout


def test_unknown_robots_and_settings_are_refused(recording: Path) -> None:
    with pytest.raises(DuagError, match="no robot zulu"):
        bench.run(bench.Plan(recording, FrontendConfig(), robots=("zulu",)))
    with pytest.raises(DuagError, match="no such setting"):
        bench.changed(FrontendConfig(), {"tracking.registration.magic": 1})


class Worker:
    """Something to time."""

    @staticmethod
    def fixed(seconds: float) -> float:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass
        return seconds

    def own(self, seconds: float) -> float:
        return 2 * self.fixed(seconds)


def test_a_stopwatch_times_calls_and_leaves_no_trace() -> None:
    before = dict(vars(Worker))
    with stopwatch.Stopwatch({"own": (Worker, "own"), "fixed": (Worker, "fixed")}) as watch:
        assert Worker().own(0.02) == 0.04
        assert Worker.fixed(0.01) == 0.01
    assert dict(vars(Worker)) == before
    Worker().own(0.001)
    assert np.round(watch.calls["own"].cpu_s, 2) == pytest.approx([0.02], abs=0.011)
    assert np.round(watch.calls["fixed"].cpu_s, 2) == pytest.approx([0.02, 0.01], abs=0.011)
    assert (np.array(watch.calls["own"].wall_s) >= 0.019).all()
    with pytest.raises(AttributeError), stopwatch.Stopwatch({"x": (Worker, "fixed"), "y": (Worker, "gone")}):
        pass
    assert dict(vars(Worker)) == before


def test_quarters_are_those_of_the_run() -> None:
    calls = stopwatch.Calls([0.001] * 4 + [0.002] * 8 + [0.003] * 4, [0.01] * 16)
    found = stopwatch.summary(calls)
    assert found["cpu_ms_first_quarter"] == pytest.approx(1)
    assert found["cpu_ms_last_quarter"] == pytest.approx(3)
    assert found["cpu_ms"] == found["cpu_ms_median"] == pytest.approx(2)
    assert found["wall_ms"] == pytest.approx(10)
