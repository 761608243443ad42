"""Depth that is wrong by a tenth of it, as of what a stereo camera sees far away, still gives surfaces and motions."""

import cv2
import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration import Outcome, Reference, RegistrationConfig, RgbdPyramid, register
from duagc.pipeline.registration.residuals import gray_floor_of_depth
from duagc.pipeline.registration.wide_surfaces import WideSurfaces
from tests.fixtures.room import CAMERA, pose, render

FARTHER = 6.0  # the room is larger, so that most is 9 to 18 m away
NOISE = 0.004  # 1/m: 4 to 8 % of the depth, and neighbors share it
STRIDES = (2, 1, 1)
FACTOR = 4  # of three levels


def shared_by_neighbors(seed: int) -> np.ndarray:
    """Noise [h, w] of unit variance that pixels within the window of a stereo matcher share."""
    values = np.random.default_rng(seed).standard_normal((CAMERA.height, CAMERA.width)).astype(np.float32)
    values = cv2.GaussianBlur(values, (0, 0), 1.5)
    return values / values.std()


def far_view(T_world_camera: np.ndarray, seed: int, noise: float = NOISE) -> RgbdPyramid:
    gray, depth = render(T_world_camera)
    inverse = 1 / (FARTHER * depth) + noise * shared_by_neighbors(seed)
    return RgbdPyramid.build(gray, (1 / np.maximum(inverse, 0.01)).astype(np.float32), CAMERA)


def in_larger_room(T: np.ndarray) -> np.ndarray:
    larger = T.copy()
    larger[..., :3, 3] *= FARTHER
    return larger


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_motions_are_found_and_not_too_short_where_all_depth_is_off_by_a_tenth():
    start, end = pose(z=-0.75, yaw=0.3), pose(x=0.12, z=-0.75, yaw=0.3)
    T = se3.inverse(in_larger_room(start)) @ in_larger_room(end)
    along = T[:3, 3] / np.sum(T[:3, 3] ** 2)
    shares = []
    for seed in range(16):
        reference = Reference.from_pyramid(far_view(start, 2 * seed), STRIDES)
        result = register(reference, far_view(end, 2 * seed + 1), T)
        assert result.conflict < 0.1  # 0.3 where noise counts as objects
        if result.outcome is Outcome.ILL_CONDITIONED:  # that views this far determine little is no error
            continue
        assert result.ok
        shares.append(result.T_reference_target[:3, 3] @ along)
    assert len(shares) >= 12
    # no bias beyond chance; with the depth of single pixels 5 % of the motion are missing, four deviations
    assert abs(np.mean(shares) - 1) < 3 * np.std(shares) / np.sqrt(len(shares))


def test_noise_of_depth_is_not_taken_for_noise_of_gray_values():
    start, end = pose(z=-0.75, yaw=0.3), pose(x=0.12, z=-0.75, yaw=0.3)
    T = se3.inverse(in_larger_room(start)) @ in_larger_room(end)
    off = []
    for seed in range(8):
        reference = Reference.from_pyramid(far_view(start, 2 * seed), STRIDES)
        result = register(reference, far_view(end, 2 * seed + 1), T)
        off.append(np.linalg.norm(result.T_reference_target[:3, 3] - T[:3, 3]))
    assert rms(off) < 0.02  # 0.09 where the scale of the depth residuals sets a floor of the gray noise


