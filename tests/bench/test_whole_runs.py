"""`duagc bench realtime` and `length`: parts of recordings are what they say, and figures those of the runs."""

from __future__ import annotations

import json
import stat
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc import converters, schemas
from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.bench import cell_digests, length, realtime, whole_runs
from duagc.pipeline.cli import app
from duagc.pipeline.recording import Recording, content_digest, open_rgbd
from tests.fixtures.full_disks import no_file_larger_than

COMMAND = """#!{python}
import json, os, sys
recording, out, workers = sys.argv[2], sys.argv[4], int(sys.argv[6])
robots = sorted(json.load(open(recording + "/recording.json"))["robots"])
if "--fail" in sys.argv:
    sys.exit("duagc: no such thing")
os.makedirs(out, exist_ok=True)
row = dict(wall_s=1.0, peak_rss_mb=100.0 * workers, executed=True)
parts = dict(tracking_s=0.1, mapping_s=0.3, refinement_s=0.1, model_s=0.1, final_refinement_s=0.4)
stages = {{f"frontend.{{r}}": row | dict(stage="frontend", robot=r, cpu_s={cost}, parts=parts) for r in robots}}
stages["exchange"] = row | dict(stage="exchange", robot=None, cpu_s=float(len(os.sched_getaffinity(0))))
json.dump(dict(stages=stages), open(out + "/timing.json", "w"))
own = dict(held_out=dict(psnr_db=30.0, depth_l1_m=0.01))
team = dict(robots_in_largest_component=len(robots), ate_rmse_m=None)
robot = dict(frames=5, keyframes=2, gaussians=7)
exchange = dict(bytes_sent=3_000_000)
metrics = dict(rendering=dict(own=own), team=team, exchange=exchange, robots={{r: robot for r in robots}})
if "--split" in sys.argv:
    metrics["robots"]["alpha-2"] = robot
json.dump(metrics, open(out + "/metrics.json", "w"))
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    out = tmp_path_factory.mktemp("runs") / "room"
    simulate(out, robots=2, frames=10, size=(64, 48), seed=1, workers=1)
    return Recording(out)


def command(folder: Path, cost: float) -> Path:
    """A `duagc` whose front ends take so long."""
    path = folder / f"duagc{cost}"
    path.write_text(COMMAND.format(python=sys.executable, cost=cost))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_a_part_is_the_beginning_of_the_first_robots(recording: Recording, tmp_path: Path) -> None:
    before = {robot: content_digest(recording.log(robot)) for robot in recording.robots}
    part = whole_runs.part_of(recording, 1, 0.15, tmp_path / "part")
    assert part.robots == ["alpha"]
    with open_rgbd(part.log("alpha")) as log, open_rgbd(recording.log("alpha")) as whole:
        assert len(log) == part.description["robots"]["alpha"]["frames"] == 5  # at 0, 1/30, .. 4/30 s
        for k in range(len(log)):
            assert (log.frame(k).color == whole.frame(k).color).all()
            assert (log.frame(k).depth == whole.frame(k).depth).all()
    assert part.digest("alpha.mcap") == content_digest(part.log("alpha")) != before["alpha"]
    assert part.groundtruth("alpha") is not None
    assert part.geometry() is not None
    assert whole_runs.seconds_of(part)["alpha"] == pytest.approx(0.15)
    linked = whole_runs.part_of(recording, 2, None, tmp_path / "whole")
    assert {robot: content_digest(linked.log(robot)) for robot in linked.robots} == before
    with pytest.raises(DuagError, match="has 2 robots, expected 3 or more"):
        whole_runs.part_of(recording, 3, None, tmp_path / "three")


def test_realtime_is_the_time_of_runs_by_the_time_of_logs(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(realtime, "THIS", (str(command(tmp_path, 3.0)),))
    plan = realtime.RealtimePlan(
        recording.path, (1, 2), (1,), other=command(tmp_path, 6.0), open3d=False, seconds=0.2
    )
    result = realtime.run(plan)
    assert [(r["version"], r["robots"]) for r in result["rows"]] == [
        ("this", 1), ("other", 1), ("this", 2), ("other", 2),
    ]  # fmt: skip
    for row, whole in zip(result["rows"], (3.0 + 1, 6.0 + 1, 6.0 + 1, 12.0 + 1), strict=True):
        log_s = 0.2 * row["robots"]
        found = row["cpu_s_per_s"]
        front = whole - 1
        assert found["tracking"] == pytest.approx(0.1 * front / log_s, abs=1e-3)
        assert found["poses"] == pytest.approx(0.2 * front / log_s, abs=1e-3)
        assert found["final"] == pytest.approx(0.4 * front / log_s, abs=1e-3)
        assert found["exchange"] == pytest.approx(1 / log_s, abs=1e-3)  # one processor was allowed
        assert found["whole"] == pytest.approx(whole / log_s, abs=1e-3)
        assert row["peak_memory_mb"] == 100.0
    lines = realtime.format_table(result).splitlines()
    ratios = [line for line in lines if "this : other" in line]
    assert len(ratios) == 2
    assert all("0.50x" in line for line in ratios)


def test_length_says_what_a_further_second_costs(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(length, "THIS", (str(command(tmp_path, 3.0)),))
    result = length.run(length.LengthPlan(recording.path, (0.3, 0.1), threads=1))
    assert [row["seconds"] for row in result["rows"]] == [0.1, 0.3]
    assert [row["cpu_s"] for row in result["rows"]] == [
        3.5,
        3.5,
    ]  # of a robot, its share of the exchange with it
    assert result["rows"][1]["more_cpu_s_per_s"] == 0.0
    assert " - |" in length.format_table(result).splitlines()[2]  # no ground truth, no ATE
    assert [row["tracking_ms"] for row in result["rows"]] == [20.0, 20.0]
    assert [row["sent_mb"] for row in result["rows"]] == [3.0, 3.0]
    with pytest.raises(DuagError, match=r"shortest log has 0\.3 s, expected 9 s or more"):
        length.run(length.LengthPlan(recording.path, (9.0,)))


def test_frames_and_time_of_a_robot_in_two_components_count_once(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(length, "THIS", (str(command(tmp_path, 3.0)),))
    plan = length.LengthPlan(recording.path, (0.1,), threads=1, options=("--split",))
    (row,) = length.run(plan)["rows"]
    assert (row["frames"], row["cpu_s"], row["tracking_ms"]) == (10, 3.5, 20.0)
    assert (row["keyframes"], row["gaussians"]) == (6, 21)


def test_what_is_kept_is_completed(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(length, "THIS", (str(command(tmp_path, 3.0)),))
    plan = length.LengthPlan(recording.path, (0.1,), threads=1, keep=tmp_path / "kept")
    (tmp_path / "kept" / "recording0.2").mkdir(parents=True)  # a part that was not finished
    assert length.run(plan)["rows"][0]["wall_s"] > 0
    plan = length.LengthPlan(recording.path, (0.1, 0.2), threads=1, keep=tmp_path / "kept")
    assert [row["wall_s"] is None for row in length.run(plan)["rows"]] == [True, False]
    runs = [path.name for path in (tmp_path / "kept").glob("run*") if path.is_dir()]
    assert sorted(runs) == ["run0.1", "run0.2"]
    for other in (replace(plan, threads=2), replace(plan, options=("--set", "seed=1"))):
        with pytest.raises(DuagError, match=r"run0\.1: was made with .*choose another --keep"):
            length.run(other)


def test_a_part_has_its_description_when_it_is_whole(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with no_file_larger_than(100), pytest.raises(DuagError, match="File too large"):
        whole_runs.part_of(recording, 1, None, tmp_path / "part")
    assert not (tmp_path / "part" / "recording.json").exists()


@pytest.mark.parametrize("stated", [True, False], ids=["digests", "no digests"])
def test_what_is_kept_of_another_recording_is_refused(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: bool
) -> None:
    monkeypatch.setattr(length, "THIS", (str(command(tmp_path, 3.0)),))
    shorter, longer = (whole_runs.part_of(recording, 2, s, tmp_path / f"{s}s").path for s in (0.2, 0.3))
    if not stated:
        for path in (shorter, longer):
            description = json.loads((path / "recording.json").read_text())
            for row in description["robots"].values():
                del row["digests"]
            (path / "recording.json").write_text(json.dumps(description))
    plan = length.LengthPlan(shorter, (0.1, 0.1), threads=1, keep=tmp_path / "kept")
    length.run(plan)
    assert length.run(plan)["rows"][0]["wall_s"] is None
    with pytest.raises(DuagError, match=r"recording0\.1: is not known to be of .*choose another --keep"):
        length.run(replace(plan, recording=longer))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["realtime", "--robots", "3"], "has 2 robots, expected 3 or more"),
        (["realtime", "--other", "/nowhere/duagc"], "/nowhere/duagc: no such command"),
        (["realtime", "--robots", "none"], "'none' is not a positive number"),
    ],
)
def test_what_cannot_be_run_is_said_at_once(recording: Recording, words: list[str], said: str) -> None:
    result = CliRunner().invoke(app, ["bench", words[0], str(recording.path), *words[1:]])
    assert result.exit_code
    assert said in f"{result.output} {result.exception}"


def test_a_command_that_fails_is_named_with_its_last_line(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = command(tmp_path, 1.0)
    monkeypatch.setattr(realtime, "THIS", (str(failing),))
    plan = realtime.RealtimePlan(recording.path, (1,), (1,), open3d=False, options=("--fail",))
    with pytest.raises(DuagError, match="said 'duagc: no such thing' and ended with 1"):
        realtime.run(plan)


def test_more_processors_than_there_are_are_refused(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole_runs.os, "sched_getaffinity", lambda _: {0, 1})
    with pytest.raises(DuagError, match="--threads 3: found 2 processors, expected 3"):
        whole_runs.execute(("nothing",), recording.path, tmp_path / "out", processors=3)


def test_a_digest_of_robustness_has_versions_and_schemas(monkeypatch: pytest.MonkeyPatch) -> None:
    before, versions = cell_digests.code_digest(), cell_digests.library_versions()
    assert versions["numpy"] == np.__version__
    with monkeypatch.context() as other:
        other.setattr(cell_digests, "library_versions", lambda: versions | {"numpy": "1"})
        assert cell_digests.code_digest() != before
    with monkeypatch.context() as other:
        other.setattr(schemas, "__path__", [converters.__path__[0]])
        assert cell_digests.code_digest() != before
    assert cell_digests.code_digest() == before
