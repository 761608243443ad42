"""The team and its lossy links: rounds, packets, bytes. It carries packets and never looks into one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.exchange.wire.state_wire import MAX_TEAM
from duagc.pipeline.network.link_model import LinkModel
from duagc.pipeline.posegraph.files import TeamGraph
from duagc.pipeline.team_posegraph.admm import AdmmAgent
from duagc.pipeline.team_posegraph.agent import GraphAgent
from duagc.pipeline.team_posegraph.elimination import EliminationAgent
from duagc.pipeline.team_posegraph.printed_admm import PaperAgent

SOLVERS: dict[str, type[GraphAgent]] = {
    "admm": AdmmAgent,
    "elimination": EliminationAgent,
    "paper": PaperAgent,
}
_ROUND_NS = 100_000_000  # a packet that is not lost is there one round later


@dataclass
class Traffic:
    """What the team sent so far, lost packets included. sent: bytes by robot, headers included."""

    sent: dict[str, int]
    packets: int = 0
    lost: int = 0

    @property
    def bytes(self) -> int:
        """Of all robots."""
        return sum(self.sent.values())


Watch = Callable[[int, dict[str, GraphAgent], Traffic], None]


def meet(
    team: TeamGraph, config: PoseGraphConfig, watch: Watch
) -> tuple[dict[str, GraphAgent], Traffic, int]:
    """Let the team solve its graph.

    Args:
        team: every agent is given its own robot's graph only.
        watch: called after every round with its number, the agents and the traffic; for records, it changes nothing.
    Returns:
        The agents, the traffic, and how many rounds there were.
    """
    names = sorted(team.robots)
    if len(names) > MAX_TEAM:
        raise DuagError(f"team of {len(names)} robots, at most {MAX_TEAM}")
    make = SOLVERS[config.solver]
    built = track(names, "robots solve their own graphs")
    agents = {name: make(team.robots[name], names, config) for name in built}
    model = LinkModel(LinkConfig(loss_probability=config.loss_probability), config.seed)
    traffic = Traffic(dict.fromkeys(names, 0))
    waiting: dict[str, list[bytes]] = {name: [] for name in names}
    rounds = 0
    for rounds in track(iter(range(1, config.max_rounds + 1)), "rounds"):
        sent = [(name, agent.tick(rounds - 1, waiting[name])) for name, agent in agents.items()]
        waiting = {name: [] for name in names}
        for sender, burst in sent:
            for out in burst:
                traffic.sent[sender] += len(out.packet)
                traffic.packets += 1
                sequence = int.from_bytes(out.packet[8:12], "little")
                if model.fate(sender, out.receiver, sequence, rounds * _ROUND_NS, len(out.packet)).delivered:
                    waiting[out.receiver].append(out.packet)
                else:
                    traffic.lost += 1
        watch(rounds, agents, traffic)
        if all(agent.settled for agent in agents.values()):
            break
    return agents, traffic, rounds
