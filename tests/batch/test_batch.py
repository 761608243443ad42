"""A suite is a matrix that is checked before anything runs; a cell that fails stops no other."""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from duagc.pipeline import existing_run, runner
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.batch import results
from duagc.pipeline.batch.batch import run_batch, status_text
from duagc.pipeline.batch.cell import CellState, read_state, run_cell, run_folder, write_state
from duagc.pipeline.batch.engines import LocalEngine
from duagc.pipeline.batch.results import gather, paired
from duagc.pipeline.batch.suite import Suite, read_suite
from duagc.pipeline.cache.claims import this_process
from duagc.pipeline.cache.file_digests import FileDigests
from tests.fixtures import fake_run
from tests.fixtures.commands import assert_one_line, duagc_here

SUITE = """
seeds = [0, 1]
[recordings]
wall = "{recording}"
[configurations.plain]
[configurations.lossy]
set = ["exchange.link.loss_probability=0.3"]
"""


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> fake_run.FakeRun:
    return fake_run.make(tmp_path_factory.mktemp("fake"))


@pytest.fixture
def suite(fake: fake_run.FakeRun, tmp_path: Path) -> Suite:
    path = tmp_path / "suite.toml"
    path.write_text(SUITE.format(recording=fake.recording))
    return read_suite(path)


class Pretended:
    """An engine whose cells end as they are asked to."""

    slots = 2

    def __init__(self, out: Path, failures: dict[str, int]) -> None:
        self.out, self.failures = out, failures
        self.running: list[str] = []
        self.most = 0
        self.begun: list[str] = []

    def submit(self, name: str, arguments: Mapping[str, str]) -> None:
        assert arguments["cell"] == name
        self.running.append(name)
        self.begun.append(name)
        self.most = max(self.most, len(self.running))

    def wait(self) -> str:
        name = self.running.pop(0)
        if self.failures.get(name, 0) > 0:
            self.failures[name] -= 1
            if "killed" not in name:
                write_state(self.out, name, CellState("failed", error="no depth"))
            return name
        write_state(self.out, name, CellState("done", wall_s=2.0))
        return name


def test_a_matrix_has_every_cell_with_its_settings(suite: Suite) -> None:
    assert list(suite.cells) == ["wall-plain-0", "wall-plain-1", "wall-lossy-0", "wall-lossy-1"]
    cell = suite.cells["wall-lossy-1"]
    assert (cell.config.seed, cell.config.exchange.link.loss_probability) == (1, 0.3)
    suite.path.write_text(
        suite.path.read_text().replace("[recordings]", "[[exclude]]\nseed = 1\n[recordings]")
    )
    assert list(read_suite(suite.path).cells) == ["wall-plain-0", "wall-lossy-0"]
    (suite.path.parent / "more.toml").write_text("[exchange]\nmax_rounds = 7\n")
    suite.path.write_text(suite.path.read_text().replace("set =", 'file = "more.toml"\nset ='))
    config = read_suite(suite.path).cells["wall-lossy-0"].config
    assert (config.exchange.max_rounds, config.exchange.link.loss_probability) == (7, 0.3)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("wall = ", 'other = "nowhere"\nwall = ', "nowhere/recording.json: no such file"),
        ("[0, 1]", "[0, true]", r"toml: seeds\.1 is true or false, expected a number"),
        (
            "loss_probability",
            "loss_probabilty",
            r"toml: configuration lossy: .* expected perhaps exchange.link.loss_probability",
        ),
        ("[0, 1]", "[0, -1]", r"toml: configuration plain: .*seed is -1, expected 0 or more"),
        ("set =", 'file = "none.toml"\nset =', "none.toml: No such file"),
        ("set =", "sets =", "configurations.lossy.sets is unknown, expected perhaps set"),
        ("seeds", "seed", "seed is unknown, expected perhaps seeds"),
        ("[0, 1]", "[0, 0]", r"seeds are \[0, 0\], expected different ones"),
        (
            "[recordings]",
            '[[exclude]]\nconfiguration = "losy"\n[recordings]',
            "losy: .* expected perhaps lossy",
        ),
        ("configurations.plain", 'configurations."a/b"', "expected a name of letters"),
        ("seeds", 'until = "evaluate"\nseeds', "until evaluate: is no stage, expected perhaps evaluation"),
        ("[recordings]", "[recordings", "not valid TOML"),
    ],
)
def test_what_does_not_exist_is_one_line_before_anything_runs(
    suite: Suite, old: str, new: str, complaint: str
) -> None:
    suite.path.write_text(suite.path.read_text().replace(old, new))
    with pytest.raises(DuagError, match=complaint):
        read_suite(suite.path)
    out = suite.path.parent / "out"
    assert_one_line(duagc_here("batch", suite.path, "--out", out))
    assert not out.exists()


