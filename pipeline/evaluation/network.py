"""What the robots said to each other and how they came to agree, from exchange.mcap and consensus.mcap.

The one place that knows the messages of these two logs. A run whose robots never talked has empty logs, and absent
values with that reason.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.component_names import robot_of, same_robot
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation.oracle import (
    NO_LISTS,
    NO_MATCHES,
    gap_to_oracle,
    matches_among,
    never_weighted,
    unlisted,
    used_matches,
)
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.exchange.record import RUNNING_KINDS
from duagc.pipeline.messages.parts import unpack_stamp
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT
from duagc.pipeline.recording import Record, read_log
from duagc.pipeline.runs.folder import RunFolder, written
from duagc.schemas import topics

Series = dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]

SOLVERS = {
    "admm": "relaxed edge-ADMM (poses), evidence sent once (Gaussians)",
    "elimination": "elimination along a tree of robots (poses), evidence sent once (Gaussians)",
    "elected": "an elected robot with all graphs (poses), evidence sent once (Gaussians)",
    "block_descent": "block-coordinate descent, robots take turns (poses), evidence sent once (Gaussians)",
    "algorithm_1": "Algorithm 1 of the paper, corrected: matched Gaussians move poses",
    "algorithm_1_printed": "Algorithm 1 of the paper, as printed: poses and matched Gaussians move together",
}
PURPOSE = {  # of a message, by its kind
    "HELLO": "set-up",
    "DESCRIPTORS": "set-up",
    "REQUEST": "set-up",
    "SAMPLE": "set-up",
    "RECTIFIED_REQUEST": "set-up",
    "RECTIFIED": "set-up",
    "CLOSURES": "set-up",
    "RELATIVE_FRAME": "set-up",
    "VOXELS": "set-up",
    "PAIRS": "set-up",
    "ANCHORS": "set-up",
    "CURRENT_POSES": "set-up",
    "EVIDENCE": "Gaussians",
    "EVIDENCE_EXACT": "Gaussians",
    "EVIDENCE_DOUBLE": "Gaussians",
    "STATE": "poses",
    "TREE": "poses",
    "ACK": "acknowledgements",
}
PURPOSES = ("Gaussians", "poses", "set-up", "acknowledgements")
PAPER_BYTES_PER_PAIR = 2 * 28 * 4  # 28 float32 from each of the two robots
NO_EXCHANGE = Absent("the robots exchanged nothing")


@dataclass(frozen=True)
class Packets:
    """Every packet of a session, one element each, in the order of the log.

    Attributes:
        round: when it was sent.
        sender: names.
        receiver: names.
        kind: of its message, names.
        size_bytes: header and payload.
        lost: whether it was dropped on its way.
        arrived: how often it arrived until the last round.
        messages: how many these packets are cut from.
    """

    round: NDArray[np.int64]
    sender: NDArray[np.str_]
    receiver: NDArray[np.str_]
    kind: NDArray[np.str_]
    size_bytes: NDArray[np.int64]
    lost: NDArray[np.bool_]
    arrived: NDArray[np.int64]
    messages: int

    def __len__(self) -> int:
        return len(self.round)

    @cached_property
    def purpose(self) -> NDArray[np.str_]:
        """What each is for."""
        return np.array([PURPOSE[kind] for kind in self.kind.tolist()], dtype=np.str_)

    @property
    def setup_bytes(self) -> int:
        """All but states of rounds, evidence and acknowledgements."""
        return int(self.size_bytes[~np.isin(self.kind, sorted(RUNNING_KINDS))].sum())


@dataclass(frozen=True)
class Link:
    """One direction of one link: packets and bytes sent, packets lost."""

    sender: str
    receiver: str
    packets: int
    dropped: int
    size_bytes: int


def is_inlier(decision: Any) -> bool:
    """Whether a loop closure is an inlier in the end: it took part, and the robust weight did not turn it off.

    Args:
        decision: duagc.v1.LoopClosureDecision.
    """
    return decision.weight >= INLIER_WEIGHT


def measured(decision: Any) -> bool:
    """Whether a candidate got as far as geometry: a motion between the two keyframes was sought and some matches fit.

    Keyframes that resemble nothing, or that the budget of requests left out, did not.

    Args:
        decision: duagc.v1.LoopClosureDecision.
    """
    return decision.measured or decision.inliers > 0


def follows_moved(decision: Any) -> bool:
    """Whether a candidate shows something that moved between the recordings of two robots.

    Args:
        decision: duagc.v1.LoopClosureDecision.
    """
    from duagc.pipeline.exchange.verification import Verdict

    return bool(decision.verdict == Verdict.SOMETHING_MOVED.value)


class Session:
    """The two logs of the exchange of one run; each is read when it is asked for, and once."""

    def __init__(self, run: RunFolder) -> None:
        """Take the run; its logs are read later.

        Args:
            run: with exchange.mcap and consensus.mcap.
        """
        self.run = run

    def _records(self, name: str, *of: topics.Topic) -> Iterator[Record]:
        """The records of all robots on some topics, in order of the log."""
        path = written(self.run.path / name)
        return read_log(path, topics=[topic.of(robot) for topic in of for robot in self.run.robots])

    def _log(self, name: str, topic: topics.Topic) -> list[Any]:
        """The messages of all robots on one topic, in order of the log."""
        return [record.message() for record in self._records(name, topic)]

    @cached_property
    def packets(self) -> Packets:
        """All packets of the session.

        Raises:
            DuagError: a packet refers to a message that the log does not have, or to an unknown kind.
        """
        of_messages = {topics.PEER_MESSAGE.of(robot) for robot in self.run.robots}
        kinds, packets = {}, []
        for record in self._records("exchange.mcap", topics.PEER_MESSAGE, topics.PEER_PACKET):
            m = record.message()
            if record.topic in of_messages:
                kinds[m.robot, m.message] = m.kind_name
            else:
                packets.append(m)
        rows, used = [], set()
        for p in packets:
            if same_robot(p.robot, p.receiver):
                continue  # no radio carried it
            kind = kinds.get((p.robot, p.message))
            if kind not in PURPOSE:
                found = "no message" if kind is None else f"a message of kind {kind}"
                raise DuagError(
                    f"{self.run.path / 'exchange.mcap'}: packet {p.sequence} of {p.robot} is cut from {found}, "
                    f"expected one of {', '.join(PURPOSE)}"
                )
            used.add((p.robot, p.message))
            times_ns = (p.deliver_ns, *p.copies_deliver_ns) if p.delivered else ()
            rows.append((p.round, p.robot, p.receiver, kind, _size(p), not p.delivered, times_ns))
        end_ns = unpack_stamp(self.summary) if rows else 0
        columns = list(zip(*rows, strict=True)) or [()] * 7
        return Packets(
            round=np.array(columns[0], dtype=np.int64),
            sender=np.array(columns[1], dtype=np.str_),
            receiver=np.array(columns[2], dtype=np.str_),
            kind=np.array(columns[3], dtype=np.str_),
            size_bytes=np.array(columns[4], dtype=np.int64),
            lost=np.array(columns[5], dtype=np.bool_),
            arrived=np.array([sum(at <= end_ns for at in times) for times in columns[6]], dtype=np.int64),
            messages=len(used),
        )

    @cached_property
    def links(self) -> list[Link]:
        """Every direction that was used, in order of the names."""
        p = self.packets
        out = []
        for sender, receiver in sorted(set(zip(p.sender.tolist(), p.receiver.tolist(), strict=True))):
            on = (p.sender == sender) & (p.receiver == receiver)
            dropped = int(np.count_nonzero(on & p.lost))
            out.append(
                Link(sender, receiver, int(np.count_nonzero(on)), dropped, int(p.size_bytes[on].sum()))
            )
        return out

    @cached_property
    def agent_rounds(self) -> list[Any]:
        """Every duagc.v1.AgentRound, in order of the log."""
        return self._log("consensus.mcap", topics.AGENT_ROUND)

    @cached_property
    def consensus_rounds(self) -> list[Any]:
        """Every duagc.v1.ConsensusRound, in order of the log."""
        return self._log("consensus.mcap", topics.CONSENSUS_ROUND)

    @cached_property
    def loop_closures(self) -> list[Any]:
        """Every duagc.v1.LoopClosureDecision, in order of the log: candidates and their verdicts."""
        return self._log("consensus.mcap", topics.LOOP_CLOSURE_DECISION)

    def loop_closure_counts(self) -> dict[str, int]:
        """Inter-robot loop closures that are inliers in the end, and measured candidates that were rejected."""
        between = [d for d in self.loop_closures if not same_robot(d.robot, d.peer)]
        kept = [is_inlier(d) for d in between]
        rejected = [measured(d) and not (is_inlier(d) or never_weighted(d)) for d in between]
        return {"inter_robot_loop_closures": sum(kept), "inter_robot_loop_closures_rejected": sum(rejected)}

    @cached_property
    def pairs(self) -> dict[tuple[str, str], NDArray[np.int64]]:
        """Ids of matched Gaussians [n, 2] by robots, lower name first: the newest pair lists that were sent."""
        from duagc.pipeline.exchange.wire.state_wire import PairList, read_pairs

        newest: dict[tuple[int, int], PairList] = {}
        for message in self._log("exchange.mcap", topics.PEER_MESSAGE):
            if message.kind_name == "PAIRS" and message.payload:
                pairs = read_pairs(message.payload, len(self.run.robots))
                key = (pairs.lower, pairs.higher)
                if key not in newest or newest[key].version < pairs.version:
                    newest[key] = pairs
        names = sorted(self.run.robots)
        return {(names[a], names[b]): newest[a, b].ids for a, b in sorted(newest)}

    @cached_property
    def unlisted_pairs(self) -> set[tuple[str, str]]:
        """Pairs of robots that share a world, but of whose matches no list was sent."""
        return unlisted([robot.component for robot in self.run.robots.values()], self.pairs)

    def matched_pairs(self) -> int | Absent:
        """Pairs of matched Gaussians over all pairs of robots; components of one robot are no pair."""
        if not all(same_robot(*pair) for pair in self.unlisted_pairs):
            return NO_LISTS
        return sum(len(ids) for pair, ids in self.pairs.items() if not same_robot(*pair))

    @cached_property
    def summary(self) -> Any:
        """The duagc.v1.ExchangeSummary that closes the log of the exchange.

        Raises:
            DuagError: it is missing: the session did not end.
        """
        path, topic = self.run.path / "exchange.mcap", topics.EXCHANGE_SUMMARY.pattern
        found = [record.message() for record in read_log(path, topics=[topic])] if path.is_file() else []
        if not found:
            raise DuagError(f"{path}: {topic} not found, expected the log of a finished session")
        return found[-1]

    def exchange_section(self) -> dict[str, Any]:
        """The section `exchange` of metrics.json."""
        p = self.packets
        ticks, matched = self.summary.rounds, self.matched_pairs()
        robot_pairs = len({frozenset(map(robot_of, (link.sender, link.receiver))) for link in self.links})
        sent = int(p.size_bytes.sum())
        per_pair = sent / (ticks * robot_pairs) if ticks * robot_pairs else NO_EXCHANGE
        paper = matched if isinstance(matched, Absent) else matched * PAPER_BYTES_PER_PAIR * ticks
        return {
            "sessions": 1,
            "rounds": ticks,
            "messages": p.messages,
            "packets_sent": len(p),
            "packets_dropped": int(np.count_nonzero(p.lost)),
            "bytes_sent": sent,
            "bytes_delivered": int((p.size_bytes * p.arrived).sum()),
            "bytes_setup": p.setup_bytes,
            "bytes_per_round_per_robot_pair": per_pair,
            "bytes_raw_alternative": self.summary.bytes_raw_alternative,
            "bytes_raw_alternative_maps_only": self.summary.bytes_raw_alternative_maps_only,
            "bytes_paper_accounting": paper,
            "matched_pairs": matched,
        }

    def consensus_section(self) -> dict[str, Any]:
        """The section `consensus` of metrics.json."""
        gap = gap_to_oracle(self.run, self.loop_closures, self.pairs)
        gaps = {
            "gap_to_oracle_sigma": gap if isinstance(gap, Absent) else gap.sigma,
            "gap_to_oracle_sigma_p99": gap if isinstance(gap, Absent) else gap.sigma_p99,
            "gap_to_oracle_m": gap if isinstance(gap, Absent) else gap.meters,
            "gap_to_oracle_rad": gap if isinstance(gap, Absent) else gap.radians,
        }
        last = {m.robot: m for m in self.agent_rounds}
        together = {robot for robot, m in last.items() if len({robot_of(name) for name in m.members}) > 1}
        agreed: dict[str, int] = {}
        for m in self.agent_rounds:
            if m.agreed:
                agreed.setdefault(m.robot, m.round)
        ticks: int | Absent = max((agreed.get(robot, 0) for robot in together), default=0) + 1
        if not together:
            ticks = Absent("no two robots share a world")
        elif together - set(agreed):
            late = ", ".join(sorted(together - set(agreed)))
            ticks = Absent(f"{late} did not get there in {self.summary.rounds} rounds")
        solver = SOLVERS[self.run.config.exchange.solver]
        return {
            "solver": solver,
            "converged": self.summary.converged,
            "rounds_to_tolerance": ticks,
            **gaps,
            "rejected_matches_share": self.rejected_matches_share(),
        }

    def rejected_matches_share(self) -> float | Absent:
        """Share of the matches of each robot's component that the robot did not use; all robots together."""
        if self.unlisted_pairs:
            return NO_LISTS
        robots = self.run.robots.values()
        matches = sum(len(ids) for r in robots for ids in matches_among(r.component, self.pairs).values())
        used = sum(len(ids) for r in robots for ids in used_matches(r, self.pairs).values())
        return (matches - used) / matches if matches else NO_MATCHES

    @property
    def period_ns(self) -> int:
        """Length of a round."""
        return self.run.config.exchange.period_ns

    def series_by_round(self) -> Mapping[str, Series]:
        """Curves over rounds: "change" and "primal" per robot (m and rad), "bytes" per purpose."""
        change: dict[str, list[tuple[int, float, float]]] = {}
        for m in self.consensus_rounds:
            change.setdefault(m.robot, []).append((m.round, m.largest_change, m.primal))
        p = self.packets
        ticks = np.arange(self.summary.rounds, dtype=np.int64)
        spent: Series = {}
        for purpose in PURPOSES:
            on = p.purpose == purpose
            if on.any():
                weights = p.size_bytes[on].astype(np.float64)
                spent[purpose] = (ticks, np.bincount(p.round[on], weights, len(ticks)).astype(np.float64))
        return {
            "change": {robot: _columns(rows, 1) for robot, rows in sorted(change.items())},
            "primal": {robot: _columns(rows, 2) for robot, rows in sorted(change.items())},
            "bytes": spent,
        }


def _size(packet: Any) -> int:
    """Bytes of a duagc.v1.PeerPacket on the air."""
    return len(packet.header) + int(packet.length) + len(packet.signature)


def _columns(
    rows: list[tuple[int, float, float]], column: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    return np.array([r[0] for r in rows], dtype=np.int64), np.array(
        [r[column] for r in rows], dtype=np.float64
    )
