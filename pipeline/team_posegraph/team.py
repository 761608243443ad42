"""The team and its lossy links: rounds, packets, bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.exchange.rounds import run_rounds
from duagc.pipeline.exchange.wire.reader import MAX_COORDINATE
from duagc.pipeline.exchange.wire.state_wire import MAX_TEAM
from duagc.pipeline.network.link_model import Fate, LinkModel
from duagc.pipeline.network.messages import Outgoing
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.files import TeamGraph
from duagc.pipeline.team_posegraph.agent import PoseGraphAgent


@dataclass
class Traffic:
    """What the team sent so far, lost packets included.

    Attributes:
        sent: bytes by robot, headers included.
        packets: how many.
        lost: of them.
    """

    sent: dict[str, int]
    packets: int = 0
    lost: int = 0

    @property
    def bytes(self) -> int:
        """Of all robots."""
        return sum(self.sent.values())


Watch = Callable[[int, dict[str, PoseGraphAgent], Traffic], None]
"""Called after every round with its number from 1, the agents and the traffic; for records, it changes nothing."""


class _Counter:
    """Counts packets, and calls the watch after every round."""

    def __init__(self, agents: dict[str, PoseGraphAgent], watch: Watch) -> None:
        self.agents, self.watch, self.traffic = agents, watch, Traffic(dict.fromkeys(agents, 0))

    def ticked(self, agent: PoseGraphAgent, round_index: int, now_ns: int) -> None:
        """Nothing is counted of a tick."""

    def sent(self, sender: str, out: Outgoing, fate: Fate, *, round_index: int, now_ns: int) -> None:
        """Count a packet."""
        self.traffic.sent[sender] += len(out.packet)
        self.traffic.packets += 1
        self.traffic.lost += not fate.delivered

    def ended(self, round_index: int) -> None:
        """Let the watch look."""
        self.watch(round_index + 1, self.agents, self.traffic)


def meet(
    team: TeamGraph, config: PoseGraphConfig, watch: Watch
) -> tuple[dict[str, PoseGraphAgent], Traffic, int]:
    """Let the team solve its graph.

    Args:
        team: every agent is given its own robot's graph only.
        config: the same at all robots.
        watch: called after every round.
    Returns:
        The agents, the traffic, and how many rounds there were.
    Raises:
        DuagError: the team is too large, or so far apart that relative frames cannot be sent.
    """
    names = sorted(team.robots)
    if len(names) > MAX_TEAM:
        raise DuagError(f"team of {len(names)} robots, at most {MAX_TEAM}")
    built = track(names, "robots solve their own graphs")
    agents = {name: PoseGraphAgent(team.robots[name], names, config) for name in built}
    settings = next(iter(agents.values())).config
    counter = _Counter(agents, watch)
    try:
        rounds = run_rounds(
            agents,
            LinkModel(settings.link, config.seed),
            counter,
            period_ns=settings.period_ns,
            max_rounds=settings.max_rounds,
            title="rounds",
        )
    except MalformedError as error:  # what a robot decided cannot be sent
        raise DuagError(f"pose graph: {error}; expected a team within {MAX_COORDINATE:g} m") from error
    return agents, counter.traffic, rounds
