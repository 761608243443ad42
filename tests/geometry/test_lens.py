"""Cameras with a lens, next to the equations of their models."""

import numpy as np
import pytest

from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, rectified, seen_by_source

CAMERA = PinholeCamera(64, 48, 50.0, 51.0, 31.0, 24.5)
SOURCE = PinholeCamera(64, 48, 55.0, 54.0, 33.0, 22.5)
TURN = (0.02, -0.03, 0.05)
MODELS = {
    "no distortion": ((), False),
    "k1 k2 p1 p2": ((-0.2, 0.05, 0.003, -0.002), False),
    "k1 k2 p1 p2 k3": ((-0.2, 0.05, 0.003, -0.002, 0.01), False),
    "rational": ((-0.2, 0.05, 0.003, -0.002, 0.01, 0.1, 0.02, -0.01), False),
    "fisheye": ((-0.02, 0.01, -0.003, 0.001), True),
}


def expected(lens: Lens, camera: PinholeCamera) -> np.ndarray:
    """Pixels [h, w, 2] of the source, by the equations that OpenCV documents."""
    rays = camera.rays() @ so3.exp(np.array(lens.rotation_rad)).T
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    r2 = x**2 + y**2
    if lens.fisheye:
        angle = np.arctan(np.sqrt(r2))
        a2 = angle**2
        k = lens.distortion
        bent = angle * (1 + k[0] * a2 + k[1] * a2**2 + k[2] * a2**3 + k[3] * a2**4)
        scale = np.where(r2 > 0, bent / np.sqrt(np.where(r2 > 0, r2, 1)), 1)
        x, y = x * scale, y * scale
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.distortion, *(0.0,) * (8 - len(lens.distortion)))
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        )
    s = lens.source
    return np.stack([s.fx * x + s.cx, s.fy * y + s.cy], axis=-1)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), TURN])
def test_maps_are_those_of_the_equations(name: str, turn: tuple[float, float, float]) -> None:
    distortion, fisheye = MODELS[name]
    lens = Lens(SOURCE, distortion, fisheye, turn)
    found = np.stack(lens.maps(CAMERA), axis=-1)
    np.testing.assert_allclose(found, expected(lens, CAMERA), atol=2e-5)


def test_a_pinhole_seen_by_itself_is_as_it_was() -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    maps = Lens(CAMERA).maps(CAMERA)
    assert np.array_equal(rectified(image, maps), image)
    assert seen_by_source(maps, 64, 48).all()


def test_beyond_the_border_the_border_is_repeated() -> None:
    """So a rim is no black edge to whoever looks at the image without its mask."""
    maps = Lens(CAMERA, (0.4, 0.0, 0.0, 0.0)).maps(CAMERA)
    assert not seen_by_source(maps, 64, 48).all()
    assert (rectified(np.full((48, 64, 3), 200, np.uint8), maps) == 200).all()


@pytest.mark.parametrize(
    ("distortion", "fisheye", "turn"),
    [
        ((-0.25, 0.0, 0.0, 0.0), False, np.sqrt(1 / 0.75)),  # where 1 - 3 * 0.25 r^2 = 0
        ((-0.2, 0.0, 0.0, 0.0), True, np.tan(np.sqrt(1 / 0.6))),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0), False, np.sqrt(2.0)),  # r / (1 + r^2 / 2)
        ((-0.05, 0.004, 0.0, 0.0), False, np.inf),
    ],
)
def test_what_lies_beyond_the_turn_of_a_distortion_is_not_seen(
    distortion: tuple[float, ...], fisheye: bool, turn: float
) -> None:
    """The polynomial leads back into the image there, and the image would be seen twice."""
    wide = PinholeCamera(200, 150, 25.0, 25.0, 99.5, 74.5)
    source = PinholeCamera(400, 300, 40.0, 40.0, 199.5, 149.5)
    lens = Lens(source, distortion, fisheye=fisheye)
    rays = wide.rays()
    radius = np.hypot(rays[..., 0], rays[..., 1])
    seen = seen_by_source(lens.maps(wide), source.width, source.height)
    near = radius < 0.99 * turn
    assert near.any()
    assert not seen[radius > 1.01 * turn].any()
    pixels = np.stack(lens.maps(wide), axis=-1)[near]
    inside = ((pixels >= 0) & (pixels <= [source.width - 1, source.height - 1])).all(axis=-1)
    assert inside.mean() > 0.3
    assert np.array_equal(seen[near], inside)


def test_what_lies_behind_a_fisheye_is_not_seen() -> None:
    """A camera turned by a radian sees more than 90 degrees off the axis of the lens."""
    source, turned = (
        PinholeCamera(424, 400, 143.0, 143.0, 211.5, 199.5),
        PinholeCamera(100, 100, 50, 50, 50, 50),
    )
    lens = Lens(source, (0.0,) * 4, True, (0.0, 1.0, 0.0))
    rays = turned.rays() @ lens.rotation().T
    across = np.hypot(rays[..., 0], rays[..., 1])
    angle = np.arctan2(across, rays[..., 2])
    true = 143.0 * angle[..., None] * rays[..., :2] / across[..., None] + [211.5, 199.5]
    maps = lens.maps(turned)
    seen = seen_by_source(maps, source.width, source.height)
    assert angle.max() > 1.7
    assert seen.sum() > 5000
    np.testing.assert_allclose(np.stack(maps, -1)[seen], true[seen], atol=1e-3)
