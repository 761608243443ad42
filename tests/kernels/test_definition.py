"""What the outputs mean, without the code that computes them: closed forms, differences, sums over pixels."""

import dataclasses

import numpy as np
import pytest

from duagc.pipeline.geometry import so3, spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.kernels.types import FisherSums, Gradients, LossWeights
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians
from duagc.pipeline.splat.information import unpack_geometry
from duagc.pipeline.splat.losses import rgbd_loss
from tests.kernels.scenes import BACKGROUND, Scene, make_scene, random_gaussians

IMPLEMENTATIONS = [ReferenceRasterizer, Rasterizer]
PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
LOSS = LossWeights(color_huber=0.1, depth_weight=0.5, depth_huber_m=0.02, alpha_weight=0.02)


@pytest.fixture(params=IMPLEMENTATIONS, ids=lambda implementation: implementation.__name__)
def rasterizer(request):
    return request.param()


def draw(rasterizer, scene: Scene, **options):
    return rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map, scene.background, **options)


def tiny(kind="plain", n=6) -> Scene:
    """35 pixels, six Gaussians: small enough to differentiate number by number."""
    scene = make_scene(kind, n=n)
    return Scene(scene.gaussians, PinholeCamera(7, 5, 5.0, 5.5, 3.2, 2.1), scene.T_camera_map)


def flat(gradients: Gradients) -> np.ndarray:
    """[n, 14] of the five arrays."""
    n = len(gradients.means)
    return np.concatenate([getattr(gradients, name).reshape(n, -1) for name in PARAMETERS], axis=1)


def assert_same_gradients(
    found: Gradients, wanted: Gradients, rtol: float, drift: dict[str, float] | None = None
) -> None:
    """Relative L2 of every array; the quaternions of balls have no derivative but rounding. drift: allowed too."""
    smallest = 1e-12 * np.linalg.norm(flat(wanted))
    for name, exact in vars(wanted).items():
        if exact is not None:
            error = np.linalg.norm(getattr(found, name) - exact)
            assert error <= max(rtol * np.linalg.norm(exact), smallest, (drift or {}).get(name, 0.0)), name


