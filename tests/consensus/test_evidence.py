"""Evidence: packing, turning with keyframes, zero where nothing was said."""

import numpy as np
import pytest

from duagc.pipeline.base import row_blocks
from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.consensus.evidence import SHAPE_FLOOR, Evidence
from duagc.pipeline.consensus.matching import gaussian_distance
from duagc.pipeline.geometry import se3, so3, spd
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import (
    COLOR,
    LOG_COVARIANCE,
    MEAN,
    OPACITY,
    pack_information,
    pack_symmetric,
    unpack_symmetric,
)
from tests.fixtures.gaussian_maps import Sums, random_map
from tests.fixtures.pose_worlds import random_poses


def test_packing_is_undone():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(5, 6, 6))
    A = A + A.swapaxes(-1, -2)
    np.testing.assert_array_equal(unpack_symmetric(pack_symmetric(A), 6), A)
    assert pack_symmetric(np.arange(9.0).reshape(3, 3)).tolist() == [0, 1, 2, 4, 5, 8]  # row by row


def test_anchored_and_back_in_the_map_is_what_the_map_said():
    gaussians, sums, T_map_keyframe = random_map(1)
    evidence = Evidence.from_map("alpha", gaussians, sums, T_map_keyframe)
    back = evidence.in_world(T_map_keyframe)
    # float64 of float32 inputs: a turn and its inverse
    np.testing.assert_allclose(back.theta[:, MEAN], gaussians.means, atol=1e-12)
    np.testing.assert_allclose(
        back.theta[:, LOG_COVARIANCE],
        spd.log_covariance(gaussians.quats_wxyz, gaussians.log_scales),
        atol=1e-12,
    )
    np.testing.assert_array_equal(back.theta[:, COLOR], gaussians.colors)
    np.testing.assert_array_equal(back.theta[:, OPACITY], gaussians.opacity_logits)
    geometry = unpack_symmetric(sums.geometry, 9)
    off = sums.deviation_m[:, None, None] ** 2 * np.eye(3)
    axes = so3.from_quat_wxyz(gaussians.quats_wxyz.astype(np.float64))
    normal = np.take_along_axis(axes, gaussians.log_scales.argmin(axis=1)[:, None, None], axis=2)
    measured = normal @ normal.swapaxes(1, 2) / sums.deviation_m[:, None, None] ** 2
    shared = np.linalg.inv(np.linalg.inv(geometry[:, :3, :3] + measured) + off)
    np.testing.assert_allclose(back.position_information(), shared, atol=1e-9)
    shared = np.linalg.inv(np.linalg.inv(geometry[:, 3:, 3:]) + SHAPE_FLOOR**2 * np.eye(6))
    np.testing.assert_allclose(back.shape_information(), shared, atol=1e-9)
    np.testing.assert_array_equal(back.color_information(), sums.color)
    np.testing.assert_array_equal(back.opacity_information(), sums.opacity)


def test_own_splats_are_as_stiff_as_all_that_share_a_pixel():
    gaussians, sums, T_map_keyframe = random_map(7)
    back = Evidence.from_rendering("alpha", gaussians, sums, T_map_keyframe).in_world(T_map_keyframe)
    geometry = unpack_symmetric(sums.geometry, 9)
    np.testing.assert_allclose(back.position_information(), 12 * geometry[:, :3, :3], atol=1e-10)
    np.testing.assert_allclose(back.opacity_information(), 12 * sums.opacity)


def test_what_is_told_is_never_surer_than_the_deviation_and_nothing_stays_nothing():
    gaussians, sums, T_map_keyframe = random_map(8)
    sums.geometry[::2] *= 1e12
    sums.geometry[1::4] = 0.0
    shared = Evidence.from_map("alpha", gaussians, sums, T_map_keyframe)
    sigma_m = 1 / np.sqrt(np.maximum(np.linalg.eigvalsh(shared.position_information())[:, -1], 1e-300))
    assert np.all(sigma_m >= sums.deviation_m * (1 - 1e-9))
    np.testing.assert_allclose(sigma_m[::2], sums.deviation_m[::2], rtol=1e-3)
    assert not shared.information[1::4, :27].any()


def test_depth_images_say_how_far_a_surface_is_where_the_sums_know_nothing_of_a_splat():
    gaussians, sums, _ = random_map(9)
    sums.geometry *= 1e-12
    position = Evidence.from_map(
        "alpha", gaussians, sums, np.tile(np.eye(4), (4, 1, 1))
    ).position_information()
    values = np.linalg.eigvalsh(position)
    np.testing.assert_allclose(values[:, 2], 0.5 / sums.deviation_m**2, rtol=1e-3)  # across the disc
    assert np.all(values[:, :2] < 1e-6)  # along it, nothing


