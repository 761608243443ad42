"""The information stage: what is summed, in which units, and what never enters."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.pipeline import messages
from duagc.pipeline.base import row_blocks
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.geometry import se3, so3, spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.information.deviation import surface_deviation
from duagc.pipeline.information.noise import ImageNoise, estimate_noise, with_correlation
from duagc.pipeline.information.stage import run_information
from duagc.pipeline.information.sums import sum_information, without_thickness
from duagc.pipeline.information.views import MapViews, without_moving
from duagc.pipeline.kernels import FisherSums, Rasterizer
from duagc.pipeline.recording import LogWriter, read_log
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import pack_geometry, unpack_geometry
from duagc.schemas import topics

CAMERA = PinholeCamera(48, 36, 40.0, 40.0, 23.5, 17.5)
SENSOR = DepthNoise(0.0012, 0.0019)
NOISE = ImageNoise(0.02, SENSOR)
FRAME_NS = 33_333_333
POSES = [se3.exp(np.array([0.05 * k, 0.0, 0.02 * k, 0.0, 0.02 * k, 0.0])) for k in range(4)]


def wall(n: int = 600, seed: int = 0) -> Gaussians:
    """Discs on the plane z = 2 that fill the view, thin at the floor, and one far behind the camera (the last)."""
    r = np.random.default_rng(seed)
    means = np.column_stack([r.uniform(-1.6, 1.6, n), r.uniform(-1.2, 1.2, n), np.full(n, 2.0)])
    means[-1] = (0, 0, -3)
    scales = np.column_stack([r.uniform(0.06, 0.1, (n, 2)), np.full(n, THICKNESS_FLOOR_M)])
    half = 0.5 * r.uniform(0, np.pi, n)
    return Gaussians(
        ids=10 * np.arange(n),
        anchors=np.zeros(n),
        means=means,
        quats_wxyz=np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)]),
        log_scales=np.log(scales),
        colors=r.uniform(0.2, 0.8, (n, 3)),
        opacity_logits=np.full(n, 2.0),
    )


def views_of(gaussians: Gaussians, color_noise: float = 0.0, depth_factor: float = 0.0) -> list[PosedRgbd]:
    """Renders of the Gaussians with noise added: what a perfect map's images would be."""
    r = np.random.default_rng(1)
    out = []
    for T in POSES:
        render = Rasterizer().forward(gaussians, CAMERA, se3.inverse(T))
        color = np.clip(render.color + r.normal(0, 1, render.color.shape) * color_noise, 0, 1)
        z = render.depth / np.maximum(render.alpha, 1e-3)
        z = z + depth_factor * NOISE.depth_sigma_m(z) * r.normal(0, 1, z.shape)
        z = np.where(render.alpha > 0.9, z, 0)
        out.append(PosedRgbd(np.rint(color * 255).astype(np.uint8), z.astype(np.float32), T))
    return out


def test_noise_of_the_log_replaces_the_model() -> None:
    """Twice the sigma, a quarter of the information of depth; times the factor of the residuals; color as before."""
    gaussians, config = wall(), InformationConfig()
    plain = views_of(gaussians)
    tight, loose = (
        [replace(v, depth_sigma_m=np.full(v.depth_m.shape, sigma, np.float32)) for v in plain]
        for sigma in (0.01, 0.02)
    )
    logged = ImageNoise(1e6, SENSOR, from_log=True)  # no information in the color
    sums = [sum_information(MapViews(gaussians, CAMERA, views), logged, config) for views in (tight, loose)]
    assert sums[0].geometry.any()
    np.testing.assert_allclose(sums[0].geometry, 4 * sums[1].geometry, rtol=1e-4, atol=1e-3)
    r = np.random.default_rng(2)
    noisy = [
        replace(
            v, depth_m=np.where(v.depth_m > 0, v.depth_m + r.normal(0, 0.03, v.depth_m.shape), 0).astype("f4")
        )
        for v in tight
    ]
    found = estimate_noise(MapViews(gaussians, CAMERA, noisy), config, every=1)
    assert found.depth.factor == pytest.approx(3.0, rel=0.05)
    assert found.depth_formula() == f"{found.depth.factor:.6g} * sigma of the log"


