"""One rendezvous of the team: a round is one tick of every agent, packets travel between them over the link model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from duagc.pipeline.base import determinism
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.agent import Agent
from duagc.pipeline.exchange.record import ConsensusRecorder, ExchangeRecorder, RawAlternative
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.exchange.wire.state_wire import MAX_TEAM
from duagc.pipeline.network import link_model
from duagc.pipeline.network.link_model import LinkModel
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.runs.robot_data import AgentInput, AgentResult, RobotData, load

__all__ = ["AgentInput", "run_session", "run_session_of"]

Delivery = tuple[int, str, int, bytes]  # deliver_ns, sender, sequence, packet


def run_session(
    inputs: Sequence[AgentInput],
    config: ExchangeConfig,
    *,
    seed: int,
    exchange_path: Path,
    consensus_path: Path,
) -> dict[str, AgentResult]:
    """Let the team meet.

    Args:
        inputs: files of every robot.
        config: the same for all. seed: of this run.
        exchange_path, consensus_path: logs to write.
    Returns:
        What every robot takes home, by name.
    Raises:
        DuagError: a file that an agent needs is missing or broken, or the team is too large.
    """
    data = [load(i) for i in sorted(inputs, key=lambda i: i.robot)]
    return run_session_of(data, config, seed=seed, exchange_path=exchange_path, consensus_path=consensus_path)


def run_session_of(
    data: Sequence[RobotData],
    config: ExchangeConfig,
    *,
    seed: int,
    exchange_path: Path,
    consensus_path: Path,
) -> dict[str, AgentResult]:
    """`run_session` on data in memory, one entry per robot."""
    determinism.configure_opencv()
    agents = team_of(data, config, seed)
    model = LinkModel(config.link, seed)
    waiting: dict[str, list[Delivery]] = {robot: [] for robot in agents}
    metadata = {"config": config.model_dump_json(), "seed": str(seed)}
    with (
        LogWriter(exchange_path, metadata=metadata) as exchange,
        LogWriter(consensus_path, metadata=metadata) as log,
    ):
        packets, rounds = ExchangeRecorder(exchange), ConsensusRecorder(log)
        now_ns = round_index = 0
        for round_index in track(iter(range(config.max_rounds)), "exchange"):
            now_ns = round_index * config.period_ns
            sent = []
            for robot, agent in agents.items():
                delivered = due(waiting[robot], now_ns)
                sent.append((robot, agent.tick(round_index, now_ns, delivered)))
                rounds.round(agent, round_index, now_ns)
            for sender, burst in sent:
                for out in burst:
                    sequence = int.from_bytes(out.packet[8:12], "little")
                    fate = model.fate(sender, out.receiver, sequence, now_ns, len(out.packet))
                    packets.packet(sender, out, sequence, round_index, now_ns, fate)
                    waiting[out.receiver].extend(
                        (at_ns, sender, sequence, out.packet) for at_ns in fate.deliver_ns
                    )
            if all(agent.done for agent in agents.values()):
                break
        results = {robot: result_of(agent) for robot, agent in agents.items()}
        for result in results.values():
            rounds.result(result, now_ns)
        packets.summary(
            list(agents),
            round_index + 1,
            all(result.converged for result in results.values()),
            RawAlternative.of(data),
            now_ns,
        )
    return results


def team_of(data: Sequence[RobotData], config: ExchangeConfig, seed: int) -> dict[str, Agent]:
    """The agents of a team, by name, in alphabetical order; each is given its own data only."""
    names = sorted(d.robot for d in data)
    if len(set(names)) != len(names) or len(names) > MAX_TEAM:
        raise DuagError(f"team of {len(names)}: expected different names and at most {MAX_TEAM} robots")
    linked = link_model.neighbors(config.link, names)
    by_name = {d.robot: d for d in data}
    return {name: Agent(by_name[name], names, linked[name], config, seed) for name in names}


def due(waiting: list[Delivery], now_ns: int) -> list[bytes]:
    """Take the packets that have arrived out of a queue, by (time of delivery, sender, sequence)."""
    waiting.sort(key=lambda d: d[:3])
    count = next((i for i, d in enumerate(waiting) if d[0] > now_ns), len(waiting))
    arrived = [d[3] for d in waiting[:count]]
    del waiting[:count]
    return arrived
