"""Recordings: folders of logs that are written whole or not at all."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter, robot_names
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording, log_metadata, open_rgbd, read_log
from tests.fixtures.recording_logs import CAMERA, depth, image, png, write_recording, write_robot


def test_a_recording_reads_back(tmp_path: Path) -> None:
    recording = Recording(write_recording(tmp_path / "rec"))
    assert recording.name == "rec"
    assert recording.robots == ["alpha", "bravo"]
    assert len(open_rgbd(recording.log("bravo"))) == 3
    truth = recording.groundtruth("alpha")
    assert truth is not None
    poses = [m.unpack_pose_in_frame(r.proto()) for r in read_log(truth, ["/alpha/groundtruth/pose"])]
    np.testing.assert_allclose(
        poses, [se3.exp([0.1 * i, 0, 0, 0, 0, 0.01 * i]) for i in range(3)], atol=1e-14
    )
    assert not any("groundtruth" in r.topic for r in read_log(recording.log("alpha")))
    truth.unlink()
    assert recording.groundtruth("alpha") is None  # optional even where it is listed
    with pytest.raises(DuagError, match="expected 'charlie' among them"):
        recording.log("charlie")


def test_robots_written_apart_make_the_same_recording(tmp_path: Path) -> None:
    """As parallel workers do: one RobotWriter each, in any order."""
    together = write_recording(tmp_path / "a" / "rec")
    with RecordingWriter(tmp_path / "b" / "rec", source={"dataset": "test"}, converter="test") as recording:
        for name in reversed(robot_names(2)):
            with RobotWriter(recording.folder, name, CAMERA, 0.001) as robot:
                write_robot(robot, 3)
            recording.add(json.loads(json.dumps(robot.summary)))  # plain enough to cross processes
    for path in sorted(together.iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / "rec" / path.name).read_bytes(), path.name


def test_exact_depth_and_geometry_lie_apart(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as writer:
        with writer.robot("alpha", CAMERA, 0.0002, {"depth_noise": "kinect"}) as robot:
            write_robot(robot, 2, exact=True)
        writer.add_geometry(lambda path: path.write_text("ply\n") and None)
    recording = Recording(tmp_path / "rec")
    truth = recording.groundtruth("alpha")
    assert truth is not None
    exact = [m.unpack_depth(r.proto(), "") for r in read_log(truth, ["/alpha/groundtruth/depth"])]
    assert np.array_equal(exact, [depth(50), depth(51)])
    assert recording.geometry() == tmp_path / "rec" / "groundtruth.ply"
    assert log_metadata(recording.log("alpha")) == {"robot": "alpha", "depth_noise": "kinect"}


def test_an_unfinished_recording_leaves_nothing(tmp_path: Path) -> None:
    def write_and_fail(error: type[BaseException]) -> None:
        with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
            write_robot(robot, 1)
            raise error

    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write_and_fail(error)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(DuagError, match="no robot"), RecordingWriter(tmp_path / "rec"):
        pass
    with (
        pytest.raises(DuagError, match="no frame"),
        RecordingWriter(tmp_path / "rec") as recording,
        recording.robot("alpha", CAMERA, 0.001),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_existing_outputs_are_kept(tmp_path: Path) -> None:
    out = write_recording(tmp_path / "rec", robots=1)
    with pytest.raises(DuagError, match="exists already"):
        write_recording(out)
    assert Recording(out).robots == ["alpha"]
    write_recording(out, robots=2, force=True)
    assert Recording(out).robots == ["alpha", "bravo"]
    other = tmp_path / "precious"
    other.mkdir()
    (other / "file").write_text("x")
    with pytest.raises(DuagError, match="--force replaces nothing else"):
        write_recording(other, force=True)
    assert (other / "file").read_text() == "x"


def test_bugs_of_converters_are_errors(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.add_frame(5, png(image(0)), "png", depth(0))
        for stamp, kind, array in ((5, "png", depth(0)), (6, "bmp", depth(0)), (6, "png", depth(0).T)):
            with pytest.raises(ValueError, match=r"expected|comes after"):
                robot.add_frame(stamp, png(image(1)), kind, array)
    with pytest.raises(DuagError, match="robot 'A b'"):
        RobotWriter(tmp_path, "A b", CAMERA, 0.001)


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"color": b"xx"}, "color is 2 bytes that are no png, expected an image"),
        ({"color": b""}, "color is 0 bytes that are no png, expected an image"),
        ({"color": png(image(1))[:500]}, "color is 500 bytes that are no png"),
        ({"color": png(image(1)[:6, :8])}, f"color is 8x6, expected {CAMERA.width}x{CAMERA.height}"),
        ({"color_format": "jpeg"}, "bytes that are no jpeg"),
        ({"stamp_ns": 6.5}, r"time 6\.5, expected a whole number of nanoseconds"),
        ({"depth_stamp_ns": 6.5}, r"time 6\.5, expected a whole number of nanoseconds"),
        (
            {"depth_sigma_m": np.full(depth(1).shape, -1.0)},
            "standard deviation of depth is -1 m, expected 0 or",
        ),
        ({"depth_sigma_m": np.full(depth(1).shape, np.nan)}, "standard deviation of depth is nan m"),
        ({"depth_sigma_m": np.full(depth(1).shape, np.inf)}, "standard deviation of depth is inf m"),
        ({"exact_depth": depth(1)[1:]}, rf"an image is .*, expected \({CAMERA.height}, {CAMERA.width}\)"),
    ],
)
def test_a_frame_that_is_none_is_refused(tmp_path: Path, wrong: dict[str, Any], complaint: str) -> None:
    frame = {"stamp_ns": 6, "color": png(image(1)), "color_format": "png", "depth": depth(1)}
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.add_frame(5, png(image(0)), "png", depth(0))
        with pytest.raises(ValueError, match=complaint):
            robot.add_frame(**frame | wrong)
        robot.add_frame(**frame)
    with open_rgbd(Recording(tmp_path / "rec").log("alpha")) as log:
        assert len(log) == 2


def test_standard_deviations_where_there_is_no_depth_may_be_no_numbers(tmp_path: Path) -> None:
    sigma_m = np.where(depth(0) > 0, 0.01, np.nan)
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.add_frame(5, png(image(0)), "png", depth(0), depth_sigma_m=sigma_m)


@pytest.mark.parametrize(
    ("T", "complaint"),
    [
        (np.zeros((4, 4)), "rotation is off by 1, expected a rigid motion"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "rotation is off by 1, expected a rigid motion"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "rotation is off by 2, expected a rigid motion"),
        (np.array([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "expected a rigid motion"),
        (np.eye(4)[:3], r"is a matrix \(3, 4\), expected \(4, 4\)"),
        (np.full((4, 4), np.nan), "numbers that are not finite, expected a pose"),
        (se3.from_rotation_translation(np.eye(3), np.array([1e10, 0, 0])), r"is 1e\+10 m away"),
    ],
)
def test_a_true_pose_that_is_no_pose_is_refused(tmp_path: Path, T: np.ndarray, complaint: str) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        with pytest.raises(DuagError, match=f"^robot alpha: the true pose at 5 ns.*{complaint}"):
            robot.add_frame(5, png(image(0)), "png", depth(0), T_world_camera=T)
        robot.add_frame(5, png(image(0)), "png", depth(0), T_world_camera=np.eye(4))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("not json", "expected the JSON of a recording"),
        ("[]", "format is 'list'"),
        ({"format": "other"}, "format is 'other'"),
        ({"schema": 99}, "schema is 99, expected 1"),
        ({"robots": {}}, "no robots"),
        ({"robots": {"alpha": {}}}, "'alpha' has no log"),
        ({"robots": {"../alpha": {"log": "alpha.mcap"}}}, "robot '../alpha'"),
        ({"robots": {"alpha": {"log": "../alpha.mcap"}}}, "alpha.log is '../alpha.mcap'"),
        ({"robots": {"alpha": {"log": "a.mcap", "groundtruth": 5}}}, "alpha.groundtruth is 5"),
        (
            {"robots": {"alpha": {"log": "a.mcap", "sensors": [5]}}},
            "alpha.sensors is a list, expected a dict",
        ),
        ({"geometry": "/etc/passwd"}, "geometry is '/etc/passwd'"),
    ],
)
def test_broken_descriptions_are_one_line(tmp_path: Path, change: str | dict[str, Any], words: str) -> None:
    path = write_recording(tmp_path / "rec", robots=1, frames=1) / "recording.json"
    path.write_text(
        change if isinstance(change, str) else json.dumps({**json.loads(path.read_text()), **change})
    )
    with pytest.raises(DuagError, match=r"recording\.json") as caught:
        Recording(path.parent)
    assert words in str(caught.value)


def test_missing_parts_of_a_recording(tmp_path: Path) -> None:
    with pytest.raises(DuagError, match=r"recording\.json: no such file"):
        Recording(tmp_path)
    out = write_recording(tmp_path / "rec", robots=1)
    (out / "alpha.mcap").unlink()
    with pytest.raises(DuagError, match=r"alpha\.mcap: no such file"):
        Recording(out).log("alpha")


@pytest.mark.parametrize("value", [0, 1])
@pytest.mark.parametrize("sensor", ["registered", "of its own", "lidar"])
def test_a_robot_without_any_depth_is_named(tmp_path: Path, sensor: str, value: int) -> None:
    raw = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    raw[0, 0] = value
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as writer:
        if sensor == "of its own":
            writer.set_depth_camera(CAMERA, np.eye(4), 0.001)
            writer.add_depth(0, raw)
        if sensor == "lidar":
            writer.set_lidar(np.eye(4), None)
            writer.add_points(0, np.ones((value, 3)))
        for k in range(2):
            shown = raw if sensor == "registered" else None
            writer.add_frame(1000 * (k + 1), png(image(k)), "png", shown)
    words = (
        "alpha: none of 2 frames has any depth (0, and the largest number, are none); expected some, or no map can be "
        "made"
    )
    description = Recording(tmp_path / "rec").description
    assert description["warnings"] == ([] if value else [words])
    assert "measures" not in description["robots"]["alpha"]


def test_robots_with_the_same_images_are_named(tmp_path: Path) -> None:
    """One recording given twice; images of no light may be the same."""

    def written(out: Path, same: int) -> list[str]:
        with RecordingWriter(out) as recording:
            for robot, name in enumerate(robot_names(2)):
                with recording.robot(name, CAMERA, 0.001) as writer:
                    for k in range(8):
                        shown = 10 * k + (robot if k >= same else 0)
                        writer.add_frame(1000 * k + 7 * robot, png(image(shown)), "png", depth(k))
        return Recording(out).description["warnings"]

    assert written(tmp_path / "other", 2) == []
    words = "bravo: 3 of its color images are those of alpha, byte for byte: what one camera saw once would count twice"
    assert written(tmp_path / "copy", 3) == [words]
    assert "color_digests" not in Recording(tmp_path / "copy").description["robots"]["alpha"]
