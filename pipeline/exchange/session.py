"""One rendezvous of the team, recorded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from duagc.pipeline.base import determinism
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.recall import Recall, Recalling, computed
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.injection import check_liar
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.raw_alternative import RawAlternative
from duagc.pipeline.exchange.record import ConsensusRecorder, ExchangeRecorder
from duagc.pipeline.exchange.rounds import run_rounds
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.exchange.wire.state_wire import MAX_TEAM
from duagc.pipeline.network import link_model
from duagc.pipeline.network.link_model import Fate, LinkModel
from duagc.pipeline.network.messages import Outgoing
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.runs.robot_data import AgentInput, RobotData, SessionResult, load

__all__ = ["AgentInput", "run_session", "run_session_of"]


def run_session(
    inputs: Sequence[AgentInput],
    config: ExchangeConfig,
    *,
    seed: int,
    exchange_path: str | Path,
    consensus_path: str | Path,
    watch: RoundWatch | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> dict[str, SessionResult]:
    """Let the team meet.

    Args:
        inputs: files of every robot.
        config: the same for all.
        seed: of this run.
        exchange_path: log of messages and packets to write.
        consensus_path: log of rounds and loop closures to write.
        watch: hears of every round, and changes nothing.
        checkpoints: keep what is slow; a session that was killed begins again, and takes it from there.
    Returns:
        The result of every robot, by name.
    Raises:
        DuagError: a file that an agent needs is missing or broken, or the team is too large.
    """
    data = [SHELF.put(load(i)) for i in sorted(inputs, key=lambda i: i.robot)]
    SHELF.sweep(heap=True)
    return run_session_of(
        data,
        config,
        seed=seed,
        exchange_path=Path(exchange_path),
        consensus_path=Path(consensus_path),
        watch=watch,
        checkpoints=checkpoints,
    )


RoundWatch = Callable[[int, Mapping[str, int]], None]
"""Hears of every round what was sent: its number, and counts of packets, dropped packets and bytes."""


class _Recorder:
    """Both logs of a session, as rounds go by."""

    def __init__(
        self, exchange: ExchangeRecorder, consensus: ConsensusRecorder, watch: RoundWatch | None
    ) -> None:
        self.exchange, self.consensus, self.watch = exchange, consensus, watch
        self._counts = Counter[str]()

    def ticked(self, agent: MapAgent, round_index: int, now_ns: int) -> None:
        """Record where the agent stands."""
        self.consensus.round(agent, round_index, now_ns)

    def sent(self, sender: str, out: Outgoing, fate: Fate, *, round_index: int, now_ns: int) -> None:
        """Record a packet."""
        self.exchange.packet(sender, out, round_index=round_index, send_ns=now_ns, fate=fate)
        self._counts += Counter(packets=1, dropped=int(not fate.delivered), bytes=len(out.packet))

    def ended(self, round_index: int) -> None:
        """Nothing is recorded of a round as a whole; who watches hears of it."""
        if self.watch is not None:
            names = ("packets", "dropped", "bytes")
            self.watch(round_index, {name: self._counts[name] for name in names})
        self._counts.clear()


def run_session_of(
    data: Sequence[RobotData],
    config: ExchangeConfig,
    *,
    seed: int,
    exchange_path: Path,
    consensus_path: Path,
    watch: RoundWatch | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> dict[str, SessionResult]:
    """`run_session` on data in memory, one entry per robot.

    Args:
        data: of every robot, in any order.
        config: the same for all.
        seed: of this run.
        exchange_path: log of messages and packets to write.
        consensus_path: log of rounds and loop closures to write.
        watch: hears of every round, and changes nothing; None: nobody watches.
        checkpoints: keep what is slow.

    Returns:
        The result of every robot, by name.

    Raises:
        DuagError: two robots have the same name, the team is too large, the settings do not fit to it, or a
            map has numbers that are not finite.
    """
    determinism.configure_opencv()
    agents = team_of(data, config, seed, Recall(checkpoints, "session"))
    metadata = {"config": config.model_dump_json(), "seed": str(seed)}
    with (
        LogWriter(exchange_path, metadata=metadata) as exchange,
        LogWriter(consensus_path, metadata=metadata) as log,
    ):
        packets, rounds = ExchangeRecorder(exchange), ConsensusRecorder(log)
        count = run_rounds(
            agents,
            LinkModel(config.link, seed),
            _Recorder(packets, rounds, watch),
            period_ns=config.period_ns,
            max_rounds=config.max_rounds,
            title="rounds of the exchange",
        )
        now_ns = (count - 1) * config.period_ns
        results = {robot: result_of(agent) for robot, agent in agents.items()}
        for result in results.values():
            rounds.result(result, now_ns)
        packets.summary(
            list(agents),
            rounds=count,
            converged=all(result.converged for result in results.values()),
            raw=RawAlternative.of(data),
            now_ns=now_ns,
        )
    return results


def team_of(
    data: Sequence[RobotData], config: ExchangeConfig, seed: int, recall: Recalling = computed
) -> dict[str, MapAgent]:
    """The agents of a team, by name, in alphabetical order; each is given its own data only.

    Args:
        data: of every robot, in any order.
        config: the same for all.
        seed: of this run.
        recall: slow results; they change no bit.

    Raises:
        DuagError: two robots have the same name, the team is too large, or the settings do not fit to it.
    """
    names = sorted(d.robot for d in data)
    if len(set(names)) != len(names) or len(names) > MAX_TEAM:
        raise DuagError(f"team of {len(names)}: expected different names and at most {MAX_TEAM} robots")
    check_liar(config.injection, names)
    linked = link_model.neighbors(config.link, names)
    by_name = {d.robot: d for d in data}
    return {
        name: MapAgent(by_name[name], names, linked[name], config, seed=seed, recall=recall) for name in names
    }