def checkerboard(scene: Scene) -> np.ndarray:
    """A mask that cuts through blocks and tiles."""
    rows, columns = np.indices((scene.camera.height, scene.camera.width))
    return (rows // 2 + columns // 3) % 2 == 0


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


class Float64Gaussians:
    """The arrays of some Gaussians, not rounded to float32."""

    def __init__(self, gaussians):
        for name in PARAMETERS:
            setattr(self, name, getattr(gaussians, name).astype(np.float64))

    def __len__(self):
        return len(self.means)


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


def test_masked_pixels_bring_no_information(rasterizer, plain):
    mask, of_color, of_depth = checkerboard(plain), plain.image(4, low=1.0), plain.image(5, low=1.0)
    residual = plain.image(6, low=0.0)
    silenced, masked = FisherSums(24, diagonal=True), FisherSums(24, diagonal=True)
    draw(rasterizer, plain)
    rasterizer.fisher(of_color * mask, of_depth * mask, silenced, residual=residual)
    draw(rasterizer, plain, mask=mask)
    rasterizer.fisher(of_color, of_depth, masked, residual=residual)
    for name, wanted in silenced.arrays().items():
        np.testing.assert_allclose(
            masked.arrays()[name], wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max(), err_msg=name
        )
    weights, pixels = rasterizer.contributions()
    np.testing.assert_allclose(masked.weight, weights, rtol=1e-6)
    assert pixels.max() <= mask.sum()


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
    render = rasterizer.forward(Gaussians.concatenate([near, far]), camera, np.eye(4), depth_kind=depth)
    layer, blended = rasterizer.layer_depth(), render.depth / render.alpha
    is_near, is_far = np.abs(layer - 1) < 1e-3, np.abs(layer - 2) < 2e-3
    assert (is_near | is_far).all()
    assert is_near[:, 5:].all()
    assert is_far[:, :2].all()
    assert ((blended > 1.1) & (blended < 1.9)).any()


def test_one_layer_of_one_wall_is_its_depth(rasterizer):
    camera = tiny().camera
    render = rasterizer.forward(wall(1.5, 0.9), camera, np.eye(4))
    np.testing.assert_allclose(rasterizer.layer_depth(), render.depth / render.alpha, rtol=1e-5)
    rasterizer.forward(wall(1.5, 0.05), camera, np.eye(4))
    light = rasterizer.forward(wall(1.5, 0.05), camera, np.eye(4)).alpha < 0.499
    assert light.any()
    assert not rasterizer.layer_depth()[light].any()


def test_a_layer_without_tolerance_is_the_median_gaussian(rasterizer):
    camera, stack = tiny().camera, [wall(z, 0.3) for z in (1.0, 1.02, 1.04, 1.06, 1.08)]
    rasterizer.forward(Gaussians.concatenate(stack), camera, np.eye(4))
    exact, loose = rasterizer.layer_depth(0.0), rasterizer.layer_depth(0.2)
    assert np.isin(np.round(exact.astype(np.float64), 4), [1.0, 1.02, 1.04, 1.06, 1.08]).all()
    assert np.ptp(loose) < np.ptp([1.0, 1.08])


def test_nothing_is_drawn_behind_a_closed_mask(rasterizer, plain):
    mask = np.zeros((plain.camera.height, plain.camera.width), dtype=bool)
    render = draw(rasterizer, plain, mask=mask)
    gradients = rasterizer.backward(plain.image(1, 3), pose=True)
    assert not any(array.any() for array in vars(render).values())
    assert not flat(gradients).any()
    assert not gradients.pose.any()
    assert not any(array.any() for array in rasterizer.contributions())
    assert not rasterizer.layer_depth().any()


def test_pose_alone_is_the_same_pose(rasterizer, scene):
    draw(rasterizer, scene)
    cotangents = scene.image(1, 3), scene.image(2), scene.image(3)
    alone = rasterizer.backward(*cotangents, pose=True, parameters=False)
    assert all(getattr(alone, name) is None for name in PARAMETERS)
    assert alone.fisher_diagonal is None
    np.testing.assert_array_equal(alone.pose, rasterizer.backward(*cotangents, pose=True).pose)


# ---------------------------------------------------------------- information


def rows_of(reference, scene: Scene) -> np.ndarray:
    """Derivatives [4, pixels, n, 14] of red, green, blue and depth, by one `backward` for each number."""
    height, width = scene.camera.height, scene.camera.width
    rows = []
    for channel in range(4):
        for pixel in np.ndindex(height, width):
            d_color, d_depth = np.zeros((height, width, 3)), np.zeros((height, width))
            if channel < 3:
                d_color[(*pixel, channel)] = 1
            else:
                d_depth[pixel] = 1
            rows.append(flat(reference.backward(d_color, d_depth)))
    return np.stack(rows).reshape(4, height * width, *rows[0].shape)


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_information_is_the_sum_over_pixels_of_squared_derivatives(rasterizer, depth):
    scene, reference = tiny(), ReferenceRasterizer()
    of_color, of_depth = scene.image(4, low=0.0), scene.image(5, low=0.0)
    draw(reference, scene, depth_kind=depth)
    rows = rows_of(reference, scene)
    precision = np.stack([of_color.ravel()] * 3 + [of_depth.ravel()]).astype(np.float64)
    wanted = np.einsum("cp,cpni,cpnj->nij", precision, rows, rows)
    draw(rasterizer, scene, depth_kind=depth)
    found = rasterizer.full_fisher(of_color, of_depth)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, wanted, atol=tolerance(rasterizer) * np.abs(wanted).max())
    sums = FisherSums(len(scene.gaussians), diagonal=True)
    rasterizer.fisher(of_color, of_depth, sums)
    diagonal = np.diagonal(wanted, axis1=1, axis2=2)
    for column in range(14):
        error = np.linalg.norm(sums.diagonal[:, column] - diagonal[:, column])
        assert error <= tolerance(rasterizer) * np.linalg.norm(diagonal[:, column])
    gradients = rasterizer.backward(scene.image(1, 3), scene.image(2), fisher=True)
    d_color, d_depth = scene.image(1, 3).reshape(-1, 3), scene.image(2).ravel()
    per_pixel = np.einsum("pc,cpni->pni", d_color, rows[:3]) + d_depth[:, None, None] * rows[3]
    empirical = (per_pixel**2).sum(axis=0)
    error = np.linalg.norm(gradients.fisher_diagonal - empirical, axis=0)
    assert (error <= tolerance(rasterizer) * np.linalg.norm(empirical, axis=0)).all()


def tolerance(rasterizer) -> float:
    """Relative to a norm; float32 squares of derivatives of float32."""
    return 1e-12 if isinstance(rasterizer, ReferenceRasterizer) else 1e-4


