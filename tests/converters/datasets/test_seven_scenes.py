"""7-Scenes: a small sequence of a synthetic room in the dataset's own files, and the real one where it is there."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.datasets import seven_scenes
from duagc.converters.datasets.seven_scenes import Options, convert, list_frames
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, content_digest, open_rgbd, read_log
from tests.fixtures.seven_scenes import (
    FRAMES,
    RIG,
    T_DEPTH_COLOR,
    depth_pose,
    make_rig_sequence,
    make_sequence,
    poses_of,
    render,
)

REAL = Path(__file__).parents[4] / "shared" / "data" / "redkitchen"


# --- conversion -------------------------------------------------------------------------------------------------------


def test_one_sequence_becomes_two_robots(sequence: Path, tmp_path: Path) -> None:
    convert(sequence, tmp_path / "rec", robots=2)
    recording = Recording(tmp_path / "rec")
    assert recording.robots == ["alpha", "bravo"]
    cut = FRAMES // 2
    for robot, numbers in (("alpha", range(cut)), ("bravo", range(cut, FRAMES))):
        log = open_rgbd(recording.log(robot))
        assert (log.camera, log.depth_scale, len(log)) == (Options().color_camera(), 0.001, len(numbers))
        assert [f.stamp_ns for f in log.frames()] == [i * 10**9 // 30 for i in range(len(numbers))]
        for record, number in zip(
            read_log(recording.log(robot), [f"/{robot}/camera/color"]), numbers, strict=True
        ):
            assert record.proto().data == (sequence / f"frame-{number:06d}.color.jpg").read_bytes()
        expected = np.array([depth_pose(n) @ T_DEPTH_COLOR for n in numbers])
        found = poses_of(recording, robot)
        np.testing.assert_allclose(found, expected, atol=1e-3)  # the defect of the rotations above
        np.testing.assert_allclose(
            found[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2),
            np.eye(3)[None].repeat(len(found), 0),
            atol=1e-12,
        )
    description = json.loads((tmp_path / "rec" / "recording.json").read_text())
    assert description["parameters"]["baseline_m"] == 0.025
    assert description["source"] == {"dataset": "7-Scenes", "folder": "seq-01", "sequences": []}
    for check in description["checks"].values():
        assert check["reprojection_median_m"] < 0.001 * check["median_depth_m"]


def test_depth_is_registered_to_color(sequence: Path, tmp_path: Path) -> None:
    """Against the depth that the color camera would have measured."""
    convert(sequence, tmp_path / "rec")
    for frame in open_rgbd(Recording(tmp_path / "rec").log("alpha")).frames():
        _, exact = render(Options().color_camera(), depth_pose(frame.index) @ T_DEPTH_COLOR)
        seen = frame.depth > 0
        error = np.abs(frame.depth - exact)[seen]
        assert np.median(error) < 0.0005  # the millimeter of the source, twice rounded
        assert np.mean(error > 0.005) < 0.01  # borders of the box, one pixel wide
        assert seen[60:-60, 80:-80].mean() > 0.97  # the rest is hidden from the depth camera by the box
        v, u = 240, 560
        assert seen[v, u]
        assert frame.depth[v, u] == pytest.approx(exact[v, u], abs=0.002)


def test_conversions_are_the_same_every_time(sequence: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        convert(sequence, tmp_path / name / "rec", robots=2)
    for name in ("alpha.mcap", "bravo.mcap", "alpha.groundtruth.mcap"):
        assert content_digest(tmp_path / "a" / "rec" / name) == content_digest(tmp_path / "b" / "rec" / name)


def test_several_sequences_become_one_robot_each(sequence: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for number in (1, 3):
        shutil.copytree(sequence, scene / f"seq-{number:02d}")
    convert(scene, tmp_path / "both", robots=2)
    both = Recording(tmp_path / "both")
    assert [len(open_rgbd(both.log(robot))) for robot in both.robots] == [FRAMES, FRAMES]
    convert(scene, tmp_path / "one", sequences=3)
    assert Recording(tmp_path / "one").description["source"]["sequences"] == ["seq-03"]
    with pytest.raises(DuagError, match="found sequences seq-01, seq-03 for 1 robots"):
        convert(scene, tmp_path / "rec")
    with pytest.raises(DuagError, match="found sequences 1, 3, expected '2' among them"):
        convert(scene, tmp_path / "rec", sequences="2")


def test_missing_numbers_are_skipped_and_told(broken: Path, tmp_path: Path) -> None:
    for path in broken.glob("frame-000002.*"):
        path.unlink()
    convert(broken, tmp_path / "rec")
    recording = Recording(tmp_path / "rec")
    stamps = [f.stamp_ns for f in open_rgbd(recording.log("alpha")).frames()]
    assert stamps == [n * 10**9 // 30 for n in (0, 1, 3, 4, 5, 6)]
    assert "seq-01: 1 frame numbers are missing and were skipped: 2" in recording.description["warnings"]
    convert(broken, tmp_path / "few", frame_limit=2)
    few = Recording(tmp_path / "few")
    assert [f.stamp_ns for f in open_rgbd(few.log("alpha")).frames()] == stamps[:2]
    assert not [line for line in few.description["warnings"] if "missing" in line]


def test_sequences_without_poses_have_no_ground_truth(broken: Path, tmp_path: Path) -> None:
    for path in broken.glob("*.pose.txt"):
        path.unlink()
    convert(broken, tmp_path / "rec")
    recording = Recording(tmp_path / "rec")
    assert recording.groundtruth("alpha") is None
    assert recording.description["checks"]["alpha"]["reprojection_median_m"] is None
    assert any("no ground truth" in w for w in recording.description["warnings"])


# --- a calibrated rig -------------------------------------------------------------------------------------------------


def errors_of(recording: Path, camera: PinholeCamera) -> tuple[float, float]:
    """Share of pixels of another color than the room's, and median error of depth in meters, all frames."""
    colors, depths = [], []
    for frame in open_rgbd(Recording(recording).log("alpha")).frames():
        color, depth = render(camera, depth_pose(frame.index) @ T_DEPTH_COLOR)
        inside = np.s_[30:-30, 30:-30]  # what the color camera did not see is at the border
        off = np.abs(frame.color[inside].astype(float) - color[inside][..., ::-1]).max(axis=-1)
        colors.append(np.mean(off > 20))
        depths.append(np.abs(frame.depth - depth)[frame.depth > 0])
    return float(np.mean(colors)), float(np.median(np.concatenate(depths)))


