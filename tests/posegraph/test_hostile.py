"""Packets whose payload was changed behind a correct CRC: refused with a reason, or used, but nobody crashes."""

import dataclasses

import numpy as np
import pytest

from duagc.pipeline.config.posegraph import settings
from duagc.pipeline.network.packets import parse, serialize
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
            sent = [out for name, agent in agents.items() for out in agent.tick(k, k, waiting[name])]
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
