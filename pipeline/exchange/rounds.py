"""Rounds of a team: one tick of every agent, then packets travel over the link model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, TypeVar

from duagc.pipeline.base.progress import track
from duagc.pipeline.exchange.agent import Agent
from duagc.pipeline.network.link_model import Fate, LinkModel
from duagc.pipeline.network.messages import Outgoing

AnyAgent = TypeVar("AnyAgent", bound=Agent)
AgentSeen = TypeVar("AgentSeen", bound=Agent, contravariant=True)
Delivery = tuple[int, str, int, bytes]
"""When a packet is delivered (ns), its sender, its sequence number, its bytes."""


class Observer(Protocol[AgentSeen]):
    """Sees what happens and changes nothing."""

    def ticked(self, agent: AgentSeen, round_index: int, now_ns: int) -> None:
        """An agent has computed its round.

        Args:
            agent: after its tick.
            round_index: the round, from 0.
            now_ns: its time in the session.
        """

    def sent(self, sender: str, out: Outgoing, fate: Fate, *, round_index: int, now_ns: int) -> None:
        """A packet was sent, and this became of it.

        Args:
            sender: name of the robot that sent it.
            out: the packet, its receiver and its message.
            fate: when its copies are delivered, or why it was dropped.
            round_index: in which it was sent.
            now_ns: time of this round in the session.
        """

    def ended(self, round_index: int) -> None:
        """All packets of a round were sent.

        Args:
            round_index: the round.
        """


def run_rounds(
    agents: Mapping[str, AnyAgent],
    model: LinkModel,
    observer: Observer[AnyAgent],
    *,
    period_ns: int,
    max_rounds: int,
    title: str,
) -> int:
    """Let agents exchange packets until all are done.

    Args:
        agents: by name, in the order of their ticks.
        model: decides what becomes of a packet.
        observer: of ticks and packets.
        period_ns: length of a round.
        max_rounds: the end, whatever has been agreed.
        title: of the progress bar.
    Returns:
        The number of rounds.
    """
    waiting: dict[str, list[Delivery]] = {robot: [] for robot in agents}
    round_index = 0
    for round_index in track(iter(range(max_rounds)), title):
        now_ns = round_index * period_ns
        bursts = []
        for robot, agent in agents.items():
            bursts.append((robot, agent.tick(round_index, due(waiting[robot], now_ns))))
            observer.ticked(agent, round_index, now_ns)
        for sender, burst in bursts:
            for out in burst:
                fate = model.fate(
                    sender, out.receiver, sequence=out.sequence, send_ns=now_ns, size=len(out.packet)
                )
                observer.sent(sender, out, fate, round_index=round_index, now_ns=now_ns)
                waiting[out.receiver].extend(
                    (at_ns, sender, out.sequence, out.packet) for at_ns in fate.deliver_ns
                )
        observer.ended(round_index)
        if all(agent.done for agent in agents.values()):
            break
    return round_index + 1


def due(waiting: list[Delivery], now_ns: int) -> list[bytes]:
    """Take the packets that have arrived out of a queue, by (time of delivery, sender, sequence).

    Args:
        waiting: deliveries to one robot; those that have arrived are removed, the rest is sorted.
        now_ns: the present time; what is delivered at this time has arrived.

    Returns:
        Bytes of the packets, in this order.
    """
    waiting.sort(key=lambda d: d[:3])
    count = next((i for i, d in enumerate(waiting) if d[0] > now_ns), len(waiting))
    arrived = [d[3] for d in waiting[:count]]
    del waiting[:count]
    return arrived
