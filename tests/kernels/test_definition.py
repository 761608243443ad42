"""What the outputs mean, without the code that computes them: closed forms, differences, sums over pixels."""

import numpy as np
import pytest

from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians
from tests.kernels.agreement import PARAMETERS, Float64Gaussians
from tests.kernels.drawing import assert_same_gradients, checkerboard, draw, flat, tiny
from tests.kernels.scenes import BACKGROUND, random_gaussians

# ---------------------------------------------------------------- what a pixel sees


@pytest.mark.parametrize("offset_px", [(0.5, 0.0), (0.25, 0.5)])
def test_a_point_is_seen_through_the_variance_of_a_square_pixel(rasterizer, offset_px):
    camera = PinholeCamera(5, 5, 100.0, 100.0, 2.0, 2.0)
    mean = np.array([*np.divide(offset_px, 100.0), 1.0])
    point = Gaussians(
        ids=[0],
        anchors=[0],
        means=[mean],
        quats_wxyz=[[1.0, 0.0, 0.0, 0.0]],
        log_scales=[[-15.0] * 3],
        colors=[[1.0] * 3],
        opacity_logits=[2.0],
    )
    alpha = rasterizer.forward(point, camera, np.eye(4)).alpha[2:4, 2:4]
    rows, columns = np.indices((2, 2))
    squared = (columns - offset_px[0]) ** 2 + (rows - offset_px[1]) ** 2
    exact = np.exp(-squared / 2 / (1 / 12)) / (1 + np.exp(-2.0))
    np.testing.assert_allclose(alpha, np.where(exact < 1 / 255, 0.0, exact), rtol=1e-4)


# ---------------------------------------------------------------- depth along the ray


def slanted_disc(normal_camera, center_camera=(0.3, -0.2, 2.0), scale_m=0.4):
    """One opaque disc at a slant to a camera at the origin of the map."""
    normal = np.asarray(normal_camera) / np.linalg.norm(normal_camera)
    tangent = np.cross(normal, [0.0, 1.0, 0.0])
    tangent /= np.linalg.norm(tangent)
    axes = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
    gaussians = random_gaussians(1, 0).replace(
        means=[center_camera],
        quats_wxyz=so3.to_quat_wxyz(axes)[None],
        log_scales=[[np.log(scale_m), np.log(0.7 * scale_m), -9.0]],
        opacity_logits=[2.0],
    )
    return gaussians, normal, np.array(center_camera)


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0.2, -1), (-0.8, 0.6, -1)])
def test_ray_plane_depth_of_a_disc_is_where_the_ray_meets_its_plane(rasterizer, normal):
    """n.(z ray) = n.p: depth and slope at the center; beyond, affine, so the error grows with the square."""
    gaussians, normal, center = slanted_disc(normal)
    camera = PinholeCamera(121, 101, 200.0, 210.0, 30.0, 71.0)
    render = rasterizer.forward(gaussians, camera, np.eye(4), depth_kind="ray_plane")
    depth = render.depth / render.alpha
    plane = (normal @ center) / (camera.rays() @ normal)
    u, v = camera.project(center)  # both whole: a pixel lies on the center
    i, j = round(float(v)), round(float(u))
    assert depth[i, j] == pytest.approx(2.0, rel=1e-6)
    by_u, by_v = (depth[i, j + 1] - depth[i, j - 1]) / 2, (depth[i + 1, j] - depth[i - 1, j]) / 2
    exact_u, exact_v = (plane[i, j + 1] - plane[i, j - 1]) / 2, (plane[i + 1, j] - plane[i - 1, j]) / 2
    # the blur turns the plane by its share of the covariance, 1/12 of about 800 px^2
    np.testing.assert_allclose([by_u, by_v], [exact_u, exact_v], rtol=2e-3, atol=1e-5)
    distance = np.hypot(*(np.indices(plane.shape) - np.array([i, j])[:, None, None]))
    near = (distance > 0) & (distance < 20)
    slope = np.hypot(exact_u, exact_v)
    curvature = 2 * slope**2 / 2.0  # of 1/z affine: z'' = 2 z'^2 / z
    error = np.abs(depth - plane)[near]
    assert (error <= curvature * distance[near] ** 2 + 3e-3 * slope * distance[near] + 2e-6).all()


def test_ray_plane_depth_of_a_ball_is_that_of_its_center_on_the_axis(rasterizer):
    """A ball on the optical axis has no covariance of position and depth."""
    gaussians = random_gaussians(1, 0).replace(means=[[0, 0, 2.0]], log_scales=[[-2.0] * 3])
    camera = PinholeCamera(11, 9, 20.0, 20.0, 5.0, 4.0)
    blended, ray_plane = (
        rasterizer.forward(gaussians, camera, np.eye(4), depth_kind=d).depth for d in DEPTH_KINDS
    )
    np.testing.assert_allclose(ray_plane, blended, rtol=1e-6)


