"""Depth as a camera next to the depth camera would have measured it."""

import numpy as np
import pytest

from duagc.converters.datasets.seven_scenes import Options
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.drawn_depth import displaced_depth


def slanted(camera: PinholeCamera, slope: float) -> np.ndarray:
    """Depth of the plane z = 1.2 + slope x."""
    return 1.2 / (1 - slope * camera.rays()[:, :, 0])


@pytest.mark.parametrize("slope", [0.0, 0.8, -0.8, 2.0])
def test_planes_stay_planes(slope: float) -> None:
    """No moiré, no holes: inside the common view a plane comes out exact and complete."""
    options = Options()
    depth = slanted(options.depth_camera(), slope)
    depth[(depth < 0.3) | (depth > 4)] = 0
    out = displaced_depth(depth, options.depth_camera(), options.color_camera(), options.baseline_m)
    # the plane in the color camera, which sits baseline_m further along x
    rays = options.color_camera().rays()[:, :, 0]
    exact = (1.2 + slope * options.baseline_m) / (1 - slope * rays)
    seen = out > 0
    interior = seen.copy()
    interior[:, 1:-1] &= seen[:, :-2] & seen[:, 2:]  # at a border the last pixel covers half its width
    np.testing.assert_allclose(out[interior], exact[interior], rtol=1e-9)
    inside = (exact > 0.35) & (exact < 3.8)
    inside[:50] = inside[-50:] = False
    inside[:, :70] = inside[:, -70:] = False
    assert seen[inside].all()


def test_the_nearest_surface_wins_and_edges_stay_sharp() -> None:
    options = Options()
    depth = np.full((480, 640), 2.0)
    depth[:, 300:340] = 0.8
    out = displaced_depth(depth, options.depth_camera(), options.color_camera(), options.baseline_m)
    values = np.unique(np.round(out, 9))
    assert values.tolist() == [0.0, 0.8, 2.0], "nothing is interpolated across the edge"
    columns = np.nonzero(out[240] == np.min(out[240][out[240] > 0]))[0]
    left = 320 + 525 * ((299.5 - 320) / 585 - 0.025 / 0.8)
    right = 320 + 525 * ((339.5 - 320) / 585 - 0.025 / 0.8)
    assert abs(columns[0] - left) <= 1
    assert abs(columns[-1] - right) <= 1
    shadow = np.nonzero(out[240, columns[-1] :] == 2.0)[0][0]  # what the bar hides from the depth camera
    assert shadow == pytest.approx(525 * 0.025 * (1 / 0.8 - 1 / 2.0), abs=2)


def test_no_depth_stays_none() -> None:
    options = Options()
    camera = options.depth_camera()
    assert not displaced_depth(np.zeros((480, 640)), camera, options.color_camera(), options.baseline_m).any()
    depth = slanted(options.depth_camera(), 0.5)
    depth[100:110, 50:300] = 0
    np.testing.assert_allclose(
        displaced_depth(depth, camera, camera, 0.0), depth, rtol=1e-12
    )  # the identity keeps every hole
