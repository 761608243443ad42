"""`duagc bench robustness`: cells are what their dials say, are kept, and are scored by what the run says."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters.simulate.sensors.degradations import Degradations
from duagc.converters.simulate.sensors.rig import Rig
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.bench import robustness as bench
from duagc.pipeline.bench import robustness_tables
from duagc.pipeline.cli import app
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.geometry.trajectory import Trajectory, read_tum, write_tum
from duagc.pipeline.recording import Recording
from duagc.pipeline.report import figures
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures.fake_run import FRAMES, FakeRun, make

PLAN = bench.RobustnessPlan(dials=("missing", "vignette"), frames=4, size=(32, 32), robots=1)


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> FakeRun:
    made = make(tmp_path_factory.mktemp("fake"))
    evaluate(made.run, made.recording, threads=1, progress=False)
    return made


def refuse(recording: Path, run: Path) -> None:
    raise DuagError(f"{recording}: nothing can be tracked")


def row(dial: str, ate_m: float, psnr_db: float, **more: object) -> dict:
    known = {"level": float(dial != bench.CLEAN), "value": "x", "frames": 100, "tracked_share": 1.0}
    known |= {"ate_m": ate_m, "ate_team_m": ate_m, "psnr_db": psnr_db, "psnr_exposure_db": psnr_db + 1}
    known |= {"psnr_moved_db": psnr_db + 2}
    known |= {"robots": 2, "joined": 2, "components": 1, "submaps": 2, "lost": []}
    return {"dial": dial, **known, "worst_good_m": 0.01, "gap_sigma": 0.02} | more


def test_each_dial_turns_one_thing_and_all_turns_everything() -> None:
    assert bench.Cell(bench.CLEAN, 0.0).settings() == (Rig(), Degradations())
    whole = bench.Cell(bench.ALL, 1.0).settings()
    for name in bench.DIALS:
        rig, degradations = bench.Cell(name, 1.0).settings()
        changed = {
            key
            for ours, plain in ((asdict(rig), asdict(Rig())), (asdict(degradations), asdict(Degradations())))
            for key in ours
            if ours[key] != plain[key]
        }
        assert len(changed) == 1, name
        key = changed.pop()
        for one, everything in zip((rig, degradations), whole, strict=True):
            assert getattr(one, key, None) == getattr(everything, key, None)
    assert whole[0].readout_s == 0.03
    assert whole[1].blur_px == 8
    assert whole[1].lens_k1 == -0.3
    assert whole[1].missing == pytest.approx(0.2)
    assert whole[1].rate_hz == pytest.approx(5.0)


@pytest.mark.parametrize("dial", bench.DIALS.values(), ids=lambda dial: dial.name)
def test_a_dial_goes_from_clean_to_its_middle(dial: bench.Dial) -> None:
    values = [dial.value(level) for level in (0.0, 0.5, 1.0)]
    assert values[0] == pytest.approx(dial.zero)
    assert values[2] == pytest.approx(dial.middle)
    assert values[0] < values[1] < values[2] or values[0] > values[1] > values[2]
    assert dial.source


@pytest.fixture
def no_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept does not depend on what is simulated."""
    monkeypatch.setattr(bench, "simulate", lambda out, **settings: out.mkdir())


@pytest.mark.usefixtures("no_images")
def test_a_run_that_cannot_be_is_a_row_that_says_so_and_is_tried_again(tmp_path: Path) -> None:
    rows = bench.run(PLAN, tmp_path / "out", refuse, "settings", workers=1)
    assert [r["dial"] for r in rows] == ["clean", "missing", "vignette"]
    assert all(r["failed"].endswith("nothing can be tracked") for r in rows)
    assert str(tmp_path) not in json.dumps(rows)
    assert not list((tmp_path / "out" / "runs").iterdir())
    seen: list[Path] = []

    def refuse_again(recording: Path, run: Path) -> None:
        seen.append(recording)
        refuse(recording, run)

    assert bench.run(PLAN, tmp_path / "out", refuse_again, "settings", workers=1) == rows
    assert len(seen) == 3


