"""A run that is there already: up to date, mended from the store, continued, or refused."""

import json
import shutil
from pathlib import Path

from duagc.pipeline.runs.digest import digest
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.fixtures.small_run import SMALL


def again(recording: Path, out: Path, *options: str) -> tuple[int, list[str], str]:
    """`duagc run` as `small_run` was made: exit code, what it said, and what it printed."""
    settings = [word for line in SMALL for word in ("--set", line)]
    result = duagc_here("run", recording, "--out", out, *settings, *options)
    return result.returncode, result.stderr.splitlines(), result.stdout


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