def test_a_batch_does_not_write_into_a_recording(suite: Suite, fake: fake_run.FakeRun) -> None:
    before = sorted(path.name for path in fake.recording.iterdir())
    assert_one_line(duagc_here("batch", suite.path, "--out", fake.recording), "is a recording, expected the")
    assert sorted(path.name for path in fake.recording.iterdir()) == before


def test_a_failed_cell_is_tried_again_once_and_stops_no_other(suite: Suite, tmp_path: Path) -> None:
    engine, said = Pretended(tmp_path, {"wall-plain-1": 1, "wall-lossy-0": 2}), list[str]()
    states = run_batch(suite, tmp_path, tmp_path / "store", engine, log=said.append)
    assert {name: state.state for name, state in states.items()} == {
        "wall-plain-0": "done",
        "wall-plain-1": "done",
        "wall-lossy-0": "failed",
        "wall-lossy-1": "done",
    }
    assert engine.most == 2
    assert sorted(engine.begun) == sorted([*suite.cells, "wall-plain-1", "wall-lossy-0"])
    assert "wall-plain-1: failed, tried again: no depth" in said
    assert said[-1].endswith("(4 of 4, 0 s left)")
    text = status_text(suite, tmp_path).splitlines()
    assert text[2] == "wall-lossy-0  failed        0.0 s  attempt 2  no depth"
    assert text[-1] == "3 done, 1 failed"


def test_two_batches_do_not_run_in_one_folder(suite: Suite, tmp_path: Path) -> None:
    refused = list[str]()

    class Second(Pretended):
        def submit(self, name: str, arguments: Mapping[str, str]) -> None:
            with pytest.raises(DuagError, match="another process runs a batch there") as error:
                run_batch(suite, tmp_path, tmp_path / "store", Pretended(tmp_path, {}), log=print)
            refused.append(str(error.value))
            super().submit(name, arguments)

    for _ in range(2):  # the lock goes with the batch
        run_batch(suite, tmp_path, tmp_path / "store", Second(tmp_path, {}), log=print)
    assert len(refused) == 2 * len(suite.cells)


def test_a_cell_whose_process_dies_has_failed(suite: Suite, tmp_path: Path) -> None:
    name = "wall-plain-0"
    killed = replace(suite, cells={"killed": suite.cells[name]})
    states = run_batch(killed, tmp_path, tmp_path / "store", Pretended(tmp_path, {"killed": 2}), log=print)
    assert states["killed"].state == "failed"
    assert "its process ended before it did" in states["killed"].error


def test_a_cell_in_a_process_says_what_went_wrong(suite: Suite, tmp_path: Path) -> None:
    """The images of the fake recording are too small to be mapped: a cell that fails for real, in its own process."""
    out = tmp_path / "out"
    suite.path.write_text(
        suite.path.read_text().replace("lossy]\nset", "lossy]\nset").replace("[0, 1]", "[0]")
    )
    one = read_suite(suite.path)
    one = replace(one, cells={"wall-plain-0": one.cells["wall-plain-0"]})
    (one.cells["wall-plain-0"].folder / "recording.json").stat()
    suite.path.write_text("seeds = [")  # between the check and the cell
    with LocalEngine(1) as engine:
        states = run_batch(one, out, tmp_path / "store", engine, log=print)
    state = states["wall-plain-0"]
    assert (state.state, state.attempts) == ("failed", 2)
    assert "not valid TOML" in state.error
    assert "not valid TOML" in (out / "cells" / "wall-plain-0.log").read_text()


def pretend_run(out: Path, name: str, ate_m: float) -> None:
    run = run_folder(out, name)
    run.mkdir(parents=True)
    (run / "metrics.json").write_text(
        json.dumps(
            {"team": {"ate_rmse_m": ate_m}, "exchange": {"bytes_sent": 1000}, "consensus": {"solver": "admm"}}
        )
    )
    row = {"wall_s": 2.0, "cpu_s": 3.0, "peak_rss_mb": 100.0}
    (run / "timing.json").write_text(json.dumps({"stages": {"frontend.alpha": row, "exchange": row}}))
    write_state(out, name, CellState("done", 1, 4.0))


def test_results_are_one_table_and_one_page_with_paired_differences(suite: Suite, tmp_path: Path) -> None:
    for name, ate_m in {"wall-plain-0": 0.01, "wall-plain-1": 0.03, "wall-lossy-0": 0.015}.items():
        pretend_run(tmp_path, name, ate_m)
    write_state(tmp_path, "wall-lossy-1", CellState("failed", 2, error="out of <memory>"))
    done = gather(suite, tmp_path)
    gap = paired(suite, done, "team.ate_rmse_m", recording="wall", configuration="lossy")
    assert gap is not None
    assert (gap.pairs, gap.mean) == (1, pytest.approx(0.005))
    table = pq.read_table(tmp_path / results.TABLE).to_pylist()
    row = next(r for r in table if r["configuration"] == "lossy" and r["name"] == "team.ate_rmse_m")
    assert (row["recording"], row["seed"], row["value"], row["state"]) == ("wall", 0, 0.015, "done")
    assert any(r["name"] == "consensus.solver" and r["text"] == "admm" for r in table)
    assert any(r["name"] == "time.cpu_s" and r["value"] == 6.0 for r in table)
    assert [r["state"] for r in table if r["seed"] == 1 and r["configuration"] == "lossy"] == ["failed"]
    text = (tmp_path / results.PAGE).read_text()
    assert "20.00" in text
    assert '15.00<small class="worse">+5.00</small>' in text
    assert "out of &lt;memory&gt;" in text