def test_noise_is_found_in_the_residuals() -> None:
    gaussians = wall()
    views = views_of(gaussians, 0.05, 2.0)
    noisy = estimate_noise(MapViews(gaussians, CAMERA, views), InformationConfig(), every=1)
    assert noisy.color_sigma == pytest.approx(0.05, rel=0.05)
    assert noisy.depth.factor == pytest.approx(2.0, rel=0.05)
    assert noisy.depth_formula() == f"{noisy.depth.factor:.6g} * (0.0012 + 0.0019 * (z - 0.4)^2)"
    sampled = estimate_noise(MapViews(gaussians, CAMERA, views), InformationConfig())
    assert sampled.color_sigma == pytest.approx(noisy.color_sigma, rel=0.15)  # 384 pixels
    assert sampled.depth.factor == pytest.approx(noisy.depth.factor, rel=0.15)
    clean = estimate_noise(MapViews(gaussians, CAMERA, views_of(gaussians)), InformationConfig())
    assert clean.color_sigma == InformationConfig().color_sigma_floor
    assert clean.depth.factor == InformationConfig().depth_factor_min
    fixed = InformationConfig(depth_factor_from_residuals=False)
    assert estimate_noise(MapViews(gaussians, CAMERA, views_of(gaussians, 0, 2.0)), fixed).depth.factor == 1.0


def test_a_few_wrong_pixels_do_not_change_the_noise() -> None:
    gaussians = wall()
    views = views_of(gaussians, 0.05, 1.0)
    spoiled = [PosedRgbd(v.color.copy(), v.depth_m.copy(), v.T_world_camera) for v in views]
    for view in spoiled:
        view.color[:6] = 255
        view.depth_m[:6] = 9.0
    config = InformationConfig()
    a, b = (estimate_noise(MapViews(gaussians, CAMERA, v), config, every=1) for v in (views, spoiled))
    assert b.color_sigma == pytest.approx(a.color_sigma, rel=0.35)
    assert b.depth.factor == pytest.approx(a.depth.factor, rel=0.35)


@pytest.mark.parametrize(("width", "pixels"), [(1, 1.0), (3, 9.0), (5, 25.0)])
def test_residuals_that_are_alike_count_once(width: int, pixels: float) -> None:
    """White noise averaged over width x width pixels: the sum of its autocorrelation is width^2."""
    gaussians = wall()
    r = np.random.default_rng(3)
    views = []
    for view in views_of(gaussians):
        noise = cv2.blur(
            r.normal(size=(*view.depth_m.shape, 2)), (width, width), borderType=cv2.BORDER_REFLECT
        )
        color = np.rint(255 * np.clip(view.color / 255.0 + 0.03 * noise[..., :1] * width, 0, 1)).astype(
            np.uint8
        )
        depth = np.where(view.depth_m > 0, view.depth_m + 0.01 * noise[..., 1], 0).astype(np.float32)
        views.append(PosedRgbd(color, depth, view.T_world_camera))
    noise, overlap = with_correlation(NOISE, MapViews(gaussians, CAMERA, views), InformationConfig())
    assert noise.color_pixels == pytest.approx(pixels, rel=0.35, abs=0.5)  # 4 images of 48 x 36 px
    assert noise.depth_pixels == pytest.approx(pixels, rel=0.35, abs=0.5)
    assert 2 < overlap < 100
    once, shared = (
        sum_information(MapViews(gaussians, CAMERA, views), n, InformationConfig())
        for n in (NOISE, replace(NOISE, color_pixels=pixels, depth_pixels=pixels))
    )
    np.testing.assert_allclose(pixels * shared.geometry, once.geometry, rtol=1e-4, atol=1e-3)
    independent = InformationConfig(correlation_px=0)
    assert with_correlation(NOISE, MapViews(gaussians, CAMERA, views), independent)[0].depth_pixels == 1.0


