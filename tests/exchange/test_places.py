"""Recognizing places and verifying closures on rendered views of a known room."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.exchange import (
    ExchangeConfig,
    PeerRegistrationConfig,
    PlacesConfig,
    VerificationConfig,
)
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.exchange import keyframe_database, place_recognition
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase
from duagc.pipeline.exchange.place_recognition import Candidate, Planner
from duagc.pipeline.exchange.verification import Verdict, Verified, verify, within_view
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import KeyframeSample
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Reference, RgbdPyramid, descriptors, features
from duagc.pipeline.runs.keyframe_images import Images
from tests.exchange.conftest import CAMERA, path, view


@pytest.fixture(scope="module")
def robots(make_robot: Any) -> dict[str, tuple[KeyframeDatabase, np.ndarray]]:
    out = {}
    for name, turn in (("alpha", 0.0), ("bravo", 0.6)):
        data, truth = make_robot(name, turn, keyframes=3, gaussians=10)
        out[name] = (KeyframeDatabase(data, ExchangeConfig()), truth)
    return out


def test_own_depth_is_read_where_it_is_asked_first(
    robots: dict[str, tuple[KeyframeDatabase, np.ndarray]],
) -> None:
    """Also where Python leaves out what is only asserted (`python -O`)."""
    (known, _), (peer, _) = robots["alpha"], robots["bravo"]
    module = {"__name__": keyframe_database.__name__}
    exec(compile(Path(keyframe_database.__file__).read_text(), "", "exec", optimize=1), module)
    samples = [peer.sample(0).features.points]
    poses = known.data.T_map_keyframe[:1]
    asked_first = module["KeyframeDatabase"](known.data, ExchangeConfig()).agreement(samples, poses)
    assert len(known.features) == 3
    assert asked_first == known.agreement(samples, poses) > 0


def test_matching_bytes_is_exact() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (50, 128)).astype(np.uint8) for _ in range(2))
    exact = ((a[:, None].astype(np.int64) - b.astype(np.int64)) ** 2).sum(axis=-1)
    assert np.array_equal(descriptors.squared_distances(a, b), exact)


def test_a_descriptor_matches_itself_only() -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (40, 128)).astype(np.uint8)
    noisy = np.clip(a[:20].astype(int) + rng.integers(-3, 4, (20, 128)), 0, 255).astype(np.uint8)
    theirs = np.concatenate([noisy, rng.integers(0, 256, (20, 128)).astype(np.uint8)])
    assert np.array_equal(descriptors.matches(a, theirs, 0.8), np.stack([np.arange(20)] * 2, axis=1))


def verified(candidate, database, sample, config=None) -> Verified:
    """What becomes of a candidate between a keyframe of a database and a neighbor's sample."""
    own = candidate.own_keyframe
    return verify(
        candidate,
        database.features[own],
        database.pyramid(own),
        sample,
        config=config or VerificationConfig(),
        rng=random_streams.generator(0, "test"),
    )


def test_a_closure_is_as_good_as_its_information_says(robots: dict) -> None:
    (alpha, truth_a), (bravo, truth_b) = robots["alpha"], robots["bravo"]
    sample = loop_closing_wire.read_sample(loop_closing_wire.write_sample(bravo.sample(0)), 3)
    result = verified(Candidate(2, 0, 0), alpha, sample)
    assert result.verdict is Verdict.KEPT
    assert result.closure is not None
    T_true = se3.inverse(truth_a[2]) @ truth_b[0]
    moved_m, moved_rad = se3.distance(result.closure.T_own_peer, T_true)
    assert moved_m < 0.003
    assert moved_rad < 0.002
    assert np.linalg.eigvalsh(result.closure.information)[0] > 1e4  # better than 1 cm and 10 mrad everywhere


def test_loop_closures_can_all_be_as_certain(robots: dict) -> None:
    (alpha, _), (bravo, _) = robots["alpha"], robots["bravo"]
    sample = loop_closing_wire.read_sample(loop_closing_wire.write_sample(bravo.sample(0)), 3)
    measured = verified(Candidate(2, 0, 0), alpha, sample).closure
    config = VerificationConfig(certainty="alike", alike_sigma_m=0.01, alike_sigma_rad=0.02)
    alike = verified(Candidate(2, 0, 0), alpha, sample, config).closure
    assert measured is not None
    assert alike is not None
    np.testing.assert_array_equal(alike.T_own_peer, measured.T_own_peer)
    np.testing.assert_allclose(alike.information, np.diag([1e4] * 3 + [2500.0] * 3))


