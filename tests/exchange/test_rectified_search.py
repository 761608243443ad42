"""Where all else joins nobody: loop closures by features of surfaces as if the cameras faced them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.exchange import ExchangeConfig, PlacesConfig
from duagc.pipeline.exchange.detected_loop_closures import Provider
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase
from duagc.pipeline.exchange.loop_closure_verifier import Verifier
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.rectified_search import most_alike
from duagc.pipeline.exchange.wire.loop_closing_wire import (
    RectifiedFeatures,
    read_rectified,
    write_indices,
    write_rectified,
)
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import Kind, MalformedError, parse
from duagc.pipeline.registration.features import Features
from tests.exchange import conftest
from tests.exchange.meeting import Team, error_m, meet

WITHOUT = PlacesConfig(rectified_planes=0)


def past_a_wall(side: float, keyframes: int) -> Array:
    """T_world_camera [k, 4, 4]: along the wall z = 2.4 m, which is seen 54 degrees from one side."""
    R = so3.exp([0.0, -0.95 * side, 0.0])
    at = [[side * (1.5 - 0.12 * k), 0.1 * side, 1.4 - 0.05 * k] for k in range(keyframes)]
    return np.array([se3.from_rotation_translation(R, position) for position in at])


@pytest.fixture
def team(monkeypatch: pytest.MonkeyPatch) -> Team:
    """Two robots that look at one wall from its two sides."""
    monkeypatch.setattr(conftest, "path", past_a_wall)
    return {name: conftest.robot(name, side, 4, 60) for name, side in (("alpha", -1.0), ("bravo", 1.0))}


def test_robots_that_see_a_wall_from_its_two_sides_are_joined(team: Team, tmp_path: Path) -> None:
    (tmp_path / "without").mkdir()
    alone = meet(team, 2, tmp_path / "without", places=WITHOUT)
    assert all(result.component == (name,) for name, result in alone.items())
    results = meet(team, 2, tmp_path)
    for result in results.values():
        assert result.component == ("alpha", "bravo")
        assert result.converged
        assert error_m(result, team) < 0.02
    closures = [c for r in results.values() for c in r.closures if c.T_own_peer is not None]
    ends = [(c.own_keyframe, c.peer_keyframe) for r in results.values() for c in r.closures]
    assert len(set(ends)) == len(ends)
    for c in closures:
        truth = se3.inverse(team[c.robot][1][c.own_keyframe]) @ team[c.peer][1][c.peer_keyframe]
        assert se3.distance(truth, c.T_own_peer)[0] < 0.05


def test_strangers_stay_strangers_and_ask_once(make_robot: Any, tmp_path: Path) -> None:
    team = {name: make_robot(name, turn, 4, 40) for name, turn in (("alpha", 0.0), ("bravo", 3.0))}
    results = meet(team, 2, tmp_path)
    assert all(result.component == (name,) and result.converged for name, result in results.items())
    packets = [parse(p.data) for p in read_session(tmp_path / "exchange.mcap").packets]
    asked = {(p.sender, p.message) for p in packets if p.kind is Kind.RECTIFIED_REQUEST}
    answered = {(p.sender, p.message) for p in packets if p.kind is Kind.RECTIFIED}
    assert (len(asked), len(answered)) == (1, 4)


def test_robots_that_are_joined_without_do_not_ask(make_robot: Any, tmp_path: Path) -> None:
    team = {name: make_robot(name, turn, 4, 40) for name, turn in (("alpha", 0.0), ("bravo", 0.6))}
    assert meet(team, 2, tmp_path)["alpha"].component == ("alpha", "bravo")
    kinds = {parse(p.data).kind for p in read_session(tmp_path / "exchange.mcap").packets}
    assert Kind.SAMPLE in kinds
    assert not kinds & {Kind.RECTIFIED_REQUEST, Kind.RECTIFIED}


def test_few_pairs_of_every_keyframe_of_the_neighbor_are_verified() -> None:
    inliers = {(0, 0): 20, (1, 0): 30, (2, 0): 25, (3, 0): 25, (5, 1): 12}
    assert most_alike(inliers, [], 3) == [(1, 0), (2, 0), (3, 0), (5, 1)]
    assert most_alike(inliers, [(1, 0)], 2) == [(2, 0), (5, 1)]


def test_features_survive_the_wire() -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, (5, 128)).astype(np.uint8)
    points = rng.normal(size=(5, 3)).astype(np.float32)
    data = write_rectified(RectifiedFeatures(3, Features(descriptors, points)))
    again = read_rectified(data, 4)
    assert again.keyframe == 3
    assert np.array_equal(again.features.descriptors, descriptors)
    assert np.abs(again.features.points - points).max() < 1e-3
    for broken in (data[:-1], data + b"\0", data[:5]):
        with pytest.raises(MalformedError):
            read_rectified(broken, 4)
    with pytest.raises(MalformedError, match="keyframe 3, expected one below 3"):
        read_rectified(data, 3)


def test_what_was_not_requested_is_refused(team: Team) -> None:
    config = ExchangeConfig()
    databases = {name: KeyframeDatabase(data, config) for name, (data, _) in team.items()}
    verifier, provider = Verifier(databases["alpha"], "bravo", 0), Provider(databases["bravo"], "alpha", 0)
    sent: list[tuple[Kind, bytes]] = []

    def send(kind: Kind, payload: bytes) -> None:
        sent.append((kind, payload))

    empty = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
    unasked = write_rectified(RectifiedFeatures(0, empty))
    with pytest.raises(MalformedError, match="RECTIFIED is not for the verifier"):
        verifier.take(Kind.RECTIFIED, unasked, send)
    provider.begin(send)
    verifier.take(*sent.pop(), send)
    while sent and sent[0][0] is not Kind.RECTIFIED_REQUEST:
        kind, payload = sent.pop(0)
        (verifier if kind is Kind.SAMPLE else provider).take(kind, payload, send)
    asked = sent.pop(0)
    provider.take(*asked, send)
    with pytest.raises(MalformedError, match="RECTIFIED_REQUEST is not for the provider, or came twice"):
        provider.take(*asked, send)
    first = next(payload for kind, payload in sent if kind is Kind.RECTIFIED)
    verifier.take(Kind.RECTIFIED, first, send)
    with pytest.raises(MalformedError, match="was not requested, or came twice"):
        verifier.take(Kind.RECTIFIED, first, send)
    with pytest.raises(MalformedError, match="must ascend"):
        Provider(databases["bravo"], "alpha", 0).take(Kind.RECTIFIED_REQUEST, write_indices([9]), send)