def test_the_floor_of_the_gray_noise_falls_with_the_share_of_noisy_far_samples():
    config = RegistrationConfig()

    def share(pyramid: RgbdPyramid) -> float:
        reference = Reference.from_pyramid(pyramid, STRIDES)
        return gray_floor_of_depth(reference, pyramid, config) / (
            config.gray_sigma_of_depth * reference.contrast
        )

    gray, depth = render(pose(yaw=0.3), noise=np.random.default_rng(0))
    near, far = RgbdPyramid.build(gray, depth, CAMERA), far_view(pose(yaw=0.3), 0)
    assert share(near) == 1.0
    assert share(far) < 0.05
    sigma = np.full_like(depth, 0.5)  # stated: the gate of depth follows it
    assert share(RgbdPyramid.build(gray, FARTHER * depth, CAMERA, depth_sigma_m=sigma)) == 1.0
    partly = far.levels[0].inverse_depth.copy()
    partly[:, : CAMERA.width // 3] = 1 / 1.5  # a wall 1.5 m away
    mixed = RgbdPyramid.build(gray, (1 / partly).astype(np.float32), CAMERA)
    assert 0.25 < share(mixed) < 0.5


def test_samples_lie_on_the_surfaces_and_face_as_they_do():
    exact, noisy = far_view(pose(yaw=0.3), 0, noise=0.0), far_view(pose(yaw=0.3), 0)
    every = np.arange(CAMERA.height), np.arange(CAMERA.width)
    wide, level, true = noisy.wide_surfaces, noisy.levels[0], exact.levels[0]
    assert wide is not None
    measured = level.normals_at(*every), level.inverse_depth
    normals, inverse_depth = wide.instead(*measured, pixels=every, camera=CAMERA, factor=FACTOR)
    taken = (inverse_depth != level.inverse_depth) & (true.normals[..., 2] != 0)
    assert taken.mean() > 0.5
    off, before = (a[taken] - true.inverse_depth[taken] for a in (inverse_depth, level.inverse_depth))
    assert rms(off) < 0.5 * rms(before)
    cosines = np.sum(normals[taken] * true.normals[taken], axis=-1)
    own = np.sum(measured[0][taken] * true.normals[taken], axis=-1)  # 0 where unknown
    assert np.median(np.arccos(cosines)) < 0.5 * np.median(np.arccos(own))


def test_exact_depth_and_that_of_a_near_room_keep_their_normals():
    assert far_view(pose(yaw=0.3), 0, noise=0.0).wide_surfaces is None
    gray, depth = render(pose(yaw=0.3), noise=np.random.default_rng(0))
    assert RgbdPyramid.build(gray, depth, CAMERA).wide_surfaces is None


def test_a_plane_ends_where_another_surface_begins():
    h, w, noise = 96, 128, 0.002
    near, far = 0.10, 0.05  # 1/m: 10 and 20 m
    rng = np.random.default_rng(0)
    finest = np.full((h, w), far, dtype=np.float32)
    finest[:, : w // 2 + 3] = near
    finest += (noise * FACTOR * rng.standard_normal((h, w))).astype(np.float32)
    coarsest = finest.reshape(h // FACTOR, FACTOR, w // FACTOR, FACTOR).mean(axis=(1, 3))
    wide = WideSurfaces.of(finest, coarsest, FACTOR, noise)
    assert wide is not None
    value = wide.planes[..., 0]
    edge = (w // 2 + 3) // FACTOR  # shows both
    left, right = value[2:-2, 2:edge], value[2:-2, edge + 1 : -2]
    assert (left > 0).mean() > 0.9 < (right > 0).mean()
    np.testing.assert_allclose(left[left > 0], near, atol=4 * noise)
    np.testing.assert_allclose(right[right > 0], far, atol=4 * noise)


def test_pixels_of_sizes_that_do_not_divide_have_planes_too():
    camera = PinholeCamera(101, 75, 80.0, 80.0, 50.0, 37.0)
    rng = np.random.default_rng(0)
    inverse = (0.08 + 0.004 * rng.standard_normal((75, 101))).astype(np.float32)
    pyramid = RgbdPyramid.build(np.full((75, 101), 0.5, np.float32), 1 / inverse, camera)
    assert pyramid.wide_surfaces is not None
    reference = Reference.from_pyramid(pyramid, STRIDES)
    assert all(np.isfinite(level.points).all() and len(level) for level in reference.levels)
    assert rms(1 / reference.levels[0].points[:, 2] - 0.08) < 0.003
