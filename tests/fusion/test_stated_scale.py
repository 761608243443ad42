"""Whether peers' Gaussians lie as far from what own depth images show as their information states."""

from statistics import NormalDist

import numpy as np
import pytest

from duagc.pipeline.config.fusion import StatedScaleConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.stated_scale import stated_scale
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.surface_distance import DepthView
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import MEAN_INFORMATION, pack_symmetric, theta_of
from tests.fixtures.gaussian_worlds import CAMERA

WALL_M, STATED_M = 2.0, 0.01
CONFIG = StatedScaleConfig()
T_MAP_CAMERAS = [se3.exp(np.array([0.05 * k, 0.0, 0.0, 0.0, 0.02 * k, 0.0])) for k in range(4)]


def of_wall(offset_m: float = 0.0) -> list[DepthView]:
    """Views that measure a wall 2 m in front of the origin, or so much farther."""
    views = []
    for T in T_MAP_CAMERAS:
        rays = CAMERA.rays() @ T[:3, :3].T
        z = (WALL_M + offset_m - T[2, 3]) / rays[..., 2]  # rays of depth one
        views.append(DepthView(z.astype(np.float32), T))
    return views


def peer(error_m: np.ndarray) -> Evidence:
    """Discs on the wall, so far from it along its normal, which state 10 mm there and 1 mm along it."""
    n = len(error_m)
    x = np.random.default_rng(3).uniform([-0.5, -0.3], [0.5, 0.3], (n, 2))
    gaussians = Gaussians(
        np.arange(n), np.zeros(n), np.column_stack([x, WALL_M + error_m]), np.tile([1.0, 0, 0, 0], (n, 1)),
        np.log(np.tile([0.03, 0.03, 0.001], (n, 1))), np.full((n, 3), 0.5), np.zeros(n),
    )  # fmt: skip
    information = np.ones((n, 31))
    information[:, MEAN_INFORMATION] = pack_symmetric(np.diag([1e6, 1e6, STATED_M**-2])[None])
    return Evidence("bravo", gaussians.ids, gaussians.anchors, theta_of(gaussians), information)


def errors(scale: float, n: int = 4000) -> np.ndarray:
    """Normal errors, so many times as large as stated."""
    return scale * STATED_M * np.random.default_rng(5).standard_normal(n)


@pytest.mark.parametrize("scale", [1.2, 2.0, 3.0])
def test_the_factor_is_that_of_the_errors(scale):
    assert stated_scale([peer(errors(scale))], CAMERA, of_wall(), CONFIG) == pytest.approx(scale, rel=0.05)


def test_smaller_errors_than_stated_change_nothing():
    assert stated_scale([peer(errors(0.4))], CAMERA, of_wall(), CONFIG) == 1.0


def test_what_all_views_of_the_peer_share_counts():
    """An error of 20 mm that the peer's own images cannot show; own ones do."""
    found = stated_scale([peer(errors(0.3))], CAMERA, of_wall(0.02), CONFIG)
    assert 1.3 < found < 2.0


def test_a_few_of_other_surfaces_hardly_change_it():
    other = errors(1.0)
    other[::25] = 0.09  # nine times what is stated
    expected = NormalDist().inv_cdf(0.5 * (1 + 0.9 / 0.96)) / NormalDist().inv_cdf(0.95)  # 1.13
    assert stated_scale([peer(other)], CAMERA, of_wall(), CONFIG) == pytest.approx(expected, rel=0.05)
    all_of_them = CONFIG.model_copy(update={"share": 0.97})
    assert stated_scale([peer(other)], CAMERA, of_wall(), all_of_them) > 3.0


def test_nothing_is_known_of_what_few_views_or_few_gaussians_show():
    many, few = peer(errors(3.0)), peer(errors(3.0, CONFIG.min_gaussians - 1))
    assert stated_scale([many], CAMERA, of_wall()[:2], CONFIG) == 1.0
    assert stated_scale([few], CAMERA, of_wall(), CONFIG) == 1.0
    assert stated_scale([few, few], CAMERA, of_wall(), CONFIG) == 1.0
    assert stated_scale([few, many], CAMERA, of_wall(), CONFIG) > 2.0
    assert stated_scale([], CAMERA, of_wall(), CONFIG) == 1.0
    assert stated_scale([many], CAMERA, of_wall(5.0), CONFIG) == 1.0  # no surface within the gate


def certain(whole: Evidence, times: float) -> Evidence:
    """The same with so many times the information."""
    return Evidence("liar", whole.ids, whole.anchors, whole.theta, times * whole.information)


def test_a_peer_that_claims_too_much_makes_no_map_uncertain():
    honest, liar = peer(errors(1.3)), certain(peer(errors(1.0)), 1e8)
    assert stated_scale([honest, liar], CAMERA, of_wall(), CONFIG) == pytest.approx(1.3, rel=0.05)
    assert stated_scale([liar, honest, honest], CAMERA, of_wall(), CONFIG) == pytest.approx(1.3, rel=0.05)
    assert stated_scale([liar], CAMERA, of_wall(), CONFIG) == CONFIG.most


def test_gaussians_that_state_nothing_do_not_count():
    whole = peer(errors(2.0))
    information = whole.information.copy()
    information[::2] = 0.0
    half = Evidence("bravo", whole.ids, whole.anchors, whole.theta, information)
    assert stated_scale([half], CAMERA, of_wall(), CONFIG) == pytest.approx(2.0, rel=0.05)


def test_as_many_views_as_are_asked_for_are_enough():
    asked = len(T_MAP_CAMERAS)
    for least, counts in ((asked, True), (asked + 1, False)):
        config = CONFIG.model_copy(update={"min_views": least})
        found = stated_scale([peer(errors(2.0))], CAMERA, of_wall(), config)
        assert found == (pytest.approx(2.0, rel=0.05) if counts else 1.0)
