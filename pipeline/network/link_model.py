"""The simulated radio: who can talk to whom, and what becomes of a packet.

What becomes of a packet follows from the seed, its directed link, its sequence number, its size and its time, and,
where a link has a bandwidth, from the packets that the same sender put on the same link before. Every draw comes from
a stream that is named after the link and the packet, so two runs that differ elsewhere lose the same packets.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.component_names import robot_of, same_robot
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.network import LinkConfig, LinkWindow

LOST = "lost on the link"
BURST = "lost in a burst"
DOWN = "no link at this time"
FAR = "out of range"
QUEUE_FULL = "the sender's queue is full"


@dataclass(frozen=True)
class Fate:
    """What became of one packet.

    Attributes:
        deliver_ns: when it is delivered, at several times if it was duplicated; empty if it was dropped.
        reason: why it was dropped; empty if it was not.
    """

    deliver_ns: tuple[int, ...]
    reason: str = ""

    @property
    def delivered(self) -> bool:
        """Whether the packet reached its receiver."""
        return bool(self.deliver_ns)


def neighbors(config: LinkConfig, robots: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The robots that each robot has a radio link to at any time, in either direction, sorted.

    Components of one robot always have a link, inside it, and those to others that the robot has.

    Args:
        config: topology and switch of the links.
        robots: names of the team in any order, or of components; the topology is laid over the robots in
            alphabetical order. Links of robots that are not among them, because no map could be begun in their logs,
            count for nothing (`check_names` finds names that are wrong).
    Raises:
        DuagError: a robot has no waypoint.
    """
    components: dict[str, list[str]] = {}
    for name in sorted(robots):
        components.setdefault(robot_of(name), []).append(name)
    linked: dict[str, set[str]] = {name: set(components[robot_of(name)]) - {name} for name in robots}
    for one, other in _edges(config, sorted(components)) if config.enabled else ():
        for a in components[one]:
            linked[a] |= set(components[other])
            for b in components[other]:
                linked[b].add(a)
    return {name: tuple(sorted(linked[name])) for name in sorted(robots)}


def _edges(config: LinkConfig, names: list[str]) -> set[tuple[str, str]]:
    """Pairs of robots that can talk to each other at some time."""
    n = len(names)
    edges: set[tuple[int, int]] = set()
    if config.topology == "listed":
        ends = {(window.sender, window.receiver) for window in config.windows}
        return {(sender, receiver) for sender, receiver in ends if sender in names and receiver in names}
    if config.topology == "range":
        _check_waypoints(config, names)
    if config.topology in ("full", "range"):  # who is near may change
        edges = {(i, j) for i in range(n) for j in range(i)}
    elif config.topology == "star":
        edges = {(i, 0) for i in range(1, n)}
    elif config.topology in ("chain", "ring"):
        edges = {(i, i - 1) for i in range(1, n)}
        if config.topology == "ring" and n > 2:
            edges.add((n - 1, 0))
    return {(names[i], names[j]) for i, j in edges}


def check_names(config: LinkConfig, robots: Sequence[str]) -> None:
    """Refuse links of robots that a recording does not have, before hours are spent on a run that could not meet.

    Args:
        config: topology of the links.
        robots: names of all robots of the recording.

    Raises:
        DuagError: a window or waypoint names another robot, or a robot has no waypoint.
    """
    names = sorted(robots)
    if config.topology == "listed":
        for window in config.windows:
            _known(names, "windows", window.sender, window.receiver)
    if config.topology == "range":
        _known(names, "waypoints", *(waypoint.robot for waypoint in config.waypoints))
        _check_waypoints(config, names)


def _check_waypoints(config: LinkConfig, names: list[str]) -> None:
    for missing in sorted(set(names) - {waypoint.robot for waypoint in config.waypoints}):
        raise DuagError(f"exchange.link.waypoints: none of {missing}, expected one for each robot")


def _known(names: list[str], setting: str, *robots: str) -> None:
    for robot in robots:
        if robot not in names:
            raise DuagError(f"exchange.link.{setting}: robot {robot!r}, expected one of {', '.join(names)}")


@dataclass
class _Radio:
    """State of one directed link: when it is free again, and the ends of its good and bad times in turn."""

    free_ns: int = 0
    changes_ns: list[int] = field(default_factory=list)


