"""Packets whose payload was changed behind a correct CRC: refused with a reason, or used, but nobody crashes."""

import dataclasses

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.posegraph import settings
from duagc.pipeline.exchange.wire import state_wire
from duagc.pipeline.exchange.wire.state_wire import pair_bit
from duagc.pipeline.network.packets import Kind, parse, serialize
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.files import read_team_graph
from duagc.pipeline.team_posegraph.agent import PoseGraphAgent
from tests.fixtures.pose_graphs import helix_edges, wild_edges, write_g2o


@pytest.mark.parametrize(
    ("solver", "robust"), [("admm", "none"), ("elimination", "none"), ("paper", "none"), ("admm", "gnc")]
)
def test_changed_payloads_crash_nobody(tmp_path, solver, robust):
    rows = helix_edges(24) + (wild_edges(24, 4) if robust == "gnc" else [])
    team = read_team_graph(write_g2o(tmp_path / "helix.g2o", rows), 3)
    rng = np.random.default_rng(0)
    refused = changed = 0
    for _ in range(12):
        config = settings(solver, robust, max_rounds=40)
        agents = {n: PoseGraphAgent(team.robots[n], sorted(team.robots), config) for n in team.robots}
        waiting = {name: [] for name in agents}
        for k in range(40):
            sent = [out for name, agent in agents.items() for out in agent.tick(k, waiting[name])]
            waiting = {name: [] for name in agents}
            for out in sent:
                packet = parse(out.packet)
                if packet.payload and rng.random() < 0.3:
                    payload = bytearray(packet.payload)
                    for _ in range(int(rng.integers(1, 4))):
                        payload[int(rng.integers(len(payload)))] = int(rng.integers(256))
                    waiting[out.receiver].append(
                        serialize(dataclasses.replace(packet, payload=bytes(payload)))
                    )
                    changed += 1
                else:
                    waiting[out.receiver].append(out.packet)
        refused += sum(sum(agent.refused.values()) for agent in agents.values())
        assert all(np.isfinite(agent.T_world_keyframe).all() for agent in agents.values())
    assert changed > 50
    assert refused > 10


def ticks(agents, waiting, rounds):
    """Carry every packet through rounds, by index."""
    for k in rounds:
        sent = [out for name, agent in agents.items() for out in agent.tick(k, waiting[name])]
        waiting.update({name: [o.packet for o in sent if o.receiver == name] for name in agents})


@pytest.mark.parametrize("solver", ["admm", "elimination"])
def test_a_message_of_a_solver_from_a_neighbor_that_is_not_joined_is_refused(tmp_path, solver):
    team = read_team_graph(write_g2o(tmp_path / "helix.g2o", helix_edges(24, turn=12)), 3)
    config = settings(solver)
    agents = {n: PoseGraphAgent(team.robots[n], sorted(team.robots), config) for n in team.robots}
    waiting = {name: [] for name in agents}
    alone, *_ = agents.values()
    other = list(agents.values())[2]
    ticks(agents, waiting, range(3))
    alone._revoke_links(pair_bit(alone.own, other.own))
    ticks(agents, waiting, range(3, 30))
    assert alone.poses is not None
    assert other.own in alone.neighbors
    assert other.own not in alone.links
    mask = state_wire.write_labeled(other.alignment.revoked, len(team.robots), bytes(4))
    other.radio.send(other.neighbors[alone.own], Kind.TREE, mask)
    ticks(agents, waiting, range(30, 36))
    assert alone.refused["solver: from a neighbor that is not joined"] == 1


@pytest.mark.parametrize("solver", ["admm", "elimination"])
def test_numbers_that_nobody_can_solve_for_stop_no_agent(tmp_path, solver, monkeypatch):
    team = read_team_graph(write_g2o(tmp_path / "helix.g2o", helix_edges(24)), 3)
    config = settings(solver)
    agents = {n: PoseGraphAgent(team.robots[n], sorted(team.robots), config) for n in team.robots}
    waiting = {name: [] for name in agents}
    rounds = iter(range(600))
    while any(agent.poses is None for agent in agents.values()):
        ticks(agents, waiting, [next(rounds)])

    def singular(H):
        raise DuagError("its numbers cannot be solved for")

    before = [agent.T_world_keyframe for agent in agents.values()]
    with monkeypatch.context() as patch:
        patch.setattr(least_squares, "factorized", singular)
        for agent in agents.values():
            if solver == "admm":
                agent.poses.agent._problem.refactorize()
        ticks(agents, waiting, [next(rounds), next(rounds)])
    assert sum(agent.refused["its numbers cannot be solved for"] for agent in agents.values()) > 0
    assert not any(agent.poses.converged for agent in agents.values())
    for agent, T in zip(agents.values(), before, strict=True):
        np.testing.assert_array_equal(agent.T_world_keyframe, T)
    if solver == "admm":  # it tries again
        ticks(agents, waiting, rounds)
        assert all(agent.done for agent in agents.values())
