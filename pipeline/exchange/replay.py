"""One agent again, from its own files and the packets that reached it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline.base import determinism
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.rounds import Delivery, due
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.network import link_model
from duagc.pipeline.runs.robot_data import AgentInput, RobotData, SessionResult, load


@dataclass(frozen=True)
class SentPackets:
    """Digests of all packets that a robot sent, in order.

    Attributes:
        recorded: of those in the log.
        recomputed: of those of the replay.
    """

    recorded: str
    recomputed: str

    @property
    def equal(self) -> bool:
        """Whether they are the same bit for bit."""
        return self.recorded == self.recomputed


def replay_agent(
    source: AgentInput, config: ExchangeConfig, *, seed: int, exchange_path: Path
) -> tuple[SessionResult, SentPackets]:
    """Recompute one robot's agent.

    Args:
        source: files of this robot only.
        config: of the run.
        seed: of the run.
        exchange_path: its exchange.mcap; only packets delivered to this robot are given to the agent.
    Returns:
        The result of the robot, and whether it sent the same packets.
    """
    return replay_agent_of(load(source), config, seed=seed, exchange_path=exchange_path)


def replay_agent_of(
    data: RobotData, config: ExchangeConfig, *, seed: int, exchange_path: Path
) -> tuple[SessionResult, SentPackets]:
    """`replay_agent` on data in memory.

    Args:
        data: of this robot.
        config: of the run.
        seed: of the run.
        exchange_path: its exchange.mcap; only packets delivered to this robot are given to the agent.

    Raises:
        DuagError: it is no log of a finished session.
    """
    determinism.configure_opencv()
    session = read_session(exchange_path)
    waiting: list[Delivery] = []
    recorded, recomputed = hashlib.sha256(), hashlib.sha256()
    for p in session.packets:
        if p.sender == data.robot:
            recorded.update(p.data)
        if p.receiver == data.robot:
            waiting.extend((at_ns, p.sender, p.sequence, p.data) for at_ns in p.deliver_ns)
    neighbors = link_model.neighbors(config.link, session.team)[data.robot]
    agent = MapAgent(data, session.team, neighbors, config, seed=seed)
    for round_index in range(session.rounds):
        for out in agent.tick(round_index, due(waiting, round_index * config.period_ns)):
            recomputed.update(out.packet)
    return result_of(agent), SentPackets(recorded.hexdigest(), recomputed.hexdigest())