@pytest.mark.parametrize("kind", ["plain", "discs", "needles"])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_both_charts_of_the_geometry_say_the_same(rasterizer, kind, depth):
    """F in (mean, quaternion, log-scale) is T^T F T of F in (mean, vec log Sigma), T the derivative of the one by the
    other: by central differences of float64 arrays."""
    scene = make_scene(kind)
    n, step = len(scene.gaussians), 1e-5
    views, sums = (scene.image(4, low=0.0), scene.image(5, low=0.0)), FisherSums(n)
    draw(rasterizer, scene, depth_kind=depth)
    rasterizer.fisher(*views, sums)
    quats, scales = (a.astype(np.float64) for a in (scene.gaussians.quats_wxyz, scene.gaussians.log_scales))
    T = np.zeros((n, 9, 10))
    T[:, :3, :3] = np.eye(3)
    for k in range(7):
        change = np.zeros(7)
        change[k] = step
        ahead = spd.log_covariance(quats + change[:4], scales + change[4:])
        behind = spd.log_covariance(quats - change[:4], scales - change[4:])
        T[:, 3:, 3 + k] = (ahead - behind) / (2 * step)
    wanted = np.swapaxes(T, 1, 2) @ unpack_geometry(sums.geometry) @ T
    found = rasterizer.full_fisher(*views)[:, :10, :10]
    seen = sums.observations > 0
    error = np.linalg.norm((found - wanted)[seen], axis=(1, 2)) / np.linalg.norm(wanted[seen], axis=(1, 2))
    assert error.max() < max(tolerance(rasterizer), 1e-8)  # of the differences


def test_full_information_and_its_parts(rasterizer, scene):
    views, sums = (
        (scene.image(4, low=0.0), scene.image(5, low=0.0)),
        FisherSums(len(scene.gaussians), diagonal=True),
    )
    draw(rasterizer, scene)
    rasterizer.fisher(*views, sums)
    full = rasterizer.full_fisher(*views)
    np.testing.assert_allclose(full, np.swapaxes(full, 1, 2), rtol=1e-6, atol=1e-6 * np.abs(full).max())
    diagonal = np.diagonal(full, axis1=1, axis2=2)
    for column in range(14):
        error = np.linalg.norm(sums.diagonal[:, column] - diagonal[:, column])
        assert error <= tolerance(rasterizer) * max(
            np.linalg.norm(diagonal[:, column]), 1e-9 * np.linalg.norm(diagonal)
        )
    np.testing.assert_allclose(sums.color, diagonal[:, 10:13], rtol=1e-5)
    np.testing.assert_allclose(sums.opacity, diagonal[:, 13], rtol=1e-4, atol=1e-9 * diagonal.max())


def test_weight_and_residual_are_sums_over_the_pixels_that_count(rasterizer, plain):
    """One pixel at a time: `alpha` is the sum of the weights, and a mask of one pixel gives its weights."""
    of_color, of_depth = plain.image(4, low=0.0), plain.image(5, low=0.0)
    of_color[:6], of_depth[3:9] = 0.0, 0.0
    counted = (of_color > 0) | (of_depth > 0)
    residual = plain.image(6, low=0.0)
    weight, by_residual = np.zeros(24), np.zeros(24)
    for pixel in np.argwhere(counted)[::7]:
        mask = np.zeros(counted.shape, dtype=bool)
        mask[tuple(pixel)] = True
        draw(rasterizer, plain, mask=mask)
        weights, _ = rasterizer.contributions()
        weight += weights
        by_residual += weights * residual[tuple(pixel)]
    mask = np.zeros(counted.shape, dtype=bool)
    mask[tuple(np.argwhere(counted)[::7].T)] = True
    sums = FisherSums(24)
    draw(rasterizer, plain)
    rasterizer.fisher(of_color * mask, of_depth * mask, sums, residual=residual)
    np.testing.assert_allclose(sums.weight, weight, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sums.residual, by_residual, rtol=1e-5, atol=1e-3)
    without = FisherSums(24)
    rasterizer.fisher(of_color * mask, of_depth * mask, without)
    np.testing.assert_array_equal(without.weight, sums.weight)
    assert not without.residual.any()


# ---------------------------------------------------------------- loss of a view


def backward_of(rasterizer, loss) -> Gradients:
    """The gradients that the cotangents of a loss give, in the type that the rasterizer takes."""
    cotangents = (loss.d_color, loss.d_depth, loss.d_alpha)
    if isinstance(rasterizer, Rasterizer):
        cotangents = tuple(d.astype(np.float32) for d in cotangents)
    return rasterizer.backward(*cotangents, pose=True)