class LinkModel:
    """Decides the fate of every packet. Packets of one directed link must be given in the order of sending."""

    def __init__(self, config: LinkConfig, seed: int) -> None:
        """Start at the beginning of a session.

        Args:
            config: of all links.
            seed: of the run; every directed link draws from a stream of its own.
        """
        self.config, self.seed = config, seed
        self._radios: dict[tuple[str, str], _Radio] = {}
        self._tracks = {
            robot: _Track.of(config, robot) for robot in {waypoint.robot for waypoint in config.waypoints}
        }

    def fate(self, sender: str, receiver: str, *, sequence: int, send_ns: int, size: int) -> Fate:
        """Decide what becomes of one packet.

        Args:
            sender: robot that sends it.
            receiver: robot that it is for.
            sequence: number of the packet on this directed link.
            send_ns: when it is handed to the radio, since the beginning of the session.
            size: bytes, header included.
        """
        config = self.config
        if same_robot(sender, receiver):
            return Fate((send_ns + 1,))  # it never leaves the robot; it was sent before it is there
        ends = robot_of(sender), robot_of(receiver)
        radio = self._radios.setdefault(ends, _Radio())
        start_ns = max(send_ns, radio.free_ns)
        if start_ns - send_ns > config.queue_ns:
            return Fate((), QUEUE_FULL)
        on_air_ns = 0
        if config.bandwidth_bytes_per_s:
            on_air_ns = size * 1_000_000_000 // config.bandwidth_bytes_per_s
            radio.free_ns = start_ns + on_air_ns
        window = self._window(*ends, start_ns)
        if config.topology == "listed" and window is None:
            return Fate((), DOWN)
        if config.topology == "range" and self._distance_m(*ends, start_ns) > config.range_m:
            return Fate((), FAR)
        draws = _Draws(self.seed, sender, receiver, sequence)
        loss = config.loss_probability
        if window is not None and window.loss_probability is not None:
            loss = window.loss_probability
        if loss > 0.0 and draws.next() < loss:
            return Fate((), LOST)
        if self._in_burst(radio, *ends, start_ns) and draws.next() < config.burst_loss_probability:
            return Fate((), BURST)
        arrival_ns = max(
            start_ns + on_air_ns + config.latency_ns, send_ns + 1
        )  # it was sent before it is there
        copies = 1 + (config.duplicate_probability > 0.0 and draws.next() < config.duplicate_probability)
        return Fate(tuple(sorted(arrival_ns + self._jitter_ns(draws) for _ in range(copies))))

    def _jitter_ns(self, draws: _Draws) -> int:
        return int(draws.next() * (self.config.jitter_ns + 1)) if self.config.jitter_ns else 0

    def _window(self, sender: str, receiver: str, now_ns: int) -> LinkWindow | None:
        """The first listed window that is open in this direction."""
        for window in self.config.windows if self.config.topology == "listed" else ():
            ends = (window.sender, window.receiver)
            this_way = ends == (sender, receiver) or (window.both_ways and ends == (receiver, sender))
            if (
                this_way
                and window.from_ns <= now_ns
                and (window.until_ns is None or now_ns < window.until_ns)
            ):
                return window
        return None

    def _distance_m(self, one: str, other: str, now_ns: int) -> float:
        return float(np.linalg.norm(self._tracks[one].at(now_ns) - self._tracks[other].at(now_ns)))

    def _in_burst(self, radio: _Radio, sender: str, receiver: str, now_ns: int) -> bool:
        """Whether a directed link is in its bad state: good and bad times in turn, exponentially distributed."""
        config = self.config
        if not config.burst_length_ns:
            return False
        while not radio.changes_ns or radio.changes_ns[-1] <= now_ns:
            k = len(radio.changes_ns)
            mean_ns = config.burst_length_ns if k % 2 else config.burst_gap_ns
            stream = random_streams.generator(
                self.seed, "link.burst", sender=sender, receiver=receiver, change=k
            )
            before = radio.changes_ns[-1] if k else 0
            radio.changes_ns.append(before + 1 + int(stream.exponential(mean_ns)))
        return bisect_right(radio.changes_ns, now_ns) % 2 == 1


class _Draws:
    """Numbers in [0, 1) for one packet, drawn only when needed."""

    def __init__(self, seed: int, sender: str, receiver: str, sequence: int) -> None:
        self._key = seed, sender, receiver, sequence
        self._stream: np.random.Generator | None = None

    def next(self) -> float:
        if self._stream is None:
            seed, sender, receiver, sequence = self._key
            self._stream = random_streams.generator(
                seed, "link", sender=sender, receiver=receiver, sequence=sequence
            )
        return float(self._stream.random())


@dataclass(frozen=True)
class _Track:
    """Where one robot's radio is: times [n] (ns), positions [n, 3] (m)."""

    times_ns: NDArray[np.float64]
    positions_m: NDArray[np.float64]

    @staticmethod
    def of(config: LinkConfig, robot: str) -> _Track:
        own = sorted((w for w in config.waypoints if w.robot == robot), key=lambda w: w.time_ns)
        return _Track(np.array([float(w.time_ns) for w in own]), np.array([w.position_m for w in own]))

    def at(self, now_ns: int) -> NDArray[np.float64]:
        """Position [3] at a time: on the straight line between two waypoints, at the first and last beyond them."""
        return np.array([np.interp(now_ns, self.times_ns, column) for column in self.positions_m.T])
