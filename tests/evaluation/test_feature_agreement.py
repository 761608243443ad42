"""The agreement of features sees wrong poses, favors no trajectory, and says when it knows nothing."""

import numpy as np
import pytest

from duagc.pipeline.evaluation.feature_agreement import MIN_PAIRS, feature_agreement
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.room import pose, render, texture

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
TRUTH = np.array([pose(x=-0.4 + 0.1 * k, z=-0.9, yaw=0.3 - 0.05 * k) for k in range(6)])


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Color and depth of the room with a texture fine enough for features."""
    colors, depths = [], []
    for T in TRUTH:
        depth = render(T, camera=CAMERA)[1]
        points = se3.transform(T, (CAMERA.rays() * depth[..., None]).reshape(-1, 3).astype(float))
        gray = np.clip(texture(4 * points, 3), 0, 1).reshape(depth.shape)
        colors.append(np.repeat(np.rint(255 * gray).astype(np.uint8)[..., None], 3, axis=-1))
        depths.append(depth)
    return colors, depths


def test_exact_poses_agree_and_wrong_ones_do_not(views) -> None:
    turned = TRUTH @ se3.exp(np.array([[0, 0, 0, 0, 0.02 * (k % 2), 0] for k in range(len(TRUTH))]))
    moved = se3.exp(np.array([3.0, -2.0, 1.0, 0.5, -0.4, 0.3])) @ TRUTH
    pairs, values = feature_agreement(*views, CAMERA, {"true": TRUTH, "turned": turned, "moved": moved})
    assert pairs >= MIN_PAIRS
    assert values["true"] < 0.5  # the positions of features
    assert values["moved"] == pytest.approx(values["true"], rel=1e-6)
    # every second view turned by 20 mrad, 5.2 px at the center: three of five pairs see it
    assert 4.5 < values["turned"] < 8


def test_pairs_do_not_depend_on_the_poses(views) -> None:
    """A trajectory that looks away does not change the numbers of the others."""
    away = TRUTH @ se3.exp(np.array([[0, 0, 0, 0, 2.5 * k, 0] for k in range(len(TRUTH))]))
    alone, together = (
        feature_agreement(*views, CAMERA, paths) for paths in ({"true": TRUTH}, {"true": TRUTH, "away": away})
    )
    assert together[0] == alone[0]
    assert together[1]["true"] == alone[1]["true"]
    assert together[1]["away"] > 100


def test_views_without_features_say_nothing(views) -> None:
    blank = [np.full_like(c, 128) for c in views[0]]
    pairs, values = feature_agreement(blank, views[1], CAMERA, {"true": TRUTH})
    assert pairs == 0
    assert isinstance(values["true"], Absent)