def measured_images(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """A color and a depth image with holes, near what is drawn, so that residuals lie on both sides of the widths."""
    reference, rng = ReferenceRasterizer(), np.random.default_rng(11)
    render = draw(reference, scene)
    color = render.color + rng.normal(scale=0.15, size=render.color.shape)
    depth = render.depth / np.maximum(render.alpha, 1e-3) + rng.normal(scale=0.05, size=render.depth.shape)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    return color.astype(np.float32), np.maximum(depth, 0.0).astype(np.float32)


@pytest.mark.parametrize("exposure", [(0.0, 0.0), (0.2, -0.05)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_view_gradients_are_forward_loss_and_backward(rasterizer, scene, exposure, masked, depth):
    color, depth_m = measured_images(scene)
    mask = checkerboard(scene) if masked else None
    loss, gradients = rasterizer.view_gradients(
        scene.gaussians,
        scene.camera,
        scene.T_camera_map,
        color=color,
        depth_m=depth_m,
        loss=LOSS,
        exposure=exposure,
        background=scene.background,
        mask=mask,
        depth_kind=depth,
        pose=True,
    )
    render = draw(rasterizer, scene, depth_kind=depth, mask=mask)
    wanted = rgbd_loss(render, color, depth_m, LOSS, exposure=exposure, mask=mask)
    rtol = 1e-12 if isinstance(rasterizer, ReferenceRasterizer) else 2e-6
    np.testing.assert_allclose(
        [loss.value, loss.color, loss.depth], [wanted.value, wanted.color, wanted.depth], rtol=rtol
    )
    np.testing.assert_allclose(loss.d_exposure, wanted.d_exposure, rtol=10 * rtol, atol=rtol)
    separate = backward_of(rasterizer, wanted)
    if isinstance(rasterizer, ReferenceRasterizer):
        assert_same_gradients(gradients, separate, 1e-6)
        return
    # Half a unit in the last place of a depth of 3 m is 1e-5 of the Huber width: what that changes counts twice,
    # once for each way of computing the same residual.
    rng, drift = np.random.default_rng(0), dict.fromkeys(vars(separate), 0.0)
    for _ in range(5):
        half_ulp = 2.0**-24 * rng.choice([-1.0, 1.0], render.depth.shape)
        moved = dataclasses.replace(render, depth=render.depth * (1 + half_ulp))
        other = backward_of(rasterizer, rgbd_loss(moved, color, depth_m, LOSS, exposure=exposure, mask=mask))
        for name in drift:
            if getattr(separate, name) is not None:
                change = np.linalg.norm(getattr(other, name) - getattr(separate, name))
                drift[name] = max(drift[name], 2 * change)
    assert_same_gradients(gradients, separate, 1e-5, drift)


def test_view_gradients_with_certain_depth_are_those_without(plain):
    color, depth_m = measured_images(plain)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    measured = {"color": color, "depth_m": depth_m, "loss": LOSS}
    rasterizer, sure = Rasterizer(), np.ones_like(depth_m)
    loss, gradients = rasterizer.view_gradients(*view, **measured, exposure=(0.1, 0.02))
    same, of_same = rasterizer.view_gradients(*view, **measured, exposure=(0.1, 0.02), depth_certainty=sure)
    np.testing.assert_allclose([same.value, same.depth], [loss.value, loss.depth], rtol=1e-5)
    np.testing.assert_allclose(same.d_exposure, loss.d_exposure, rtol=1e-4)
    np.testing.assert_allclose(of_same.means, gradients.means, atol=1e-4 * np.abs(gradients.means).max())
    less, of_less = rasterizer.view_gradients(*view, **measured, depth_certainty=0.0 * sure)
    assert less.depth == 0
    without, of_color = rasterizer.view_gradients(
        *view, **measured | {"loss": dataclasses.replace(LOSS, depth_weight=0.0)}
    )
    assert less.value == pytest.approx(without.value, rel=1e-5)
    np.testing.assert_allclose(of_less.means, of_color.means, atol=1e-4 * np.abs(of_color.means).max())


@pytest.mark.parametrize("pose_only", [False, True])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_view_gradients_of_the_depth_of_single_gaussians_are_those_of_the_reference(plain, depth, pose_only):
    color, depth_m = measured_images(plain)
    certainty = np.random.default_rng(5).uniform(0, 1, depth_m.shape).astype(np.float32)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    options = {"depth_kind": depth, "pose": True, "depth_certainty": certainty, "mask": checkerboard(plain)}
    options |= {"parameters": not pose_only, "color": color, "depth_m": depth_m}
    both = dataclasses.replace(LOSS, surface_weight=0.8)
    loss, gradients = Rasterizer().view_gradients(*view, loss=both, **options)
    wanted, of_reference = ReferenceRasterizer().view_gradients(*view, loss=both, **options)
    assert loss.surface == pytest.approx(wanted.surface, rel=1e-5)
    assert loss.value == pytest.approx(wanted.value, rel=1e-5)
    if pose_only:
        assert gradients.means is None
        np.testing.assert_allclose(gradients.pose, of_reference.pose, rtol=1e-4, atol=1e-6)
    else:
        assert_same_gradients(gradients, of_reference, 1e-4)
    without, of_less = Rasterizer().view_gradients(*view, loss=LOSS, **options)
    assert without.surface == 0
    assert loss.value == pytest.approx(without.value + 0.8 * loss.surface, rel=1e-5)
    assert np.abs(gradients.pose - of_less.pose).max() > 0.01 * np.abs(of_less.pose).max()


def test_view_gradients_draw_a_view_that_can_be_asked_further(rasterizer, plain):
    color, depth_m = measured_images(plain)
    view = (plain.gaussians, plain.camera, plain.T_camera_map)
    measured = {"color": color, "depth_m": depth_m, "loss": LOSS}
    _, pose_only = rasterizer.view_gradients(*view, **measured, pose=True, parameters=False)
    assert pose_only.means is None
    weights, _ = rasterizer.contributions()
    _, both = rasterizer.view_gradients(*view, **measured, pose=True)
    np.testing.assert_array_equal(pose_only.pose, both.pose)
    rasterizer.forward(*view)
    np.testing.assert_array_equal(weights, rasterizer.contributions()[0])


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_a_pixel_that_closes_early_is_that_of_the_reference(plain, depth):
    color, depth_m = measured_images(plain)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    options = {"color": color, "depth_m": depth_m, "loss": dataclasses.replace(LOSS, surface_weight=0.8)}
    options |= {"depth_kind": depth, "pose": True, "mask": checkerboard(plain)}
    rasterizer = Rasterizer()
    loss, gradients = rasterizer.view_gradients(*view, **options, closing=0.2)
    wanted, of_reference = ReferenceRasterizer().view_gradients(*view, **options, closing=0.2)
    assert loss.value == pytest.approx(wanted.value, rel=1e-5)
    assert_same_gradients(gradients, of_reference, 1e-4)
    whole, of_whole = rasterizer.view_gradients(*view, **options)
    assert abs(loss.value - whole.value) > 1e-4 * whole.value
    assert np.abs(gradients.means - of_whole.means).max() > 1e-3 * np.abs(of_whole.means).max()
    same, of_same = rasterizer.view_gradients(*view, **options, closing=1e-4)  # where pixels close anyway
    assert same == whole
    np.testing.assert_array_equal(of_same.means, of_whole.means)


def test_a_view_that_was_closed_early_cannot_be_asked_further(plain):
    color, depth_m = measured_images(plain)
    rasterizer = Rasterizer()
    view = plain.gaussians, plain.camera, plain.T_camera_map
    rasterizer.view_gradients(*view, color=color, depth_m=depth_m, loss=LOSS, closing=0.2)
    with pytest.raises(RuntimeError, match="closed early"):
        rasterizer.contributions()
    visible = rasterizer.visible
    rasterizer.forward(*view)
    assert rasterizer.visible == visible > 0
    rasterizer.contributions()


def test_derivatives_by_exposure_are_differences(rasterizer, plain):
    color, depth_m = measured_images(plain)
    step = 1e-3 if not isinstance(rasterizer, ReferenceRasterizer) else 1e-6

    def at(a, b):
        return rasterizer.view_gradients(
            plain.gaussians,
            plain.camera,
            plain.T_camera_map,
            color=color,
            depth_m=depth_m,
            loss=LOSS,
            exposure=(a, b),
        )[0]

    by_a = (at(0.1 + step, 0.02).value - at(0.1 - step, 0.02).value) / (2 * step)
    by_b = (at(0.1, 0.02 + step).value - at(0.1, 0.02 - step).value) / (2 * step)
    np.testing.assert_allclose(at(0.1, 0.02).d_exposure, [by_a, by_b], rtol=1e-2 if step > 1e-5 else 1e-6)


def test_views_without_measurements_have_no_loss(rasterizer, plain):
    nothing = np.zeros((plain.camera.height, plain.camera.width), dtype=bool)
    color, depth_m = measured_images(plain)
    view = (plain.gaussians, plain.camera, plain.T_camera_map)
    loss, gradients = rasterizer.view_gradients(*view, color=color, depth_m=depth_m, loss=LOSS, mask=nothing)
    assert loss.value == loss.color == loss.depth == 0.0
    assert loss.d_exposure == (0.0, 0.0)
    assert not flat(gradients).any()
    loss, _ = rasterizer.view_gradients(*view, color=color, depth_m=np.zeros_like(depth_m), loss=LOSS)
    assert loss.depth == 0.0
    assert loss.value == loss.color > 0