def test_the_deviation_is_the_distance_from_the_measured_surface() -> None:
    """Gaussians before and behind a wall that is seen at a slant; one far behind it, one that no camera sees."""
    tilt = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.6, 0.0]))
    normal, at = tilt[:3, 2], np.array([0.0, 0.0, 2.0])
    rays = CAMERA.rays()
    depth = (normal @ at / (rays @ normal)).astype(np.float32)  # the plane through `at`
    along = np.array([[0.1, 0.2, 0.0], [-0.2, 0.1, 0.0], [0.3, -0.2, 0.0], [0.0, 0.0, 0.0]]) @ tilt[:3, :3].T
    off_m = np.array([0.0, 0.02, -0.05, 0.5])
    means = np.concatenate([at + along + off_m[:, None] * normal, [[0.0, 0.0, -3.0]]])
    n = len(means)
    gaussians = Gaussians(
        np.arange(n), np.zeros(n), means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -4.0), np.zeros((n, 3)),
        np.zeros(n),
    )  # fmt: skip
    view = PosedRgbd(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), depth, np.eye(4))
    found = surface_deviation(MapViews(gaussians, CAMERA, [view] * 1000), 0.1)
    np.testing.assert_allclose(found[:3], np.abs(off_m[:3]), atol=1e-3)
    np.testing.assert_array_equal(found[3:], 0.1)  # not measured within the gate
    half = surface_deviation(MapViews(gaussians, CAMERA, [view]), 0.1)  # and it counts as half a view
    np.testing.assert_allclose(half[1:3] ** 2, (off_m[1:3] ** 2 + 0.5 * 0.02**2) / 1.5, rtol=0.05)
    other = PosedRgbd(view.color, (depth + 0.04).astype(np.float32), np.eye(4))  # two of five look past it
    past = surface_deviation(MapViews(gaussians, CAMERA, [*[view] * 300, *[other] * 200]), 0.1)
    np.testing.assert_allclose(past[:3], np.abs(off_m[:3]), atol=1e-3)
    blind = PosedRgbd(view.color, view.depth_m, view.T_world_camera, np.zeros(depth.shape, bool))
    np.testing.assert_array_equal(surface_deviation(MapViews(gaussians, CAMERA, [blind]), 0.1), 0.1)


def test_the_deviation_is_found_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians = wall()
    views = MapViews(gaussians, CAMERA, views_of(gaussians, depth_factor=1.0))
    whole = surface_deviation(views, 0.1)
    assert len(np.unique(whole)) > 200
    monkeypatch.setattr(row_blocks, "ROWS", 100)
    assert np.array_equal(surface_deviation(views, 0.1), whole)


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


# --- the stage on logs ---------------------------------------------------------------------------------------------


def write_logs(
    folder: Path, held_out: tuple[int, ...] = (2,), keyframes: tuple[int, ...] = (0, 1, 3)
) -> Gaussians:
    """A sensor log of four frames and the front end's log of it."""
    gaussians = wall()
    with LogWriter(folder / "alpha.mcap", "alpha") as log:
        log.channel(topics.DEPTH.of("alpha"), topics.DEPTH.schema, {"depth_scale": "0.0001"})
        log.write(topics.CALIBRATION.of("alpha"), messages.pack_calibration(0, "alpha", CAMERA), 0)
        for index, view in enumerate(views_of(gaussians, 0.05)):
            # a held-out frame is black and far away: were it used, it would show
            color = view.color * (index not in held_out)
            depth = np.rint(view.depth_m * 1e4).astype(np.uint16)
            stamp = index * FRAME_NS
            png = cv2.imencode(".png", color[:, :, ::-1])[1].tobytes()
            log.write(topics.COLOR.of("alpha"), messages.pack_color(stamp, "alpha", png, "png"), stamp)
            log.write(topics.DEPTH.of("alpha"), messages.pack_depth(stamp, "alpha", depth), stamp)
    with LogWriter(folder / "frontend.mcap", "alpha") as log:
        for index, T in enumerate(POSES):
            stamp = index * FRAME_NS
            odometry = messages.Odometry(
                stamp, "alpha", index, index in held_out, 0, T, T, np.eye(6), "ok", 1.0, 0.0, 0.0
            )
            log.write(topics.ODOMETRY.of("alpha"), odometry, stamp)
            if index in keyframes:
                number = keyframes.index(index)
                keyframe = messages.Keyframe(
                    stamp, "alpha", number, index, T, number - 1, np.eye(4), np.zeros((6, 6)), (0.0, 0.0)
                )
                log.write(topics.KEYFRAME.of("alpha"), keyframe, stamp)
        stamp = 3 * FRAME_NS
        empty = messages.GaussianMap(stamp, "alpha", "alpha/map", Gaussians.empty())
        log.write(topics.MAP.of("alpha"), empty, stamp)
        log.write(topics.MAP.of("alpha"), messages.GaussianMap(stamp, "alpha", "alpha/map", gaussians), stamp)
    return gaussians


