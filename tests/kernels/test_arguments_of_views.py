"""Options of a view and of its derivatives: what cannot be is refused by name, before anything is added or changed."""

import dataclasses

import numpy as np
import pytest

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import FisherSums, LossWeights, Rasterizer, available_isas
from duagc.pipeline.splat.gaussians import Gaussians
from tests.kernels.scenes import random_gaussians

CAMERA = PinholeCamera(20, 10, 15.0, 15.0, 9.5, 4.5)
SHAPE = (10, 20)
LOSS = LossWeights(color_huber=0.1, depth_weight=0.5, depth_huber_m=0.02, alpha_weight=0.02)
REFUSED = (ValueError, TypeError)


def ones(*channels: int) -> np.ndarray:
    return np.ones((*SHAPE, *channels), np.float32)


def drawn(n: int = 5) -> Rasterizer:
    rasterizer = Rasterizer()
    rasterizer.forward(random_gaussians(n, 0), CAMERA, np.eye(4))
    return rasterizer


def differentiated(**changes: object):
    arguments = {
        "gaussians": random_gaussians(5, 0),
        "camera": CAMERA,
        "T_camera_map": np.eye(4),
        "color": ones(3),
        "depth_m": ones(),
        "loss": LOSS,
    }
    return Rasterizer().view_gradients(**{**arguments, **changes})


BYTES = np.ones((*SHAPE, 3), np.uint8)
TABLE = ones(3)[:1, :1].repeat(256, axis=0)[:, 0]


@pytest.mark.parametrize(
    ("color", "table", "words"),
    [
        (ones(3), TABLE, "color is float32, expected an array of uint8"),
        (BYTES[1:], TABLE, r"color has shape .*, expected \(10, 20, 3\)"),
        (BYTES, TABLE[1:], r"color_table has shape \(255, 3\), expected \(256, 3\)"),
        (BYTES, TABLE.astype(np.float64), "color_table is float64"),
        (BYTES, None, "color is uint8, expected an array of float32"),
        (BYTES, np.inf * TABLE, "color"),
    ],
)
def test_images_of_bytes_that_cannot_be(color, table, words):
    assert np.isfinite(differentiated(color=BYTES, color_table=TABLE)[0].value)
    with pytest.raises(REFUSED, match=words):
        differentiated(color=color, color_table=table)


MASKS = {
    "transposed": np.ones(SHAPE[::-1], bool),
    "short": np.ones((9, 20), bool),
    "channels": np.ones((*SHAPE, 1), bool),
    "flat": np.ones(200, bool),
    "empty": np.ones((0, 20), bool),
    "bytes": np.ones(SHAPE, np.uint8),
    "floats": ones(),
    "list": np.ones(SHAPE, bool).tolist(),
    "one": True,
}


@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS)
def test_masks_that_cannot_be(mask):
    with pytest.raises(REFUSED, match="mask"):
        Rasterizer().forward(random_gaussians(5, 0), CAMERA, np.eye(4), mask=mask)
    with pytest.raises(REFUSED, match="mask"):
        differentiated(mask=mask)


@pytest.mark.parametrize("depth", ["center", "", "BLENDED", None, 1, b"blended", ["blended"]])
def test_kinds_of_depth_that_do_not_exist(depth):
    with pytest.raises(REFUSED, match=r"depth_kind .*ray_plane"):
        Rasterizer().forward(random_gaussians(5, 0), CAMERA, np.eye(4), depth_kind=depth)
    with pytest.raises(REFUSED, match=r"depth_kind .*ray_plane"):
        differentiated(depth_kind=depth)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"parameters": False}, "pose"),
        ({"parameters": False, "pose": True, "fisher": True}, "fisher"),
    ],
)
def test_pose_alone_excludes_the_rest(options, named):
    with pytest.raises(ValueError, match=named):
        drawn().backward(ones(3), **options)


