"""Discs seeded from one image lie on what was measured and cover it once."""

from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M, SeedingConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer, Render
from duagc.pipeline.splat import seeding
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.seeding import seed_discs, unexplained

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
T_MAP_CAMERA = se3.exp(np.array([0.3, -0.2, 0.5, 0.2, -0.4, 0.1]))


def plane(normal: tuple[float, float, float], distance_m: float) -> np.ndarray:
    """Depth image of the plane normal . X = -distance in front of the camera."""
    n = np.array(normal) / np.linalg.norm(normal)
    return (-distance_m / (CAMERA.rays() @ n)).astype(np.float32)


def stripes() -> np.ndarray:
    """Left half flat gray, right half one-pixel stripes."""
    color = np.full((CAMERA.height, CAMERA.width, 3), 0.5, np.float32)
    color[:, 32::2] = 0.1
    return color


def seeded(depth: np.ndarray, color: np.ndarray, budget: int = 10_000, **config: Any) -> Gaussians:
    wanted = depth > 0
    return seed_discs(
        color,
        depth,
        wanted,
        CAMERA,
        T_map_camera=T_MAP_CAMERA,
        budget=budget,
        first_id=100,
        anchor=3,
        config=SeedingConfig(**config),
    )


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.6, 0.0, -1.0), (-0.3, 0.7, -1.0)])
def test_discs_lie_flat_on_a_plane(normal: tuple[float, float, float]) -> None:
    discs = seeded(plane(normal, 2.0), stripes())
    in_camera = discs.transformed(se3.inverse(T_MAP_CAMERA))
    n = np.array(normal) / np.linalg.norm(normal)
    # means of inverse depth are exact on a plane; float32 means at 3 m
    np.testing.assert_allclose(in_camera.means @ n, -2.0, atol=2e-6)
    axes = so3.from_quat_wxyz(in_camera.quats_wxyz)
    np.testing.assert_allclose(np.abs(axes[:, :, 2] @ n), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.exp(discs.log_scales[:, 2]), THICKNESS_FLOOR_M, rtol=1e-6)


def test_a_ball_is_as_wide_as_the_disc_in_its_place_and_round() -> None:
    depth = plane((0.6, 0.0, -1.0), 2.0)
    discs, balls = seeded(depth, stripes()), seeded(depth, stripes(), shape="ball")
    np.testing.assert_array_equal(balls.means, discs.means)
    np.testing.assert_array_equal(balls.log_scales, np.repeat(discs.log_scales[:, :1], 3, axis=1))


def test_detail_is_sampled_finely_and_plain_surfaces_coarsely() -> None:
    discs = seeded(plane((0, 0, -1), 2.0), stripes()).transformed(se3.inverse(T_MAP_CAMERA))
    u = CAMERA.project(discs.means)[:, 0]
    assert np.count_nonzero(u < 31) == 4 * 6  # cells of 8 pixels
    assert np.count_nonzero(u > 31) == 16 * 24  # cells of 2 pixels
    sizes = np.exp(discs.log_scales[:, 0])
    np.testing.assert_allclose(sizes[u < 31], SeedingConfig().spread * 8 * 2.0 / 50, rtol=1e-5)
    np.testing.assert_allclose(sizes[u > 31], SeedingConfig().spread * 2 * 2.0 / 50, rtol=1e-5)


@pytest.mark.parametrize("budget", [0, 1, 10, 50, 200, 10_000])
def test_the_budget_holds_and_ids_count_up(budget: int) -> None:
    discs = seeded(plane((0.1, 0, -1), 2.0), stripes(), budget)
    assert len(discs) <= budget
    assert len(discs) >= 0.2 * min(budget, 400)
    np.testing.assert_array_equal(discs.ids, np.arange(100, 100 + len(discs)))
    assert (discs.anchors == 3).all()


def test_a_disc_belongs_to_one_surface() -> None:
    depth = plane((0, 0, -1), 3.0)
    depth[:, 21:] = 1.0
    depth[10:20, 5:9] = 0
    discs = seeded(depth, stripes()).transformed(se3.inverse(T_MAP_CAMERA))
    z = discs.means[:, 2]
    assert ((np.abs(z - 3.0) < 1e-5) | (np.abs(z - 1.0) < 1e-5)).all()
    assert (z > 2).any()
    assert (z < 2).any()


def test_missing_depth_gives_no_disc() -> None:
    assert len(seeded(np.zeros((CAMERA.height, CAMERA.width), np.float32), stripes())) == 0
    assert len(seeded(plane((0, 0, -1), 150.0), stripes())) == 0  # beyond the sensor's range


def test_a_seeded_view_is_explained_and_a_changed_one_is_not() -> None:
    color = np.broadcast_to(np.array([0.2, 0.5, 0.7], np.float32), (CAMERA.height, CAMERA.width, 3)).copy()
    depth = plane((0.2, 0.1, -1), 2.0)
    discs = seeded(depth, color, opacity=0.95, spread=0.7)
    render = Rasterizer().forward(discs, CAMERA, se3.inverse(T_MAP_CAMERA))
    inner = (slice(4, -4), slice(4, -4))
    assert not unexplained(render, color, depth, SeedingConfig())[inner].any()
    nearer = depth.copy()
    nearer[20:30, 20:30] -= 0.3
    assert unexplained(render, color, nearer, SeedingConfig())[20:30, 20:30].all()
    painted = color.copy()
    painted[20:30, 20:30] = 0.9
    assert unexplained(render, painted, depth, SeedingConfig())[21:29, 21:29].all()
    empty = Render(np.zeros_like(color), np.zeros_like(depth), np.zeros_like(depth))
    assert unexplained(empty, color, depth, SeedingConfig()).all()


@pytest.mark.parametrize("side", [8, 2])
@pytest.mark.parametrize("shape", [(24, 40), (13, 21, 3), (5, 3)])
def test_pixels_of_some_cells_are_those_of_all(shape, side):
    """In the same order in memory too, by which sums over a cell round."""
    rng = np.random.default_rng(0)
    image = rng.random(shape).astype(np.float32)
    every = seeding._cells(image, side)
    cells = np.flatnonzero(rng.random(every.shape[1]) < 0.5)
    found, wanted = seeding._pixels_of(cells, image, side), every[:, cells]
    np.testing.assert_array_equal(found, wanted)
    assert found.strides == wanted.strides


@pytest.mark.parametrize("distance_m", [0.15, 2.0, 40.0])
def test_near_and_far_surfaces_get_discs(distance_m: float) -> None:
    discs = seeded(plane((0.0, 0.0, -1.0), distance_m), stripes())
    in_camera = se3.transform(se3.inverse(T_MAP_CAMERA), discs.means.astype(np.float64))
    assert len(discs) > 40
    np.testing.assert_allclose(in_camera[:, 2], distance_m, rtol=1e-3)


def test_cells_that_do_not_nest_and_no_detail_at_all_are_refused() -> None:
    for sides in [(8, 2), (2, 4), (8, 4, 3), ()]:
        with pytest.raises(ValueError, match="each half of the one before"):
            SeedingConfig(cell_sizes_px=sides)
    with pytest.raises(ValueError, match="greater than 0"):
        SeedingConfig(detail=0.0)
