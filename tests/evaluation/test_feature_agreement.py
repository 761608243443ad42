"""The agreement of features sees wrong poses, favors no trajectory, and says when it knows nothing."""

import numpy as np
import pytest

from duagc.pipeline.evaluation.feature_agreement import (
    MIN_PAIRS,
    MatchedPair,
    feature_agreement,
    matched_pairs,
)
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.room import detailed, pose

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
TRUTH = np.array([pose(x=-0.4 + 0.1 * k, z=-0.9, yaw=0.3 - 0.05 * k) for k in range(6)])


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[np.ndarray]]:
    colors, depths = zip(*(detailed(T, CAMERA) for T in TRUTH), strict=True)
    return list(colors), list(depths)


@pytest.fixture(scope="module")
def pairs(views) -> list[MatchedPair]:
    return matched_pairs(*views, CAMERA)


def test_exact_poses_agree_and_wrong_ones_do_not(pairs) -> None:
    turned = TRUTH @ se3.exp(np.array([[0, 0, 0, 0, 0.02 * (k % 2), 0] for k in range(len(TRUTH))]))
    moved = se3.exp(np.array([3.0, -2.0, 1.0, 0.5, -0.4, 0.3])) @ TRUTH
    values = feature_agreement(pairs, CAMERA, {"true": TRUTH, "turned": turned, "moved": moved})
    assert len(pairs) >= MIN_PAIRS
    assert values["true"] < 0.5  # the positions of features
    assert values["moved"] == pytest.approx(values["true"], rel=1e-6)
    # every second view turned by 20 mrad, 5.2 px at the center: three of five pairs see it
    assert 4.5 < values["turned"] < 8


def test_matched_points_are_the_same_points(pairs) -> None:
    for pair in pairs:
        moved = se3.transform(se3.inverse(TRUTH[pair.a]) @ TRUTH[pair.b], pair.points_b)
        assert np.median(np.linalg.norm(moved - pair.points_a, axis=1)) < 0.01


def test_a_trajectory_does_not_change_the_numbers_of_the_others(pairs) -> None:
    away = TRUTH @ se3.exp(np.array([[0, 0, 0, 0, 2.5 * k, 0] for k in range(len(TRUTH))]))
    alone, together = (
        feature_agreement(pairs, CAMERA, paths) for paths in ({"true": TRUTH}, {"true": TRUTH, "away": away})
    )
    assert together["true"] == alone["true"]
    assert together["away"] > 100


def test_views_without_features_say_nothing(views) -> None:
    blank = [np.full_like(c, 128) for c in views[0]]
    pairs = matched_pairs(blank, views[1], CAMERA)
    assert pairs == []
    assert isinstance(feature_agreement(pairs, CAMERA, {"true": TRUTH})["true"], Absent)