def bad_images(*channels: int) -> dict[str, object]:
    """Images that no argument [10, 20, channels] can be, whatever its range."""
    image = ones(*channels)
    nan, infinite, negative_infinite = image.copy(), image.copy(), image.copy()
    nan[7, 19], infinite[0, 0], negative_infinite[9, 3] = np.nan, np.inf, -np.inf
    return {
        "nan": nan,
        "inf": infinite,
        "-inf": negative_infinite,
        "short": image[:-1],
        "empty": image[:0],
        "axis": image[..., None],
        "float64": image.astype(np.float64),
        "float16": image.astype(np.float16),
        "integer": image.astype(np.int32),
        "list": image.tolist(),
        "number": 1.0,
        "text": "image",
    }


def negative(image: np.ndarray) -> np.ndarray:
    image[3, 4] = -1e-3
    return image


RESIDUALS = {**bad_images(), "negative": negative(ones())}
COLORS = bad_images(3)
DEPTHS = {**bad_images(), "negative": negative(ones())}


@pytest.mark.parametrize("residual", RESIDUALS.values(), ids=RESIDUALS)
def test_residuals_that_cannot_be(residual):
    sums = FisherSums(5)
    with pytest.raises(REFUSED, match="residual"):
        drawn().fisher(ones(), ones(), sums, residual=residual)
    assert not any(array.any() for array in sums.arrays().values())  # a refused view adds nothing


@pytest.mark.parametrize("color", COLORS.values(), ids=COLORS)
def test_color_images_that_cannot_be(color):
    with pytest.raises(REFUSED, match="color"):
        differentiated(color=color)


@pytest.mark.parametrize("depth_m", DEPTHS.values(), ids=DEPTHS)
def test_depth_images_that_cannot_be(depth_m):
    with pytest.raises(REFUSED, match="depth_m"):
        differentiated(depth_m=depth_m)


@pytest.mark.parametrize(
    "exposure",
    [
        (0.0,),
        (0.0, 0.0, 0.0),
        (np.nan, 0.0),
        (0.0, np.inf),
        (1e4, 0.0),
        (-1e4, 0.0),
        0.0,
        "ab",
        None,
        ("a", "b"),
    ],
    ids=str,
)
def test_exposures_that_cannot_be(exposure):
    with pytest.raises(REFUSED, match="exposure"):
        differentiated(exposure=exposure)


@pytest.mark.parametrize("closing", [-0.1, 0.6, float("nan"), None, "0.1"])
def test_shares_of_light_that_cannot_be(closing):
    with pytest.raises(REFUSED, match="closing"):
        differentiated(closing=closing)


@pytest.mark.parametrize("name", ["color_huber", "depth_weight", "depth_huber_m", "alpha_weight"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, -np.inf, "1", None, 1e30])
def test_loss_weights_that_cannot_be(name, value):
    with pytest.raises(ValueError, match=f"loss.{name}"):
        dataclasses.replace(LOSS, **{name: value})


@pytest.mark.parametrize("name", ["color_huber", "depth_huber_m"])
def test_huber_widths_of_zero(name):
    with pytest.raises(ValueError, match=f"loss.{name}"):
        dataclasses.replace(LOSS, **{name: 0.0})


def test_a_loss_that_is_none():
    with pytest.raises(REFUSED, match="loss"):
        differentiated(loss=None)


@pytest.mark.parametrize("name", ["T_camera_map", "background"])
@pytest.mark.parametrize("value", [np.nan, np.zeros((2, 2)), "map"])
def test_places_that_cannot_be(name, value):
    with pytest.raises(REFUSED, match=name):
        differentiated(**{name: value})


@pytest.mark.parametrize("name", ["means", "quats_wxyz", "log_scales", "colors", "opacity_logits"])
def test_gaussians_that_are_not_numbers(name):
    gaussians = random_gaussians(5, 0)
    array = getattr(gaussians, name).copy()
    array.reshape(5, -1)[3, -1] = np.nan
    with pytest.raises(ValueError, match=f"gaussians.{name} .* row 3"):
        differentiated(gaussians=gaussians.replace(**{name: array}))


