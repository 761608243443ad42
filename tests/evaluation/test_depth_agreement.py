"""The agreement of depth images sees wrong poses, bears hidden surfaces, and says when it knows nothing."""

import numpy as np
import pytest

from duagc.pipeline.evaluation.depth_agreement import MIN_PAIRS, SAME_SURFACE, _compare, depth_agreement
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from tests.fixtures.room import CAMERA, pose, render

TRUTH = np.array([pose(x=-0.4 + 0.1 * k, z=-0.9, yaw=0.3 - 0.05 * k) for k in range(7)])


@pytest.fixture(scope="module")
def depths() -> list[np.ndarray]:
    return [render(T)[1] for T in TRUTH]


def test_exact_poses_agree_and_wrong_ones_do_not(depths) -> None:
    rng = np.random.default_rng(0)
    wrong = TRUTH @ se3.exp(0.01 * rng.standard_normal((len(TRUTH), 6)))
    pairs, values = depth_agreement(depths, CAMERA, {"true": TRUTH, "wrong": wrong})
    assert pairs >= MIN_PAIRS
    assert values["true"] < 1e-5  # inverse depth is interpolated exactly on planes; a box hides some of it
    assert 3e-3 < values["wrong"] < 5e-2


def test_frame_of_the_poses_does_not_matter(depths) -> None:
    moved = se3.exp(np.array([3.0, -2.0, 1.0, 0.5, -0.4, 0.3])) @ TRUTH
    noisy = [
        d + 0.01 * np.random.default_rng(k).standard_normal(d.shape).astype(np.float32)
        for k, d in enumerate(depths)
    ]
    _, values = depth_agreement(noisy, CAMERA, {"a": TRUTH, "b": moved})
    assert values["b"] == pytest.approx(values["a"], rel=1e-6)
    # the difference of two depths with 1 cm of noise, one of them interpolated: 0.6745 x (1.2 to 1.4) cm
    assert 7.5e-3 < values["a"] < 1e-2


def test_the_same_pairs_judge_all(depths) -> None:
    """A trajectory under which the views see nothing of each other leaves no pair for anybody."""
    apart = TRUTH.copy()
    apart[:, 0, 3] += 10 * np.arange(len(TRUTH))
    pairs, values = depth_agreement(depths, CAMERA, {"true": TRUTH, "apart": apart})
    assert pairs == 0
    assert all(isinstance(v, Absent) for v in values.values())


def test_unknown_depth_is_not_compared(depths) -> None:
    holes = [d.copy() for d in depths]
    for d in holes:
        d[30:42, 40:60] = 0
    pairs, values = depth_agreement(holes, CAMERA, {"true": TRUTH})
    assert pairs >= MIN_PAIRS
    assert values["true"] < 1e-5
    _, values = depth_agreement([np.zeros_like(d) for d in depths], CAMERA, {"true": TRUTH})
    assert isinstance(values["true"], Absent)


def test_points_are_compared_wherever_four_pixels_are_around_them() -> None:
    """A plane whose inverse depth is linear in the image, and points on it, a little nearer to the camera."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    inverse = 0.3 + 0.001 * u + 0.0005 * v
    rng = np.random.default_rng(2)
    at = rng.uniform([-2, -2], [CAMERA.width + 1, CAMERA.height + 1], (4000, 2))
    z = 1 / (0.3 + 0.001 * at[:, 0] + 0.0005 * at[:, 1])
    rays = (at - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points = np.column_stack([rays, np.ones(4000)]) * (z - 0.01)[:, None]
    found = _compare(inverse, points, CAMERA)
    whole = (at >= 0).all(axis=1) & (at[:, 0] < CAMERA.width - 1) & (at[:, 1] < CAMERA.height - 1)
    assert found is not None
    assert len(found) == pytest.approx(np.sum(whole), abs=2)
    np.testing.assert_allclose(found, 0.01, atol=1e-9)


def test_depths_are_compared_to_the_bit_as_they_are_defined() -> None:
    """Random inverse depth with holes; some points lie outside, some behind."""
    rng = np.random.default_rng(0)
    inverse = 0.5 + 0.004 * rng.standard_normal((CAMERA.height, CAMERA.width))
    inverse[rng.random(inverse.shape) < 0.1] = np.nan
    points = rng.standard_normal((4000, 3)) * [0.8, 0.6, 0.3] + [0.0, 0.0, 1.5]
    points[::50, 2] *= -1
    found = _compare(inverse, points, CAMERA)
    expected = []
    for x, y, z in points:
        if z <= 0.05:
            continue
        u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
        if not (0 <= u < CAMERA.width - 1 and 0 <= v < CAMERA.height - 1):
            continue
        i, j = int(v), int(u)
        a, b = u - j, v - i
        corners = inverse[i, j], inverse[i, j + 1], inverse[i + 1, j], inverse[i + 1, j + 1]
        if max(corners) - min(corners) < SAME_SURFACE * corners[0] and np.isfinite(corners).all():
            weights = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
            total = weights[0] * corners[0] + weights[1] * corners[1] + weights[2] * corners[2]
            expected.append(1 / (total + weights[3] * corners[3]) - z)
    assert found is not None
    assert found.tolist() == expected
