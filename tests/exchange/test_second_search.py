"""The second search: where one loop closure says that views overlap, further ones are found, within the budget."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.exchange import ExchangeConfig, PlacesConfig
from duagc.pipeline.exchange import loop_closure_verifier
from duagc.pipeline.exchange.detected_loop_closures import Provider
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase
from duagc.pipeline.exchange.loop_closure_verifier import Verifier
from duagc.pipeline.exchange.place_recognition import Candidate, Planner
from duagc.pipeline.exchange.verification import Verdict, Verified, verify
from duagc.pipeline.exchange.view_overlap import ALONG_PATH, overlaps, shared_view
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.network.packets import Kind
from duagc.pipeline.posegraph.loop_closures import KeyframePoses
from duagc.pipeline.posegraph.relative_poses import LoopClosure

MIN_SCORE = 26
CAMERA = PinholeCamera(160, 120, 100.0, 100.0, 79.5, 59.5)
WALL = np.full((30, 40), 2.0, dtype=np.float32)  # every fourth pixel of a wall at 2 m


def shared(*motion: float, peer_camera: PinholeCamera = CAMERA) -> float:
    return float(shared_view(WALL, CAMERA, se3.exp(np.array(motion))[None], peer_camera)[0])


def test_views_share_what_both_see_from_similar_directions() -> None:
    assert shared(0, 0, 0, 0, 0, 0) == 1.0
    assert shared(1.6, 0, 0, 0, 0, 0) == pytest.approx(0.5, abs=0.1)  # half of the 3.2 m that it sees
    assert shared(0, 0, 1.4, 0, 0, 0) == 0.0  # less than half as far away
    assert shared(0, 0, 0.8, 0, 0, 0) > 0.9  # it sees a third of the points, which fill its image
    assert shared(0, 0, 0, 0, 2.0, 0) == 0.0
    assert shared(2.4, 0, 0.3, 0, -1.0, 0) < 0.25  # in its image, but looked at from the side
    assert float(shared_view(0 * WALL, CAMERA, np.eye(4)[None], CAMERA)[0]) == 0.0


def test_views_of_other_cameras_share_what_these_see() -> None:
    wide, narrow = (
        replace(CAMERA, fx=40.0, fy=40.0),
        replace(CAMERA, width=640, height=480, fx=1000.0, fy=1000.0),
    )
    narrow = replace(narrow, cx=319.5, cy=239.5)
    assert shared(1.6, 0, 0, 0, 0, 0, peer_camera=wide) == 1.0  # it sees 8 m of the wall
    assert shared(0, 0, 0, 0, 0, 0, peer_camera=narrow) == 1.0  # what it sees is seen by the own camera too
    assert shared(1.4, 0, 0, 0, 0, 0, peer_camera=narrow) == pytest.approx(0.66, abs=0.1)
    assert shared(0, 0, 0, 0, 1.05, 0, peer_camera=narrow) == 0.0  # next to what the own camera sees
    assert shared(0, 0, 0, 0, 1.05, 0) > 0.1


def test_overlaps_are_predicted_along_both_paths_by_the_nearest_closure() -> None:
    n = 40
    path = np.tile(np.eye(4), (n, 1, 1))
    path[:, 0, 3] = 0.4 * np.arange(n)
    drift = np.stack([np.arange(n) * 1e-4] * 2, axis=1)
    own, peer = KeyframePoses(path, drift), KeyframePoses(path.copy(), drift)
    true, false = LoopClosure(5, 5, np.eye(4), np.eye(6)), LoopClosure(30, 5, np.eye(4), np.eye(6))
    found = overlaps([true, false], [WALL] * n, CAMERA, CAMERA, own=own, peer=peer)
    assert max(abs(j - 5) for _, j in found) == ALONG_PATH
    assert found[7, 7] == 1.0
    assert found[32, 7] == 1.0  # nearer to the false one
    assert found[5, 9] == pytest.approx(0.5, abs=0.1)
    close = LoopClosure(12, 5, np.eye(4), np.eye(6))  # as false; both reach keyframes 4 to 13
    for held in ([true, close], [close, true]):
        found = overlaps(held, [WALL] * n, CAMERA, CAMERA, own=own, peer=peer)
        assert found[7, 7] == found[13, 6] == 1.0  # two steps from the true one, two from the other one
        assert found[6, 11] < 0.5


def test_overlap_makes_a_pair_worth_a_sample_and_samples_at_hand_are_free() -> None:
    drift = np.stack([np.arange(40) * 0.003**2, np.arange(40) * 0.001**2], axis=1)
    first = Candidate(3, 3, 30)
    config = PlacesConfig(max_requested_keyframes=2)
    plan = Planner([first], config, drift_own=drift, drift_peer=drift, closures=LoopClosureConfig())
    assert plan.next() == [first]
    plan.take(first, closure=True)
    assert plan.next() == []
    plan.expect({(4, 3): 0.9, (5, 3): 0.39, (6, 5): 0.8, (7, 6): 0.7, (3, 3): 1.0}, lambda i, j: i + j)
    again = plan.next()
    assert {c.ends: (c.score, c.overlap) for c in again} == {(4, 3): (7, 0.9), (6, 5): (11, 0.8)}
    assert plan.requested == {3, 5}  # the budget of two; 6 would be the third
    for c in again:
        plan.take(c, closure=False)
    assert plan.next() == []
    plan.expect({(8, 3): 0.9}, lambda i, j: 0)
    assert [c.ends for c in plan.next()] == [(8, 3)]
    assert [c.ends for c, _ in plan.not_requested()] == [(7, 6)]  # enough matches to be listed


@pytest.fixture(scope="module")
def robots(make_robot: Any) -> list[Any]:
    return [
        make_robot(name, turn, keyframes=4, gaussians=10)[0] for name, turn in (("alpha", 0), ("bravo", 1.2))
    ]


def search(robots: list[Any], min_score: int, blind: bool = False) -> tuple[Verifier, list[int]]:
    """Let both ends talk until they have decided; the verifier, and the keyframes that were requested."""
    config = ExchangeConfig(places=PlacesConfig(min_score=min_score, rectified_planes=0))
    alpha, bravo = (KeyframeDatabase(data, config) for data in robots)
    verifier, provider = Verifier(alpha, "bravo", 0), Provider(bravo, "alpha", 0)
    if blind:
        alpha.overlaps = lambda near, peer, camera: {}  # type: ignore[method-assign]
    queue: list[tuple[Any, Kind, bytes]] = []
    provider.begin(lambda kind, payload: queue.append((verifier, kind, payload)))
    while queue:
        end, kind, payload = queue.pop(0)
        other = provider if end is verifier else verifier
        end.take(kind, payload, lambda kind, payload, to=other: queue.append((to, kind, payload)))
    assert verifier.decided
    assert provider.decided
    return verifier, sorted(provider.answered)


def test_one_closure_leads_to_those_that_join_two_robots(robots: list[Any]) -> None:
    """With descriptors alone one pair of keyframes is found, and two loop closures are needed."""
    alone, _ = search(robots, MIN_SCORE, blind=True)
    assert [t.candidate.score >= MIN_SCORE for t in alone.tried if t.result.closure] == [True]
    assert alone.joined is None
    verifier, requested = search(robots, MIN_SCORE)
    assert verifier.joined is not None
    closures = [t for t in verifier.tried if t.result.closure is not None]
    assert sum(t.candidate.score < MIN_SCORE for t in closures) >= 2
    assert len(requested) == 2  # the second for what it promised
    ends = [t.candidate.ends for t in verifier.tried]
    assert len(set(ends)) == len(ends)


def test_a_pair_that_registration_rejects_leads_to_others(
    robots: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def rejects_the_first(candidate: Candidate, *args: Any, **settings: Any) -> Verified:
        result = verify(candidate, *args, **settings)
        if candidate.score < MIN_SCORE:
            return result
        assert result.closure is not None
        guess = replace(result.closure, information=np.zeros((6, 6)))
        return replace(result, verdict=Verdict.MOVED, closure=None, tentative=guess)

    monkeypatch.setattr(loop_closure_verifier, "verify", rejects_the_first)
    assert search(robots, MIN_SCORE)[0].joined is not None