def test_lens_rotation_and_depth_error_are_undone(tmp_path: Path) -> None:
    source = make_rig_sequence(tmp_path / "seq-01")
    convert(source, tmp_path / "rec", **RIG)
    convert(source, tmp_path / "again", **RIG)
    convert(source, tmp_path / "as_if_ideal", color_focal_px=515.0)
    assert content_digest(tmp_path / "rec" / "alpha.mcap") == content_digest(
        tmp_path / "again" / "alpha.mcap"
    )
    camera = Options(**RIG).color_camera()
    assert open_rgbd(Recording(tmp_path / "rec").log("alpha")).camera == camera
    assert camera.fx == camera.fy == 515
    colors, depths = errors_of(tmp_path / "rec", camera)
    assert colors < 0.04, "edges of the pattern, blurred by half a pixel"
    assert depths < 0.0005, "the millimeter of the source, rounded twice"
    colors, depths = errors_of(tmp_path / "as_if_ideal", camera)
    assert colors > 0.1
    assert depths > 0.005


def test_depth_that_a_correction_puts_beyond_16_bits_is_none(tmp_path: Path) -> None:
    """30 m become 75 m, which would be 9.5 m without the highest bit."""
    source = make_sequence(tmp_path / "seq-01", frames=2)
    for path in source.glob("*.depth.png"):
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        raw[200:240, 200:240] = 30_000
        cv2.imwrite(str(path), raw)
    options = {f"depth_correction_per_m={sign}0.02 0 0 0 0 0" for sign in ("", "-")}
    found = []
    for k, option in enumerate(sorted(options)):
        registry.convert("7scenes", source, tmp_path / f"rec{k}", options=[option])
        with open_rgbd(tmp_path / f"rec{k}" / "alpha.mcap") as log:
            found.append(log.frame(0).depth[210:230, 210:230])
    nearer, farther = sorted(found, key=np.median, reverse=True)
    assert 10 < np.median(nearer) < 30
    assert not farther.any()


# --- the table of converters ------------------------------------------------------------------------------------------


def test_the_command_finds_the_converter(sequence: Path, tmp_path: Path) -> None:
    registry.convert(
        "7scenes", sequence, tmp_path / "rec", options=["color_focal_px=520", "baseline_m = 0.03"]
    )
    parameters = Recording(tmp_path / "rec").description["parameters"]
    assert (parameters["color_focal_px"], parameters["baseline_m"]) == (520, 0.03)
    text = registry.describe()
    assert "7scenes: Microsoft 7-Scenes" in text
    assert "--set baseline_m=0.025" in text
    with pytest.raises(DuagError, match="dataset '8scenes', expected perhaps 7scenes"):
        registry.convert("8scenes", sequence, tmp_path / "other")
    with pytest.raises(DuagError, match="expected NAME=VALUE"):
        registry.convert("7scenes", sequence, tmp_path / "other", options=["baseline_m"])


def test_every_option_is_documented() -> None:
    assert seven_scenes.Options.model_fields.keys() <= seven_scenes.Options.documentation().keys()


# --- the real thing ---------------------------------------------------------------------------------------------------


def test_real_sequence(tmp_path: Path) -> None:
    """RedKitchen, 24 of its frames: the poses agree with the registered depth to 1 % of it."""
    if not REAL.is_dir():
        pytest.skip("needs ../shared/data/redkitchen")
    source = tmp_path / "redkitchen"
    source.mkdir()
    for number in range(24):
        for path in REAL.glob(f"frame-{number:06d}.*"):
            shutil.copy(path, source)
    frames, missing = list_frames(source)
    assert (len(frames), missing) == (24, [])
    convert(source, tmp_path / "rec", robots=2)
    recording = Recording(tmp_path / "rec")
    for check in recording.description["checks"].values():
        assert check["reprojection_median_m"] < 0.01 * check["median_depth_m"]
        assert check["registered_holes"] < 0.005
    poses = poses_of(recording, "alpha")
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-12)
