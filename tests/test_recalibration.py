"""Calibrated recordings from the commands: written where that is better, else the recording as it is."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters.datasets import tum
from duagc.converters.simulate.team import simulate
from duagc.converters.writer import RecordingWriter
from duagc.pipeline import recalibration, runner
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.camera_calibration import calibrate as calibrating
from duagc.pipeline.camera_calibration.adjustment import Quality
from duagc.pipeline.camera_calibration.calibrate import Calibration, Judged
from duagc.pipeline.camera_calibration.rig import NAMES, CameraRig
from duagc.pipeline.camera_calibration.undetermined import UndeterminedError
from duagc.pipeline.cli import app
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.job import Job
from duagc.pipeline.recording import Recording, format_info, info, open_rgbd
from duagc.pipeline.replay import replay
from duagc.pipeline.run_plan import RunPlan
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.runs.stages import CALIBRATED
from tests.fixtures.small_run import SMALL

CAMERAS = [PinholeCamera(64, 48, f, f, 31.5, 23.5) for f in (60.0, 70.0)]
BETTER, SAME = Quality(0.6, 0.7, 1.1), Quality(0.8, 0.9, 1.2)


def found(camera: PinholeCamera, after: Quality) -> Calibration:
    lens = np.array([camera.fx + 1, camera.fy + 1, camera.cx + 1, camera.cy - 1, 0.02, 0, 0])
    rig = CameraRig(camera, lens, so3.exp(np.array([0.0, 0.01, 0.01])), 0.004, np.full(6, 0.01))
    return Calibration(
        rig=rig,
        sigma=dict.fromkeys(NAMES, 0.001),
        halves=[rig, rig],
        judged=[Judged("half", "the other half", SAME, after)] * 2,
        names=["first", "second"],
        views=20,
        landmarks=900,
        recording={},
    )


def write(folder: Path, *cameras: PinholeCamera) -> Path:
    """A recording with a robot for each camera."""
    rng = np.random.default_rng(0)
    import cv2

    png = cv2.imencode(".png", rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))[1].tobytes()
    with RecordingWriter(folder, source={"dataset": "noise"}, converter="tum") as recording:
        for name, camera in zip(("alpha", "bravo"), cameras, strict=False):
            with recording.robot(name, camera, 0.001) as robot:
                for k in range(6):
                    robot.add_frame(
                        10**9 + k * 33_000_000, png, "png", np.full((48, 64), 1500 + k, np.uint16)
                    )
    return folder


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[list[str]]]:
    """Puts calibrations in place of the estimate, by focal length; returns which robots it was asked for."""

    def put(by_focal: dict[float, Quality | str]) -> list[list[str]]:
        asked: list[list[str]] = []

        def calibrate(
            folder: Path, _config: object, robots: list[str], *_views: int, workers: int
        ) -> Calibration:
            assert workers >= 1
            names = list(robots) or Recording(folder).robots
            asked.append(names)
            with open_rgbd(Recording(folder).log(names[0])) as log:
                camera = log.camera
            after = by_focal[camera.fx]
            if isinstance(after, str):
                raise UndeterminedError(after)
            return found(camera, after)

        monkeypatch.setattr(recalibration, "calibrate", calibrate)
        monkeypatch.setattr(calibrating, "calibrate", calibrate)
        return asked

    return put


Answers = Callable[[dict[float, Quality | str]], list[list[str]]]


def command(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.output


def test_robots_of_each_camera_are_calibrated_together_and_judged_apart(
    tmp_path: Path, answers: Answers
) -> None:
    asked = answers({60.0: BETTER, 70.0: "alpha: its images do not determine fx"})
    recording = Recording(write(tmp_path / "rec", *CAMERAS))
    (tmp_path / "out").mkdir()
    outcomes, written = recalibration.calibrated(recording, lambda: tmp_path / "out", "rec", RunConfig())
    assert written
    assert asked == [["alpha"], ["bravo"]]
    assert [outcome.refused for outcome in outcomes] == ["", "alpha: its images do not determine fx"]
    out = Recording(tmp_path / "out")
    assert out.log("bravo").read_bytes() == recording.log("bravo").read_bytes()
    assert out.log("alpha").read_bytes() != recording.log("alpha").read_bytes()
    with open_rgbd(out.log("alpha")) as log:
        assert {log.frame(k).depth_offset_ns for k in range(6)} == {-4_000_000}
    said = out.calibration
    assert "alpha: calibrated" in said
    assert "bravo: kept as recorded: alpha: its images do not determine fx" in said
    assert "  calibration: alpha: calibrated" in format_info(info(out.path))
    first, second = out.description["calibration"]["cameras"]
    assert first["values"]["fx"] == {"value": 61.0, "sigma": 0.001, "of_halves": [61.0, 61.0], "unit": "px"}
    assert first["depth_stamps_moved_ns"] == -4_000_000
    assert first["judged"][0]["calibrated"]["features_px"] == 0.6
    assert "values" not in second


def test_calibrate_applies_what_it_found(tmp_path: Path, answers: Answers) -> None:
    answers({60.0: BETTER})
    folder = write(tmp_path / "rec", CAMERAS[0], CAMERAS[0])
    text = command("calibrate", folder, "--apply", tmp_path / "out")
    assert "alpha, bravo: calibrated" in text
    assert Recording(tmp_path / "out").name == "out"
    assert Recording(tmp_path / "out").description["calibration"]["recording"] == "rec"
    again = "out: exists already; choose another path or give --force"
    with pytest.raises(DuagError, match=again):
        command("calibrate", folder, "--apply", tmp_path / "out")
    command("calibrate", folder, "--apply", tmp_path / "out", "--force", "--robot", "bravo")
    out = Recording(tmp_path / "out")
    assert out.log("alpha").read_bytes() == Recording(folder).log("alpha").read_bytes()
    with pytest.raises(DuagError, match="is the recording itself, expected the name of another"):
        command("calibrate", folder, "--apply", folder, "--force")


def test_calibrate_refuses_what_is_no_better(tmp_path: Path, answers: Answers) -> None:
    """With the figures, and without a file."""
    answers({60.0: SAME})
    folder = write(tmp_path / "rec", CAMERAS[0])
    expected = (
        "rec: found no better calibration than its own: half, calibrated by the other half: 0.0 % better"
    )
    with pytest.raises(DuagError, match=expected):
        command("calibrate", folder, "--apply", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["rec"]
    command("calibrate", folder, "--apply", tmp_path / "out", "--set", "calibration.min_gain=0")
    assert (tmp_path / "out" / "recording.json").is_file()


@pytest.mark.parametrize("better", [True, False])
def test_convert_delivers_the_better_recording(
    tmp_path: Path, answers: Answers, monkeypatch: pytest.MonkeyPatch, better: bool
) -> None:
    """Under the given name either way, and nothing besides it."""
    answers({60.0: BETTER if better else SAME})
    monkeypatch.setattr(tum, "convert", lambda src, out, force=False: write(out, CAMERAS[0]))
    text = command("convert", "tum", tmp_path, "--out", tmp_path / "rec", "--calibrate")
    said = "alpha: calibrated" if better else "alpha: kept as recorded: half, calibrated by the other half"
    assert said in text
    assert "features 0.80 -> " in text
    recording = Recording(tmp_path / "rec")
    assert recording.name == "rec"
    assert sorted(p.name for p in recording.path.iterdir()) == ["alpha.mcap", "recording.json"]
    assert bool(recording.calibration) == better
    assert [path.name for path in tmp_path.iterdir()] == ["rec"]


def test_a_run_keeps_the_calibrated_recording(tmp_path: Path, answers: Answers) -> None:
    recording = Recording(write(tmp_path / "rec", CAMERAS[0]))
    for after, plan in ((SAME, RunPlan(1, calibrate=True)), (BETTER, RunPlan(1, calibrate=True))):
        asked, said = answers({60.0: after}), list[str]()
        folder = tmp_path / f"run{after is SAME}.part"
        folder.mkdir()
        job = Job(recording, folder, RunConfig(), plan, log=said.append, place=folder)
        job.calibrate()
        assert len(asked) == 1
        if after is SAME:
            assert job.recording is recording
            assert not list(folder.iterdir())
    assert job.recording.path == folder / CALIBRATED
    assert job.recording.name == "rec"
    assert said[0] == "calibration"
    assert "alpha: calibrated" in said


def test_a_calibration_is_computed_once(tmp_path: Path, answers: Answers) -> None:
    recording = Recording(write(tmp_path / "rec", CAMERAS[0]))
    asked, said = answers({60.0: BETTER}), list[str]()
    plan = RunPlan(1, calibrate=True, store=tmp_path / "store")
    for number in range(2):
        folder = tmp_path / f"run{number}"
        folder.mkdir()
        job = Job(recording, folder, RunConfig(), plan, log=said.append, place=folder)
        job.calibrate()
        assert job.recording.path == folder / CALIBRATED
    assert len(asked) == 1
    assert "calibration: from the store" in said
    assert said.count("alpha: calibrated") == 2
    logs = [tmp_path / run / CALIBRATED / "alpha.mcap" for run in ("run0", "run1")]
    assert logs[0].read_bytes() == logs[1].read_bytes()


@pytest.mark.slow
def test_the_run_of_a_calibrated_recording_can_be_replayed(tmp_path: Path, answers: Answers) -> None:
    """Every stage reads the recording in the folder of the run, wherever that is now."""
    simulate(tmp_path / "rec", robots=2, frames=20, size=(160, 120), seed=1, overlap=0.9, workers=1)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        answers({log.camera.fx: BETTER})
    settings = load_config(RunConfig, overrides=SMALL)
    runner.run(tmp_path / "rec", tmp_path / "run", settings, calibrate=True, log=lambda line: None)
    (tmp_path / "run").rename(tmp_path / "moved")
    run = RunFolder(tmp_path / "moved")
    assert run.recording == run.path / CALIBRATED
    manifest = json.loads((run.path / "manifest.json").read_text())
    assert manifest["calibration"]["of"] == "../rec"
    assert manifest["inputs"]["alpha"] == Recording(run.recording).digest("alpha.mcap")
    assert "own images: alpha, bravo: calibrated;" in (run.path / "report" / "index.html").read_text()
    compared = replay(run.path, run.recording, ["alpha"], lambda line: None)
    assert compared
    assert all(comparison.equal for comparison in compared)


def test_an_outcome_without_a_calibration_has_no_figures() -> None:
    outcome = recalibration.CalibrationOutcome(("alpha",), None, "too dark")
    assert outcome.lines() == ["alpha: kept as recorded: too dark"]
    accepted = recalibration.CalibrationOutcome.of(
        found(CAMERAS[0], BETTER), ["alpha"], RunConfig().calibration
    )
    assert accepted.plain()["depth_stamps_moved_ns"] == -4_000_000
    assert replace(accepted, refused="no").lines()[0] == "alpha: kept as recorded: no"
