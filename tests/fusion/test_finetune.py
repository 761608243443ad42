"""Training of a fused map: better on the own images, elsewhere as it was, and the same each time."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.config.fusion import FinetuneConfig, FusionConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.evaluation.image_metrics import psnr
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.finetune import finetune_map, num_steps
from duagc.pipeline.fusion.peer_views import peer_views
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians
from duagc.pipeline.splat.information import INFORMATION_SIZE, MEAN_INFORMATION, pack_symmetric
from duagc.pipeline.splat.map_cells import MapCells
from tests.fixtures.speckled_wall import CAMERA, POSES, wall

ALL = np.ones(400, bool)


def context(
    config: FinetuneConfig, depth_kind: DepthKind = "blended", seed: int = 0, threads: int = 1
) -> MapContext:
    fusion = FusionConfig(finetune=config)
    return MapContext(CAMERA, fusion, MapMatching(), depth_kind, threads=threads, seed=seed)


ALIKE = {"zulu": ColorMap(np.ones(3), np.zeros(3), np.zeros(3), np.zeros(3), 0)}


@pytest.fixture(scope="module")
def spoiled() -> tuple[Gaussians, list[PosedRgbd]]:
    """A wall whose Gaussians were moved and dulled after its images were taken."""
    true = wall()
    views = []
    for T in POSES:
        render = Rasterizer().forward(true, CAMERA, se3.inverse(T))
        depth = np.where(render.alpha > 0.9, render.depth / np.maximum(render.alpha, 1e-6), 0)
        color = np.clip(np.rint(255 * render.color), 0, 255).astype(np.uint8)
        views.append(PosedRgbd(color, depth.astype(np.float32), T))
    rng = np.random.default_rng(1)
    moved = true.means + rng.normal(0, 0.01, true.means.shape).astype(np.float32)
    return true.replace(means=moved, colors=0.8 * true.colors), views


def score(gaussians: Gaussians, views: list[PosedRgbd]) -> float:
    drawn = [Rasterizer().forward(gaussians, CAMERA, se3.inverse(v.T_world_camera)) for v in views]
    return float(np.mean([psnr(r.color, v.color / 255) for r, v in zip(drawn, views, strict=True)]))


def test_it_draws_better_also_where_it_was_not_trained(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    train, held_out = views[::2], views[1::2]
    better = finetune_map(gaussians, train, context(FinetuneConfig(steps_per_view=30, rate=0.3)))
    assert score(better, train) > score(gaussians, train) + 5
    assert score(better, held_out) > score(gaussians, held_out) + 3
    assert np.array_equal(better.ids, gaussians.ids)


def test_what_no_view_sees_stays(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    better = finetune_map(gaussians, views, context(FinetuneConfig()))
    for name in ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits"):
        before, after = getattr(gaussians, name), getattr(better, name)
        assert np.array_equal(before[-10:], after[-10:])
        assert not np.array_equal(before[:-10], after[:-10])


def test_what_others_own_stays(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    own = np.arange(400) % 3 > 0
    better = finetune_map(gaussians, views, context(FinetuneConfig()), trained=own)
    for name in ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits"):
        before, after = getattr(gaussians, name), getattr(better, name)
        assert np.array_equal(before[~own], after[~own])
        assert not np.array_equal(before[own], after[own])
    assert score(better, views) > score(gaussians, views)


def test_masked_pixels_teach_nothing(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    nothing = [PosedRgbd(v.color, v.depth_m, v.T_world_camera, np.zeros((48, 64), bool)) for v in views]
    same = finetune_map(gaussians, nothing, context(FinetuneConfig()))
    assert np.array_equal(same.means, gaussians.means)
    assert np.array_equal(same.colors, gaussians.colors)


def test_the_same_bits_on_any_number_of_threads(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    one, three, other = (
        finetune_map(gaussians, views, context(FinetuneConfig(), "ray_plane", seed=seed, threads=threads))
        for seed, threads in ((0, 1), (0, 3), (1, 1))
    )
    assert np.array_equal(one.means, three.means)
    assert np.array_equal(one.colors, three.colors)
    assert not np.array_equal(one.means, other.means)


def test_a_long_log_takes_the_same_steps_of_what_views_see(
    spoiled: tuple[Gaussians, list[PosedRgbd]],
) -> None:
    gaussians, views = spoiled
    config, peers = context(FinetuneConfig()), views[1::2]
    seen = MapCells.of(gaussians).seen(views[0].depth_m, views[0].T_world_camera, CAMERA)
    assert 100 < len(seen) < 390  # not what is behind the camera, or far to its side
    own = np.arange(400) % 3 > 0
    for trained in (None, own):
        whole, parts = (
            finetune_map(gaussians, views[::2], config, trained=trained, peer_views=peers, keyframes=k)
            for k in (48, 49)
        )
        for name in ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits"):
            assert np.array_equal(getattr(whole, name), getattr(parts, name))
    assert not np.array_equal(parts.means, gaussians.means)
    assert np.array_equal(spoiled[0].means, gaussians.means)


def test_what_a_view_draws_is_in_the_cells_that_it_sees() -> None:
    """Two walls, of which the nearer one has a hole."""
    distance_m = 2.0
    rng = np.random.default_rng(3)
    n, scales = 3000, np.log([0.08, 0.08, 0.001])
    nearer = rng.uniform(-1.6, 1.6, (n, 3))
    nearer = nearer[np.hypot(nearer[:, 0], nearer[:, 1]) > 0.3]
    means = np.concatenate([nearer, rng.uniform(-3, 3, (n, 3))])
    means[:, 2] = np.where(np.arange(len(means)) < len(nearer), distance_m, distance_m + 2)
    walls = wall(len(means)).replace(
        means=means.astype(np.float32),
        log_scales=np.tile(np.float32(scales), (len(means), 1)),
        opacity_logits=np.full(len(means), 5, np.float32),
    )
    rasterizer, cells = Rasterizer(), MapCells.of(walls)
    for T in POSES[::3]:
        _, depth_m = rasterizer.forward_with_layer(walls, CAMERA, se3.inverse(T))
        weights = rasterizer.contributions()[0]
        assert weights[len(nearer) :].sum() > 10
        seen = cells.seen(depth_m, T, CAMERA)
        missing = np.setdiff1d(np.arange(len(walls)), seen)
        assert len(missing) > len(walls) / 4
        assert weights[missing].sum() < 1e-3 * weights.sum()


def test_no_steps_change_nothing(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    assert finetune_map(gaussians, views, context(FinetuneConfig(steps_per_view=0))) is gaussians
    assert finetune_map(gaussians, [], context(FinetuneConfig())) is gaussians


def seen_by_zulu(
    evidence: Evidence,
    T_world_keyframe: np.ndarray,
    most: int,
    depth_kind: DepthKind = "blended",
    threads: int = 1,
    pixels: str = "covered",
    camera: PinholeCamera = CAMERA,
) -> list[PosedRgbd]:
    return peer_views(
        {"zulu": evidence.in_world(T_world_keyframe)},
        {"zulu": T_world_keyframe},
        context(FinetuneConfig(peer_views=most, peer_pixels=pixels), threads=threads),
        depth_kinds={"zulu": depth_kind},
        cameras={"zulu": camera},
        colors=ALIKE,
    )


def test_a_neighbors_map_is_drawn_with_the_depth_that_it_was_made_with() -> None:
    true, poses = wall(), np.array(POSES[:1])
    tilted = true.replace(quats_wxyz=np.tile(np.float32([0.9689, 0.0, 0.2474, 0.0]), (400, 1)))
    evidence = Evidence.from_map("zulu", tilted.replace(anchors=np.zeros(400, np.int32)), None, poses)
    seen = {}
    for depth in DEPTH_KINDS:
        (view,) = seen_by_zulu(evidence, poses, 1, depth)
        render = Rasterizer().forward(tilted, CAMERA, se3.inverse(poses[0]), depth_kind=depth)
        sure = (render.alpha > 0.901) & (view.depth_m > 0)
        assert sure.any()
        np.testing.assert_allclose(view.depth_m[sure], (render.depth / render.alpha)[sure], atol=1e-3)
        seen[depth] = view.depth_m
    assert np.abs(seen["blended"] - seen["ray_plane"]).max() > 0.01


def test_a_neighbors_map_shows_what_it_would_from_where_the_neighbor_stood() -> None:
    true, T_world_map = wall(), se3.exp(np.array([0.3, -0.2, 0.1, 0.02, 0.1, 0.05]))
    poses, anchors = np.array(POSES[:3]), np.arange(400) % 3
    scattered = true.means + [0, 0, 0.02] * np.random.default_rng(2).normal(
        size=(400, 3)
    )  # no two at one depth
    true = true.replace(means=scattered.astype(np.float32))
    anchored = true.replace(anchors=anchors.astype(np.int32))
    evidence = Evidence.from_map("zulu", anchored, None, poses)
    there = T_world_map @ poses
    all_of_them = seen_by_zulu(evidence, there, 40)
    assert len(all_of_them) == 5  # three keyframes and the two places between them
    for k, view in enumerate(all_of_them[::2]):
        np.testing.assert_allclose(view.T_world_camera, there[k], atol=1e-12)
        render = Rasterizer().forward(true, CAMERA, se3.inverse(poses[k]))
        sure = render.alpha > 0.901  # turning the map moves alpha by rounding
        assert sure.any()
        assert view.mask is not None
        assert view.mask[sure].all()
        assert not view.mask[render.alpha < 0.899].any()
        assert not view.depth_m[~view.mask].any()
        share = render.alpha[sure]
        np.testing.assert_allclose(view.depth_m[sure], render.depth[sure] / share, atol=1e-3)
        np.testing.assert_allclose(view.color[sure], 255 * render.color[sure] / share[:, None], atol=1)
    some = seen_by_zulu(evidence, there, 2, threads=2)
    assert [v.T_world_camera.tolist() for v in some] == [
        all_of_them[k].T_world_camera.tolist() for k in (1, 3)
    ]
    assert np.array_equal(some[0].color, all_of_them[1].color)
    assert not peer_views({}, {}, context(FinetuneConfig()), depth_kinds={}, cameras={}, colors={})


def test_a_neighbors_map_is_drawn_as_its_camera_sees() -> None:
    true, poses = wall(), np.array(POSES[:1])
    evidence = Evidence.from_map("zulu", true.replace(anchors=np.zeros(400, np.int32)), None, poses)
    camera = PinholeCamera(96, 40, 80.0, 82.0, 47.0, 20.0)
    (view,) = seen_by_zulu(evidence, poses, 1, camera=camera)
    assert view.camera == camera
    render = Rasterizer().forward(true, camera, se3.inverse(poses[0]))
    assert view.mask is not None
    assert np.array_equal(view.mask, render.alpha >= 0.9)
    sure = view.mask
    np.testing.assert_allclose(
        view.color[sure], 255 * render.color[sure] / render.alpha[sure][:, None], atol=1
    )


def test_of_a_neighbors_views_the_half_of_which_its_information_is_better_can_be_taken() -> None:
    true, poses = wall(), np.array(POSES[:1])
    evidence = Evidence.from_map("zulu", true.replace(anchors=np.zeros(400, np.int32)), None, poses)
    right = se3.transform(se3.inverse(poses[0]), true.means.astype(float))[:, 0] > 0
    information = np.zeros((400, INFORMATION_SIZE))
    information[:, MEAN_INFORMATION] = pack_symmetric(np.eye(3)) * np.where(right, 1e6, 1e4)[:, None]
    evidence = replace(evidence, information=information)
    masks = {}
    for pixels in ("covered", "certain", "uncertain", "random"):
        (view,) = seen_by_zulu(evidence, poses, 1, pixels=pixels)
        masks[pixels] = view.mask
    covered = masks["covered"]
    assert np.array_equal(masks["certain"] | masks["uncertain"], covered)
    assert not (masks["certain"] & masks["uncertain"]).any()
    column = np.arange(CAMERA.width) > CAMERA.cx
    for pixels, side in (("certain", column), ("uncertain", ~column)):
        half = masks[pixels].sum() / covered.sum()
        assert 0.4 < half < 0.6
        assert masks[pixels][:, side].sum() > 0.8 * min(masks[pixels].sum(), covered[:, side].sum())
    assert not (masks["random"] & ~covered).any()
    assert 0.45 < masks["random"].sum() / covered.sum() < 0.55


def test_neighbors_views_teach_what_own_ones_do_not_see(spoiled: tuple[Gaussians, list[PosedRgbd]]) -> None:
    gaussians, views = spoiled
    half = np.zeros((48, 64), bool)
    half[:, :20] = True
    own = [PosedRgbd(v.color, v.depth_m, v.T_world_camera, half) for v in views[::2]]
    config = FinetuneConfig(steps_per_view=30, rate=0.3, peer_share=1.0)
    alone = finetune_map(gaussians, own, context(config))
    together = finetune_map(gaussians, own, context(config), peer_views=views[1::2])
    assert score(together, views) > score(alone, views) + 3
    same = finetune_map(gaussians, own, context(config, threads=2), peer_views=views[1::2])
    assert np.array_equal(together.means, same.means)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_views_of_another_camera_teach_as_well(
    spoiled: tuple[Gaussians, list[PosedRgbd]], scale: float
) -> None:
    gaussians, views = spoiled
    camera = CAMERA.scaled(round(64 * scale), round(48 * scale))
    theirs = []
    for view in views[1::2]:
        render = Rasterizer().forward(wall(), camera, se3.inverse(view.T_world_camera))
        depth_m = np.where(render.alpha > 0.9, render.depth / np.maximum(render.alpha, 1e-6), 0)
        color = np.clip(np.rint(255 * render.color), 0, 255).astype(np.uint8)
        theirs.append(PosedRgbd(color, depth_m.astype(np.float32), view.T_world_camera, camera=camera))
    nothing = [replace(v, mask=np.zeros((48, 64), bool)) for v in views[::2]]
    settings = context(FinetuneConfig(steps_per_view=30, rate=0.3, peer_share=1.0))
    taught = finetune_map(gaussians, nothing, settings, peer_views=theirs)
    assert score(taught, views) > score(gaussians, views) + 3


def test_steps_are_shared_out() -> None:
    config = FinetuneConfig(steps_per_view=5, steps_max=100, peer_share=0.25)
    assert num_steps(config, 4, 7, depth="blended") == (20, 5)
    assert num_steps(config, 40, 7, depth="blended") == (100, 25)
    assert num_steps(config, 40, 0, depth="blended") == (100, 0)
    assert num_steps(config, 40, 7, keyframes=48, depth="blended") == (100, 25)
    assert num_steps(config, 40, 7, keyframes=72, depth="blended") == (150, 38)  # a longer log has more
    assert num_steps(config, 40, 7, keyframes=400, depth="blended") == (200, 50)
    noisy, exact = (num_steps(FinetuneConfig(), 10, 0, depth=depth)[0] for depth in ("blended", "ray_plane"))
    assert noisy < exact  # where nothing is set


def test_made_up_colors_of_a_neighbor_do_little_to_own_views(
    spoiled: tuple[Gaussians, list[PosedRgbd]],
) -> None:
    """Robust loss, a fifth of the steps, and own images last."""
    gaussians, views = spoiled
    own, hostile = views[::2], [replace(v, color=255 - v.color) for v in views[1::2]]
    fooled = finetune_map(gaussians, own, context(FinetuneConfig()), peer_views=hostile)
    assert score(fooled, own) > score(gaussians, own) + 1
