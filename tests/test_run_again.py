"""A run that is there already: up to date, mended from the store, continued, or refused."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.runs.digest import digest
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.fixtures.small_run import SMALL

ABOUT = {"config.toml", "manifest.json", "timing.json"}
PREPARED = {
    f"robots/{robot}/{part}.mcap" for robot in ("alpha", "bravo") for part in ("frontend", "information")
}
EXCHANGED = {"exchange.mcap", "consensus.mcap", "robots/alpha/session.npz", "robots/bravo/session.npz"}


def again(recording: Path, out: Path, *options: str) -> tuple[int, list[str], str]:
    """`duagc run` as `small_run` was made: exit code, what it said, and what it printed."""
    settings = [word for line in SMALL for word in ("--set", line)]
    result = duagc_here("run", recording, "--out", out, *settings, *options)
    return result.returncode, result.stderr.splitlines(), result.stdout


def names(run_folder: Path) -> set[str]:
    return {path.relative_to(run_folder).as_posix() for path in run_folder.rglob("*") if path.is_file()}


def stages_in(run_folder: Path) -> set[str]:
    return set(json.loads((run_folder / "manifest.json").read_text())["stages"])


def exchange_in(small_runs: Path) -> tuple[str, ...]:
    """Options that compute the exchange again, with times that no other test gets to see."""
    return "--from", "exchange", "--until", "exchange", "--store", str(small_runs / "own_store")


def executed(run_folder: Path) -> list[str]:
    rows = json.loads((run_folder / "timing.json").read_text())["stages"]
    return [name for name, row in rows.items() if row["executed"]]


def test_a_run_that_is_there_already_is_up_to_date(small_recording: Path, small_run: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in small_run.rglob("*")}
    assert len(executed(small_run)) == 10
    code, lines, printed = again(small_recording, small_run)
    assert (code, lines[0]) == (0, f"duagc: {small_run}: up to date")
    assert [line.split()[1] for line in lines[-4:]] == ["fusion", "evaluation", "report", "rrd"]
    assert "refined.ply" in printed
    assert {path: path.stat().st_mtime_ns for path in small_run.rglob("*")} == before


def test_a_damaged_result_of_a_run_is_taken_from_the_store(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    damaged = small_runs / "damaged_run"
    shutil.copytree(small_run, damaged)
    (damaged / "robots" / "alpha" / "odometry.tum").write_text("nothing")
    (damaged / "notes").mkdir()
    (damaged / "notes" / "mine.txt").write_text("mine")
    code, lines, _ = again(small_recording, damaged)
    assert code == 0
    assert (damaged / "notes" / "mine.txt").read_text() == "mine"
    assert "odometry.tum: is not what was computed; taken from the store" in lines[0]
    assert digest(damaged) == digest(small_run)
    assert executed(damaged) == []
    (damaged / "metrics.json").write_text("{}")  # as `duagc evaluate --own-longer` writes it again
    assert "up to date" in again(small_recording, damaged)[1][0]
    (damaged / "manifest.json").write_text('{"schema": 1, "stages": {"exchange": "mine"}}')
    code, lines, _ = again(small_recording, damaged)
    assert code == 1
    assert "exists already, and exchange differs" in lines[0]


def test_a_run_without_what_it_is_read_by_is_mended(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    damaged = small_runs / "run_to_mend"
    shutil.copytree(small_run, damaged)
    (damaged / "videos").symlink_to("../videos")
    (damaged / "empty").mkdir()
    config, timing = ((damaged / name).read_text() for name in ("config.toml", "timing.json"))
    for name, text in (
        ("config.toml", None),
        ("config.toml", config.replace("seed = 0", "seed = 5")),
        ("timing.json", None),
        ("timing.json", timing[:300]),
        ("timing.json", '{"a": [1]}'),
        ("run.rrd", ""),
        ("metrics.json", ""),
    ):
        if text is None:
            (damaged / name).unlink()
        else:
            (damaged / name).write_text(text)
        code, lines, _ = again(small_recording, damaged)
        assert code == 0, lines
        assert lines[0].endswith(f"{name}: is not what was computed; taken from the store")
        assert "up to date" in again(small_recording, damaged)[1][0]
    assert (damaged / "config.toml").read_text() == config
    assert (damaged / "run.rrd").read_bytes() == (small_run / "run.rrd").read_bytes()
    assert (damaged / "videos").readlink() == Path("../videos")
    assert (damaged / "empty").is_dir()


def test_results_of_other_settings_do_not_stay_in_a_run(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    """Those that no manifest names neither; files that somebody else put there do."""
    out = small_runs / "other_fusion"
    shutil.copytree(small_run, out)
    mine = {"picture.png", "robots/alpha/before/fused.ply"}
    (out / "robots" / "alpha" / "before").mkdir()
    for name in mine:
        (out / name).write_text("mine")
    manifest = json.loads((out / "manifest.json").read_text())
    del manifest["stages"]["evaluation"], manifest["stages"]["report"]  # as if measured by `duagc evaluate`
    (out / "manifest.json").write_text(json.dumps(manifest))
    code, lines, printed = again(small_recording, out, "--set=fusion.max_added=3", *exchange_in(small_runs))
    assert code == 0
    assert "max_added = 3\n" in (out / "config.toml").read_text()
    assert names(out) == ABOUT | PREPARED | EXCHANGED | mine
    assert {name.split(".")[0] for name in stages_in(out)} == {"frontend", "information", "exchange"}
    assert any("left out results of other settings or inputs: metrics.json and" in line for line in lines)
    assert "refined.ply" not in printed
    assert_one_line(duagc_here("evaluate", out), "trajectory.tum: not found; `duagc run`")
    assert_one_line(duagc_here("report", out), "metrics.json: not found")


def test_later_results_of_the_same_settings_stay_in_a_run(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    out = small_runs / "same_fusion"
    shutil.copytree(small_run, out)
    (out / "metrics.json").write_text("{}")  # as `duagc evaluate --own-longer` writes it again
    code, lines, _ = again(small_recording, out, *exchange_in(small_runs))
    assert code == 0
    assert executed(out) == ["exchange"]
    assert names(out) == names(small_run) - {"report/index.html"}  # it shows how long the exchange took
    assert stages_in(out) == stages_in(small_run) - {"report"}
    assert any(
        line.endswith("left out results of other settings or inputs: report/index.html") for line in lines
    )
    assert digest(out) == digest(small_run)
    assert (out / "run.rrd").read_bytes() == (small_run / "run.rrd").read_bytes()
    assert (out / "metrics.json").read_text() == "{}"
    code, lines, _ = again(small_recording, out, "--set=fusion.max_added=3")
    assert code == 1
    assert "fusion of alpha differs" in lines[0]


def test_later_results_of_other_settings_go_from_a_run_whose_earlier_ones_are_up_to_date(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    out = small_runs / "other_later_settings"
    shutil.copytree(small_run, out)
    until = ("--until", "exchange", "--set", "fusion.max_added=3")
    code, lines, _ = again(small_recording, out, *until)
    assert code == 0
    assert any("left out results of other settings or inputs" in line for line in lines)
    assert names(out) == ABOUT | PREPARED | EXCHANGED
    assert executed(out) == []
    assert "up to date" in again(small_recording, out, *until)[1][0]


def test_a_run_is_up_to_date_though_another_one_computed_one_of_its_stages_again(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    """The times of the stages, which the report shows, are not those of the store any more."""
    out, store = small_runs / "first_of_two", small_runs / "store_of_two"
    shutil.copytree(small_run, out)
    shutil.copytree(small_runs / ".duagc-store", store)
    shared = ("--store", str(store))
    other = ("--from", "exchange", "--until", "exchange", *shared)
    assert again(small_recording, small_runs / "second_of_two", *other)[0] == 0
    code, lines, _ = again(small_recording, out, *shared)
    assert (code, lines[0]) == (0, f"duagc: {out}: up to date")


def test_metrics_of_another_evaluation_are_replaced_with_a_warning(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    out = small_runs / "measured_otherwise"
    shutil.copytree(small_run, out)
    (out / "metrics.json").write_text("{}")  # as `duagc evaluate --own-longer` writes it again
    (out / "run.rrd").unlink()
    code, lines, _ = again(small_recording, out)
    assert code == 0
    warned = f"duagc: warning: {out / 'metrics.json'}: was written by another evaluation since"
    assert any(line.startswith(warned) for line in lines)
    assert digest(out) == digest(small_run)


def test_results_of_another_team_do_not_stay_in_a_run(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    team, out = small_runs / "team", small_runs / "run_of_team"
    shutil.copytree(small_recording, team)
    shutil.copytree(small_run, out)
    third = small_runs / "third"
    png = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))[1]
    with (
        RecordingWriter(third) as recording,
        recording.robot("charlie", PinholeCamera(64, 48, 60, 60, 31.5, 23.5), 0.001) as robot,
    ):
        for k in range(3):
            robot.add_frame(k * 33_000_000, png.tobytes(), "png", np.full((48, 64), 1500, np.uint16))
    shutil.copy(third / "charlie.mcap", team)
    described, more = (json.loads((folder / "recording.json").read_text()) for folder in (team, third))
    described["robots"]["charlie"] = more["robots"]["charlie"]
    (team / "recording.json").write_text(json.dumps(described))
    code, lines, _ = again(team, out, "--until", "information")
    assert code == 0, lines
    charlie = {f"robots/charlie/{part}.mcap" for part in ("frontend", "information")}
    assert names(out) == ABOUT | PREPARED | charlie
    assert any("left out results of other settings or inputs: consensus.mcap and" in line for line in lines)


def test_another_consensus_computes_nothing_upstream_and_going_back_nothing_at_all(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    other = "--set=exchange.link.loss_probability=0.2"
    code, _, printed = again(small_recording, small_run, other, "--why")
    assert code == 0
    assert printed.splitlines() == [
        "frontend of alpha: in the store",
        "information of alpha: in the store",
        "frontend of bravo: in the store",
        "information of bravo: in the store",
        "exchange: computed: settings: exchange.link.loss_probability 0.0 -> 0.2",
        "fusion, evaluation, report, rrd: computed unless the results before turn out as they were",
    ]
    code, lines, _ = again(small_recording, small_run, other)
    assert code == 1
    assert "exchange differs (settings: exchange.link.loss_probability 0.0 -> 0.2)" in lines[0]
    again(small_recording, small_runs / "run_other", other, "--until", "exchange")
    assert executed(small_runs / "run_other") == ["exchange"]
    code, lines, _ = again(small_recording, small_runs / "run_other", "--force")
    assert code == 0
    assert executed(small_runs / "run_other") == []
    assert digest(small_runs / "run_other") == digest(small_run)
    for name in ("metrics.json", "report/index.html"):
        assert (small_runs / "run_other" / name).read_bytes() == (small_run / name).read_bytes()


def test_metrics_and_report_can_be_left_out_and_come_later(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    out = small_runs / "run_bare"
    code, _, printed = again(small_recording, out, "--no-evaluation")
    assert code == 0
    assert executed(out) == ["rrd"]
    assert "refined.ply" in printed
    assert not (out / "metrics.json").exists()
    assert not (out / "report").exists()
    assert digest(out) == digest(small_run)
    assert "up to date" in again(small_recording, out, "--no-evaluation")[1][0]
    assert again(small_recording, out)[0] == 0
    assert executed(out) == []
    assert "up to date" in again(small_recording, out, "--no-evaluation")[1][0]
    for name in ("metrics.json", "metrics.parquet", "report/index.html"):
        assert (out / name).read_bytes() == (small_run / name).read_bytes()


def test_stages_have_names(small_recording: Path, small_runs: Path) -> None:
    for option in ("--from", "--until"):
        assert_one_line(
            duagc_here("run", small_recording, "--out", small_runs / "none", option, "fussion"),
            "perhaps fusion",
        )
    assert_one_line(
        duagc_here(
            "run", small_recording, "--out", small_runs / "none", "--from", "fusion", "--until", "exchange"
        ),
        "comes after --until exchange",
    )
    assert (
        duagc_here("run", small_recording, "--out", small_runs / "none", "--no-cache", "--why").returncode
        == 2
    )
    for option, stage in (("--until", "report"), ("--from", "evaluation")):
        words = ("run", small_recording, "--out", small_runs / "none", "--no-evaluation", option, stage)
        assert "expected without --from or --until" in duagc_here(*words).stderr


def test_a_run_that_is_up_to_date_knows_where_its_recording_is_now(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    run, moved = small_runs / "run_moved", small_runs / "moved"
    shutil.copytree(small_run, run)
    shutil.copytree(small_recording, moved)
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(manifest | {"recording": "../gone"}))
    assert "up to date" in again(moved, run)[1][0]
    assert json.loads((run / "manifest.json").read_text()) == manifest | {"recording": "../moved"}
