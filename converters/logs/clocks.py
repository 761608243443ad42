"""How the clocks of a team's robots differ, as far as their logs can tell.

- One recorder wrote the messages of several robots: its times are common to all. Headers of a robot lie before them by
  the time that messages take, at least; the least of it is taken to be the same for every robot.
- Each robot has its own recorder, and some messages stand in both logs, known by what they say and by the time in their
  header (what has no time, such as a counter, may be said twice): their times of recording differ by the clocks'
  difference and by the transmission from one robot to the other. Messages in both directions bound the difference from
  both sides; from one direction the time of transmission cannot be separated.
- Otherwise nothing can be said: robots that do not see each other move independently.
- Within one log, the least delay between header and recording changes evenly if the clocks of the two run at different
  rates (`drift`).
- Within one log, true poses and a gyroscope or odometry turn together: `lag` finds how far apart in time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.logs.choice import IMAGE_TYPES, INFO_TYPE, POINTS_TYPE
from duagc.converters.logs.entries import InvalidMessage, stamp_ns
from duagc.converters.logs.files import Log, is_below
from duagc.converters.logs.frames import TF_TYPES
from duagc.converters.logs.motion import IMU_TYPE
from duagc.converters.logs.video import is_video
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import so3
from duagc.pipeline.messages.parts import NANOSECONDS

MOST_SHARED = 5000  # messages of a log that are compared
LEAST_SHARED = 5
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
UNSHARED = (*IMAGE_TYPES, INFO_TYPE, POINTS_TYPE, IMU_TYPE, *TF_TYPES)  # large, or of every robot alike
Times = dict[tuple[str, bytes], int]
LEAST_OFFSET_S = 0.02  # what pairing of images bears, and what transport takes
RATE_HZ = 100.0  # of angular speeds that are compared
LEAST_CORRELATION = 0.8
LEAST_DRIFT_S = 60.0  # length of a log that can tell a drift
PIECES = 20  # of a log, in each of which one message is taken to have been recorded without delay
DRIFT_SIGMAS = 5.0
MOST_RATE = 1e-3  # by which two clocks differ; more is a recorder that cannot keep up


@dataclass(frozen=True)
class Drift:
    """How much later, by its header, a message was recorded: at the start and at the end of a log.

    Attributes:
        seconds: between the two.
        scatter_s: how far the least delays lie from a line.
    """

    start_s: float
    end_s: float
    seconds: float
    scatter_s: float

    @property
    def rate(self) -> float:
        """Seconds that the recorder's clock gains in one second of the headers'."""
        return (self.end_s - self.start_s) / self.seconds

    @property
    def matters(self) -> bool:
        """Whether it adds up to more than pairs of images bear, and is no play of the delays."""
        change = abs(self.end_s - self.start_s)
        return abs(self.rate) < MOST_RATE and change > max(LEAST_OFFSET_S, DRIFT_SIGMAS * self.scatter_s)

    def words(self) -> str:
        """One line for people."""
        return (
            f"the recorder's clock gains {1e6 * self.rate:.0f} ppm on that of the headers ({self.start_s:.3f} s after "
            f"them at the start, {self.end_s:.3f} s at the end, {self.seconds:.0f} s later), or it fell behind evenly"
        )


def drift(stamps_ns: NDArray[np.int64], delays_ns: NDArray[np.int64]) -> Drift | None:
    """The line through the least delays of pieces of a log; its slope is the median of those between two of them.

    Args:
        stamps_ns: times of headers [n].
        delays_ns: time of recording less those [n].
    Returns:
        None for a log that is too short to tell.
    """
    if len(stamps_ns) < 2:
        return None
    start, span = int(stamps_ns.min()), int(stamps_ns.max()) - int(stamps_ns.min())
    if span < LEAST_DRIFT_S * NANOSECONDS:
        return None
    seconds = (stamps_ns - start) / NANOSECONDS
    piece = np.minimum((seconds / (span / NANOSECONDS) * PIECES).astype(np.int64), PIECES - 1)
    order = np.lexsort((delays_ns, piece))
    _, first = np.unique(piece[order], return_index=True)
    least = order[first]
    if len(least) < PIECES // 2:
        return None
    t, d = seconds[least], delays_ns[least] / NANOSECONDS
    i, j = np.triu_indices(len(t), 1)
    slope = float(np.median((d[j] - d[i]) / (t[j] - t[i])))
    level = float(np.median(d - slope * t))
    scatter = float(np.median(np.abs(d - slope * t - level)))
    length = span / NANOSECONDS
    return Drift(level, level + slope * length, length, scatter)


@dataclass(frozen=True)
class RobotClock:
    """What the times of one robot's images say.

    Attributes:
        files: those that hold images.
        delays_ns: time of recording less that of the header, [n].
        header: times of the recording are those of headers (not of the recorder).
    """

    robot: str
    log: Log
    files: frozenset[Path]
    namespace: str
    delays_ns: NDArray[np.int64]
    start_ns: int
    end_ns: int
    header: bool


@dataclass(frozen=True)
class Offset:
    """What to add to a robot's times to have them on the reference's clock; None where it is not known.

    Attributes:
        low_s: bounds, None if that side is open.
        high_s: bounds, None if that side is open.
        how: in words.
    """

    seconds: float | None
    low_s: float | None
    high_s: float | None
    how: str

    @property
    def matters(self) -> bool:
        """Whether it is known, and larger than its uncertainty."""
        if self.seconds is None or abs(self.seconds) < LEAST_OFFSET_S:
            return False
        return not (self.low_s is not None and self.high_s is not None and self.low_s <= 0 <= self.high_s)

    def row(self) -> dict[str, Any]:
        """Plain numbers and text."""
        return {"offset_s": self.seconds, "low_s": self.low_s, "high_s": self.high_s, "how": self.how}


def compare(clocks: Sequence[RobotClock]) -> dict[str, Offset]:
    """Offset of every robot's times to those of the first, by the robots' names.

    Args:
        clocks: of all robots, the reference first.
    """
    reference = clocks[0]
    out = {reference.robot: Offset(0.0, 0.0, 0.0, "the reference")}
    known: dict[tuple[str, ...], Times] = {}
    for clock in clocks[1:]:
        out[clock.robot] = _offset(reference, clock, known)
    return out


def overlap_warnings(clocks: Sequence[RobotClock]) -> list[str]:
    """Robots whose times have nothing in common with those of the first.

    Args:
        clocks: of all robots, the reference first.
    """
    first = clocks[0]
    return [
        f"{c.robot}: its times ({c.start_ns / NANOSECONDS:.3f} to {c.end_ns / NANOSECONDS:.3f} s) have none in common "
        f"with those of {first.robot}"
        for c in clocks[1:]
        if c.start_ns > first.end_ns or c.end_ns < first.start_ns
    ]


def _offset(a: RobotClock, b: RobotClock, known: dict[tuple[str, ...], Times]) -> Offset:
    recorded = _recorder_offset(a, b, known)
    if recorded.seconds is None or not (a.header and b.header):
        return recorded
    # header + delay is the recorder's time; the least delays are taken to be equal, up to their usual size
    least_a, least_b = int(a.delays_ns.min()), int(b.delays_ns.min())
    usual = max(float(np.median(c.delays_ns)) - int(c.delays_ns.min()) for c in (a, b)) / NANOSECONDS
    between = (least_b - least_a) / NANOSECONDS
    low, high = recorded.low_s, recorded.high_s
    return Offset(
        recorded.seconds + between,
        None if low is None else low + between - usual,
        None if high is None else high + between + usual,
        recorded.how,
    )


def _recorder_offset(a: RobotClock, b: RobotClock, known: dict[tuple[str, ...], Times]) -> Offset:
    """What to add to times of b's recorder to have those of a's. known: of a, by topics; what is read is added."""
    if a.files & b.files:
        return Offset(0.0, 0.0, 0.0, "one recorder")
    shared = sorted(set(a.log.topics) & set(b.log.topics))
    shared = [t for t in shared if all(_tells_time(log, t) for log in (a.log, b.log))]
    times_a, times_b = known.get(tuple(shared)), _times(b.log, shared)
    if times_a is None:
        times_a = known[tuple(shared)] = _times(a.log, shared)
    rows = [(key[0], times_a[key] - times_b[key]) for key in times_a if key in times_b]
    if len(rows) < LEAST_SHARED:
        return Offset(None, None, None, "recorders of their own, and no messages that both recorded")
    differences = np.array([d for _, d in rows], dtype=np.float64) / NANOSECONDS
    sender = np.array([_sender(topic, a, b) for topic, _ in rows])
    # from a: recorded by b a little later, so a - b is at most the offset; from b: at least
    from_a, from_b = differences[sender == 1], differences[sender == 2]
    low = float(from_a.max()) if len(from_a) else None
    high = float(from_b.min()) if len(from_b) else None
    if low is not None and high is not None:
        low, high = min(low, high), max(low, high)  # a drift may turn them round
        return Offset((low + high) / 2, low, high, f"{len(rows)} messages that both recorded, sent by both")
    if low is not None or high is not None:
        one = low if low is not None else high
        return Offset(
            one,
            low,
            high,
            f"{len(rows)} messages that both recorded, sent by one: less the transmission between them",
        )
    middle = float(np.median(differences))
    ends = float(differences.min()), float(differences.max())
    return Offset(middle, *ends, f"{len(rows)} messages that both recorded, sent by it is not known whom")


def _sender(topic: str, a: RobotClock, b: RobotClock) -> int:
    """1 or 2: the robot whose namespace a topic is in; 0: neither."""
    for number, clock in ((1, a), (2, b)):
        if clock.namespace and is_below(topic, clock.namespace):
            return number
    return 0


def _tells_time(log: Log, topic: str) -> bool:
    """Whether the messages of a topic may be known again in another log: they hold a time, and are small."""
    known = log.topics[topic]
    if known.type in UNSHARED or is_video(known.type) or not known.count:
        return False
    try:
        return known.type == CLOCK_TYPE or hasattr(log.first(topic), "header")
    except DuagError:  # of a type that is not understood
        return False


def _times(log: Log, topics: Sequence[str]) -> Times:
    """When the messages of some topics were recorded, by topic and content; what comes twice is left out."""
    found: Times = {}
    twice: set[tuple[str, bytes]] = set()
    for number, entry in enumerate(log.entries(*topics) if topics else ()):
        if number >= MOST_SHARED:
            break
        try:
            if log.topics[entry.topic].type != CLOCK_TYPE and not stamp_ns(entry.read()):
                continue
        except InvalidMessage:  # of a topic that is not converted, perhaps
            continue
        key = entry.topic, hashlib.blake2b(entry.data, digest_size=16).digest()
        if key in found:
            twice.add(key)
        found[key] = entry.log_ns
    return {key: time for key, time in found.items() if key not in twice}


def lag(
    stamps_a_ns: NDArray[np.int64],
    speed_a: Array,
    stamps_b_ns: NDArray[np.int64],
    speed_b: Array,
    *,
    most_s: float = 2.0,
) -> tuple[float, float] | None:
    """How much later b turns than a, by angular speeds (rad/s) that one body shows to two sensors.

    Args:
        stamps_a_ns: increasing times of the first sensor, [n].
        speed_a: angular speed at these times, rad/s, [n].
        stamps_b_ns: increasing times of the second sensor, [m].
        speed_b: angular speed at these times, rad/s, [m].
        most_s: largest lag that is tried, in either direction, seconds.

    Returns:
        Lag in seconds and the correlation there; None if they do not correlate, or hardly turn.
    """
    if min(len(stamps_a_ns), len(stamps_b_ns)) < 2:
        return None
    start, stop = max(stamps_a_ns[0], stamps_b_ns[0]), min(stamps_a_ns[-1], stamps_b_ns[-1])
    seconds = (int(stop) - int(start)) / NANOSECONDS
    if seconds < 4 * most_s:
        return None
    grid = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    a, b = (
        np.interp(grid, (stamps - start) / NANOSECONDS, speed)
        for stamps, speed in ((stamps_a_ns, speed_a), (stamps_b_ns, speed_b))
    )
    most = int(most_s * RATE_HZ)
    inner = slice(most, len(a) - most)
    scores = np.array(
        [_correlation(a[inner], b[most + k : len(b) - most + k]) for k in range(-most, most + 1)]
    )
    best = int(np.argmax(scores))
    if not 0 < best < len(scores) - 1 or scores[best] < LEAST_CORRELATION:
        return None
    before, at, after = scores[best - 1 : best + 2]
    return (best - most + 0.5 * (before - after) / (before - 2 * at + after)) / RATE_HZ, float(at)


def angular_speed(stamps_ns: NDArray[np.int64], T_world_body: Array) -> tuple[NDArray[np.int64], Array]:
    """Times between the poses [n, 4, 4] of a body, and how fast it turned there (rad/s), [n - 1] each.

    Args:
        stamps_ns: increasing times of the poses, [n].
        T_world_body: [n, 4, 4].
    """
    R = T_world_body[:, :3, :3]
    turned = np.linalg.norm(so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]), axis=-1)
    steps = np.diff(stamps_ns)
    return stamps_ns[:-1] + steps // 2, turned * NANOSECONDS / steps


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 1e-9 else 0.0
