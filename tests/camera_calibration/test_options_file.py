"""What becomes of a calibration: whether it is accepted, and the file of options that says it."""

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters.datasets import seven_scenes
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.camera_calibration import report
from duagc.pipeline.camera_calibration.adjustment import Quality
from duagc.pipeline.camera_calibration.calibrate import Calibration, Judged
from duagc.pipeline.camera_calibration.rig import NAMES
from duagc.pipeline.cli import app
from duagc.pipeline.config.calibration import CalibrationConfig
from tests.camera_calibration.test_calibration import TRUE, still_recording


def found_by(converter: str, **parameters: object) -> Calibration:
    before, after = Quality(0.8, 0.9, 1.2), Quality(0.6, 0.7, 1.1)
    description = {"name": "kitchen", "converter": {"name": converter}, "parameters": parameters}
    sigma = dict.fromkeys(NAMES, 0.001)
    halves = ["alpha, frames 0 to 9", "bravo, frames 0 to 9"]
    return Calibration(
        rig=TRUE,
        sigma=sigma,
        halves=[TRUE, TRUE],
        judged=[Judged(half, "the other half", before, after) for half in halves],
        names=halves,
        views=20,
        landmarks=900,
        recording=description,
    )


@pytest.mark.parametrize(
    ("after", "why"),
    [
        (Quality(0.7, 0.9, 1.2), ""),
        (
            Quality(0.79, 0.9, 1.2),
            "between, calibrated by both halves: 0.4 % better in the mean, up to 0.0 % worse",
        ),
        (
            Quality(0.6, 0.93, 1.2),
            "8.1 % better in the mean, up to 3.3 % worse, expected at least 2 % and at most 1 %",
        ),
        (Quality(0.9, 0.9, 1.2), "4.0 % worse in the mean, up to 12.5 % worse"),
        (Quality(math.nan, 0.9, 1.2), "nan % "),
    ],
)
def test_a_calibration_is_refused_unless_views_that_it_did_not_use_agree_better(
    after: Quality, why: str
) -> None:
    """Each set of views by itself; here the halves agree better in every case."""
    found = found_by("tum")
    between = Judged("9 frames between", "both halves", Quality(0.8, 0.9, 1.2), after)
    refusal = replace(found, judged=[*found.judged, between]).refusal(CalibrationConfig())
    assert (why in refusal) if why else refusal == ""


def test_a_delay_changes_stamps_only_if_it_is_certain() -> None:
    found, config = found_by("tum"), CalibrationConfig()  # 4 ms
    assert replace(found, sigma=found.sigma | {"delay_s": 0.0019}).delay_ns(config) == 4_000_000
    assert replace(found, sigma=found.sigma | {"delay_s": 0.0021}).delay_ns(config) == 0
    halves = [replace(TRUE, delay_s=delay_s) for delay_s in (0.001, 0.007)]
    assert replace(found, halves=halves).delay_ns(config) == 0  # they differ too much
    said = report.changes(found, 4_000_000)
    assert "color 4.0 +- 1.0 ms later than its stamps say: stamps of depth moved by -4.0 ms" in said
    assert "stamps as recorded" in report.changes(found, 0)[2]


def test_the_file_of_options_is_one_of_the_converter(tmp_path: Path) -> None:
    """What was found, and what that is relative to, with standard deviations in comments."""
    found = found_by("7scenes", color_distortion="", color_focal_px=520.0, baseline_m=0.03, rate_hz=30)
    report.write(found, tmp_path / "cameras.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["cameras.toml"]
    text = (tmp_path / "cameras.toml").read_text()
    read = seven_scenes.Options(**tomllib.loads(text))
    assert tomllib.loads(text) == report.options(found)
    assert (read.color_focal_px, read.color_focal_y_px, read.baseline_m) == (266, 265, 0.03)
    assert (read.color_cx_px, read.color_cy_px) == (163, 121)
    assert read.lens().distortion == (0.08, -0.3, 0.0, 0.0, 0.25)
    assert read.depth_correction() == tuple(TRUE.depth_error)
    np.testing.assert_allclose(read.lens().rotation_rad, [0.006, -0.008, 0.01], atol=1e-5)
    for name in NAMES:
        assert f"# {name} = " in text
    assert "# k1 = 0.08000 +- 0.00100 (halves 0.08000, 0.08000)" in text
    line = (
        "bravo, frames 0 to 9, by the other half: features 0.80 -> 0.60 px, their depth 0.90 -> 0.70 sigma(z)"
    )
    assert line in text
    text = report.format_calibration(found)
    assert line in text
    assert "--out FILE.toml" in report.uses(found)
    (tmp_path / "other.toml.part").mkdir()
    with pytest.raises(DuagError, match=r"other.toml: Is a directory, expected to write options"):
        report.write(found, tmp_path / "other.toml")


def test_recordings_that_take_no_calibration() -> None:
    calibrated = found_by("7scenes").recording | {"calibration": {"recording": "kitchen"}}
    for other, why in (
        (found_by("tum"), "was made by tum, which takes no calibration"),
        (found_by("7scenes", color_distortion="0.1 0 0 0"), "was converted with color_distortion, expected"),
        (found_by("7scenes", depth_correction_per_m="0.1"), "was converted with depth_correction_per_m"),
        (replace(found_by("7scenes"), recording=calibrated), "is calibrated already, expected one as its"),
    ):
        assert report.options(other) is None
        assert why in report.uses(other)
        with pytest.raises(ValueError, match=why):
            report.toml(other)
    assert json.loads(json.dumps(report.plain(found_by("tum"))))["values"]["fx"]["value"] == 266


def test_a_file_that_cannot_be_written_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    folder = still_recording(tmp_path / "still")  # which cannot be calibrated: nothing below gets there
    recorded = folder / "recording.json"

    def refused(out: Path, message: str, *more: str) -> None:
        arguments = ["calibrate", str(folder), "--out", str(out), *more]
        with pytest.raises(DuagError, match=message) as caught:
            CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert "\n" not in str(caught.value)

    refused(
        tmp_path / "a.toml", "still: was made by , which takes no calibration, .*, for --out; see --apply"
    )
    recorded.write_text(recorded.read_text().replace('"name": ""', '"name": "7scenes"', 1))
    refused(tmp_path / "a.json", "a.json: .* expected NAME.toml in a folder that exists")
    refused(tmp_path / "none" / "a.toml", "a.toml: .* expected NAME.toml in a folder that exists")
    (tmp_path / "a.toml").write_text("mine")
    refused(tmp_path / "a.toml", "a.toml: exists already; choose another --out or give --force")
    (tmp_path / "b.toml").mkdir()
    refused(tmp_path / "b.toml", "b.toml: exists already", "--force")
    refused(tmp_path / "a.toml", "still: its images do not determine", "--force")
    assert (tmp_path / "a.toml").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.toml", "b.toml", "still"]
