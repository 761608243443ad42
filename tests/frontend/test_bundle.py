"""Joint optimization of keyframes by their images, and loops: truth found, contradictions refused, bits repeated."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.frontend import KeyframeConfig, LoopConfig, RelocalizationConfig
from duagc.pipeline.frontend import bundle
from duagc.pipeline.frontend.bundle import Neighborhood, optimize, strayed
from duagc.pipeline.frontend.current_frame import features_of
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes, solve_pose_graph
from duagc.pipeline.frontend.loops import find_loops
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import (
    Level,
    Reference,
    RegistrationConfig,
    RgbdPyramid,
    place_recognition,
    register,
)
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.features import Features
from tests.fixtures.room import pose, render

CAMERA = PinholeCamera(320, 240, 220.0, 220.0, 159.5, 119.5)
CONFIG, REGISTRATION = KeyframeConfig(), RegistrationConfig()
STRIDES = (3, 2, 1)


def picture(T_world_camera: np.ndarray, noise: np.random.Generator | None = None) -> RgbdPyramid:
    """The room with cells of 12 cm of random brightness, which have features."""
    gray, depth = render(T_world_camera, camera=CAMERA, noise=noise, gray_sigma=0.01)
    exact = render(T_world_camera, camera=CAMERA)[1]
    points = se3.transform(T_world_camera, (CAMERA.rays() * exact[..., None]).reshape(-1, 3))
    i, j, k = np.floor(points / 0.12 + 0.03).astype(np.int64).T
    cells = np.random.default_rng(0).random(4096)[(i * 73856093 ^ j * 19349663 ^ k * 83492791) % 4096]
    gray = 0.5 * gray + 0.4 * cells.reshape(gray.shape).astype(np.float32)
    return RgbdPyramid.build(gray, depth, CAMERA)


@dataclass(frozen=True)
class View:
    reference: Reference
    coarsest: Level
    features: Features

    @staticmethod
    def of(pyramid: RgbdPyramid) -> "View":
        reference = Reference.from_pyramid(pyramid, STRIDES)
        return View(reference, pyramid.levels[-1], features_of(pyramid, RelocalizationConfig()))


class Walk:
    """Keyframes at known poses, with their images and the registrations of each to the one before."""

    def __init__(self, world: list[np.ndarray], noise: np.random.Generator | None = None) -> None:
        self.truth = np.array([se3.inverse(world[0]) @ T for T in world])
        self.pyramids = [picture(T, noise) for T in world]
        self.views = [View.of(p) for p in self.pyramids]
        self.pairs = []
        for k in range(1, len(world)):
            guess = se3.inverse(self.truth[k - 1]) @ self.truth[k]
            found = register(self.views[k - 1].reference, self.pyramids[k], guess)
            assert found.ok
            self.pairs.append(RelativePose(k - 1, k, found.T_reference_target, found.information))

    def images(self, index: int, levels: int) -> RgbdPyramid:
        return self.pyramids[index]

    def chained(self, pairs: list[RelativePose]) -> np.ndarray:
        T = [np.eye(4)]
        for pair in pairs:
            T.append(T[-1] @ pair.T_i_j)
        return np.array(T)

    def error_m(self, T: np.ndarray) -> float:
        return float(np.sqrt(np.mean(se3.distance(self.truth, T)[0] ** 2)))


@pytest.fixture(scope="module")
def noisy() -> Walk:
    """A sideways walk of which every view sees much of the others."""
    rng = np.random.default_rng(1)
    return Walk([pose(x=-0.5 + 0.12 * k, z=-0.9 + 0.03 * k, yaw=0.3 - 0.06 * k) for k in range(8)], rng)


@pytest.fixture(scope="module")
def good(noisy: Walk) -> tuple[OptimizedKeyframes, list[RelativePose]]:
    """What the optimization makes of the true poses."""
    return optimize(
        noisy.truth, noisy.views, noisy.images, noisy.pairs, config=CONFIG, registration=REGISTRATION
    )


def test_joint_optimization_is_better_than_the_registrations_alone(noisy: Walk) -> None:
    start = noisy.chained(noisy.pairs)
    before = solve_pose_graph(start, noisy.pairs, 3.0)
    after, factors = optimize(
        start, noisy.views, noisy.images, noisy.pairs, config=CONFIG, registration=REGISTRATION
    )
    assert len(factors) > 2 * len(noisy.pairs)
    assert noisy.error_m(after.T_map_keyframe) < 0.7 * noisy.error_m(before.T_map_keyframe)
    # more images, more information
    gained = after.relative_information(0, 7) - before.relative_information(0, 7)
    assert np.linalg.eigvalsh(gained)[0] > 0


def test_poor_start_ends_where_the_good_one_does(
    noisy: Walk, good: tuple[OptimizedKeyframes, list[RelativePose]]
) -> None:
    rng = np.random.default_rng(2)
    spoilt = [
        RelativePose(p.i, p.j, p.T_i_j @ se3.exp(0.005 * rng.standard_normal(6)), p.information)
        for p in noisy.pairs
    ]
    poor = optimize(
        noisy.chained(spoilt), noisy.views, noisy.images, spoilt, config=CONFIG, registration=REGISTRATION
    )[0]
    assert noisy.error_m(noisy.chained(spoilt)) > 0.007
    assert se3.distance(good[0].T_map_keyframe, poor.T_map_keyframe)[0].max() < 1e-3  # of 8 mm


def test_factors_say_what_the_optimization_found(good: tuple[OptimizedKeyframes, list[RelativePose]]) -> None:
    found, factors = good
    weighted = [
        RelativePose(f.i, f.j, f.T_i_j, w * f.information)
        for f, w in zip(factors, found.weights, strict=True)
    ]
    again = solve_pose_graph(found.T_map_keyframe, weighted, 1e9)
    np.testing.assert_allclose(again.T_map_keyframe, found.T_map_keyframe, atol=1e-7)


def test_keyframe_that_shows_nothing_keeps_what_tracking_said(noisy: Walk) -> None:
    dark = RgbdPyramid.build(np.zeros((240, 320), np.float32), np.zeros((240, 320), np.float32), CAMERA)
    views = [*noisy.views[:7], View.of(dark)]
    images = [*noisy.pyramids[:7], dark]
    found, factors = optimize(
        noisy.truth, views, lambda k, levels: images[k], noisy.pairs, config=CONFIG, registration=REGISTRATION
    )
    of_dark = [f for f in factors if 7 in (f.i, f.j)]
    assert of_dark == [noisy.pairs[-1]]
    moved = se3.inverse(found.T_map_keyframe[6]) @ found.T_map_keyframe[7]
    assert se3.distance(moved, noisy.pairs[-1].T_i_j)[0] < 1e-9


def test_equal_input_gives_equal_bits(
    noisy: Walk, good: tuple[OptimizedKeyframes, list[RelativePose]]
) -> None:
    a, b = (
        good[0],
        optimize(
            noisy.truth, noisy.views, noisy.images, noisy.pairs, config=CONFIG, registration=REGISTRATION
        )[0],
    )
    np.testing.assert_array_equal(a.T_map_keyframe, b.T_map_keyframe)
    np.testing.assert_array_equal(a.covariance([3, 5]), b.covariance([3, 5]))


@pytest.fixture(scope="module")
def circle() -> Walk:
    """Once around: the last view sees what the first did."""
    return Walk([pose(x=0.1, yaw=2 * np.pi * k / 16) for k in range(17)])


def drifted(circle: Walk) -> tuple[np.ndarray, list[RelativePose]]:
    """Tracking that turned and moved a little too far at every step: 30 degrees at the end."""
    step = se3.exp(np.array([0.025, 0.0, 0.0, 0.0, 0.033, 0.0]))
    wrong = [RelativePose(p.i, p.j, p.T_i_j @ step, np.diag([1e3] * 3 + [1e3] * 3)) for p in circle.pairs]
    return circle.chained(wrong), wrong


def test_loop_is_found_and_closes_the_drift(circle: Walk) -> None:
    start, wrong = drifted(circle)
    loops = find_loops(
        start,
        circle.views,
        circle.images,
        config=LoopConfig(),
        registration=REGISTRATION,
        seed=0,
        robot="alpha",
    )
    assert (0, 16) in [(p.i, p.j) for p in loops]
    for loop in loops:
        truth = se3.inverse(circle.truth[loop.i]) @ circle.truth[loop.j]
        assert se3.distance(truth, loop.T_i_j)[0] < 5e-3
    assert circle.error_m(start) > 0.07
    closed, _ = optimize(
        start, circle.views, circle.images, [*wrong, *loops], config=CONFIG, registration=REGISTRATION
    )
    # association is projective, rounds converge as ICP does: ten of them end at 6 mm, forty at 2
    assert circle.error_m(closed.T_map_keyframe) < 0.01 < 0.2 * circle.error_m(start)


def test_loops_are_looked_for_among_a_bounded_number(circle: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many keyframes there are, features are compared with those of so many only; the loop is among them."""
    rng = np.random.default_rng(0)
    none = Features(rng.integers(0, 120, (120, 128), dtype=np.uint8), np.ones((120, 3), np.float32))
    start, _ = drifted(circle)
    views = [circle.views[0], *[View(circle.views[1].reference, circle.views[1].coarsest, none)] * 40]
    views.append(circle.views[16])
    poses = np.concatenate([start[:1], np.repeat(start[1:2], 40, axis=0), start[16:]])
    images = {0: circle.pyramids[0], 41: circle.pyramids[16]}
    compared = []
    monkeypatch.setattr(place_recognition, "matches", lambda *a: compared.append(a) or matches(*a))
    config = LoopConfig(compared=3, min_matches=60)
    found = find_loops(
        poses, views, lambda k, _: images[k], config=config, registration=REGISTRATION, seed=0, robot="alpha"
    )
    assert [(p.i, p.j) for p in found] == [(0, 41)]
    assert 0 < len(compared) <= 3 * len(views)


