"""Poses that do not belong to the depth are refused; rough ones are reported."""

import numpy as np
import pytest

from duagc.converters.layouts.self_check import ReprojectionCheck
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
FRAMES = 30


def checked(
    scale: float, noise_m: float = 0.0, shared_m: float = 0.0, stated: bool = False
) -> ReprojectionCheck:
    """A camera that goes 5 cm a frame toward a wall at 4 m, by poses that say it goes so many times as far.

    Args:
        scale: so many times.
        noise_m: standard deviation of a pixel's depth.
        shared_m: of an error that all pixels of a frame share.
        stated: the sensor states the latter.
    """
    check, rng = ReprojectionCheck(CAMERA, FRAMES), np.random.default_rng(0)
    for k in range(FRAMES):
        pose = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, scale * 0.05 * k])
        if check.needs(k, pose):
            depth_m = 4.0 - 0.05 * k + noise_m * rng.standard_normal((60, 80))
            sigma_m = np.full(depth_m.shape, shared_m) if stated else None
            check.add(k, depth_m + shared_m * rng.standard_normal(), pose, sigma_m)
    return check


def test_right_poses_leave_nothing() -> None:
    rows = checked(1.0).result("rec")
    assert rows["reprojection_median_m"] < 1e-9
    assert "rough" not in rows


def test_rough_poses_are_reported_and_not_refused() -> None:
    rows = checked(1.3).result("rec")  # 15 cm of 50, 5 % of the depth
    assert rows["reprojection_median_m"] == pytest.approx(0.15)
    assert rows["rough"]


@pytest.mark.parametrize("scale", [-1.0, 0.0, 0.4, 2.0])
def test_poses_of_another_convention_are_refused(scale: float) -> None:
    with pytest.raises(DuagError, match="do not belong together"):
        checked(scale).result("rec")


def test_noise_of_the_depth_is_no_fault_of_the_poses() -> None:
    rows = checked(1.0, noise_m=0.3).result("rec")
    assert rows["reprojection_median_m"] > 0.06 * rows["median_depth_m"]
    assert "rough" not in rows


@pytest.mark.parametrize("scale", [-1.0, 0.0, 2.0])
def test_noise_hides_no_other_convention(scale: float) -> None:
    with pytest.raises(DuagError, match="do not belong together"):
        checked(scale, noise_m=0.2).result("rec")


def test_errors_that_neighbors_share_are_explained_by_the_noise_that_the_sensor_states() -> None:
    assert checked(1.0, shared_m=0.3).result("rec")["rough"]
    rows = checked(1.0, shared_m=0.3, stated=True).result("rec")
    assert rows["reprojection_median_m"] > 0.05 * rows["median_depth_m"]
    assert "rough" not in rows
    with pytest.raises(DuagError, match="do not belong together"):
        checked(-1.0, shared_m=0.3, stated=True).result("rec")
