"""Depth of another time than its color, moved by the motion of the camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.depth_motion import KIND_KEY, CurveKind, DepthMotion
from duagc.pipeline.recording.depth_sources import DepthImage
from duagc.pipeline.recording.motion import GyroPrior
from duagc.pipeline.recording.moved_depth import move_depth
from duagc.pipeline.recording.write import LogWriter
from tests.fixtures.box_room import look, render

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
START = look([0.5, 0.2, 0.2], [4.0, 3.0, -0.5])
VELOCITY = np.array([0.6, -0.3, 0.9, 0.3, -0.9, 0.6])  # per second
FRAME_NS = 33_000_000


def place(seconds: float) -> np.ndarray:
    return START @ se3.exp(VELOCITY * seconds)


def depth_at(seconds: float) -> np.ndarray:
    return np.asarray(render(CAMERA, place(seconds))[1], dtype=np.float32)


@pytest.mark.parametrize("offset_s", [0.015, -0.03, 0.09])
def test_depth_is_moved_as_if_it_had_been_taken_there(offset_s: float) -> None:
    """Exact on planes; at the border and behind edges it is unknown, and nowhere invented."""
    taken, true = depth_at(offset_s), depth_at(0)
    T_color_depth = se3.inverse(place(0)) @ place(offset_s)
    moved = move_depth(DepthImage(taken), CAMERA, T_color_depth)
    assert moved.sigma_m is None
    assert moved.depth_m.dtype == np.float32
    known = moved.depth_m > 0
    assert known.mean() > 0.8
    error = np.abs(moved.depth_m - true)[known]
    assert np.percentile(error, 95) < 1e-5
    assert error.max() < 0.05 * true.max()
    assert np.median(np.abs(taken - true)) > 100 * np.percentile(error, 95)


def test_what_is_hidden_behind_an_edge_stays_unknown() -> None:
    """A card 0.5 m in front of a wall at 2 m: where the camera now looks past it, nothing was seen."""
    depth_m = np.full((120, 160), 2.0, np.float32)
    depth_m[30:90, 60:100] = 0.5
    T_color_depth = se3.from_rotation_translation(np.eye(3), np.array([-0.02, 0.0, 0.0]))
    moved = move_depth(DepthImage(depth_m), CAMERA, T_color_depth).depth_m
    card, wall = 0.02 * 130 / 0.5, 0.02 * 130 / 2.0  # px, to the left
    row = moved[60]
    assert (row[int(60 - card) + 2 : int(100 - card) - 1] == 0.5).all()
    assert (row[101:150] == 2).all()
    uncovered = row[int(np.ceil(100 - card)) + 1 : int(100 - wall) - 1]
    assert len(uncovered) >= 1
    assert (uncovered == 0).all()


def test_standard_deviations_and_holes_move_along() -> None:
    depth_m = np.full((120, 160), 2.0, np.float32)
    depth_m[50:60, 80:90] = 0
    sigma_m = np.where(depth_m > 0, np.float32(0.01), np.float32(0))
    T_color_depth = se3.from_rotation_translation(np.eye(3), np.array([0.2, 0.0, 0.0]))
    moved = move_depth(DepthImage(depth_m, sigma_m), CAMERA, T_color_depth)
    assert moved.sigma_m is not None
    assert np.array_equal(moved.sigma_m > 0, moved.depth_m > 0)
    v, u = np.nonzero(moved.depth_m[:, 20:] == 0)
    assert v.min() == 50
    assert v.max() == 59
    assert u.min() + 20 == 93  # 13 px to the right
    assert u.max() + 20 == 102


def test_next_to_no_motion_changes_no_bit() -> None:
    depth = DepthImage(depth_at(0))
    slow = se3.exp(1e-3 * VELOCITY)
    assert move_depth(depth, CAMERA, slow) is depth
    assert (
        move_depth(DepthImage(np.zeros((120, 160), np.float32)), CAMERA, se3.exp(VELOCITY)).depth_m.max() == 0
    )


def trajectory(frames: list[int]) -> Trajectory:
    stamps = np.array(frames, dtype=np.int64) * FRAME_NS
    return Trajectory(stamps, np.array([place(1e-9 * s) for s in stamps.tolist()]))


@pytest.mark.parametrize("offset_ms", [-90, -40, -12, 0, 12, 40, 90])
def test_the_camera_moves_at_constant_velocity_between_its_frames(offset_ms: int) -> None:
    motion = DepthMotion(trajectory(list(range(5))))
    for k in range(5):
        found = motion.between(k * FRAME_NS, k * FRAME_NS + offset_ms * 1_000_000)
        assert found is not None
        seconds = 1e-9 * k * FRAME_NS
        np.testing.assert_allclose(
            found, se3.inverse(place(seconds)) @ place(seconds + 1e-3 * offset_ms), atol=1e-12
        )


def test_errors_of_single_poses_are_smoothed() -> None:
    """Poses that stagger by 5 mm from frame to frame would move depth by as much."""
    frames = trajectory(list(range(9)))
    stagger = np.array([se3.exp(np.array([5e-3 * (-1) ** k, 0, 0, 0, 0, 0])) for k in range(9)])
    motion = DepthMotion(Trajectory(frames.stamps_ns, frames.poses @ stagger))
    for k in range(2, 7):
        found = motion.between(k * FRAME_NS, k * FRAME_NS + 15_000_000)
        assert found is not None
        seconds = 1e-9 * k * FRAME_NS
        true = se3.inverse(place(seconds)) @ place(seconds + 0.015)
        assert se3.distance(found, true)[0] < 2e-3


def test_a_camera_that_shakes_is_followed() -> None:
    """A parabola through seven poses misses a third of the speed of a camera that shakes four times a second."""

    def shaken(seconds: float) -> np.ndarray:
        return place(seconds) @ se3.exp(np.array([0, 0, 0, 0, 0.04 * np.sin(8 * np.pi * seconds), 0]))

    rng, stamps = np.random.default_rng(0), np.arange(60, dtype=np.int64) * 33_333_333
    errors = se3.exp(rng.normal(scale=3e-4, size=(len(stamps), 6)))
    poses = np.array([shaken(1e-9 * s) for s in stamps.tolist()]) @ errors
    motion, off, turns = DepthMotion(Trajectory(stamps, poses)), [], []
    for stamp in stamps[5:-5].tolist():
        found = motion.between(stamp, stamp + 12_000_000)
        assert found is not None
        true = se3.inverse(shaken(1e-9 * stamp)) @ shaken(1e-9 * stamp + 0.012)
        off.append(se3.distance(found, true)[1])
        turns.append(se3.distance(np.eye(4), true)[1])
    assert np.mean(off) < 0.2 * np.mean(turns)


def vibrating(seconds: float) -> np.ndarray:
    """A camera on a machine that turns twelve times a second."""
    angle = 0.04 * np.sin(24 * np.pi * seconds)
    return place(seconds) @ se3.exp(np.array([0, 0, 0, angle, 0.5 * angle, 0]))


def gyro_of_vibrations(late_s: float) -> GyroPrior:
    """At 200 Hz, with a bias, mounted a degree askew, and a clock that may be late."""
    times = np.arange(-0.1, 2.2, 0.005)
    before, after = (np.array([vibrating(t - late_s + dt) for t in times]) for dt in (-1e-4, 1e-4))
    rates = se3.log(se3.inverse(before) @ after)[:, 3:] / 2e-4
    own = rates @ so3.exp([0.01, -0.015, 0.01]) + np.array([0.02, -0.01, 0.015])
    return GyroPrior(np.rint(1e9 * times).astype(np.int64).tolist(), own)


@pytest.mark.parametrize("late_s", [0.0, 0.02])
def test_vibrations_between_frames_are_known_by_a_gyroscope_alone(late_s: float) -> None:
    stamps = np.arange(60, dtype=np.int64) * 33_333_333
    part = Trajectory(stamps, np.array([vibrating(1e-9 * s) for s in stamps.tolist()]))
    motion, by_poses = DepthMotion(part, gyro=gyro_of_vibrations(late_s)), DepthMotion(part)
    for stamp in stamps[5:-5].tolist():
        times = stamp + np.array([-10_000_000, 0, 7_000_000])
        found, without = motion.at(stamp, times), by_poses.at(stamp, times)
        assert found is not None
        if late_s == 0.0:
            then = np.array([vibrating(1e-9 * t) for t in times.tolist()])
            assert se3.distance(found, se3.inverse(vibrating(1e-9 * stamp)) @ then)[1].max() < 2e-3
        else:
            np.testing.assert_array_equal(found, without, "another clock says nothing")


@pytest.mark.parametrize("shakes", [False, True])
def test_the_kind_of_curves_is_read_as_it_was_written(tmp_path: Path, shakes: bool) -> None:
    """What a front end found describes the motion along other poses of the same frames too."""
    stamps = np.arange(60, dtype=np.int64) * 33_333_333
    of = vibrating if shakes else place
    part = Trajectory(stamps, np.array([of(1e-9 * s) for s in stamps.tolist()]))
    gyro = gyro_of_vibrations(0.0) if shakes else None
    kind = CurveKind.of(part, gyro)
    assert bool(kind.notes()) == shakes, "parabolas go without saying"
    with LogWriter(tmp_path / "a.mcap", "alpha", kind.notes()):
        pass
    found = CurveKind.found(tmp_path / "a.mcap")
    still = Trajectory(stamps, part.poses[:1].repeat(len(stamps), axis=0))
    given, again = (DepthMotion(still, gyro=gyro, kind=k) for k in (kind, found))
    times = stamps[30] + np.array([-10_000_000, 7_000_000])
    np.testing.assert_array_equal(given.at(stamps[30], times), again.at(stamps[30], times))


@pytest.mark.parametrize(
    "said", ["", "{}", '{"degree": 3, "gyro": null}', '{"degree": 4, "gyro": {"bias": [1]}}']
)
def test_kinds_of_curves_that_no_front_end_writes_are_refused(tmp_path: Path, said: str) -> None:
    with LogWriter(tmp_path / "a.mcap", "alpha", {KIND_KEY: said}):
        pass
    with pytest.raises(DuagError, match=r"motion_curves is .*, expected degree and gyro"):
        CurveKind.found(tmp_path / "a.mcap")


def test_poses_that_do_not_say_move_nothing() -> None:
    motion = DepthMotion(trajectory([0, 1, 2, 20]))
    assert motion.between(3 * FRAME_NS, 3 * FRAME_NS + 1) is None, "no such frame"
    assert motion.between(20 * FRAME_NS, 20 * FRAME_NS + 10_000_000) is None, "no other frame near"
    assert motion.between(2 * FRAME_NS, 2 * FRAME_NS - 10_000_000) is not None
    assert DepthMotion(trajectory([4])).between(4 * FRAME_NS, 4 * FRAME_NS + 1) is None


@pytest.mark.parametrize("lost", [[4], [3, 4, 5]])
def test_a_lost_frame_moves_as_the_frames_before_and_after_it_say(lost: list[int]) -> None:
    """In fast turns frames are lost because their depth is late: then nothing would ever move it."""
    motion = DepthMotion(trajectory([k for k in range(9) if k not in lost]))
    for k in lost:
        found = motion.between(k * FRAME_NS, k * FRAME_NS - 18_000_000)
        assert found is not None
        seconds = 1e-9 * k * FRAME_NS
        np.testing.assert_allclose(found, se3.inverse(place(seconds)) @ place(seconds - 0.018), atol=1e-12)
    assert motion.between(9 * FRAME_NS, 9 * FRAME_NS - 18_000_000) is None, "nothing after it"


def test_a_log_moves_its_depth_once_it_knows_how(tmp_path: Path) -> None:
    late_ns = 14_000_000
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(4):
            color, _ = render(CAMERA, place(1e-9 * k * FRAME_NS))
            png = cv2.imencode(".png", color)[1].tobytes()
            taken = depth_at(1e-9 * (k * FRAME_NS + late_ns))
            raw = np.rint(taken / 0.0005).astype(np.uint16)
            robot.add_frame(k * FRAME_NS, png, "png", raw, depth_stamp_ns=k * FRAME_NS + late_ns)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert log.pairing.largest_offset_ns == late_ns
        before = log.frame(2)
        log.move_depth(trajectory([0, 1, 2, 3]))
        after = log.frame(2)
        assert np.array_equal(log.usable_depth(2), after.usable_depth)
        assert log.moments(2) is None, "nobody said how long the shutter is open"
        log.open_shutter(0.03, trajectory([0, 1, 2, 3]))
        passed = log.frame(2).T_camera_moment
        assert passed is not None
        np.testing.assert_array_equal(log.moments(2), passed)
    true = depth_at(1e-9 * 2 * FRAME_NS)
    assert before.depth_offset_ns == after.depth_offset_ns == late_ns
    assert (before.depth_moved, after.depth_moved) == (False, True)
    both = (before.depth > 0) & (after.depth > 0)
    assert both.mean() > 0.9
    assert np.percentile(np.abs(after.depth - true)[both], 90) < 1e-3
    assert np.percentile(np.abs(before.depth - true)[both], 90) > 1e-2