def test_known_overlaps_and_foreign_places_are_no_loops(circle: Walk) -> None:
    loops = find_loops(
        circle.truth,
        circle.views,
        circle.images,
        config=LoopConfig(),
        registration=REGISTRATION,
        seed=0,
        robot="alpha",
    )
    assert loops == []
    # the other side of the room, said to be elsewhere: nothing there resembles it
    half = [0, 1, 2, 3, 8]
    views = [circle.views[k] for k in half]
    images = [circle.pyramids[k] for k in half]
    far = circle.truth[half]
    far[-1, :3, 3] += 5
    assert (
        find_loops(
            far,
            views,
            lambda k, levels: images[k],
            config=LoopConfig(),
            registration=REGISTRATION,
            seed=0,
            robot="alpha",
        )
        == []
    )


def test_overlapping_pairs_are_those_that_see_each_other(circle: Walk) -> None:
    config = KeyframeConfig(optimization_neighbors=3)
    pairs = Neighborhood(circle.views, config).pairs(circle.truth)
    assert (0, 16) in pairs
    assert (0, 8) not in pairs
    assert all(first < second for first, second in pairs)
    assert max(sum(second == k for _, second in pairs) for k in range(17)) <= 3


def test_work_per_keyframe_does_not_grow_with_the_path(noisy: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up and down the same room: what is counted is images read, overlaps computed and costs expanded."""
    counts = {"images": 0, "overlaps": 0, "costs": 0}

    def counted(name: str, function: Any) -> Any:
        def call(*arguments: Any, **keywords: Any) -> Any:
            counts[name] += 1
            return function(*arguments, **keywords)

        return call

    def work(length: int) -> dict[str, float]:
        there_and_back = [k if k < 8 else 14 - k for k in range(14)]
        order = [there_and_back[k % 14] for k in range(length)]
        steps = [se3.inverse(noisy.truth[a]) @ noisy.truth[b] for a, b in pairwise(order)]
        tracked = [RelativePose(k, k + 1, step, 1e4 * np.eye(6)) for k, step in enumerate(steps)]
        counts.update(images=0, overlaps=0, costs=0)
        optimize(
            noisy.truth[order],
            [noisy.views[k] for k in order],
            counted("images", lambda k, levels: noisy.pyramids[order[k]]),
            tracked,
            config=KeyframeConfig(optimization_candidates=8, optimization_neighbors=3, optimization_rounds=3),
            registration=REGISTRATION,
        )
        return {name: count / length for name, count in counts.items()}

    monkeypatch.setattr(bundle, "linearize", counted("costs", bundle.linearize))
    monkeypatch.setattr(bundle, "overlap", counted("overlaps", bundle.overlap))
    short, long = work(16), work(32)
    assert long["overlaps"] > 8  # the limit is reached: many more keyframes see the place
    for name in counts:
        assert long[name] < 1.25 * short[name] + 1, name


def test_a_pair_that_did_not_move_is_not_looked_at_again(noisy: Walk) -> None:
    read: list[int] = []

    def images(index: int, levels: int) -> RgbdPyramid:
        read.append(index)
        return noisy.pyramids[index]

    rounds = []
    for limit in (3, 30):
        read.clear()
        config = KeyframeConfig(optimization_rounds=limit)
        optimize(noisy.truth, noisy.views, images, noisy.pairs, config=config, registration=REGISTRATION)
        rounds.append(len(read) / len(noisy.views))
    assert rounds[0] <= 3
    assert rounds[1] < 30


def test_a_pair_that_has_strayed_keeps_to_tracking_and_a_loop_closure_does_not(
    noisy: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, *others = noisy.pairs
    closure = others.pop()

    def factors() -> list[RelativePose]:
        return optimize(
            noisy.chained(noisy.pairs),
            noisy.views,
            noisy.images,
            [first, *others],
            closures=[closure],
            config=CONFIG,
            registration=REGISTRATION,
        )[1]

    assert not any(factor is first for factor in factors())
    monkeypatch.setattr(bundle, "strayed", lambda found, tracked: tracked is first or tracked is closure)
    held = factors()
    assert any(factor is first for factor in held)
    assert not any(factor is closure for factor in held)
    assert len({(factor.i, factor.j) for factor in held}) == len(held)


@pytest.mark.parametrize(
    ("away_m", "sigma_m", "far"),
    [
        (0.3, 0.2, True),  # 30 sigma of tracking, 1.5 of the images where the pair is now
        (0.3, 0.01, False),  # the images say so
        (0.1, 0.2, False),  # tracking may be as wrong
    ],
)
def test_a_cost_far_from_tracking_that_does_not_resist_has_strayed(away_m, sigma_m, far):
    def pair(T: np.ndarray, sigma: float) -> RelativePose:
        return RelativePose(0, 1, T, np.diag([sigma**-2] * 3 + [1e6] * 3))

    tracked = pair(se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3])), 0.01)
    found = pair(tracked.T_i_j @ se3.exp(np.array([away_m, 0, 0, 0, 0, 0])), sigma_m)
    assert strayed(found, tracked) == far
