"""The logs of a session: every message once, every packet by reference, every round of every agent."""

from __future__ import annotations

import hashlib
import heapq
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc import schemas
from duagc.pipeline.base.component_names import same_robot
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.raw_alternative import RawAlternative
from duagc.pipeline.messages import map_frame, pack_pose, pack_stamp
from duagc.pipeline.messages.parts import pack_information
from duagc.pipeline.network.link_model import Fate
from duagc.pipeline.network.messages import Outgoing
from duagc.pipeline.network.packets import (
    EVIDENCE_KINDS,
    HEADER_BYTES,
    Kind,
    MalformedError,
    parse,
    payload_bytes,
)
from duagc.pipeline.recording import LogWriter, read_log
from duagc.pipeline.runs.robot_data import SessionResult
from duagc.schemas import topics


def _write(writer: LogWriter, topic: str, message: Any, now_ns: int) -> None:
    """Write a message with the time of the session."""
    pack_stamp(message, now_ns)
    writer.write(topic, message, now_ns)


class ExchangeRecorder:
    """Writes exchange.mcap."""

    def __init__(self, writer: LogWriter) -> None:
        """Nothing was sent.

        Args:
            writer: of the log.
        """
        self.writer = writer
        self._known: set[tuple[str, int]] = set()
        self._on_air: set[tuple[str, int]] = set()  # of these, what a radio carried
        self._by_content: dict[bytes, tuple[str, int]] = {}
        self._totals: dict[tuple[str, str, str], list[int]] = {}  # packets, dropped, bytes, bytes delivered
        # a heap: arrival (ns), link, bytes
        self._on_the_way: list[tuple[int, tuple[str, str, str], int]] = []

    def packet(self, sender: str, out: Outgoing, *, round_index: int, send_ns: int, fate: Fate) -> None:
        """Record one packet, and its message if this is the first packet of it.

        Args:
            sender: name of the robot that sent it.
            out: the packet, its receiver and its message.
            round_index: in which it was sent.
            send_ns: when it was sent, time of the session.
            fate: when its copies are delivered, or why it was dropped.
        """
        self._message(sender, out, send_ns)
        length = payload_bytes(out.packet)
        end = HEADER_BYTES + length
        packet = parse(out.packet[:end])
        message = schemas.new(
            "PeerPacket",
            robot=sender,
            receiver=out.receiver,
            sequence=out.sequence,
            round=round_index,
            message=out.message.id,
            offset=packet.offset,
            length=length,
            header=out.packet[:HEADER_BYTES],
            signature=out.packet[end:],
            delivered=fate.delivered,
            deliver_ns=fate.deliver_ns[0] if fate.delivered else 0,
            copies_deliver_ns=fate.deliver_ns[1:],
            dropped=fate.reason,
        )
        _write(self.writer, topics.PEER_PACKET.of(sender), message, send_ns)
        if same_robot(sender, out.receiver):
            return  # between components of one robot: no radio carries it
        self._on_air.add((sender, out.message.id))
        link = sender, out.receiver, out.message.kind.name
        totals = self._totals.setdefault(link, [0, 0, 0, 0])
        totals[0] += 1
        totals[1] += not fate.delivered
        totals[2] += len(out.packet)
        self._arrive(send_ns)
        for at_ns in fate.deliver_ns:
            heapq.heappush(self._on_the_way, (at_ns, link, len(out.packet)))

    def _arrive(self, now_ns: int) -> None:
        """Count what has arrived."""
        while self._on_the_way and self._on_the_way[0][0] <= now_ns:
            _, link, size = heapq.heappop(self._on_the_way)
            self._totals[link][3] += size

    def _message(self, sender: str, out: Outgoing, send_ns: int) -> None:
        key = (sender, out.message.id)
        if key in self._known:
            return
        self._known.add(key)
        payload = out.message.payload
        earlier = self._by_content.setdefault(hashlib.sha256(payload).digest(), key)
        message = schemas.new(
            "PeerMessage",
            robot=sender,
            message=out.message.id,
            kind=int(out.message.kind),
            kind_name=out.message.kind.name,
            length=len(payload),
        )
        if earlier == key:
            message.payload = payload
        else:
            message.same_as_robot, message.same_as_message = earlier
        _write(self.writer, topics.PEER_MESSAGE.of(sender), message, send_ns)

    def summary(
        self, team: list[str], *, rounds: int, converged: bool, raw: RawAlternative, now_ns: int
    ) -> None:
        """Record what the session cost.

        Args:
            team: names, sorted.
            rounds: how many there were.
            converged: whether every robot has all that it should have.
            raw: for comparison.
            now_ns: time of the last round.
        """
        self._arrive(now_ns)  # no agent sees what comes after the last round
        message = schemas.new(
            "ExchangeSummary",
            team=team,
            rounds=rounds,
            converged=converged,
            messages=len(self._on_air),
            bytes_raw_alternative=raw.maps_and_information,
            bytes_raw_alternative_maps_only=raw.maps_only,
        )
        for (sender, receiver, kind), (packets, dropped, size, arrived) in sorted(self._totals.items()):
            message.links.add(
                sender=sender,
                receiver=receiver,
                kind_name=kind,
                packets_sent=packets,
                packets_dropped=dropped,
                bytes_sent=size,
                bytes_delivered=arrived,
            )
            message.packets_sent += packets
            message.packets_dropped += dropped
            message.bytes_sent += size
            message.bytes_delivered += arrived
            message.bytes_setup += size * (kind not in RUNNING_KINDS)
        _write(self.writer, topics.EXCHANGE_SUMMARY.pattern, message, now_ns)


