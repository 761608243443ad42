"""Depth that is not a depth image: LiDAR sweeps seen from the camera, standard deviations, and how they are logged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.recording.lidar import lidar_depth
from tests.fixtures.stereo_room import path, render, sweep

CAMERA = PinholeCamera(240, 180, 200.0, 201.0, 119.2, 89.7)
R_CAMERA_LIDAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x forward, z up
T_CAMERA_LIDAR = se3.from_rotation_translation(
    R_CAMERA_LIDAR @ so3.exp([0.02, -0.01, 0.03]), [0.02, -0.25, -0.1]
)
SIGMA_M = 0.02


def seen(T_world_camera: np.ndarray, T_camera_lidar: np.ndarray, sigma_m: float, **how: int) -> tuple:
    """Depth and sigma of a sweep, the truth, and the points in the camera frame."""
    points = sweep(T_world_camera @ T_camera_lidar, sigma_m=sigma_m, **how)
    _, truth = render(CAMERA, T_world_camera)
    return *lidar_depth(points, T_camera_lidar, CAMERA, sigma_m), truth, se3.transform(T_camera_lidar, points)


def test_pixels_that_are_hit_have_exactly_the_depth_of_the_point() -> None:
    depth, sigma, truth, points = seen(path(1)[0], T_CAMERA_LIDAR, 0.0)
    pixels = np.rint(CAMERA.project(points[points[:, 2] > 0.1])).astype(int)
    z = points[points[:, 2] > 0.1, 2].astype(np.float32)
    inside = ((pixels >= 0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1)
    hit = depth[pixels[inside, 1], pixels[inside, 0]] == z[inside]
    assert hit.mean() > 0.7  # of several in a pixel the nearest
    at = pixels[inside][hit]
    assert (sigma[at[:, 1], at[:, 0]] == 0).all()
    close = np.isclose(depth[at[:, 1], at[:, 0]], truth[at[:, 1], at[:, 0]], rtol=0.02)
    assert close.mean() > 0.98  # a point may lie half a pixel off the center, beyond the edge of the box
    filled = depth > 0
    assert filled.mean() > 0.55
    assert np.median(np.abs(depth - truth)[filled]) < 1e-4  # between the points walls are exact


@pytest.mark.parametrize(("rings", "columns"), [(16, 1800), (64, 900)])
def test_sigma_says_what_the_error_is(rings: int, columns: int) -> None:
    units = []
    for T in path(3, step=0.3):
        depth, sigma, truth, _ = seen(T, T_CAMERA_LIDAR, SIGMA_M, rings=rings, columns=columns)
        known = depth > 0
        assert (sigma[known] >= np.float32(SIGMA_M)).all()
        assert (sigma[~known] == 0).all()
        units.append((depth - truth)[known] / sigma[known])
    unit = np.concatenate(units)
    assert 0.4 < 1.4826 * np.median(np.abs(unit)) < 1.2
    assert np.mean(np.abs(unit) > 4) < 0.02  # at the edges of the box


def test_what_the_camera_cannot_see_is_hidden() -> None:
    """A LiDAR half a meter to the right looks behind the box; those points do not shine through it."""
    T_camera_lidar = se3.from_rotation_translation(R_CAMERA_LIDAR, [0.6, -0.1, 0.0])
    T = path(1)[0]
    depth, _, truth, points = seen(T, T_camera_lidar, 0.0, rings=32)
    pixels = np.rint(CAMERA.project(points[points[:, 2] > 0.1])).astype(int)
    z = points[points[:, 2] > 0.1, 2]
    inside = ((pixels >= 2) & (pixels < (CAMERA.width - 2, CAMERA.height - 2))).all(axis=1)
    pixels, z = pixels[inside], z[inside]
    nearest = cv2.erode(truth, np.ones((5, 5)))
    farthest = cv2.dilate(truth, np.ones((5, 5)))
    through = z > 1.1 * farthest[pixels[:, 1], pixels[:, 0]]
    assert through.sum() > 100  # without the test
    known = depth > 0
    wrong = known & ((depth > 1.1 * farthest) | (depth < 0.9 * nearest))
    assert wrong.sum() < 0.1 * through.sum()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points_are_no_surface(count: int) -> None:
    points = np.array([[2.0, 0.1 * k, 0.05 * k] for k in range(count)]).reshape(-1, 3)  # on a line
    depth, sigma = lidar_depth(
        points, se3.from_rotation_translation(R_CAMERA_LIDAR, np.zeros(3)), CAMERA, 0.01
    )
    assert np.count_nonzero(depth) == count
    assert np.array_equal(depth > 0, sigma > 0)


def picture(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def record(out: Path, fill: object, depth_scale: float = 0.001) -> Path:
    with RecordingWriter(out) as recording, recording.robot("alpha", CAMERA, depth_scale) as robot:
        fill(robot)  # type: ignore[operator]
    return Recording(out).log("alpha")


def test_a_lidar_is_written_and_read(tmp_path: Path) -> None:
    T = path(1)[0]
    color, _ = render(CAMERA, T)
    points = sweep(T @ T_CAMERA_LIDAR, sigma_m=SIGMA_M)
    frames = {}
    for stated in (SIGMA_M, None):

        def fill(robot: RobotWriter, stated: float | None = stated) -> None:
            robot.set_lidar(T_CAMERA_LIDAR, stated)
            robot.add_points(3, points)
            robot.add_frame(5, picture(color), "png", None)

        with open_rgbd(record(tmp_path / f"rec{stated}", fill)) as log:
            frames[stated] = log.frame(0)
    depth, sigma = lidar_depth(points.astype(np.float32).astype(float), T_CAMERA_LIDAR, CAMERA, SIGMA_M)
    assert frames[SIGMA_M].depth_offset_ns == -2
    np.testing.assert_allclose(frames[SIGMA_M].depth, depth, atol=1e-5)
    np.testing.assert_allclose(frames[SIGMA_M].depth_sigma, sigma, atol=1e-5)
    assert frames[None].depth_sigma is None  # nobody said how good it is
    assert np.count_nonzero(frames[None].depth) > 10_000


def test_a_depth_camera_an_imu_and_an_odometry_are_written_and_read(tmp_path: Path) -> None:
    depth_camera = PinholeCamera(120, 90, 100.0, 100.0, 59.5, 44.5)
    T_camera_depth, T_camera_imu = se3.exp([0.05, 0, 0, 0, 0.02, 0]), se3.exp([0, 0, 0.1, 0.4, 0, 0])
    T = path(1)[0]
    color, truth = render(CAMERA, T)
    _, raw = render(depth_camera, T @ T_camera_depth)
    rate = np.array([0.1, 0.5, -0.3])

    def fill(robot: RobotWriter) -> None:
        robot.set_depth_camera(depth_camera, T_camera_depth, 0.0005)
        robot.set_imu(T_camera_imu)
        for k in range(41):
            robot.add_imu(k * 5_000_000, T_camera_imu[:3, :3].T @ rate, np.array([0, 9.8, 0]))
            if k == 4:
                robot.add_depth(20_000_000, np.rint(raw / 0.0005).astype(np.uint16))
                robot.add_frame(20_000_000, picture(color), "png", None)

    with open_rgbd(record(tmp_path / "rec", fill)) as log:
        frame, prior = log.frame(0), log.motion_prior()
    known = frame.depth > 0
    assert known.mean() > 0.8
    assert np.median(np.abs(frame.depth - truth)[known] / truth[known]) < 0.003
    assert prior is not None
    motion = prior.between(10_000_000, 110_000_000)
    assert motion is not None
    np.testing.assert_allclose(so3.log(motion.T_start_stop[:3, :3]), 0.1 * rate, atol=1e-6)

    def odometry(robot: RobotWriter) -> None:
        for k in range(3):
            robot.add_odometry(k * 100_000_000, se3.exp([0.1 * k, 0, 0, 0, 0, 0]))
        robot.add_frame(200_000_000, picture(color), "png", np.ones((180, 240), np.uint16))

    with open_rgbd(record(tmp_path / "odo", odometry)) as log:
        motion = log.motion_prior().between(50_000_000, 150_000_000)  # type: ignore[union-attr]
    assert motion is not None
    np.testing.assert_allclose(motion.T_start_stop, se3.exp([0.1, 0, 0, 0, 0, 0]), atol=1e-12)


def test_standard_deviations_of_pixels_are_written_and_read(tmp_path: Path) -> None:
    depth = np.full((180, 240), 2000, np.uint16)
    depth[:10] = 0
    sigma = np.linspace(0.00001, 6.5, depth.size).reshape(depth.shape)
    sigma[20] = 0.0
    color = np.zeros((180, 240, 3), np.uint8)

    def fill(robot: RobotWriter, second: bool = True) -> None:
        robot.add_frame(0, picture(color), "png", depth, depth_sigma_m=sigma)
        robot.add_frame(10, picture(color), "png", depth, depth_sigma_m=sigma if second else None)

    with open_rgbd(record(tmp_path / "rec", fill)) as log:
        frame = log.frame(1)
    assert frame.depth_sigma is not None
    known = frame.depth > 0
    assert not known[:10].any()
    assert not known[20].any()  # nobody vouches for these
    assert known[30:].all()
    np.testing.assert_allclose(frame.depth_sigma[known], sigma[known], rtol=0.032, atol=1e-4)
    assert (frame.depth_sigma[~known] == 0).all()
    with open_rgbd(record(tmp_path / "one", lambda robot: fill(robot, False))) as log:
        log.frame(0)
        with pytest.raises(DuagError, match="at 10 ns has no image on /alpha/camera/depth_sigma"):
            log.frame(1)


def test_sensors_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with RobotWriter(tmp_path, "alpha", CAMERA, 0.001) as robot:
        with pytest.raises(ValueError, match="an image is"):
            robot.add_frame(0, b"", "png", None, depth_sigma_m=np.zeros((2, 2)))
        with pytest.raises(ValueError, match="expected that of a depth camera: None"):
            robot.add_depth(0, np.zeros((3, 4), np.uint16))
        robot.set_depth_camera(PinholeCamera(4, 3, 5, 5, 1, 1), np.eye(4), 0.001)
        with pytest.raises(ValueError, match="an image is"):
            robot.add_depth(0, np.zeros((4, 4), np.uint16))
        robot.add_frame(7, picture(np.zeros((180, 240, 3), np.uint8)), "png", np.zeros((180, 240), np.uint16))


def test_readings_may_come_after_the_last_frame_of_a_robot_that_sees_itself(tmp_path: Path) -> None:
    """The mask of its own body is written when all images were seen."""

    class Body:
        def add(self, *_: object) -> None:
            pass

        def result(self, _: object) -> dict[str, np.ndarray]:
            shown = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
            shown[100:] = False
            return {"body": shown}

    def fill(robot: RobotWriter) -> None:
        robot.set_imu(np.eye(4))
        robot._regions = Body()
        color, depth = render(CAMERA, path(1)[0])
        robot.add_frame(20_000_000, picture(color), "png", np.rint(depth / 0.0005).astype(np.uint16))
        robot.add_imu(90_000_000, np.zeros(3), np.array([0, 9.8, 0]))

    with open_rgbd(record(tmp_path / "rec", fill)) as log:
        assert log.valid is not None
        assert not log.valid[100:].any()
        assert log.frame(0).stamp_ns == 20_000_000
