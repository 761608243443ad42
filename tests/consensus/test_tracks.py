"""Tracks over many robots: connected by matches, with no robot twice."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.consensus import tracks as module
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import MapMatching, gaussian_distance
from duagc.pipeline.consensus.tracks import tracks
from duagc.pipeline.splat.information import LOG_COVARIANCE

CONFIG = MapMatching()


def identical(owner, ids):
    """Evidence on one place, all ids alike but for a growing opacity."""
    theta = np.zeros((len(ids), 13))
    theta[:, LOG_COVARIANCE] = -8 * np.array([1, 1, 1, 0, 0, 0])
    theta[:, 12] = 0.01 * np.arange(len(ids))
    return Evidence(owner, np.array(ids), np.zeros(len(ids)), theta, np.zeros((len(ids), 31)))


def groups(evidence, pairs):
    found = tracks(evidence, pairs, CONFIG)
    out = {}
    for track, robot, row in zip(found.track.tolist(), found.robot.tolist(), found.row.tolist(), strict=True):
        name = found.robots[robot]
        out.setdefault(track, set()).add((name, int(evidence[name].ids[row])))
    return sorted(out.values(), key=sorted)


def test_tracks_run_over_all_robots():
    evidence = {
        "alpha": identical("alpha", [5, 6]),
        "bravo": identical("bravo", [7]),
        "charlie": identical("charlie", [5]),
    }
    pairs = {("alpha", "bravo"): np.array([[6, 7]]), ("bravo", "charlie"): np.array([[7, 5]])}
    assert groups(evidence, pairs) == [{("alpha", 6), ("bravo", 7), ("charlie", 5)}]


@pytest.mark.parametrize("count", [0, 1])
def test_robots_without_matches_have_no_tracks(count):
    """Whether they have a map or, with `frontend.mapping_enabled=false`, none."""
    evidence = {robot: identical(robot, range(count)) for robot in ("alpha", "bravo", "charlie")}
    pairs = {("alpha", "bravo"): np.zeros((0, 2), np.int64)}
    assert groups(evidence, pairs) == groups(evidence, {}) == []


def test_a_track_with_two_gaussians_of_one_robot_loses_its_worst_pair():
    evidence = {
        "alpha": identical("alpha", [0, 1]),
        "bravo": identical("bravo", [0]),
        "charlie": identical("charlie", [0]),
    }
    # alpha 0 - bravo 0 - charlie 0 - alpha 1, of which the last is the worst (opacity 0.01 against 0)
    pairs = {
        ("alpha", "bravo"): np.array([[0, 0]]),
        ("bravo", "charlie"): np.array([[0, 0]]),
        ("alpha", "charlie"): np.array([[1, 0]]),
    }
    assert groups(evidence, pairs) == [{("alpha", 0), ("bravo", 0), ("charlie", 0)}]


@pytest.mark.parametrize("seed", range(5))
def test_tracks_of_five_robots_are_what_a_plain_search_finds(seed):
    """Random pairs, many of which put two Gaussians of a robot into one track: against pairs removed one by one."""
    rng = np.random.default_rng(seed)
    names = ["alpha", "bravo", "charlie", "delta", "echo"]
    evidence = {}
    for name in names:
        e = identical(name, list(range(8)))
        theta = e.theta + np.eye(13)[12] * rng.normal(size=(8, 1))
        evidence[name] = Evidence(name, e.ids, e.anchors, theta, e.information)
    pairs = {
        (a, b): np.stack([rng.permutation(8)[:3], rng.permutation(8)[:3]], axis=1)
        for i, a in enumerate(names)
        for b in names[i + 1 :]
    }
    edges = [((a, int(x)), (b, int(y))) for (a, b), ids in pairs.items() for x, y in ids]

    def far(edge):
        (a, x), (b, y) = edge
        return gaussian_distance(evidence[a], np.array([x]), evidence[b], np.array([y]), config=CONFIG)[0]

    def parts(edges):
        found = []
        for one, other in edges:
            joined = [p for p in found if one in p or other in p]
            found = [p for p in found if p not in joined] + [set().union({one, other}, *joined)]
        return found

    while broken := [p for p in parts(edges) if len({name for name, _ in p}) < len(p)]:
        worst = [max((e for e in edges if e[0] in p), key=far) for p in broken]
        edges = [e for e in edges if e not in worst]
    expected = sorted(parts(edges), key=sorted)
    assert any(len(p) > 2 for p in expected)
    assert groups(evidence, pairs) == expected


def test_many_robots_that_saw_the_same_are_joined_at_once(monkeypatch):
    """Matches of eight robots connect all their Gaussians: one by one their worst pairs would take hours."""
    rng = np.random.default_rng(0)
    names = [f"robot{k}" for k in range(8)]
    evidence = {}
    for name in names:
        theta = identical(name, list(range(60))).theta + np.eye(13)[12] * rng.normal(size=(60, 1))
        evidence[name] = replace(identical(name, list(range(60))), theta=theta)
    pairs = {
        (a, b): np.stack([rng.permutation(60)[:40], rng.permutation(60)[:40]], axis=1)
        for i, a in enumerate(names)
        for b in names[i + 1 :]
    }
    calls = []
    plain = module.csgraph.connected_components
    monkeypatch.setattr(
        module.csgraph, "connected_components", lambda *a, **k: calls.append(1) or plain(*a, **k)
    )
    found = tracks(evidence, pairs, CONFIG)
    assert len(calls) <= 2
    assert len(np.unique(found.track)) > 60
    assert len({*zip(found.track.tolist(), found.robot.tolist(), strict=True)}) == len(found.track)


def test_pairs_of_gaussians_that_never_arrived_are_left_out():
    evidence = {"alpha": identical("alpha", [0, 1]), "bravo": identical("bravo", [3])}
    pairs = {("alpha", "bravo"): np.array([[0, 3], [1, 4]]), ("bravo", "zulu"): np.array([[3, 3]])}
    assert groups(evidence, pairs) == [{("alpha", 0), ("bravo", 3)}]
    assert groups(evidence, {}) == []
