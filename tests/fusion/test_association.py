"""Averages of tracks, block by block, against the sums written out; what limits them; who stands for a track."""

import numpy as np
import pytest

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.fusion.association import (
    PRIOR,
    EvidenceRows,
    Scatter,
    TrackMembers,
    _across,
    association_covariance,
    fused_moves,
    weighted_move,
)
from duagc.pipeline.geometry import spd
from duagc.pipeline.splat.information import LOG_COVARIANCE
from tests.fixtures.gaussian_worlds import World, information

FLOOR_M = 1e-5


def members_of(seed, tracks=40, size=3):
    """Tracks of as many members each, near each other, with thick Gaussians; the second one is the reference."""
    rng = np.random.default_rng(seed)
    n = tracks * size
    theta = np.repeat(rng.normal(size=(tracks, 13)), size, axis=0) + 0.003 * rng.normal(size=(n, 13))
    quats = np.repeat(rng.normal(size=(tracks, 4)), size, axis=0)
    scales = np.repeat(rng.uniform(-5, -3, size=(tracks, 3)), size, axis=0) + 0.01 * rng.normal(size=(n, 3))
    theta[:, LOG_COVARIANCE] = spd.log_covariance(quats, scales)
    first = np.arange(tracks) * size
    return TrackMembers(EvidenceRows(theta, information(rng, n)), first + 1, first)


@pytest.mark.parametrize("association", ["members", "neighbors"])
def test_each_block_is_the_mean_of_what_its_members_say(association):
    config = FusionConfig(association=association)
    members, size = members_of(0), 3
    scatter = Scatter.of(members, config)
    moves = fused_moves(members, config, FLOOR_M)
    rows, compared = members.rows, 0
    prior_position, prior_shape = PRIOR[association]
    for k, reference in enumerate(members.reference):
        pull = {"position": np.zeros(3), "shape": np.zeros(6), "color": np.zeros(3), "opacity": 0.0}
        total = {"position": prior_position * np.eye(3), "shape": prior_shape * np.eye(6)}
        total |= {"color": np.zeros(3), "opacity": 0.0}
        traces: dict[str, list[float]] = {}
        for row in range(size * k, size * (k + 1)):
            own = row == reference
            share = 0.5 if association == "members" else float(not own)
            extent = association_covariance(rows.theta[row, None, LOG_COVARIANCE], config.spacing_per_sigma)[
                0
            ]
            along = extent * (association == "members" or not own)
            delta = rows.theta[row] - rows.theta[reference]
            spread = along + share * scatter.position_m**2 * np.eye(3)
            W = np.linalg.inv(np.linalg.inv(rows.position[row]) + spread)
            V = np.linalg.inv(np.linalg.inv(rows.shape[row]) + share * scatter.shape**2 * np.eye(6))
            c = 1 / (1 / rows.color[row] + share * scatter.color**2)
            o = 1 / (1 / rows.opacity[row] + share * scatter.opacity**2)
            for name, weight, value in (
                ("position", W, W @ delta[:3]),
                ("shape", V, V @ delta[3:9]),
                ("color", c, c * delta[9:12]),
                ("opacity", o, o * delta[12]),
            ):
                total[name], pull[name] = total[name] + weight, pull[name] + value
                traces.setdefault(name, []).append(np.trace(np.atleast_2d(weight)))
        np.testing.assert_allclose(moves[k, 9:12], pull["color"] / total["color"], atol=1e-12)
        np.testing.assert_allclose(moves[k, 12], pull["opacity"] / total["opacity"], atol=1e-12)
        deltas = rows.theta[size * k : size * (k + 1)] - rows.theta[reference]
        for name, part in (("position", slice(0, 3)), ("shape", slice(3, 9))):
            expected = np.linalg.solve(total[name], pull[name])
            center = np.average(deltas[:, part], axis=0, weights=traces[name])
            reach = np.linalg.norm(deltas[:, part] - center, axis=1).max()
            if np.linalg.norm(expected - center) < 0.98 * reach:  # beyond it a mean is limited
                np.testing.assert_allclose(moves[k, part], expected, rtol=1e-9, atol=1e-12)
                compared += 1
    assert compared > 15


def test_across_is_the_inverse_shape_in_units_of_the_shortest_axis():
    rng = np.random.default_rng(1)
    quats, scales = rng.normal(size=(20, 4)), rng.uniform(-4, -2, size=(20, 3))
    vec = spd.log_covariance(quats, scales)
    values, vectors = np.linalg.eigh(spd.vec_to_sym(vec))
    covariance = (vectors * np.exp(values)[:, None, :]) @ vectors.swapaxes(1, 2)
    shortest = np.exp(2 * scales.min(axis=1))
    expected = shortest[:, None, None] * np.linalg.inv(covariance)
    np.testing.assert_allclose(_across(vec), expected, atol=1e-9)


def test_a_member_without_information_gives_the_others_no_room():
    """Two planes that are nearly parallel cross far away; a third member far off knows nothing of either."""
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.05, 1.0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = 1e6 * normals[:, :, None] * normals[:, None, :]
    values, first = np.array([[0.0, 0, 0], [0, 0, 0.01]]), np.array([0])
    two = weighted_move(weights, values, first, 100.0)
    three = weighted_move(
        np.concatenate([weights, np.zeros((1, 3, 3))]), np.vstack([values, [5.0, 5.0, 5.0]]), first, 100.0
    )
    assert np.linalg.norm(two) < 0.02
    np.testing.assert_allclose(three, two, atol=1e-12)


@pytest.mark.parametrize("surer", ["bravo", "charlie"])
def test_of_peers_alone_the_one_that_knows_its_position_best_stands_for_a_track(surer):
    world = World(5)
    e = world.evidence[surer]
    known = e.information.copy()
    known[:, :6] *= 100.0
    world.evidence[surer] = type(e)(surer, e.ids, e.anchors, e.theta, known)
    result = world.fuse("alpha", pairs={("bravo", "charlie"): world.pairs["bravo", "charlie"]})
    imported = result.members > 1
    assert imported.any()
    assert {result.robots[k] for k in result.source[imported]} == {surer}


def test_the_order_of_own_evidence_changes_nothing_and_imported_ids_are_new():
    world = World(6)
    own = world.maps["alpha"]
    shuffled = np.random.default_rng(7).permutation(len(own))
    world.maps["alpha"] = own.select(shuffled)
    e = world.evidence["alpha"]
    pairs = {("alpha", "bravo"): world.pairs["alpha", "bravo"][::3]}
    in_map_order = world.fuse("alpha", pairs=pairs, evidence=world.evidence | {"alpha": e.select(shuffled)})
    by_id = world.fuse("alpha", pairs=pairs, self_information=e)
    np.testing.assert_array_equal(by_id.theta, in_map_order.theta)
    np.testing.assert_array_equal(by_id.gaussians.means, in_map_order.gaussians.means)
    assert by_id.added > 0
    assert len(np.unique(by_id.gaussians.ids)) == len(by_id.gaussians)
    assert by_id.gaussians.ids[len(own) :].min() == own.ids.max() + 1