def test_frames_of_a_log_count_once_however_many_components_it_has(tmp_path: Path) -> None:
    pretend_run(tmp_path, "one", 0.01)
    run = run_folder(tmp_path, "one")
    robots = {name: {"frames": 50, "ate_rmse_m": 0.1} for name in ("alpha", "alpha-2")}
    (run / "metrics.json").write_text(json.dumps({"robots": robots}))
    row = {"wall_s": 2.0, "cpu_s": 3.0, "peak_rss_mb": 100.0, "parts": {"tracking_s": 1.0, "mapping_s": 2.0}}
    (run / "timing.json").write_text(json.dumps({"stages": {"frontend.alpha": row}}))
    assert results.numbers_of(run)["time.tracking_ms_per_frame"] == 20.0


def test_a_run_that_was_measured_otherwise_is_not_up_to_date(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, again = "wall-plain-0", []
    pretend_run(tmp_path, name, 0.01)
    run = run_folder(tmp_path, name)
    named = {"metrics.json": vars(FileDigests(None).of(run / "metrics.json"))}
    (run / "manifest.json").write_text(json.dumps({"stages": {"evaluation": {"files": named}}}))
    monkeypatch.setattr(existing_run, "is_up_to_date", lambda *of, **settings: True)
    monkeypatch.setattr(runner, "run", lambda *of, **settings: again.append(settings["force"]))
    assert run_cell(suite.path, tmp_path, name, tmp_path / "store") == ""
    assert again == []
    (run / "metrics.json").write_text("{}")
    assert run_cell(suite.path, tmp_path, name, tmp_path / "store") == ""
    assert again == [True]


def test_engines_have_names(suite: Suite, tmp_path: Path) -> None:
    assert duagc_here("batch", suite.path, "--out", tmp_path / "out", "--engine", "cloud").returncode == 2
    result = duagc_here("batch", suite.path, "--out", tmp_path / "out", "--status", "--json")
    assert json.loads(result.stdout)["wall-plain-0"]["state"] == "waiting"
    assert read_state(tmp_path / "out", "wall-plain-0") == CellState()


@pytest.mark.slow
def test_cells_share_what_they_have_in_common(tmp_path: Path) -> None:
    """Two configurations of the exchange: one front end, computed once, in cells that run at the same time."""
    from duagc.converters.simulate.team import simulate

    simulate(tmp_path / "room", robots=2, frames=12, size=(160, 120), seed=1, overlap=0.9, workers=1)
    path = tmp_path / "suite.toml"
    small = [
        "frontend.mapping.max_gaussians=2000",
        "frontend.mapping.iterations=4",
        "frontend.mapping.final_iterations=4",
        "frontend.mapping.final_iterations_view=0",
        "fusion.finetune.steps_per_view=2",
    ]
    path.write_text(
        '[recordings]\nroom = "room"\n'
        f"[configurations.plain]\nset = {json.dumps(small)}\n"
        f"[configurations.lossy]\nset = {json.dumps([*small, 'exchange.link.loss_probability=0.3'])}\n"
    )
    result = duagc_here("batch", path, "--out", tmp_path / "out", "--workers", "2")
    assert result.returncode == 0, result.stderr
    executed = []
    for name in ("room-plain-0", "room-lossy-0"):
        rows = json.loads((tmp_path / "out" / "runs" / name / "timing.json").read_text())["stages"]
        executed += [stage for stage, row in rows.items() if row["executed"]]
    assert executed.count("frontend.alpha") == executed.count("frontend.bravo") == 1
    assert executed.count("exchange") == 2
    assert os.listdir(tmp_path / "out" / ".duagc-store" / "claims") == []
    again = duagc_here("batch", path, "--out", tmp_path / "out", "--workers", "2")
    assert again.returncode == 0
    assert "up to date" in (tmp_path / "out" / "cells" / "room-plain-0.log").read_text()
    assert run_cell(path, tmp_path / "out", "room-plain-0", tmp_path / "out" / ".duagc-store") == ""


def test_a_cell_whose_process_has_ended_waits_again(tmp_path: Path) -> None:
    here = this_process()
    for process, state in (
        (here, "running"),
        ({**here, "started": "0"}, "waiting"),  # another process of that number
        ({**here, "host": "another"}, "running"),  # of which nothing is known
    ):
        write_state(tmp_path, "cell", CellState("running", 2, process=process))
        assert (read_state(tmp_path, "cell").state, read_state(tmp_path, "cell").attempts) == (state, 2)