def test_a_darker_camera_finds_the_same_place(robots: dict) -> None:
    (alpha, truth_a), (bravo, truth_b) = robots["alpha"], robots["bravo"]

    def darker(robot: KeyframeDatabase) -> KeyframeDatabase:
        def dark(keyframe: int) -> Images:
            color, *depth = robot.data.images(keyframe)
            return Images(np.rint(0.33 * color + 8).astype(np.uint8), *depth)

        return KeyframeDatabase(replace(robot.data, images=dark), ExchangeConfig())

    def sent(robot: KeyframeDatabase) -> KeyframeSample:
        return loop_closing_wire.read_sample(loop_closing_wire.write_sample(robot.sample(0)), 3)

    pairs = [(darker(alpha), sent(bravo)), (alpha, sent(darker(bravo)))]
    for own, sample in pairs:
        result = verified(Candidate(2, 0, 0), own, sample)
        assert result.closure is not None
        moved_m, moved_rad = se3.distance(result.closure.T_own_peer, se3.inverse(truth_a[2]) @ truth_b[0])
        assert moved_m < 0.003
        assert moved_rad < 0.002
    alike = VerificationConfig(registration=PeerRegistrationConfig(max_gain=2.0))  # as within one robot
    verdicts = [verified(Candidate(2, 0, 0), *pair, alike).verdict for pair in pairs]
    # light may be less where textures are the same, but not more
    assert verdicts == [Verdict.KEPT, Verdict.NOT_REGISTERED]


def test_a_view_that_shows_little_of_the_other_is_enough(robots: dict) -> None:
    """Within a robot more is asked for: there is no lack of better pairs."""
    (alpha, truth_a), (bravo, truth_b) = robots["alpha"], robots["bravo"]
    sample, pair = loop_closing_wire.read_sample(loop_closing_wire.write_sample(bravo.sample(2)), 3), (1, 2)
    result = verified(Candidate(*pair, 0), alpha, sample)
    assert result.verdict is Verdict.KEPT
    assert result.closure is not None
    moved_m, moved_rad = se3.distance(result.closure.T_own_peer, se3.inverse(truth_a[1]) @ truth_b[2])
    assert moved_m < 0.003
    assert moved_rad < 0.002
    within = RegistrationConfig().min_overlap
    strict = VerificationConfig(registration=PeerRegistrationConfig(min_overlap=within), min_overlap=within)
    refused = verified(Candidate(*pair, 0), alpha, sample, strict)
    assert refused.verdict is Verdict.NOT_REGISTERED
    assert "low_overlap" in refused.detail


def test_overlap_is_of_what_a_camera_can_see_at_all() -> None:
    config, narrow = VerificationConfig(), replace(CAMERA, fx=2 * CAMERA.fx, fy=2.5 * CAMERA.fy)
    assert within_view(config, CAMERA, CAMERA) is config
    assert within_view(config, CAMERA, narrow) is config
    within = within_view(config, narrow, CAMERA)
    assert within.min_overlap == pytest.approx(config.min_overlap / 5)
    assert within.registration.min_overlap == pytest.approx(config.registration.min_overlap / 5)


@pytest.mark.parametrize("own_is_narrow", [True, False])
def test_a_narrow_camera_and_a_wide_one_find_each_other(own_is_narrow: bool) -> None:
    """The narrow one sees a tenth of what the wide one sees, and all of that is in the wide one's view."""
    narrow = replace(CAMERA, fx=3.2 * CAMERA.fx, fy=3.2 * CAMERA.fy)
    cameras, T = (narrow, CAMERA) if own_is_narrow else (CAMERA, narrow), path(0.0, 2)
    seen = [view(pose, camera) for pose, camera in zip([T[0], turned(T[0])], cameras, strict=True)]
    own, theirs = (
        features.extract(*images, camera, 400) for images, camera in zip(seen, cameras, strict=True)
    )
    pyramid, other = (
        RgbdPyramid.build(*images, camera) for images, camera in zip(seen, cameras, strict=True)
    )
    sample = KeyframeSample(0, theirs, Reference.sample(other, 2000))
    rng = random_streams.generator(0, "test")
    config = within_view(VerificationConfig(), *cameras)
    result = verify(Candidate(0, 0, 20), own, pyramid, sample, config=config, rng=rng)
    assert result.closure is not None, (result.verdict, result.detail)
    moved_m, moved_rad = se3.distance(result.closure.T_own_peer, se3.inverse(T[0]) @ turned(T[0]))
    assert moved_m < 0.02
    assert moved_rad < 0.01


