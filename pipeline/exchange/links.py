"""The simulated radio: who can talk to whom, and what becomes of a packet."""

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline import streams
from pipeline.exchange.config import LinkConfig

LOST = "lost on the link"


@dataclass(frozen=True)
class Fate:
    """What became of one packet: delivered at a time, or dropped for a reason."""

    deliver_ns: int | None
    reason: str = ""

    @property
    def delivered(self) -> bool:
        """Whether the packet reached its receiver."""
        return self.deliver_ns is not None


def neighbours(config: LinkConfig, robots: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The robots that each robot can talk to, sorted.

    Args:
        config: topology and switch of the links.
        robots: names of the team in any order; the topology is laid over them in alphabetical order.
    """
    names = sorted(robots)
    n = len(names)
    edges: set[tuple[int, int]] = set()
    if config.enabled and config.topology == "full":
        edges = {(i, j) for i in range(n) for j in range(i)}
    elif config.enabled and config.topology == "star":
        edges = {(i, 0) for i in range(1, n)}
    elif config.enabled and config.topology in ("chain", "ring"):
        edges = {(i, i - 1) for i in range(1, n)}
        if config.topology == "ring" and n > 2:
            edges.add((n - 1, 0))
    linked: dict[str, set[str]] = {name: set() for name in names}
    for i, j in edges:
        linked[names[i]].add(names[j])
        linked[names[j]].add(names[i])
    return {name: tuple(sorted(linked[name])) for name in names}


class LinkModel:
    """Decides the fate of every packet, from nothing but the seed, the link and the packet's sequence number."""

    def __init__(self, config: LinkConfig, seed: int) -> None:
        self.config, self.seed = config, seed

    def fate(self, sender: str, receiver: str, sequence: int, send_ns: int) -> Fate:
        """Fate of one packet sent at `send_ns`; it depends on no other packet and on no other draw."""
        p = self.config.loss_probability
        if p > 0.0:
            draw = streams.generator(
                self.seed, "link", sender=sender, receiver=receiver, sequence=sequence
            ).random()
            if draw < p:
                return Fate(None, LOST)
        return Fate(send_ns + self.config.latency_ns)
