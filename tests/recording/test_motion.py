"""Motion between frames by other sensors."""

from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import LogWriter, open_rgbd
from duagc.pipeline.recording.gyro_calibration import GyroCorrection
from duagc.pipeline.recording.motion import GyroPrior
from tests.fixtures.recording_logs import copy_camera, write_camera


def spin(time_s: float) -> np.ndarray:
    """T_odometry_camera of a constant twist."""
    return se3.exp(np.array([0.3, -0.1, 0.2, 0.4, 0.7, -0.5]) * time_s)


def test_odometry_prior_is_interpolated_and_has_limits(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    assert open_rgbd(path).motion_prior() is None
    times = [*range(0, 10**9, 100_000_000), 2 * 10**9]
    with LogWriter(tmp_path / "b.mcap", "alpha") as log:
        copy_camera(path, log, 0)
        for time in times:
            log.write(
                "/alpha/odometry_prior", m.pack_pose_in_frame(time, "odometry", spin(time * 1e-9)), time
            )
    prior = open_rgbd(tmp_path / "b.mcap").motion_prior()
    assert prior is not None
    for start, stop in ((0, 900_000_000), (130_000_000, 470_000_000), (200_000_000, 233_000_000)):
        motion = prior.between(start, stop)
        assert motion is not None
        assert motion.knows_translation
        np.testing.assert_allclose(motion.T_start_stop, spin((stop - start) * 1e-9), atol=1e-9)
    for start, stop in ((0, 1_500_000_000), (500_000_000, 2_100_000_000)):  # a gap, and beyond the end
        assert prior.between(start, stop) is None


def test_gyro_prior_turns_as_the_camera_does(tmp_path: Path) -> None:
    """An IMU that is mounted askew, at 200 Hz, with a rate that changes."""
    path = write_camera(tmp_path / "alpha.mcap")
    T_camera_imu = se3.exp([0.1, 0, 0, 0.5, -1.0, 0.3])
    times = list(range(0, 600_000_000, 5_000_000))
    rates = [np.array([0.5, -1.0, 0.2]) * (1 + time * 1e-9) for time in times]

    def write(transform: bool) -> Path:
        with LogWriter(tmp_path / "b.mcap", "alpha") as log:
            copy_camera(path, log, 0)
            if transform:
                log.write(
                    "/alpha/imu/transform", m.pack_transform(0, "alpha/camera", "alpha/imu", T_camera_imu), 0
                )
            for time, rate in zip(times, rates, strict=True):
                own = T_camera_imu[:3, :3].T @ rate
                log.write("/alpha/imu", m.pack_imu(time, "alpha", own, [0, 9.8, 0]), time)
        return tmp_path / "b.mcap"

    prior = open_rgbd(write(True)).motion_prior()
    assert prior is not None
    motion = prior.between(102_000_000, 411_000_000)
    assert motion is not None
    assert not motion.knows_translation
    turned = np.array([0.5, -1.0, 0.2]) * (0.309 + 0.5 * (0.411**2 - 0.102**2))  # the axis is constant
    np.testing.assert_allclose(motion.T_start_stop, se3.exp([0, 0, 0, *turned]), atol=1e-4)
    assert prior.between(102_000_000, 700_000_000) is None
    assert isinstance(prior, GyroPrior)
    turns = prior.turns(411_000_000, np.array([102_000_000, 411_000_000, 500_000_000]), GyroCorrection())
    assert turns is not None
    np.testing.assert_allclose(turns[0].T, motion.T_start_stop[:3, :3], atol=1e-12)
    np.testing.assert_allclose(turns[1], np.eye(3), atol=1e-12)
    later = prior.between(411_000_000, 500_000_000)
    assert later is not None
    np.testing.assert_allclose(turns[2], later.T_start_stop[:3, :3], atol=1e-12)
    assert prior.turns(411_000_000, np.array([700_000_000]), GyroCorrection()) is None
    with pytest.raises(DuagError, match="/alpha/imu/transform has no message"):
        open_rgbd(write(False)).motion_prior()


def test_a_gap_that_ends_where_a_motion_begins_leaves_it_known():
    """A rate is measured when the motion begins, so that it needs nothing of the gap before."""
    stamps = [0, 100_000_000, 120_000_000, 140_000_000, 240_000_000]
    prior = GyroPrior(stamps, np.tile([0.0, 1.0, 0.0], (len(stamps), 1)))
    motion = prior.between(100_000_000, 140_000_000)
    assert motion is not None
    np.testing.assert_allclose(motion.T_start_stop, se3.exp([0, 0, 0, 0, 0.04, 0]), atol=1e-12)
    turns = prior.turns(100_000_000, np.array([120_000_000, 140_000_000]), GyroCorrection())
    assert turns is not None
    np.testing.assert_allclose(turns[1], motion.T_start_stop[:3, :3], atol=1e-12)
    assert prior.between(99_999_999, 140_000_000) is None
    assert prior.between(100_000_000, 140_000_001) is None
