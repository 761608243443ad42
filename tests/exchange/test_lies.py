"""Well-formed lies: messages that every format accepts and no honest robot sends end nobody's session."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange import algorithm_1, block_descent
from duagc.pipeline.exchange.loop_closing import can_be_sent
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.session import team_of
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.exchange.wire import loop_closing_wire, state_wire
from duagc.pipeline.exchange.wire.link_setup_wire import LinkSetup
from duagc.pipeline.exchange.wire.state_wire import pair_bit
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, parse, serialize
from duagc.pipeline.posegraph.cycle_consistency import Proposal
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.runs.robot_data import RobotData
from tests.exchange.conftest import information_of
from tests.exchange.meeting import NAMES, Team
from tests.fixtures.sampling import sampled

Change = Callable[[int, str, str, bytes], bytes | None]
"""From the round, the sender, the receiver and a packet to what arrives; None holds it back."""


def session(
    team: Team,
    names: tuple[str, ...],
    change: Change = lambda *packet: packet[3],
    rounds: int = 200,
    **config: Any,
) -> dict[str, MapAgent]:
    """A session over lossless air; packets held back arrive 60 rounds after its start."""
    agents = team_of([team[name][0] for name in names], ExchangeConfig(**config), seed=0)
    air: dict[str, list[bytes]] = {name: [] for name in agents}
    held: list[tuple[str, bytes]] = []
    for k in range(rounds):
        sent = {name: agent.tick(k, air[name]) for name, agent in agents.items()}
        for agent in agents.values():
            if agent.poses is not None:
                agent.poses.residuals()  # as the record of a session asks for them
        air = {name: [] for name in agents}
        for sender, out in ((s, o) for s, burst in sent.items() for o in burst):
            packet = change(k, sender, out.receiver, out.packet)
            if packet is None:
                held.append((out.receiver, out.packet))
            else:
                air[out.receiver].append(packet)
        if k == 60:
            for receiver, packet in held:
                air[receiver].append(packet)
        if all(agent.done for agent in agents.values()):
            break
    return agents


def with_one_keyframe(data: RobotData) -> RobotData:
    """The robot as if it had stopped after its first keyframe."""
    maps = data.gaussians.select(np.flatnonzero(data.gaussians.anchors == 0))
    return dataclasses.replace(
        data,
        T_map_keyframe=data.T_map_keyframe[:1],
        odometry=[],
        registrations=[],
        gaussians=maps,
        information=information_of(data.robot, maps, np.random.default_rng(0)),
    )


def test_keyframes_too_far_away_to_be_sent_on_join_nobody(
    team: Team, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each coordinate is within the format; that of the map as seen from the other robot is not."""
    write = loop_closing_wire.write_descriptors

    def far(descriptors: loop_closing_wire.DescriptorSet) -> bytes:
        T = descriptors.T_first_keyframe.copy()
        T[:, :3, 3] += [9.9e5, 0.0, 9.9e5]
        return write(dataclasses.replace(descriptors, T_first_keyframe=T))

    monkeypatch.setattr(loop_closing_wire, "write_descriptors", far)
    agents = session(team, NAMES[:2])
    results = {name: result_of(agent) for name, agent in agents.items()}
    assert {name: result.component for name, result in results.items()} == {n: (n,) for n in NAMES[:2]}
    measured = [c for result in results.values() for c in result.closures if c.T_own_peer is not None]
    assert measured
    assert all(c.verdict == Verdict.INCONSISTENT.value for c in measured)
    assert any("beyond what can be sent" in c.detail for c in measured)


def without_information(closures: tuple[LoopClosure, ...], diagonal: list[float]) -> tuple[LoopClosure, ...]:
    """Loop closures that say nothing of most directions."""
    return tuple(dataclasses.replace(c, information=np.diag(diagonal)) for c in closures)


@pytest.mark.parametrize("diagonal", sampled([[0.0] * 6, [1e4, 0.0, 0.0, 0.0, 0.0, 0.0]]))
@pytest.mark.parametrize("solver", ["algorithm_1", "block_descent"])
def test_a_loop_closure_without_information_stops_no_solver(
    team: Team, monkeypatch: pytest.MonkeyPatch, solver: str, diagonal: list[float]
) -> None:
    """Of a neighbor, whose only keyframe and ours nothing else holds then."""

    def lying(write: Callable[[Any], bytes]) -> Callable[[Any], bytes]:
        def written(message: Any) -> bytes:
            if isinstance(message, LinkSetup) and message.closures:
                closures = without_information(message.closures, diagonal)
                message = dataclasses.replace(message, closures=closures)
            return write(message)

        return written

    monkeypatch.setattr(algorithm_1, "write_setup", lying(algorithm_1.write_setup))
    monkeypatch.setattr(block_descent, "write_message", lying(block_descent.write_message))
    for alone in NAMES[:2]:  # which robot decides depends on what they saw
        robots = team | {alone: (with_one_keyframe(team[alone][0]), team[alone][1][:1])}
        agents = session(robots, NAMES[:2], rounds=40, solver=solver)
        joined = [n.loop_closing.joined for n in agents[alone].neighbors.values() if n.loop_closing]
        assert all(j is not None for j in joined), "the test needs them to be joined"
        for agent in agents.values():
            assert np.isfinite(result_of(agent).T_world_keyframe).all()


@pytest.mark.parametrize(("own", "peer"), [("alpha", "bravo"), ("bravo", "alpha")])
def test_what_can_be_sent_is_judged_in_the_direction_that_is_sent(own: str, peer: str) -> None:
    """From the one side each coordinate is below the limit, from the other one is above."""
    T = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 4])
    T[:3, 3] = [9e5, 9e5, 0.0]
    assert np.abs(se3.inverse(T)[:3, 3]).max() > 1e6
    assert can_be_sent(own, peer, (Proposal(3, T, (1.0, 1.0), 0.5),)) == (own < peer)


def test_a_link_revoked_by_a_forged_state_before_it_was_there_has_a_result(team: Team) -> None:
    """Charlie says that alpha and bravo, who meet later, have revoked their link."""

    def change(k: int, sender: str, receiver: str, data: bytes) -> bytes | None:
        if {sender, receiver} == {"alpha", "bravo"} and k < 60:
            return None
        packet = parse(data)
        if sender != "charlie" or packet.kind is not Kind.STATE:
            return data
        state, poses = state_wire.read_state(packet.payload, len(NAMES))
        state = dataclasses.replace(state, revoked_links=state.revoked_links | pair_bit(0, 1))
        payload = state_wire.write_state(state) + poses
        return serialize(dataclasses.replace(packet, payload=payload, total=len(payload)))

    agents = session(team, NAMES, change)
    results = [result_of(agent) for agent in agents.values()]
    between = [c for r in results for c in r.closures if {c.robot, c.peer} == {"alpha", "bravo"}]
    measured = [c for c in between if c.T_own_peer is not None]
    assert measured
    assert all(c.weight == 0.0 and c.verdict == Verdict.OUTWEIGHED.value for c in measured)
