"""One end of a link: its metric, its copies, which of the shared keyframes pull, what of a packet counts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import LoopClosureConfig, PoseConsensusConfig
from duagc.pipeline.consensus import admm_penalties, admm_weights
from duagc.pipeline.consensus.admm_edge import (
    REMEMBERED,
    AdmmEdge,
    PosePacket,
    SharedKeyframes,
    link_metric,
    start_of_copies,
)
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses
from tests.fixtures.pose_worlds import random_information, random_poses

CONFIG = PoseConsensusConfig()


def edge(keyframes=(2, 5), closures=(), metric=1.0, **config):
    shared = SharedKeyframes(np.array(keyframes, np.int32), np.full((len(keyframes), 6), metric, np.float32))
    kept = np.ones(len(closures), dtype=bool)
    settings = CONFIG.model_copy(update=config)
    return AdmmEdge.begin("bravo", shared, tuple(closures), kept, decides=True, config=settings)


def closures_of(keyframes, seed=0):
    rng = np.random.default_rng(seed)
    T, information = random_poses(rng, len(keyframes)), random_information(rng, len(keyframes))
    return [LoopClosure(k, peer, T[k], information[k]) for k, peer in enumerate(keyframes)]


def packet(sequence, keyframes, *, converged=False, curvature=None):
    n = len(keyframes)
    return PosePacket(
        sequence=sequence,
        version=0,
        keyframes=np.array(keyframes, np.int32),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (n, 1)),
        translations=np.zeros((n, 3)),
        penalties=np.ones(2, np.float32),
        curvature=curvature,
        converged=converged,
    )


def test_the_metric_is_the_information_averaged_over_directions_in_every_frame():
    floors = LoopClosureConfig(sigma_floor_m=0.02, sigma_floor_rad=0.01)
    closures = closures_of([5, 2, 5])
    metric = link_metric(closures, np.array([2, 5]), floors)
    floor = np.diag([0.02**2] * 3 + [0.01**2] * 3)
    floored = [np.linalg.inv(np.linalg.inv(c.information) + floor) for c in closures]
    means = [[np.trace(W[:3, :3]) / 3] * 3 + [np.trace(W[3:, 3:]) / 3] * 3 for W in floored]
    np.testing.assert_allclose(metric, [means[1], np.add(means[0], means[2])], rtol=1e-6)

    rotation = random_poses(np.random.default_rng(1), 1)[0][:3, :3]
    turn = np.kron(np.eye(2), rotation)
    turned = [replace(c, information=turn @ c.information @ turn.T) for c in closures]
    np.testing.assert_allclose(link_metric(turned, np.array([2, 5]), floors), metric, rtol=1e-5)


def test_of_what_a_neighbor_says_of_itself_the_newest_counts():
    link = edge()
    link.take_header(packet(4, [2], converged=True, curvature=np.array([2.0, 3.0], np.float32)))
    link.take_header(packet(3, [2], converged=False, curvature=np.array([8.0, 9.0], np.float32)))
    assert link.peer_converged
    np.testing.assert_array_equal(link.peer_curvature, [2.0, 3.0])
    link.take_header(packet(5, [2], converged=False))
    assert not link.peer_converged
    np.testing.assert_array_equal(link.peer_curvature, [2.0, 3.0])


def test_a_keyframe_that_pulls_again_begins_anew():
    link = edge()
    link.offset[:] = 0.3
    link.changes[:] = 1e-9
    link.activate(np.array([True, False]), 1)
    assert link.largest_recent_change() == 1e-9  # what does not pull keeps nobody from converging
    np.testing.assert_array_equal(link.force()[1], 0)
    link.activate(np.array([False, False]), 1)  # of the same version: no news
    np.testing.assert_array_equal(link.active, [True, False])
    link.activate(np.array([True, True]), 2)
    np.testing.assert_array_equal(link.offset, [[0.3] * 6, [0.0] * 6])
    np.testing.assert_array_equal(link.changes[0], [1e-9] * REMEMBERED)
    assert np.all(np.isinf(link.changes[1]))
    assert link.largest_change() == np.inf


def test_a_copy_is_carried_by_any_loop_closure_with_weight():
    link = edge(keyframes=(2, 5, 7), closures=closures_of([5, 2, 7, 7]))
    link.robust.weights = np.array([0.01, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(link.carrying(), [False, True, True])


def test_copies_start_where_the_first_kept_loop_closure_puts_them():
    closures = closures_of([5, 5, 5, 2])
    own = random_poses(np.random.default_rng(2), 4)
    known = random_poses(np.random.default_rng(3), 1)[0]
    kept = np.array([False, True, True, False])
    at = start_of_copies(closures, kept, np.array([2, 5, 9]), own, known={9: known})
    np.testing.assert_allclose(at[0], own[3] @ closures[3].T_own_peer)  # the only one, kept or not
    np.testing.assert_allclose(at[1], own[1] @ closures[1].T_own_peer)
    np.testing.assert_array_equal(at[2], known)


def test_an_arrival_moves_the_edge_variable_by_its_share_of_the_way():
    """y = x (+) (-offset); m and y without rotations, so that the way is a difference of positions."""
    rng = np.random.default_rng(4)
    link, x = edge(), random_poses(rng, 2)
    link.offset[:, :3] = rng.normal(size=(2, 3))
    y, m = retract(x, -link.offset), retract(x, np.pad(rng.normal(size=(2, 3)), ((0, 0), (0, 3))))
    link.relax(np.array([0, 1]), m, x, 0.9)
    moved = retract(x, -link.offset)
    np.testing.assert_allclose(moved[:, :3, 3], y[:, :3, 3] + 0.9 * (m - y)[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(link.changes[:, -1], 0.9 * np.abs((m - y)[:, :3, 3]).max(axis=1), atol=1e-12)


def received(link, now=1000.0, total=0.0):
    link.received, link.received_total = now, total
    return link


def test_the_curvature_is_that_of_a_spring_in_units_of_the_metric():
    """The force of a spring K (x - x0), in a metric W: W^-1/2 K W^-1/2, whatever moved, of what pulls."""
    rng = np.random.default_rng(5)
    link = received(edge(metric=4.0))
    x = random_poses(rng, 2)
    assert admm_penalties.curvature(link, x, CONFIG) is None  # the window begins
    link.received = 1000.0
    step = np.concatenate([0.01 * rng.normal(size=(2, 3)), np.zeros((2, 3))], axis=1)
    step[:, 3] = 0.02
    stiffness = np.repeat([6.0, 10.0], 3)
    link.offset = link.offset + stiffness * step / link.penalty()
    found = admm_penalties.curvature(link, retract(x, step), CONFIG)
    np.testing.assert_allclose(found, [6.0 / 4.0, 10.0 / 4.0], rtol=1e-9)


@pytest.mark.parametrize("arrived", [0.0, 1.0, 4.0, 100.0])
def test_penalties_go_to_the_mean_curvature_by_smaller_and_smaller_factors(arrived):
    link = received(edge(), total=arrived * CONFIG.penalty_decay + 7.0)
    link.adapting_from = 7.0
    link.penalties = np.array([1.0, 2.0])
    most = 1.0 + 2.0 / max(1.0, arrived)
    near = np.sqrt(0.5 * (1 + most))  # of both ends, one stiffer than the other by 100
    own, peer = link.penalties * near * [10.0, 0.1], link.penalties * near * [0.1, 10.0]
    found = admm_penalties.next_penalties(link, own, peer, CONFIG)
    np.testing.assert_allclose(found, link.penalties * near, rtol=1e-6)
    far = admm_penalties.next_penalties(link, 1e6 * own, peer, CONFIG)
    np.testing.assert_allclose(far, np.minimum(link.penalties * most, CONFIG.penalty_max), rtol=1e-6)
    low = admm_penalties.next_penalties(link, 1e-6 * own, peer, CONFIG)
    np.testing.assert_allclose(low, np.maximum(link.penalties / most, CONFIG.penalty_min), rtol=1e-6)


def test_parts_of_a_packet_that_name_other_keyframes_have_no_place():
    link = edge(keyframes=(2, 5, 9))
    np.testing.assert_array_equal(link.places_of(packet(1, [5, 9])), [1, 2])
    assert link.places_of(packet(1, [5, 10])) is None
    assert link.places_of(packet(1, [3])) is None


@pytest.mark.parametrize("slow", [0, 1])
def test_own_loops_wait_for_the_slowest_link(slow):
    """Their weights follow poses that all links move."""
    links = [received(edge(), total=40.0) for _ in range(2)]
    for link in links:
        link.changes[:] = 1e-6
    asked = []
    weights = SimpleNamespace(advance=lambda total, steady, squared: asked.append((total, steady)) or True)
    loops = RelativePoses.empty()
    assert admm_weights.advance_loops(weights, loops, links, np.zeros((0, 4, 4)), config=CONFIG)
    links[slow].received_total = 3.0
    admm_weights.advance_loops(weights, loops, links, np.zeros((0, 4, 4)), config=CONFIG)
    links[slow].received_total = 40.0
    links[slow].changes[0, -1] = 1.0
    admm_weights.advance_loops(weights, loops, links, np.zeros((0, 4, 4)), config=CONFIG)
    assert asked == [(40.0, True), (3.0, False), (40.0, False)]