def test_the_stage_writes_what_it_returns_and_the_threads_do_not_show(tmp_path: Path) -> None:
    gaussians = write_logs(tmp_path)
    paths = [tmp_path / name for name in ("alpha.mcap", "frontend.mcap", "information.mcap")]
    result = run_information(
        *paths, config=InformationConfig(), moving=MovingConfig(), thickness_floor_m=THICKNESS_FLOOR_M
    )
    (record,) = read_log(paths[2])
    assert record.topic == "/alpha/information"
    back = record.message()
    np.testing.assert_array_equal(back.ids, gaussians.ids)
    np.testing.assert_array_equal(back.geometry, result.geometry)
    assert back.kind == "gauss_newton"
    assert back.window == "all"
    assert back.observations.max() == 3
    assert back.color_sigma == pytest.approx(0.05, rel=0.15)
    settings = {"config": InformationConfig(), "moving": MovingConfig()}
    settings["thickness_floor_m"] = THICKNESS_FLOOR_M
    run_information(*paths[:2], tmp_path / "again.mcap", **settings, threads=3)
    (again,) = read_log(tmp_path / "again.mcap")
    assert again.data == record.data


def test_held_out_frames_never_enter(tmp_path: Path) -> None:
    write_logs(tmp_path, held_out=(1,))
    with pytest.raises(DuagError, match=r"has frame 1, expected no frame that is held out"):
        run_information(
            tmp_path / "alpha.mcap",
            tmp_path / "frontend.mcap",
            tmp_path / "out.mcap",
            config=InformationConfig(),
            moving=MovingConfig(),
            thickness_floor_m=THICKNESS_FLOOR_M,
        )
    assert not (tmp_path / "out.mcap").exists()


def test_a_front_end_without_a_map_is_one_line(tmp_path: Path) -> None:
    write_logs(tmp_path)
    with LogWriter(tmp_path / "unfinished.mcap", "alpha"):
        pass
    with pytest.raises(DuagError, match="has no message, expected the map"):
        run_information(
            tmp_path / "alpha.mcap",
            tmp_path / "unfinished.mcap",
            tmp_path / "out.mcap",
            config=InformationConfig(),
            moving=MovingConfig(),
            thickness_floor_m=THICKNESS_FLOOR_M,
        )


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
    assert all(view.mask is None for view in without_moving(plain, CAMERA, config))
    masked = without_moving(crossed, CAMERA, config)
    for view in masked:
        assert view.mask is not None
        assert view.mask[view.depth_m < 1.5].mean() < 0.05
        assert view.mask.mean() > 0.7
    assert list(without_moving(crossed, CAMERA, MovingConfig(enabled=False))) == crossed
    less = sum_information(MapViews(gaussians, CAMERA, masked), NOISE, InformationConfig())
    more = sum_information(MapViews(gaussians, CAMERA, crossed), NOISE, InformationConfig())
    assert less.weight.sum() < 0.95 * more.weight.sum()