RUNNING_KINDS = frozenset(kind.name for kind in (Kind.ACK, Kind.STATE, *EVIDENCE_KINDS))
"""Names of kinds whose bytes are not set-up; messages of a solver are."""


@dataclass(frozen=True)
class Recorded:
    """A recorded session.

    Attributes:
        team: names, sorted.
        rounds: how many there were.
        packets: all of them in the order of sending.
    """

    team: tuple[str, ...]
    rounds: int
    packets: list[RecordedPacket]


@dataclass(frozen=True)
class RecordedPacket:
    """One packet of a recorded session, rebuilt.

    Attributes:
        sender: name of the robot that sent it.
        receiver: name of the robot that it is for.
        sequence: its number on this directed link.
        round: in which it was sent.
        kind_name: of its message.
        send_ns: when it was sent.
        deliver_ns: when every copy arrived; empty if it was dropped.
        dropped: why it was dropped; empty if it was not.
        data: its bytes.
    """

    sender: str
    receiver: str
    sequence: int
    round: int
    kind_name: str
    send_ns: int
    deliver_ns: tuple[int, ...]
    dropped: str
    data: bytes


def read_session(exchange_path: Path) -> Recorded:
    """A session with every packet rebuilt from its header and its message.

    Args:
        exchange_path: its exchange.mcap.

    Raises:
        DuagError: a packet refers to a message that is not there or is not what its header says; no summary.
    """
    messages: dict[tuple[str, int], tuple[str, bytes]] = {}
    packets: list[RecordedPacket] = []
    summary = None
    for record in read_log(exchange_path):
        m = record.message()
        if record.schema == topics.PEER_MESSAGE.schema:
            payload = m.payload
            if m.same_as_robot:
                payload = _lookup(exchange_path, messages, m.same_as_robot, m.same_as_message)[1]
            messages[m.robot, m.message] = (m.kind_name, payload)
        elif record.schema == topics.PEER_PACKET.schema:
            kind_name, payload = _lookup(exchange_path, messages, m.robot, m.message)
            data = m.header + payload[m.offset : m.offset + m.length]
            try:
                parse(data)
            except MalformedError as error:
                where = f"{exchange_path}: {record.topic} sequence {m.sequence}"
                raise DuagError(f"{where} is no packet ({error}), expected what its header says") from error
            packets.append(
                RecordedPacket(
                    sender=m.robot,
                    receiver=m.receiver,
                    sequence=m.sequence,
                    round=m.round,
                    kind_name=kind_name,
                    send_ns=record.log_time_ns,
                    deliver_ns=(m.deliver_ns, *m.copies_deliver_ns) if m.delivered else (),
                    dropped=m.dropped,
                    data=data + m.signature,
                )
            )
        elif record.schema == topics.EXCHANGE_SUMMARY.schema:
            summary = m
    if summary is None:
        raise DuagError(
            f"{exchange_path}: {topics.EXCHANGE_SUMMARY.pattern} not found, expected a finished session"
        )
    return Recorded(tuple(summary.team), summary.rounds, packets)


