"""Sums of information: over which views, in which units, and what brings none."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.geometry import so3, spd
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.information.noise import ImageNoise, estimate_noise
from duagc.pipeline.information.sums import sum_information, without_thickness
from duagc.pipeline.information.views import MapViews, free_space, without_moving
from duagc.pipeline.kernels import FisherSums
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import pack_geometry, unpack_geometry
from tests.fixtures.noisy_wall import CAMERA, NOISE, POSES, SENSOR, views_of, wall


def test_windows() -> None:
    gaussians = wall()
    views = views_of(gaussians)

    def total(window: str, length: int) -> FisherSums:
        config = InformationConfig.model_validate({"window": window, "window_length": length})
        return sum_information(MapViews(gaussians, CAMERA, views), NOISE, config)

    everything, rolling, latest = total("all", 2), total("rolling", 2), total("per_gaussian", 2)
    assert everything.observations.max() == 4
    assert rolling.observations.max() == 2
    np.testing.assert_array_equal(latest.observations, np.minimum(everything.observations, 2))
    seen_by_both = rolling.observations == 2
    for name, array in latest.arrays().items():
        wanted = rolling.arrays()[name][seen_by_both]
        np.testing.assert_allclose(array[seen_by_both], wanted, rtol=1e-12, err_msg=name)
    assert latest.weight[seen_by_both].any()
    assert (everything.opacity >= latest.opacity).all()
    early = (rolling.observations == 0) & (everything.observations > 0)
    assert early.any()  # seen at the beginning only: forgotten by `rolling`, kept by `per_gaussian`
    assert not rolling.geometry[early].any()
    assert (latest.observations[early] > 0).all()


def test_never_seen_is_zero_and_noise_scales() -> None:
    gaussians = wall()
    views = views_of(gaussians)
    once = sum_information(MapViews(gaussians, CAMERA, views), NOISE, InformationConfig())
    assert once.observations[-1] == 0
    assert not once.geometry[-1].any()
    assert not once.color[-1].any()
    assert once.opacity[-1] == 0
    twice = sum_information(
        MapViews(gaussians, CAMERA, views), ImageNoise(0.04, replace(SENSOR, factor=2.0)), InformationConfig()
    )
    np.testing.assert_allclose(twice.geometry, once.geometry / 4, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(twice.color, once.color / 4, rtol=1e-5)


def test_holes_in_the_depth_bring_no_depth_information() -> None:
    gaussians = wall()
    views = views_of(gaussians)
    blind = [PosedRgbd(v.color, np.zeros_like(v.depth_m), v.T_world_camera) for v in views]
    with_depth = sum_information(MapViews(gaussians, CAMERA, views), NOISE, InformationConfig())
    without = sum_information(MapViews(gaussians, CAMERA, blind), NOISE, InformationConfig())
    np.testing.assert_array_equal(with_depth.color, without.color)
    along_z = np.zeros(len(gaussians))
    for sums, sign in ((with_depth, 1.0), (without, -1.0)):
        along_z += sign * unpack_geometry(sums.geometry)[:, 2, 2]
    assert (along_z >= 0).all()
    assert np.median(along_z[with_depth.observations > 0]) > 100.0


def test_masked_pixels_bring_nothing() -> None:
    """What they show does not matter, neither for the noise nor for the sums, and they only ever take away."""
    gaussians, whole = wall(), views_of(wall(), 0.05, 2.0)
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    mask[:, 10:30] = False
    masked, spoiled = [], []
    for view in whole:
        color, depth = view.color.copy(), view.depth_m.copy()
        color[~mask], depth[~mask] = 255, 9.0
        masked.append(PosedRgbd(view.color, view.depth_m, view.T_world_camera, mask))
        spoiled.append(PosedRgbd(color, depth, view.T_world_camera, mask))
    config = InformationConfig()
    noise = estimate_noise(MapViews(gaussians, CAMERA, masked), config)
    assert noise == estimate_noise(MapViews(gaussians, CAMERA, spoiled), config)
    sums = [
        sum_information(MapViews(gaussians, CAMERA, views), noise, config)
        for views in (masked, spoiled, whole)
    ]
    for name, array in sums[0].arrays().items():
        np.testing.assert_array_equal(array, sums[1].arrays()[name])
    assert np.all(sums[0].color <= sums[2].color * (1 + 1e-6))
    assert sums[0].color.sum() < 0.9 * sums[2].color.sum()


def test_thickness_at_the_floor_has_no_information_and_the_rest_is_untouched() -> None:
    r = np.random.default_rng(0)
    n = 50
    quats = r.normal(size=(n, 4))
    scales = r.uniform(0.01, 0.1, (n, 3))
    thin = r.integers(0, 3, n)
    floored = np.arange(n) % 2 == 0
    scales[floored, thin[floored]] = THICKNESS_FLOOR_M
    zero = np.zeros((n, 3))
    gaussians = Gaussians(np.arange(n), np.zeros(n), zero, quats, np.log(scales), zero, np.zeros(n))
    root = r.normal(size=(n, 9, 9))
    full = root @ root.swapaxes(1, 2)
    after = unpack_geometry(without_thickness(pack_geometry(full), gaussians, THICKNESS_FLOOR_M))
    np.testing.assert_array_equal(after[~floored], full[~floored])
    axes = so3.from_quat_wxyz(gaussians.quats_wxyz)
    for k in np.flatnonzero(floored):
        basis = []
        for i in range(3):
            for j in range(i, 3):
                S = np.outer(axes[k][:, i], axes[k][:, j])
                v = np.concatenate([np.zeros(3), spd.sym_to_vec(S + S.T)])
                basis.append((i == j == thin[k], v / np.linalg.norm(v)))
        basis += [(False, e) for e in np.eye(9)[:3]]
        for is_thickness, v in basis:
            if is_thickness:
                np.testing.assert_allclose(after[k] @ v, 0, atol=1e-12)
            else:
                assert v @ after[k] @ v == pytest.approx(v @ full[k] @ v, rel=1e-9)
        assert np.linalg.eigvalsh(after[k])[0] > -1e-9
        assert np.linalg.eigvalsh(after[k])[1] > 1e-6  # nothing else was lost


def test_what_moved_is_in_no_sum() -> None:
    """A card at half the distance, elsewhere in every view: the wall behind it is not informed through it."""
    gaussians = wall()
    plain, crossed = [], []
    for k, T in enumerate(POSES):
        # all views of the wall at z = 2, from poses that turn little: its depth is that of a plane
        normal, offset = T[:3, :3].T @ np.array([0.0, 0.0, 1.0]), 2.0 - T[2, 3]
        depth = (offset / (CAMERA.rays() @ normal)).astype(np.float32)
        color = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
        plain.append(PosedRgbd(color, depth, T))
        card = depth.copy()
        card[8:24, 2 + 11 * k : 12 + 11 * k] = 1.0
        crossed.append(PosedRgbd(color, card, T))
    config = MovingConfig(halvings=1, grow_px=4)
    assert all(view.mask is None for view in without_moving(plain, free_space(plain, CAMERA, config)))
    masked = without_moving(crossed, free_space(crossed, CAMERA, config))
    for view in masked:
        assert view.mask is not None
        assert view.mask[view.depth_m < 1.5].mean() < 0.05
        assert view.mask.mean() > 0.7
    unchanged = without_moving(crossed, free_space(crossed, CAMERA, MovingConfig(enabled=False)))
    for view, given in zip(unchanged, crossed, strict=True):
        assert all(value is vars(given)[name] for name, value in vars(view).items())
    less = sum_information(MapViews(gaussians, CAMERA, masked), NOISE, InformationConfig())
    more = sum_information(MapViews(gaussians, CAMERA, crossed), NOISE, InformationConfig())
    assert less.weight.sum() < 0.95 * more.weight.sum()
