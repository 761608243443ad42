"""What no camera and no Gaussian can be is refused by name; what is merely extreme is drawn."""

import reprlib

import numpy as np
import pytest

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import FisherSums, Rasterizer, available_isas
from duagc.pipeline.splat.gaussians import Gaussians
from tests.kernels.scenes import make_scene, random_gaussians

CAMERA = PinholeCamera(20, 10, 15.0, 15.0, 9.5, 4.5)


def drawn(n: int = 5) -> Rasterizer:
    rasterizer = Rasterizer()
    rasterizer.forward(random_gaussians(n, 0), CAMERA, np.eye(4))
    return rasterizer


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["means", "quats_wxyz", "log_scales", "colors", "opacity_logits"])
def test_gaussians_that_are_not_numbers(name, bad):
    gaussians = random_gaussians(40, 0)
    array = getattr(gaussians, name).copy()
    array.reshape(40, -1)[37, -1] = bad
    with pytest.raises(ValueError, match=f"gaussians.{name} .* row 37"):
        Rasterizer().forward(gaussians.replace(**{name: array}), CAMERA, np.eye(4))


def test_gaussians_without_orientation_or_size():
    gaussians = random_gaussians(3, 0)
    with pytest.raises(ValueError, match="quats_wxyz has length 0 in row 1"):
        Rasterizer().forward(
            gaussians.replace(quats_wxyz=[[1, 0, 0, 0], [0] * 4, [1, 0, 0, 0]]), CAMERA, np.eye(4)
        )
    with pytest.raises(ValueError, match="log_scales is 50 in row 2"):
        Rasterizer().forward(gaussians.replace(log_scales=[[0] * 3, [0] * 3, [0, 50, 0]]), CAMERA, np.eye(4))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0),
        ("height", -3),
        ("width", 10.5),
        ("height", 100_000),
        ("fx", 0.0),
        ("fy", -5.0),
        ("fx", np.nan),
        ("cx", np.inf),
        ("width", np.nan),
        ("width", np.inf),
        ("height", None),
        ("height", "10"),
        ("width", [20]),
        ("fx", "a"),
        ("fy", None),
        ("cx", 1j),
        ("cy", [4.5]),
    ],
    ids=str,
)
def test_cameras_that_cannot_be(name, value):
    values = {**vars(CAMERA), name: value}
    with pytest.raises(ValueError, match=f"camera.{name}"):
        Rasterizer().forward(Gaussians.empty(), PinholeCamera(**values), np.eye(4))


@pytest.mark.parametrize(
    ("T", "complaint"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "rigid"),
        (2 * np.eye(4), "rigid"),
        (1e39 * np.eye(4), "infinity"),
        ("map", "numbers"),
        (None, "numbers"),
        ([["a"] * 4] * 4, "numbers"),
        ([[1, 0, 0, 0], [0, 1, 0]], "numbers"),
        (np.eye(4, dtype=complex), "complex"),
        (np.eye(4, dtype=object), "numbers"),
        (np.eye(4) > 0, "bool"),
    ],
    ids=reprlib.repr,
)
def test_poses_that_cannot_be(T, complaint):
    with pytest.raises(ValueError, match=f"T_camera_map .*{complaint}"):
        Rasterizer().forward(Gaussians.empty(), CAMERA, T)


@pytest.mark.parametrize(
    "background",
    [(0, 0), (0, 0, np.nan), (0, 0, 1e39), "abc", 0.5, None, (0, 0, 1j), ((0, 0), 0, 0)],
    ids=str,
)
def test_backgrounds_that_cannot_be(background):
    with pytest.raises(ValueError, match="background"):
        Rasterizer().forward(Gaussians.empty(), CAMERA, np.eye(4), background)


@pytest.mark.parametrize("name", ["d_color", "d_depth", "d_alpha"])
@pytest.mark.parametrize("fault", ["shape", "dtype", "list", "nan", "inf"])
def test_cotangents_that_cannot_be(name, fault):
    images = {"d_color": np.zeros((10, 20, 3), np.float32)}
    image = images["d_color"] if name == "d_color" else np.zeros((10, 20), np.float32)
    if fault in ("nan", "inf"):
        image[7, 19] = float(fault)
    faulty = {"shape": image[:-1], "dtype": image.astype(np.float64), "list": image.tolist()}.get(
        fault, image
    )
    with pytest.raises(ValueError, match=name):
        drawn().backward(**{**images, name: faulty})