def _lookup(
    path: Path, messages: dict[tuple[str, int], tuple[str, bytes]], robot: str, message: int
) -> tuple[str, bytes]:
    found = messages.get((robot, message))
    if found is None:
        raise DuagError(f"{path}: message {message} of {robot} not found before its first use")
    return found


class ConsensusRecorder:
    """Writes consensus.mcap."""

    def __init__(self, writer: LogWriter) -> None:
        """Nothing was written.

        Args:
            writer: of the log.
        """
        self.writer = writer
        self._last: dict[str, bytes] = {}

    def round(self, agent: MapAgent, round_index: int, now_ns: int) -> None:
        """Record where an agent stands, if that changed, and its pose round, if there was one.

        Args:
            agent: after its tick of this round.
            round_index: the round.
            now_ns: its time in the session.
        """
        robot = agent.data.robot
        self._write_changed(topics.AGENT_ROUND.of(robot), self._agent(agent), round_index, now_ns)
        if agent.poses is not None:
            self._write_changed(topics.CONSENSUS_ROUND.of(robot), self._poses(agent), round_index, now_ns)

    def _write_changed(self, topic: str, message: Any, round_index: int, now_ns: int) -> None:
        """Rounds in which nothing changed are left out: the last one written still holds."""
        content = message.SerializeToString(deterministic=True)
        if self._last.get(topic) != content:
            self._last[topic] = content
            message.round = round_index
            _write(self.writer, topic, message, now_ns)

    @staticmethod
    def _agent(agent: MapAgent) -> Any:
        neighbors = agent.neighbors.values()
        return schemas.new(
            "AgentRound",
            frame_id=map_frame(agent.team[agent.alignment.root]),
            robot=agent.data.robot,
            root=agent.team[agent.alignment.root],
            members=[agent.team[i] for i in agent.alignment.members],
            joined_links=sum(n.joined for n in neighbors),
            undecided_links=sum(not n.decided for n in neighbors),
            evidence_owners=len(agent.knowledge.evidence),
            pair_lists=len(agent.knowledge.pairs),
            open_messages=sum(n.transport.open_messages for n in neighbors),
            revoked_links=sum(n.link.revoked for n in neighbors),
            agreed=agent.agreed,
            done=agent.done,
            packets_refused=sum(agent.refused.values()),
        )

    @staticmethod
    def _poses(agent: MapAgent) -> Any:
        assert agent.poses is not None
        values = agent.poses.residuals()
        largest = agent.poses.largest_change
        message = schemas.new(
            "ConsensusRound",
            frame_id=map_frame(agent.team[agent.alignment.root]),
            robot=agent.data.robot,
            primal=values["primal"],
            dual=values["dual"],
            cost=values["cost"],
            step=values["step"],
            largest_change=largest,
            converged=agent.poses.converged,
            agreed=agent.agreed,
            factorizations=values["factorizations"],
        )
        for peer, (translation, rotation) in sorted(values["penalties"].items()):
            message.links.add(
                peer=peer,
                penalty_translation=translation,
                penalty_rotation=rotation,
                version=values["versions"][peer],
                weights=values["weights"].get(peer, []),
            )
        return message

    def result(self, result: SessionResult, now_ns: int) -> None:
        """Record what became of every candidate.

        Args:
            result: of one robot.
            now_ns: time of the last round.
        """
        for c in result.closures:
            message = schemas.new(
                "LoopClosureDecision",
                robot=c.robot,
                peer=c.peer,
                own_keyframe=c.own_keyframe,
                peer_keyframe=c.peer_keyframe,
                score=c.score,
                matches=c.matches,
                inliers=c.inliers,
                verdict=c.verdict,
                detail=c.detail,
                measured=c.T_own_peer is not None,
                weight=-1.0 if c.weight is None else c.weight,
            )
            if c.T_own_peer is not None:
                message.pose_own_peer.CopyFrom(pack_pose(c.T_own_peer))
            if c.information is not None:
                message.information.extend(pack_information(c.information))
            _write(self.writer, topics.LOOP_CLOSURE_DECISION.of(c.robot), message, now_ns)