def test_only_depth_knows_of_its_kind(rasterizer, scene):
    blended, ray_plane = (draw(rasterizer, scene, depth_kind=d) for d in DEPTH_KINDS)
    np.testing.assert_array_equal(blended.color, ray_plane.color)
    np.testing.assert_array_equal(blended.alpha, ray_plane.alpha)
    assert np.abs(blended.depth - ray_plane.depth).max() > 1e-3


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_gradients_are_differences(depth):
    """Central differences in float64, of parameters that float32 would round: through the reference's own arrays."""
    scene, step = tiny(), 1e-6
    reference = ReferenceRasterizer()
    d_color, d_depth, d_alpha = scene.image(1, 3), scene.image(2), scene.image(3)

    def loss(name, index, change):
        gaussians = Float64Gaussians(scene.gaussians)
        getattr(gaussians, name)[index] += change
        render = reference.forward(gaussians, scene.camera, scene.T_camera_map, BACKGROUND, depth_kind=depth)
        return (
            (d_color * render.color).sum() + (d_depth * render.depth).sum() + (d_alpha * render.alpha).sum()
        )

    draw(reference, scene, depth_kind=depth)
    gradients = reference.backward(d_color, d_depth, d_alpha)
    for name in PARAMETERS:
        found = getattr(gradients, name)
        differences = np.zeros_like(found)
        for index in np.ndindex(found.shape):
            differences[index] = (loss(name, index, step) - loss(name, index, -step)) / (2 * step)
        np.testing.assert_allclose(found, differences, rtol=1e-6, atol=1e-7 * np.abs(found).max())


# ---------------------------------------------------------------- masks and pose only


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_masked_pixels_are_black_and_silent(rasterizer, scene, depth):
    mask = checkerboard(scene)
    whole, d_color, d_depth = draw(rasterizer, scene, depth_kind=depth), scene.image(1, 3), scene.image(2)
    silenced = rasterizer.backward(d_color * mask[..., None], d_depth * mask, pose=True, fisher=True)
    masked = draw(rasterizer, scene, depth_kind=depth, mask=mask)
    found = rasterizer.backward(d_color, d_depth, pose=True, fisher=True)
    for name in ("color", "depth", "alpha"):
        np.testing.assert_array_equal(getattr(masked, name)[mask], getattr(whole, name)[mask])
        assert not getattr(masked, name)[~mask].any()
    assert_same_gradients(found, silenced, 1e-6)  # the same sums in another order


def test_nothing_is_drawn_behind_a_closed_mask(rasterizer, plain):
    mask = np.zeros((plain.camera.height, plain.camera.width), dtype=bool)
    render = draw(rasterizer, plain, mask=mask)
    gradients = rasterizer.backward(plain.image(1, 3), pose=True)
    assert not any(array.any() for array in vars(render).values())
    assert not flat(gradients).any()
    assert not gradients.pose.any()
    assert not any(array.any() for array in rasterizer.contributions())
    layer = rasterizer.forward_with_layer(plain.gaussians, plain.camera, plain.T_camera_map, mask=mask)[1]
    assert not layer.any()


def test_pose_alone_is_the_same_pose(rasterizer, scene):
    draw(rasterizer, scene)
    cotangents = scene.image(1, 3), scene.image(2), scene.image(3)
    alone = rasterizer.backward(*cotangents, pose=True, parameters=False)
    assert all(getattr(alone, name) is None for name in PARAMETERS)
    assert alone.fisher_diagonal is None
    np.testing.assert_array_equal(alone.pose, rasterizer.backward(*cotangents, pose=True).pose)


# ---------------------------------------------------------------- depth of one layer


def wall(z_m: float, opacity: float, right_of_px: float = -np.inf) -> Gaussians:
    """Wide discs, one for every pixel right of a column, that face the camera of `tiny`."""
    camera = tiny().camera
    uv = np.argwhere(np.ones((camera.height, camera.width), bool))[:, ::-1]
    rays = np.column_stack(
        [(uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, np.ones(len(uv))]
    )
    means = (z_m * rays[uv[:, 0] > right_of_px]).astype(np.float32)
    n = len(means)
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n, np.int32),
        means=means,
        quats_wxyz=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.tile(np.log(np.float32([0.1 * z_m, 0.1 * z_m, 1e-3])), (n, 1)),
        colors=np.zeros((n, 3), np.float32),
        opacity_logits=np.full(n, np.log(opacity / (1 - opacity)), np.float32),
    )


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_one_layer_is_never_between_two(rasterizer, depth):
    """A near wall covers the right half: blended depth slides from the far one to it, the layer's depth jumps."""
    camera = tiny().camera
    near, far = wall(1.0, 0.9, right_of_px=3), wall(2.0, 0.9)
    both = Gaussians.concatenate([near, far])
    render, layer = rasterizer.forward_with_layer(both, camera, np.eye(4), depth_kind=depth)
    blended = render.depth / render.alpha
    is_near, is_far = np.abs(layer - 1) < 1e-3, np.abs(layer - 2) < 2e-3
    assert (is_near | is_far).all()
    assert is_near[:, 5:].all()
    assert is_far[:, :2].all()
    assert ((blended > 1.1) & (blended < 1.9)).any()


def test_one_layer_of_one_wall_is_its_depth(rasterizer):
    camera = tiny().camera
    render, layer = rasterizer.forward_with_layer(wall(1.5, 0.9), camera, np.eye(4))
    np.testing.assert_allclose(layer, render.depth / render.alpha, rtol=1e-5)
    render, layer = rasterizer.forward_with_layer(wall(1.5, 0.05), camera, np.eye(4))
    light = render.alpha < 0.499
    assert light.any()
    assert not layer[light].any()


def test_a_layer_without_tolerance_is_the_median_gaussian(rasterizer):
    camera, stack = tiny().camera, [wall(z, 0.3) for z in (1.0, 1.02, 1.04, 1.06, 1.08)]
    view = Gaussians.concatenate(stack), camera, np.eye(4)
    exact, loose = (rasterizer.forward_with_layer(*view, tolerance=x)[1] for x in (0.0, 0.2))
    assert np.isin(np.round(exact.astype(np.float64), 4), [1.0, 1.02, 1.04, 1.06, 1.08]).all()
    assert np.ptp(loose) < np.ptp([1.0, 1.08])