def turned(T_world_camera: np.ndarray) -> np.ndarray:
    """A pose a little to the side, which looks a little elsewhere."""
    return T_world_camera @ se3.exp(np.array([0.05, 0.03, 0.0, 0.02, 0.03, 0.05]))


def test_different_places_are_refused(robots: dict, make_robot: Any) -> None:
    alpha, _ = robots["alpha"]
    far, _ = make_robot("charlie", np.pi, keyframes=1, gaussians=10)
    sample = KeyframeDatabase(far, ExchangeConfig()).sample(0)
    result = verified(Candidate(0, 0, 0), alpha, sample)
    assert result.verdict in (Verdict.FEW_MATCHES, Verdict.FEW_INLIERS)
    assert result.closure is None
    assert "needed" in result.detail


DRIFT = np.stack([np.arange(40) * 0.003**2, np.arange(40) * 0.001**2], axis=1)


def planner(candidates: list[Candidate], **config: Any) -> Planner:
    return Planner(
        candidates, PlacesConfig(**config), drift_own=DRIFT, drift_peer=DRIFT, closures=LoopClosureConfig()
    )


def test_every_pair_of_keyframes_is_scored_or_has_a_word_said_about_it(robots: dict) -> None:
    (alpha, _), (bravo, _) = robots["alpha"], robots["bravo"]
    peer = [f.descriptors[:80] for f in bravo.features]
    found, unlike = place_recognition.scored(alpha.features, peer, 0.8, 8)
    assert found
    assert [c.score for c in found] == sorted((c.score for c in found), reverse=True)
    none, unlike = place_recognition.scored(alpha.features, peer, 0.8, 1000)
    assert none == []
    assert [c.peer_keyframe for c in unlike] == [0, 1, 2]


def test_the_plan_keeps_to_the_budget_and_says_why_not_more() -> None:
    candidates = [Candidate(i, j, 20) for j in range(9) for i in range(5)]
    plan = planner(candidates, max_requested_keyframes=4, keyframes_per_request=3, worth_nats=0.0)
    first, second = plan.next(), plan.next()
    assert [len({c.peer_keyframe for c in batch}) for batch in (first, second)] == [3, 1]
    assert len(first) == 9  # three of each keyframe
    assert plan.next() == []
    left = plan.not_requested()
    assert {c for c, _ in left} | set(first) | set(second) == set(candidates)
    assert all(reason for _, reason in left)
    assert any("budget of 4" in reason for _, reason in left)


def test_places_far_apart_are_worth_more_than_more_of_one_place() -> None:
    """Two places, many keyframes at the first: after one look there the other place comes next."""
    near, far = [Candidate(i, i, 30) for i in range(4)], [Candidate(39, 39, 12)]
    plan = planner([*near, *far], keyframes_per_request=1)
    first = plan.next()[0]
    plan.take(first, closure=True)
    assert first in near
    assert plan.worth(39, [(first, 1.0), (near[1], 1.0)]) > plan.worth(2, [(first, 1.0), (near[1], 1.0)])


def test_strangers_try_on_and_those_who_met_stop() -> None:
    candidates = [Candidate(k, k, 14) for k in range(20)]
    refused, kept = (planner(candidates, keyframes_per_request=1, worth_nats=1.0) for _ in range(2))
    for plan, closure in ((refused, False), (kept, True)):
        while batch := plan.next():
            for c in batch:
                plan.take(c, closure)
    assert len(refused.requested) == 20
    assert len(kept.requested) < 15
    assert all("nats, 1 needed" in reason for _, reason in kept.not_requested())


def test_information_of_the_inverse_motion() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    information, T = root @ root.T, se3.exp(rng.normal(size=6))
    xi = 1e-6 * rng.normal(size=6)
    eta = se3.log(T @ se3.inverse(T @ se3.exp(xi)))  # T^-1 exp(eta) = (T exp(xi))^-1
    assert eta @ se3.inverse_information(T, information) @ eta == pytest.approx(
        xi @ information @ xi, rel=1e-4
    )
