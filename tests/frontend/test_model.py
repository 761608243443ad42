"""Frames registered to a map by their color, with tracking as the prior."""

import numpy as np
import pytest

from duagc.pipeline.config.frontend import ModelConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import SparseStepsConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.mapping import Mapper
from duagc.pipeline.frontend.model_registration import ModelTracker
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.recording import RgbdFrame
from duagc.pipeline.registration import RegistrationConfig
from duagc.pipeline.splat.gaussians import Gaussians
from tests.fixtures.room import CAMERA, pose, render

KEYFRAME = pose(z=-0.9)
FRAME = pose(x=0.06, z=-0.88, yaw=0.04)
T_KEYFRAME_FRAME = se3.inverse(KEYFRAME) @ FRAME
OFF = se3.exp(np.array([0.006, -0.004, 0.005, 0.003, -0.004, 0.002]))
CONFIG = ModelConfig()


def image(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    gray, depth = render(T_world_camera)
    return np.repeat(np.rint(255 * np.clip(gray, 0, 1)).astype(np.uint8)[..., None], 3, axis=2), depth


def room_map(seed: int) -> Gaussians:
    """The room from three places; the map frame is the keyframe's camera."""
    # what is tested is the registration: the map is to be good in few steps
    whole = SparseStepsConfig(checkerboard=False, closing=0.0)
    config = MappingConfig(
        max_gaussians=20000, iterations=20, final_iterations=60, pose_rate=0.0, sparse=whole
    )
    mapper = Mapper(CAMERA, config, seed=seed, depth="blended")
    for k, T in enumerate((KEYFRAME, pose(x=-0.1, z=-0.9), pose(x=0.12, z=-0.85, yaw=0.05))):
        mapper.add_keyframe(k, PosedRgbd(*image(T), se3.inverse(KEYFRAME) @ T))
    mapper.finalize()
    return mapper.gaussians


@pytest.fixture(scope="module")
def maps() -> list[Gaussians]:
    """Maps that differ by the order of their few steps: by which of them is taken, poses end twice as far off."""
    return [room_map(seed) for seed in range(4)]


@pytest.fixture(scope="module")
def gaussians(maps: list[Gaussians]) -> Gaussians:
    return maps[0]


def tracked(sigma_m: float) -> TrackedFrame:
    """The frame, a few millimeters and milliradians from where it is."""
    information = np.diag([sigma_m**-2.0] * 6)
    T = T_KEYFRAME_FRAME @ OFF
    return TrackedFrame(
        frame_index=1,
        stamp_ns=10,
        keyframe_index=0,
        T_keyframe_camera=T,
        information=information,
        status=Status.OK,
        overlap=0.9,
        rms_depth_m=0.001,
        rms_gray=0.01,
        reason=Reason.NONE,
    )


def seen(color: np.ndarray | None = None) -> RgbdFrame:
    exact, depth = image(FRAME)
    return RgbdFrame(1, 10, exact if color is None else color, np.full_like(depth, 9.0))  # depth is not used


def tracker(gaussians: Gaussians, config: ModelConfig = CONFIG, threads: int = 1) -> ModelTracker:
    return ModelTracker(
        gaussians, "blended", CAMERA, config, registration=RegistrationConfig(), threads=threads
    )


def test_a_poor_pose_becomes_a_good_one(maps: list[Gaussians]) -> None:
    before = tracked(0.02)
    found = [tracker(gaussians).register(before, seen(), np.eye(4)) for gaussians in maps]
    poor, *good = (np.array(se3.distance(f.T_keyframe_camera, T_KEYFRAME_FRAME)) for f in (before, *found))
    assert (np.mean(good, axis=0) < 0.5 * poor).all()  # a pixel is 6 mm wide
    after = found[0]
    np.testing.assert_array_equal(after.information, before.information)
    assert (after.frame_index, after.status, after.keyframe_index) == (1, Status.OK, 0)


def test_a_view_from_nearby_serves_as_well(maps: list[Gaussians]) -> None:
    before = tracked(0.02)
    nearby = T_KEYFRAME_FRAME @ se3.exp(np.array([0.01, -0.01, 0.01, 0.003, 0.004, -0.004]))
    found = [tracker(gaussians).register(before, seen(), np.eye(4), nearby) for gaussians in maps]
    poor, *good = (np.array(se3.distance(f.T_keyframe_camera, T_KEYFRAME_FRAME)) for f in (before, *found))
    assert (np.mean(good, axis=0) < 0.6 * poor).all()


def test_frames_that_see_nearly_the_same_share_a_view() -> None:
    turning = np.array([se3.exp(np.array([0, 0, 0, 0, 0.002 * k, 0])) for k in range(30)])
    shared, alone = (
        tracker(Gaussians.empty(), ModelConfig(shared_view=share)).drawn_from(turning, 1.0)
        for share in (0.01, 0.0)
    )
    np.testing.assert_array_equal(alone, turning)
    off = [se3.distance(*pair)[1] for pair in zip(shared, turning, strict=True)]
    most_rad = 0.01 * CAMERA.width / CAMERA.fx
    assert 0.5 * most_rad < max(off) <= most_rad
    assert len(np.unique(shared, axis=0)) < 5


def test_a_pose_that_is_known_exactly_stays(gaussians: Gaussians) -> None:
    before = tracked(1e-7)
    after = tracker(gaussians).register(before, seen(), np.eye(4))
    moved = se3.distance(before.T_keyframe_camera, after.T_keyframe_camera)
    assert max(moved) < 1e-6


def test_large_images_are_registered_at_a_smaller_size(maps: list[Gaussians]) -> None:
    small = ModelConfig(max_pixels=CAMERA.width * CAMERA.height - 1)
    before = tracked(0.02)
    found = [tracker(gaussians, small).register(before, seen(), np.eye(4)) for gaussians in maps]
    poor, *good = (se3.distance(f.T_keyframe_camera, T_KEYFRAME_FRAME)[0] for f in (before, *found))
    assert np.mean(good) < 0.7 * poor


def test_a_frame_that_the_map_does_not_show_stays(gaussians: Gaussians) -> None:
    poor, elsewhere = tracked(0.02), pose(yaw=np.pi)
    assert tracker(gaussians).register(poor, seen(), se3.inverse(KEYFRAME) @ elsewhere) is poor
    assert tracker(Gaussians.empty()).register(poor, seen(), np.eye(4)) is poor


def test_threads_change_no_bit(gaussians: Gaussians) -> None:
    one, three = (tracker(gaussians, threads=n).register(tracked(0.02), seen(), np.eye(4)) for n in (1, 3))
    np.testing.assert_array_equal(one.T_keyframe_camera, three.T_keyframe_camera)