@pytest.mark.parametrize("name", ["inv_var_color", "inv_var_depth"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_precisions_that_cannot_be(name, bad):
    images = {key: np.ones((10, 20), np.float32) for key in ("inv_var_color", "inv_var_depth")}
    images[name][9, 0] = bad
    sums = FisherSums(5)
    with pytest.raises(ValueError, match=name):
        drawn().fisher(**images, sums=sums)
    assert not any(np.any(array) for array in sums.arrays().values())  # a refused view adds nothing


def test_sums_of_another_map():
    ones = np.ones((10, 20), np.float32)
    with pytest.raises(ValueError, match=r"sums\.geometry"):
        drawn(5).fisher(ones, ones, FisherSums(6))


def test_settings_that_cannot_be():
    for isa in ("mmx", "", None, 2, ["avx2"]):
        with pytest.raises(ValueError, match="isa is"):
            Rasterizer(isa)
    for threads in (0, -1, 10**9, 1.5, np.nan, "2", None, [2]):
        with pytest.raises(ValueError, match="threads is"):
            Rasterizer(threads=threads)
    assert Rasterizer().isa == available_isas()[0]
    assert Rasterizer(threads=np.int64(2)).threads == 2


@pytest.mark.parametrize(
    "value", [None, "room", 3, np.zeros((5, 3), np.float32)], ids=["none", "text", "number", "array"]
)
def test_arguments_of_another_type(value):
    ones = np.ones((10, 20), np.float32)
    with pytest.raises(ValueError, match=r"gaussians is .* expected Gaussians"):
        Rasterizer().forward(value, CAMERA, np.eye(4))
    with pytest.raises(ValueError, match=r"camera is .* expected PinholeCamera"):
        Rasterizer().forward(random_gaussians(5, 0), value, np.eye(4))
    with pytest.raises(ValueError, match=r"sums is .* expected FisherSums"):
        drawn().fisher(ones, ones, value)


def test_nothing_to_differentiate_before_the_first_view():
    with pytest.raises(RuntimeError, match="forward"):
        Rasterizer().backward(np.zeros((1, 1, 3), np.float32))


def test_a_refused_view_leaves_nothing_to_differentiate():
    rasterizer = drawn()
    with pytest.raises(ValueError, match="means"):
        rasterizer.forward(random_gaussians(2, 0).replace(means=np.full((2, 3), np.nan)), CAMERA, np.eye(4))
    with pytest.raises(RuntimeError, match="forward"):
        rasterizer.contributions()


def everything(gaussians: Gaussians, camera: PinholeCamera, isa: str) -> list[np.ndarray]:
    rasterizer, sums = Rasterizer(isa), FisherSums(len(gaussians))
    ones = np.ones((camera.height, camera.width), np.float32)
    render = rasterizer.forward(gaussians, camera, np.eye(4), (0.3, 0.2, 0.1))
    gradients = rasterizer.backward(np.ones((*ones.shape, 3), np.float32), ones, ones, pose=True, fisher=True)
    rasterizer.fisher(ones, ones, sums)
    return [
        *vars(render).values(),
        *vars(gradients).values(),
        *sums.arrays().values(),
        *rasterizer.contributions(),
    ]


@pytest.mark.parametrize("isa", available_isas())
def test_no_gaussians_are_the_background(isa):
    color, depth, alpha, *rest = everything(Gaussians.empty(), CAMERA, isa)
    np.testing.assert_array_equal(color, np.broadcast_to(np.float32([0.3, 0.2, 0.1]), color.shape))
    assert not depth.any()
    assert not alpha.any()
    assert not any(np.any(array) for array in rest)


@pytest.mark.parametrize("isa", available_isas())
def test_gaussians_behind_the_camera_are_not_there(isa):
    gaussians = random_gaussians(20, 0)
    _, _, alpha, *rest = everything(gaussians.replace(means=-gaussians.means), CAMERA, isa)
    assert not alpha.any()
    assert not any(np.any(array) for array in rest)


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 2), (16, 16)])
def test_any_size_of_image(isa, size):
    camera = PinholeCamera(*size, 15.0, 15.0, size[0] / 2, size[1] / 2)
    arrays = everything(random_gaussians(30, 0), camera, isa)
    assert arrays[0].shape == (size[1], size[0], 3)
    assert all(np.isfinite(array).all() for array in arrays)


@pytest.mark.parametrize("isa", available_isas())
def test_extremes_stay_finite(isa):
    """Sizes from nothing to a planet, any distance, opacities at both ends, and centers at the camera's edge."""
    rng, n = np.random.default_rng(7), 400
    gaussians = random_gaussians(n, 7).replace(
        means=rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-3, 12, (n, 1)),
        quats_wxyz=rng.normal(size=(n, 4)) * 10.0 ** rng.uniform(-10, 10, (n, 1)),
        log_scales=rng.uniform(-60, 39, (n, 3)),
        opacity_logits=rng.uniform(-1, 1, n) * 10.0 ** rng.uniform(-3, 30, n),
    )
    assert all(np.isfinite(array).all() for array in everything(gaussians, CAMERA, isa)[:3])
    moderate = gaussians.replace(
        means=rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-2, 3, (n, 1)),
        log_scales=rng.uniform(-30, 3, (n, 3)),
    )
    assert all(np.isfinite(array).all() for array in everything(moderate, CAMERA, isa))


def test_rasterizers_do_not_share_state():
    first, second = Rasterizer(), Rasterizer()
    a, b = make_scene("plain"), make_scene("opaque")
    image = first.forward(a.gaussians, a.camera, a.T_camera_map).color.copy()
    second.forward(b.gaussians, b.camera, b.T_camera_map)
    d_color = a.image(0, 3)
    expected = Rasterizer()
    expected.forward(a.gaussians, a.camera, a.T_camera_map)
    np.testing.assert_array_equal(first.backward(d_color).means, expected.backward(d_color).means)
    np.testing.assert_array_equal(image, first.forward(a.gaussians, a.camera, a.T_camera_map).color)


def test_outputs_outlive_their_rasterizer_and_are_never_shared():
    """Output memory is handed out again, but only after numpy let go of it."""
    gaussians, d_color = random_gaussians(50, 0), np.ones((10, 20, 3), np.float32)
    rasterizer = Rasterizer()
    kept = [
        rasterizer.forward(gaussians, CAMERA, np.eye(4)).color[2:] for _ in range(40)
    ]  # views count as holding
    means = [rasterizer.backward(scale * d_color).means for scale in (np.float32(1), np.float32(2))]
    wanted = kept[0].copy()
    del rasterizer
    for _ in range(5):
        drawn(50)
    assert all(np.array_equal(image, wanted) for image in kept)
    np.testing.assert_array_equal(means[1], 2 * means[0])


def test_threads_are_checked_at_every_call(plain):
    rasterizer = Rasterizer()
    rasterizer.threads = 0
    with pytest.raises(ValueError, match="threads is 0"):
        rasterizer.forward(plain.gaussians, plain.camera, plain.T_camera_map)