@pytest.mark.parametrize(("name", "value"), [("width", 0), ("height", 0), ("fx", 0.0), ("cy", np.nan)])
def test_cameras_that_cannot_be(name, value):
    with pytest.raises(ValueError, match=f"camera.{name}"):
        differentiated(camera=dataclasses.replace(CAMERA, **{name: value}))


def test_a_refused_view_leaves_nothing_to_differentiate():
    rasterizer = drawn()
    with pytest.raises(REFUSED, match="depth_m"):
        rasterizer.view_gradients(
            random_gaussians(5, 0), CAMERA, np.eye(4), color=ones(3), depth_m=-ones(), loss=LOSS
        )
    with pytest.raises(RuntimeError, match="forward"):
        rasterizer.contributions()


@pytest.mark.parametrize("call", ["full_fisher", "fisher", "contributions", "statistics"])
def test_nothing_to_ask_before_the_first_view(call):
    arguments = {"full_fisher": (ones(), ones()), "fisher": (ones(), ones(), FisherSums(0))}.get(call, ())
    with pytest.raises(RuntimeError, match="forward"):
        getattr(Rasterizer(), call)(*arguments)


@pytest.mark.parametrize("name", ["inv_var_color", "inv_var_depth", "information", "observations"])
def test_arguments_of_the_opacity_information_that_cannot_be(name):
    rasterizer = drawn()
    n = len(rasterizer._last_forward()[0])
    sums = {"information": np.zeros(n), "observations": np.zeros(n, np.uint32)}
    arguments = {"inv_var_color": ones(), "inv_var_depth": ones(), **sums}
    with pytest.raises(REFUSED, match=name):
        rasterizer.opacity_information(**{**arguments, name: -arguments[name][1:] - 1})


@pytest.mark.parametrize("tolerance", [-0.1, 1.5, float("nan"), "0.05", None])
def test_tolerances_that_cannot_be(tolerance):
    with pytest.raises(ValueError, match="tolerance is"):
        Rasterizer().forward_with_layer(random_gaussians(5, 0), CAMERA, np.eye(4), tolerance=tolerance)


@pytest.mark.parametrize("name", ["inv_var_color", "inv_var_depth"])
@pytest.mark.parametrize("image", RESIDUALS.values(), ids=RESIDUALS)
def test_precisions_of_the_full_information_that_cannot_be(name, image):
    images = {"inv_var_color": ones(), "inv_var_depth": ones(), name: image}
    with pytest.raises(REFUSED, match=name):
        drawn().full_fisher(**images)


@pytest.mark.parametrize(
    "name", ["geometry", "color", "opacity", "observations", "weight", "residual", "diagonal"]
)
@pytest.mark.parametrize("fault", ["shape", "dtype", "read-only", "strided", "list"])
def test_sums_that_cannot_be(name, fault):
    sums = FisherSums(5, diagonal=True)
    array = getattr(sums, name)
    read_only = array.copy()
    read_only.flags.writeable = False
    faulty = {
        "shape": array[:-1],
        "dtype": array.astype(np.float32),
        "read-only": read_only,
        "strided": np.concatenate([array, array])[::2],
        "list": array.tolist(),
    }
    setattr(sums, name, faulty[fault])
    with pytest.raises(REFUSED, match=rf"sums\.{name}"):
        drawn().fisher(ones(), ones(), sums, residual=ones())
    assert not any(np.any(array) for array in sums.arrays().values())


