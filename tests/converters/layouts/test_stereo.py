"""Stereo: rectification, depth and its standard deviation against exact renderings through distorted lenses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from duagc.converters.layouts.row_check import RowCheck
from duagc.converters.layouts.stereo import RawCamera, StereoOptions, StereoRig, disparity_sigma_m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.stereo_room import path, render, right_of

LEFT = PinholeCamera(306, 256, 294.1, 294.0, 155.4, 127.0)
RIGHT = PinholeCamera(306, 256, 292.7, 292.7, 150.6, 126.4)
D_LEFT, D_RIGHT = (-0.098, 0.11, 0.0004, -0.0006), (-0.101, 0.12, -0.0007, 0.0003)
T_RIGHT_LEFT = se3.from_rotation_translation(so3.exp([0.014, -0.02, 0.008]), [-0.3648, 0.0014, -0.0127])
OPTIONS = StereoOptions(min_depth_m=1.0)


def raw(camera: PinholeCamera, distortion: tuple[float, ...]) -> RawCamera:
    return RawCamera(camera.matrix(), distortion, camera.width, camera.height)


def rig(options: StereoOptions = OPTIONS) -> StereoRig:
    return StereoRig.of(raw(LEFT, D_LEFT), raw(RIGHT, D_RIGHT), T_RIGHT_LEFT, "here", options=options)


def pair(T_world_left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Color images of both cameras."""
    left, _ = render(LEFT, T_world_left, D_LEFT)
    right, _ = render(RIGHT, right_of(T_world_left, T_RIGHT_LEFT), D_RIGHT)
    return left, right


def gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def rectified(stereo: StereoRig, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    left, right = pair(T)
    return gray(stereo.rectify_left(left)), gray(stereo.rectify_right(right))


def truth_of(stereo: StereoRig, T_world_left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the rectified camera sees: color and exact depth."""
    T = T_world_left.copy()
    T[:3, :3] = T[:3, :3] @ stereo.R_rectified_left.T
    return render(stereo.camera, T)


@pytest.mark.parametrize("shrink", [1, 2])
def test_depth_and_its_sigma_agree_with_the_truth(shrink: int) -> None:
    stereo = rig(OPTIONS.model_copy(update={"shrink": shrink}))
    units, errors, filled = [], [], []
    for T in path(3, step=0.4):
        color, truth = truth_of(stereo, T)
        assert np.median(np.abs(stereo.rectify_left(pair(T)[0]).astype(int) - color)) <= 8
        depth_m, sigma_m = stereo.depth(*rectified(stereo, T))
        known = depth_m > 0
        assert np.array_equal(known, sigma_m > 0)
        units.append(((depth_m - truth) / np.where(known, sigma_m, 1))[known])
        errors.append((np.abs(depth_m - truth) / truth)[known])
        filled.append(known.mean())
    unit, error = np.concatenate(units), np.concatenate(errors)
    assert np.mean(filled) > 0.7  # what only one camera sees stays empty
    assert np.median(error) < 0.007 * shrink  # 0.2 px at 5.5 m
    assert 0.8 < 1.4826 * np.median(np.abs(unit)) < 1.3  # says what its error is
    assert np.mean(np.abs(unit) > 4) < 0.02
    assert abs(np.median(unit)) < 0.4


def test_what_only_the_left_camera_sees_stays_empty() -> None:
    """Behind the left edge of the box the right camera sees the box, not the wall."""
    stereo = rig()
    T = path(1)[0]
    _, truth = truth_of(stereo, T)
    T_right = T.copy()
    T_right[:3, :3] = T[:3, :3] @ stereo.R_rectified_left.T
    T_right = T_right @ se3.exp([stereo.baseline_m, 0, 0, 0, 0, 0])
    _, there = render(stereo.camera, T_right)
    disparity = stereo.camera.fx * stereo.baseline_m / truth
    v, u = np.indices(truth.shape)
    column = np.rint(u - disparity).astype(int)
    inside = column >= 0
    hidden = inside & (there[v, np.maximum(column, 0)] < 0.9 * truth)
    hidden = cv2.erode(hidden.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert hidden.sum() > 300
    depth_m, _ = stereo.depth(*rectified(stereo, T))
    assert np.mean(depth_m[hidden] > 0) < 0.25
    assert np.mean((depth_m > 0)[u < disparity - 1.5]) < 0.01  # left of what the right camera sees


def test_sigma_grows_with_the_square_of_depth() -> None:
    np.testing.assert_allclose(disparity_sigma_m(np.array([1.0, 2.0, 10.0]), 0.2, 50.0), [0.004, 0.016, 0.4])


def test_rows_are_tested_on_the_images() -> None:
    stereo = rig()
    right_order = RowCheck()
    for T in path(2, step=0.4):
        right_order.add(*rectified(stereo, T))
    found = right_order.result("here")
    assert found["row_difference_px"] < 0.25
    assert found["disparity_px"] > 0
    assert found["matched_features"] > 100

    turned_back = se3.from_rotation_translation(T_RIGHT_LEFT[:3, :3].T, T_RIGHT_LEFT[:3, 3])
    wrong = StereoRig.of(raw(LEFT, D_LEFT), raw(RIGHT, D_RIGHT), turned_back, "here", options=OPTIONS)
    check = RowCheck()
    check.add(*rectified(wrong, path(1)[0]))
    with pytest.raises(DuagError, match=r"here: matched features lie .* px apart in rows"):
        check.result("here")

    check = RowCheck()
    left, right = rectified(stereo, path(1)[0])
    check.add(right, left)
    with pytest.raises(DuagError, match="the cameras are swapped"):
        check.result("here")
    check = RowCheck()
    check.add(np.zeros_like(left), np.zeros_like(left))
    with pytest.raises(DuagError, match="here: 0 features"):
        check.result("here")


def test_impossible_rigs_are_one_line() -> None:
    left, right = raw(LEFT, D_LEFT), raw(RIGHT, D_RIGHT)
    with pytest.raises(DuagError, match="expected it to the left"):
        StereoRig.of(left, right, se3.inverse(T_RIGHT_LEFT), "here")
    small = RawCamera(RIGHT.matrix(), D_RIGHT, 300, 256)
    with pytest.raises(DuagError, match="right images are 300x256, expected 306x256"):
        StereoRig.of(left, small, T_RIGHT_LEFT, "here")


FISHEYE = (0.01, -0.02, 0.003, 0.001)
RADIAL, TURNS_BACK = (-0.1, 0.02, 0.0004, -0.0006), (-0.25, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("fisheye", "distortion"), [(True, FISHEYE), (True, ()), (False, RADIAL)])
def test_a_point_lies_in_one_row_of_both_rectified_images(
    fisheye: bool, distortion: tuple[float, ...]
) -> None:
    camera = PinholeCamera(376, 240, 200.0, 202.0, 185.0, 118.0)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    coefficients = np.array(distortion or (0.0,) * 4)
    raw_camera = RawCamera(camera.matrix(), distortion, camera.width, camera.height, fisheye)
    stereo = StereoRig.of(raw_camera, raw_camera, T_RIGHT_LEFT, "here", options=OPTIONS)
    assert stereo._maps is not None
    points = np.random.default_rng(1).uniform([-1, -0.6, 3], [1, 0.6, 5], (200, 3))
    rows = points @ stereo.R_rectified_left.T
    u, v = (
        stereo.camera.fx * rows[:, 0] / rows[:, 2] + stereo.camera.cx,
        stereo.camera.fy * rows[:, 1] / rows[:, 2] + stereo.camera.cy,
    )
    disparity = stereo.camera.fx * stereo.baseline_m / rows[:, 2]
    seen = (u - disparity > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    assert np.count_nonzero(seen) > 100
    in_right = points @ T_RIGHT_LEFT[:3, :3].T + T_RIGHT_LEFT[:3, 3]
    for maps, column, of_camera in zip(stereo._maps, (u, u - disparity), (points, in_right), strict=True):
        drawn = [
            cv2.remap(part, column[seen].astype(np.float32), v[seen].astype(np.float32), cv2.INTER_LINEAR)
            for part in maps
        ]
        truth, _ = project(of_camera[seen][:, None], np.zeros(3), np.zeros(3), camera.matrix(), coefficients)
        error_px = np.stack([d.ravel() for d in drawn], -1) - truth[:, 0]
        assert np.abs(error_px).max() < 0.1  # maps are read between pixels


def test_rectified_cameras_that_do_not_fit_are_refused_by_what_is_wrong() -> None:
    left = PinholeCamera(320, 240, np.float64(262.4), np.float64(262.4), 160.0, 120.0)
    with pytest.raises(DuagError) as raised:
        StereoRig.rectified(left, left, -0.11, "here")
    assert str(raised.value) == (
        "here: base line is -0.11 m, expected more than 0; P[3] of the right CameraInfo must be -f b, "
        "or left and right are swapped"
    )
    with pytest.raises(DuagError) as raised:
        StereoRig.rectified(left, PinholeCamera(320, 200, 262.4, 262.5, 160.0, 120.0), 0.11, "here")
    assert str(raised.value) == (
        "here: left and right rectified camera have height 240 and 200, fy 262.4 and 262.5, expected the same"
    )


def test_one_fisheye_alone_is_refused() -> None:
    pinhole = raw(LEFT, D_LEFT)
    fisheye = RawCamera(RIGHT.matrix(), FISHEYE, RIGHT.width, RIGHT.height, True)
    with pytest.raises(DuagError, match="one camera of the pair is a fisheye"):
        StereoRig.of(pinhole, fisheye, T_RIGHT_LEFT, "here")


def test_pixels_beyond_the_turn_of_a_distortion_are_none_of_the_scene() -> None:
    """There the polynomial leads back into the image, which would be seen twice."""
    camera = PinholeCamera(376, 240, 130.0, 130.0, 188.0, 120.0)
    raw_camera = RawCamera(camera.matrix(), TURNS_BACK, camera.width, camera.height)
    stereo = StereoRig.of(raw_camera, raw_camera, T_RIGHT_LEFT, "here", options=OPTIONS)
    assert stereo.valid is not None
    x, y = np.meshgrid(*(np.arange(n) for n in (camera.width, camera.height)))
    rays = np.stack(
        [
            (x - stereo.camera.cx) / stereo.camera.fx,
            (y - stereo.camera.cy) / stereo.camera.fy,
            np.ones(x.shape),
        ],
        axis=-1,
    )
    rays = rays @ stereo.R_rectified_left  # to the left camera
    radius = np.hypot(rays[..., 0], rays[..., 1]) / rays[..., 2]
    turn = (3 * 0.25) ** -0.5  # of r (1 - 0.25 r^2)
    assert np.mean(radius > turn) > 0.01
    assert not stereo.valid[radius > 1.005 * turn].any()
    assert stereo.valid[radius < 0.9 * turn].mean() > 0.8