@pytest.fixture
def no_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept does not depend on what a run comes to."""
    monkeypatch.setattr(bench, "measured", lambda run, recording: {"frames": 7})
    monkeypatch.setattr(bench, "Recording", lambda path: None)


def test_a_level_that_cannot_be_is_refused_before_a_cell_is_computed(tmp_path: Path) -> None:
    def never(recording: Path, out: Path) -> None:
        raise AssertionError("a cell was computed")

    plan = replace(PLAN, dials=("rolling_shutter",), levels=(1.0, 1.5))
    with pytest.raises(DuagError, match=r"readout is 0\.045"):
        bench.run(plan, tmp_path, never, "")


@pytest.mark.usefixtures("no_images", "no_numbers")
def test_finished_cells_are_kept_unless_they_are_damaged(tmp_path: Path) -> None:
    calls: list[Path] = []
    count = lambda recording, run: calls.append(recording)  # noqa: E731
    rows = bench.run(PLAN, tmp_path, count, "settings", workers=1)
    assert bench.run(PLAN, tmp_path, count, "settings", workers=1) == rows
    assert len(calls) == 3
    (tmp_path / "cells" / "missing-1.json").write_text("{")
    assert bench.run(PLAN, tmp_path, count, "settings", workers=1) == rows
    assert len(calls) == 4


@pytest.mark.usefixtures("no_images", "no_numbers")
def test_other_meshes_make_a_cell_again(tmp_path: Path) -> None:
    calls: list[Path] = []
    count = lambda recording, run: calls.append(recording)  # noqa: E731
    scene = tmp_path / "house"
    (scene / "textures").mkdir(parents=True)
    plan = replace(PLAN, dials=(), scene=str(scene))
    for file, content, expected in (
        ("wall.obj", "v 0 0 0", 1),
        ("wall.obj", "v 0 0 0", 1),
        ("wall.obj", "v 0 0 1", 2),
        ("textures/wall.PNG", "paint", 3),
        ("readme.txt", "a house", 3),
    ):
        (scene / file).write_text(content)
        bench.run(plan, tmp_path / "out", count, "settings", workers=1)
        assert len(calls) == expected
    assert bench.finished_row(tmp_path / "out", bench.Cell(bench.CLEAN, 0.0), plan) is not None
    (scene / "wall.obj").write_text("v 0 1 0")
    assert bench.finished_row(tmp_path / "out", bench.Cell(bench.CLEAN, 0.0), plan) is None


@pytest.mark.usefixtures("no_images", "no_numbers")
def test_other_settings_or_another_walk_make_a_cell_again(tmp_path: Path) -> None:
    plan = replace(PLAN, dials=())
    calls = []

    def count(recording: Path, run: Path) -> None:
        calls.append(recording)

    for settings, wanted, expected in (
        ("one", plan, 1),
        ("one", plan, 1),
        ("other", plan, 2),
        ("other", replace(plan, frames=5), 3),
        ("other", replace(plan, frames=5, levels=(0.5,)), 3),
    ):
        bench.run(wanted, tmp_path, count, settings, workers=1)
        assert len(calls) == expected


def test_numbers_are_those_of_the_run(fake: FakeRun) -> None:
    found = bench.measured(RunFolder(fake.run), Recording(fake.recording))
    metrics = json.loads((fake.run / "metrics.json").read_text())
    assert found["frames"] == 2 * FRAMES
    assert found["tracked_share"] == pytest.approx(1 - 1 / FRAMES)
    assert found["psnr_db"] == metrics["rendering"]["own"]["held_out"]["psnr_db"]
    assert found["psnr_exposure_db"] == metrics["rendering"]["own"]["held_out"]["psnr_exposure_db"]
    assert (found["robots"], found["joined"], found["components"]) == (2, 2, 1)
    assert [(e["robot"], e["first"], e["last"]) for e in found["lost"]] == [
        ("alpha", 10, 10),
        ("bravo", 10, 10),
    ]
    assert found["worst_good_m"] < 1e-6  # the corrected ways are the true ones


def test_the_worst_pose_counts_if_it_was_called_good(tmp_path: Path) -> None:
    made = make(tmp_path, joined=False)
    for index, worst in ((5, True), (10, False)):  # frame 10 is called lost
        path = made.run / "robots" / "alpha" / "trajectory.tum"
        before = read_tum(path)
        poses = before.poses.copy()
        poses[index, :3, 3] += [0.0, 0.5, 0.0]
        write_tum(path, Trajectory(before.stamps_ns, poses))
        found = bench.worst_good_m(RunFolder(made.run), Recording(made.recording))
        write_tum(path, before)
        assert found is not None
        assert (found > 0.3) == worst
    assert np.allclose(before.poses, RunFolder(made.run).robots["alpha"].trajectory.poses)


def test_bounds_are_ratios_to_the_clean_cell() -> None:
    clean = row("clean", 0.002, 30.0)
    met = bench.bounds_met(row("blur", 0.0059, 27.1), clean)
    assert met == {"ate": True, "psnr": True, "component": True, "worst": True, "gap": True}
    missed = bench.bounds_met(
        row("blur", 0.0061, 26.9, components=2, worst_good_m=0.11, gap_sigma=0.06), clean
    )
    assert missed == {"ate": False, "psnr": False, "component": False, "worst": False, "gap": False}
    assert bench.bounds_met(row("blur", 0.1, 26.9) | {"ate_m": None}, clean) is not None
    unknown = clean | {"ate_m": None, "psnr_db": None}  # two frames cannot be aligned
    assert bench.bounds_met(row("blur", 0.001, 40.0), unknown) == met | {"ate": False, "psnr": False}
    assert bench.bounds_met(row("all", 1.0, 10.0), clean) is None
    assert bench.bounds_met({"dial": "lens", "failed": "no"}, clean) is None


def test_the_table_has_a_row_for_every_cell_and_names_what_is_missed() -> None:
    rows = [
        row("clean", 0.002, 30.0),
        row("blur", 0.004, 25.0),
        {"dial": "lens", "level": 1.0, "value": "-0.3", "failed": "lens-1: no"},
        row("all", 0.5, 12.0, joined=1, components=2, worst_good_m=0.9)
        | {"psnr_db": None, "lost": [{"robot": "bravo", "first": 3, "last": 9, "reason": "dark"}]},
    ]
    text = robustness_tables.format_table(rows)
    lines = text.splitlines()
    assert len({line.count("|") for line in lines[:6]}) == 1
    assert re.search(r"blur .* 2\.00 .* -5\.00 .* psnr", lines[3])
    assert "run failed" in lines[4]
    assert "worst" in lines[5]
    assert "lens-1: no" in text
    assert "all x: lost bravo 3 to 9 (dark)" in text
    svg = figures.robustness(rows)
    assert svg == figures.robustness(rows)
    for dial in ("clean", "blur", "lens", "all"):
        assert dial in svg


def test_the_command_refuses_dials_that_it_does_not_know(tmp_path: Path) -> None:
    runner = CliRunner()
    assert (
        runner.invoke(app, ["bench", "robustness", "--only", "fog", "--out", str(tmp_path / "a")]).exit_code
        == 2
    )
    assert not (tmp_path / "a").exists()
    listed = runner.invoke(app, ["bench", "robustness", "--list"])
    assert listed.exit_code == 0
    for dial in bench.DIALS.values():
        assert re.search(rf"^{dial.name} +{re.escape(dial.text(1))} ", listed.stdout, re.MULTILINE)


@pytest.mark.slow
def test_a_cell_of_a_real_run_is_the_same_again(tmp_path: Path) -> None:
    args = [
        "bench",
        "robustness",
        "--only",
        "missing",
        "--frames",
        "24",
        "--size",
        "160x120",
        "--workers",
        "1",
    ]
    args += ["--set", "frontend.mapping.final_iterations=2"]
    texts = []
    for name in ("one", "two"):
        out = tmp_path / name
        done = CliRunner().invoke(app, [*args, "--out", str(out)])
        assert done.exit_code == 0, done.output
        texts.append([(out / f"robustness.{kind}").read_bytes() for kind in ("json", "md", "svg")])
    assert texts[0] == texts[1]
    rows = json.loads(texts[0][0])["rows"]
    assert [r["dial"] for r in rows] == ["clean", "missing"]
    assert rows[1]["frames"] < rows[0]["frames"]