@pytest.mark.parametrize("isa", available_isas())
def test_arrays_in_any_layout(isa):
    """Strided, reversed and Fortran-ordered images count as what they show."""
    rng, gaussians = np.random.default_rng(0), random_gaussians(20, 0)
    color, depth_m = rng.random((*SHAPE, 3)).astype(np.float32), rng.uniform(1, 3, SHAPE).astype(np.float32)
    mask, residual = rng.random(SHAPE) < 0.7, rng.random(SHAPE).astype(np.float32)

    def layouts(image: np.ndarray) -> list[np.ndarray]:
        strided = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)[::2, ::2]
        return [image, strided, np.asfortranarray(image), image[::-1].copy()[::-1]]

    results = []
    for layout in range(4):
        of_color, of_depth, of_mask, of_residual = (
            layouts(image)[layout] for image in (color, depth_m, mask, residual)
        )
        rasterizer, sums = Rasterizer(isa), FisherSums(20, diagonal=True)
        loss, gradients = rasterizer.view_gradients(
            gaussians, CAMERA, np.eye(4), color=of_color, depth_m=of_depth, loss=LOSS, mask=of_mask, pose=True
        )
        rasterizer.fisher(of_residual, of_depth, sums, residual=of_residual)
        results.append(
            [loss.value, *loss.d_exposure, gradients.pose, gradients.means, *sums.arrays().values()]
        )
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 2), (16, 16)])
@pytest.mark.parametrize("n", [0, 1, 30])
@pytest.mark.parametrize("depth", ["blended", "ray_plane"])
def test_any_size_of_anything(isa, size, n, depth):
    width, height = size
    camera = PinholeCamera(width, height, 15.0, 15.0, width / 2, height / 2)
    gaussians = random_gaussians(n, 0) if n else Gaussians.empty()
    rasterizer, sums = Rasterizer(isa), FisherSums(n, diagonal=True)
    image, mask = np.ones((height, width), np.float32), np.indices((height, width)).sum(axis=0) % 3 > 0
    loss, gradients = rasterizer.view_gradients(
        gaussians,
        camera,
        np.eye(4),
        color=np.ones((height, width, 3), np.float32),
        depth_m=image,
        loss=LOSS,
        mask=mask,
        depth_kind=depth,
        pose=True,
    )
    rasterizer.fisher(image, image, sums, residual=image)
    full, statistics = rasterizer.full_fisher(image, image), rasterizer.statistics()
    assert np.isfinite([loss.value, loss.color, loss.depth, *loss.d_exposure]).all()
    for array in (*vars(gradients).values(), *sums.arrays().values(), full):
        assert array is None or np.isfinite(array).all()
    assert full.shape == (n, 14, 14)
    assert statistics.visible <= n
    assert statistics.blended_pairs <= statistics.evaluated_pairs
    assert statistics.blended_pairs == rasterizer.contributions()[1].sum()


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("depth", ["blended", "ray_plane"])
def test_extremes_stay_finite(isa, depth):
    """Sizes from nothing to a planet, any distance, opacities at both ends, and centers at the camera's edge."""
    rng, n = np.random.default_rng(7), 400
    gaussians = random_gaussians(n, 7).replace(
        means=rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-2, 3, (n, 1)),
        quats_wxyz=rng.normal(size=(n, 4)) * 10.0 ** rng.uniform(-10, 10, (n, 1)),
        log_scales=rng.uniform(-60, 3, (n, 3)),
        opacity_logits=rng.uniform(-1, 1, n) * 10.0 ** rng.uniform(-3, 30, n),
    )
    rasterizer, sums = Rasterizer(isa), FisherSums(n, diagonal=True)
    loss, gradients = rasterizer.view_gradients(
        gaussians, CAMERA, np.eye(4), color=ones(3), depth_m=ones(), loss=LOSS, depth_kind=depth, pose=True
    )
    rasterizer.fisher(ones(), ones(), sums, residual=ones())
    assert np.isfinite([loss.value, loss.color, loss.depth, *loss.d_exposure]).all()
    for array in (*vars(gradients).values(), *sums.arrays().values(), rasterizer.full_fisher(ones(), ones())):
        assert array is None or np.isfinite(array).all()