def test_a_mean_on_the_measured_surface_is_known_to_a_tenth_of_a_millimeter():
    gaussians, sums, _ = random_map(9)
    sums.geometry *= 1e-12
    sums.deviation_m[:] = 0.0
    position = Evidence.from_map(
        "alpha", gaussians, sums, np.tile(np.eye(4), (4, 1, 1))
    ).position_information()
    np.testing.assert_allclose(np.linalg.eigvalsh(position)[:, 2], 1e8, rtol=1e-6)


def test_a_motion_of_the_world_leaves_every_mahalanobis_distance():
    """What the evidence says about any hypothesis does not depend on the frame."""
    gaussians, sums, T_map_keyframe = random_map(2)
    evidence = Evidence.from_map("alpha", gaussians, sums, T_map_keyframe)
    rng = np.random.default_rng(3)
    T = random_poses(rng, 1)[0]
    here, there = evidence.in_world(T_map_keyframe), evidence.in_world(T @ T_map_keyframe)
    offset_mean, offset_shape = rng.normal(size=(len(gaussians), 3)), rng.normal(size=(len(gaussians), 6))
    turned_mean, turned_shape = offset_mean @ T[:3, :3].T, offset_shape @ spd.sym_rotation(T[:3, :3]).T
    for name, offset, turned in (
        ("position_information", offset_mean, turned_mean),
        ("shape_information", offset_shape, turned_shape),
    ):
        np.testing.assert_allclose(
            np.einsum("ni,nij,nj->n", turned, getattr(there, name)(), turned),
            np.einsum("ni,nij,nj->n", offset, getattr(here, name)(), offset),
            rtol=1e-9,
        )
    np.testing.assert_allclose(there.theta[:, MEAN], se3.transform(T, here.theta[:, MEAN]), atol=1e-12)


def test_sums_are_found_by_id_and_absence_is_zero():
    gaussians, sums, T_map_keyframe = random_map(4)
    complete = Evidence.from_map("alpha", gaussians, sums, T_map_keyframe)
    order = np.random.default_rng(5).permutation(len(gaussians))[: len(gaussians) // 2]
    half = Sums(*(array[order] for array in list(vars(sums).values())[:5]))
    partial = Evidence.from_map("alpha", gaussians, half, T_map_keyframe)
    there = np.isin(gaussians.ids, half.ids)
    np.testing.assert_array_equal(partial.information[there], complete.information[there])
    np.testing.assert_array_equal(partial.information[~there], 0)
    np.testing.assert_array_equal(Evidence.from_map("alpha", gaussians, None, T_map_keyframe).information, 0)


def test_blocks_pack_as_documented():
    gaussians, sums, T_map_keyframe = random_map(6)
    e = Evidence.from_map("alpha", gaussians, sums, T_map_keyframe)
    packed = pack_information(
        e.position_information(), e.shape_information(), e.color_information(), e.opacity_information()
    )
    np.testing.assert_array_equal(packed, e.information)
    with pytest.raises(ValueError, match="information"):
        Evidence("alpha", e.ids, e.anchors, e.theta, e.information[:, :30])


def test_no_gaussians_no_evidence():
    evidence = Evidence.from_map("alpha", Gaussians.empty(), None, np.eye(4)[None])
    assert len(evidence.in_world(np.eye(4)[None])) == 0


def test_large_maps_go_in_blocks_to_the_same_bits(monkeypatch: pytest.MonkeyPatch):
    gaussians, sums, T_map_keyframe = random_map(1)

    def given() -> list[Evidence]:
        shared = Evidence.from_map("alpha", gaussians, sums, T_map_keyframe)
        rendered = Evidence.from_rendering("alpha", gaussians, sums, T_map_keyframe)
        return [shared, rendered, rendered.in_world(T_map_keyframe)]

    def apart(a: Evidence) -> np.ndarray:
        return gaussian_distance(a, np.arange(19), a, np.arange(1, 20), config=MapMatching())

    whole = given()
    distances = apart(whole[2])
    assert (distances > 0).all()
    monkeypatch.setattr(row_blocks, "ROWS", 7)
    for one, other in zip(whole, given(), strict=True):
        assert np.array_equal(one.theta, other.theta)
        assert np.array_equal(one.information, other.information)
    assert np.array_equal(apart(whole[2]), distances)
