"""What an agent makes of single packets: parts, keyframes that no longer pull, what a neighbor says of itself."""

from dataclasses import replace

import numpy as np

from duagc.pipeline.consensus.pose_admm import PoseConsensusConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.least_squares import difference, retract
from tests.fixtures.pose_worlds import EXACT, make_team, talk

PLAIN = PoseConsensusConfig(
    robust=False, odometry_floor_m=0, odometry_floor_rad=0, closures=EXACT, wire="float64", tolerance=1e-9
)


def two():
    agents = make_team(3, robots=2).agents(PLAIN)
    for agent in agents.values():
        agent.step()
    holding = next(a for a in agents.values() if any(link.holds for link in a.links.values()))
    other = next(a for a in agents.values() if a is not holding)
    return holding, other


def test_parts_of_a_packet_count_by_their_share():
    holding, other = two()
    packet, link = other.outgoing(holding.robot), holding.links[other.robot]
    n = len(packet.keyframes)
    assert n > 1
    assert holding.receive(other.robot, packet.part(slice(0, 1)))
    assert link.received_total == link.received == 1 / n
    assert holding.receive(other.robot, packet)  # of it, only the rest is new
    np.testing.assert_allclose([link.received_total, link.received], 1.0)


def test_a_copy_that_pulls_no_longer_is_where_its_owner_has_it():
    holding, other = two()
    link, packet = holding.links[other.robot], other.outgoing(holding.robot)
    active = np.ones(len(link.keyframes), dtype=bool)
    active[0] = False
    link.activate(active, 1)
    before = holding._x[link.slots].copy()
    assert holding.receive(other.robot, packet)
    sent = se3.from_quat_translation(packet.quats_wxyz, packet.translations)
    np.testing.assert_allclose(holding._x[link.slots[0]], sent[0], atol=1e-12)
    np.testing.assert_array_equal(holding._x[link.slots[1:]], before[1:])  # those move by steps alone
    np.testing.assert_array_equal(link.offset[0], 0)
    assert not holding.receive(other.robot, packet)


def test_the_recorded_disagreement_is_what_was_sent_less_the_edge_variable():
    holding, other = two()
    packet, link = other.outgoing(holding.robot), holding.links[other.robot]
    y = retract(holding._x[link.slots], -link.offset)
    assert holding.receive(other.robot, packet)
    sent = se3.from_quat_translation(packet.quats_wxyz, packet.translations)
    apart = np.abs(difference(sent, y)).max()
    assert apart > 1e-3
    np.testing.assert_allclose(holding.residuals()["primal"], apart)


def test_two_have_agreed_when_both_have_converged():
    agents = make_team(3, robots=2).agents(PLAIN)
    talk(agents, 400)
    alpha, bravo = agents["alpha"], agents["bravo"]
    assert alpha.agreed
    assert bravo.agreed
    packet = bravo.outgoing("alpha")
    alpha.receive("bravo", replace(packet, converged=False))
    assert alpha.converged
    assert not alpha.agreed
