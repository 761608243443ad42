"""Reliable messages to one neighbor: cutting, bursts within a budget, selective acknowledgement, reassembly.

A burst holds, in this order: acknowledgements, the state of this round, then the open messages by kind and id,
what is overdue before what is new. Where packets wait in a queue, acknowledgements say so to the sender, which then
sends what the link takes (`congestion`). Nothing here looks into a payload, except that evidence is passed on chunk by
chunk.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.network import TransportConfig
from duagc.pipeline.network.chunks import ChunkNews, OpenMessage, PartialMessage, priority
from duagc.pipeline.network.congestion import FULL_ROUNDS, MOST_ROUNDS, Congestion, LinkObserver, SendRate
from duagc.pipeline.network.messages import Arrival, Message, Outgoing
from duagc.pipeline.network.packets import (
    EVIDENCE_KINDS,
    HEADER_BYTES,
    MAX_PACKET_BYTES,
    MAX_PAYLOAD_BYTES,
    URGENT_KINDS,
    Kind,
    MalformedError,
    Packet,
    chunk_bytes,
    chunk_count,
    serialize,
)
from duagc.pipeline.network.signatures import SIGNATURE_BYTES, Identity

_ACK_HEAD = struct.Struct("<IIH")  # message id, first chunk, number of chunks; then one bit per chunk
_FULL_LINK = struct.Struct("<IIHI")  # no message, bytes a round that it takes, late rounds, round of sending
_FULL_LINK_ID = 2**32 - 1
MAX_REPEATS = 32
LAST_CHUNKS = 3
LOSSY = 0.97  # share of packets heard below which a link loses some
SEQUENCE_BLOCK = 1024
ACK_CHUNKS = 8 * (MAX_PAYLOAD_BYTES - _ACK_HEAD.size)


class Transport:
    """One end of the link to one neighbor."""

    def __init__(
        self,
        own: int,
        peer: int,
        peer_name: str,
        config: TransportConfig,
        *,
        new_id: Callable[[], int],
        identity: Identity | None = None,
    ) -> None:
        """Nothing is queued.

        Args:
            own: index of this robot in the sorted team.
            peer: index of the neighbor.
            peer_name: its name.
            config: of retransmission.
            new_id: gives message ids that are unique for this sender.
            identity: signs the packets; without, they are not signed.
        """
        self.own, self.peer, self.peer_name, self.config = own, peer, peer_name, config
        self.new_id = new_id
        self._seal = serialize if identity is None else identity.seal
        signature_bytes = 0 if identity is None else SIGNATURE_BYTES
        self._overhead_bytes = HEADER_BYTES + signature_bytes
        self.sequence = 0
        self.last_heard: int | None = None
        self._open: dict[int, OpenMessage] = {}
        self._partial: dict[int, PartialMessage] = {}
        self._received: dict[int, tuple[Kind, int]] = {}  # complete messages: kind, total bytes
        self._to_acknowledge: dict[int, ChunkNews] = {}
        self._packets_heard = self._highest_sequence = 0
        self._heard: dict[int, int] = {}  # sequence numbers, a mask for each block of SEQUENCE_BLOCK
        self._observer = LinkObserver()
        self._rate = SendRate(MAX_PACKET_BYTES + signature_bytes)

    # --- outgoing

    def send(self, message: Message) -> None:
        """Queue a reliable message of at most `max_message_bytes`.

        Args:
            message: for the neighbor.
        """
        size, most = len(message.payload), self.config.max_message_bytes
        if size > most:  # every neighbor refuses it
            raise DuagError(f"exchange.transport.max_message_bytes is {most}, expected at least {size}")
        n = chunk_count(message.kind, size)
        self._open[message.id] = OpenMessage(message, np.zeros(n, bool), np.zeros(n, np.int64))

    def cancel(self, message: int) -> None:
        """Stop sending a message, if it is still open.

        Args:
            message: its id.
        """
        self._open.pop(message, None)

    def cancel_all(self) -> None:
        """Stop sending whatever is still open."""
        self._open.clear()

    def is_open(self, message: int) -> bool:
        """Whether a message is not yet fully acknowledged.

        Args:
            message: its id.
        """
        return message in self._open

    @property
    def open_messages(self) -> int:
        """Queued messages that are not yet fully acknowledged."""
        return len(self._open)

    @property
    def idle(self) -> bool:
        """Whether every queued message has been acknowledged."""
        return not self._open

    def in_contact(self, round_index: int) -> bool:
        """Whether the neighbor was heard lately.

        Args:
            round_index: the current round.
        """
        return (
            self.last_heard is not None
            and round_index - self.last_heard <= self.config.contact_lost_after_rounds
        )

    def burst(self, round_index: int, states: list[Message], budget_bytes: int) -> list[Outgoing]:
        """All packets of this round for this neighbor.

        Args:
            round_index: the current round.
            states: fire-and-forget messages, one packet each.
            budget_bytes: most that may be sent, headers included.
        """
        out: list[Outgoing] = []
        acknowledgements = self._acknowledgements(round_index)
        most_bytes, budget_bytes = budget_bytes, self._rate.budget(budget_bytes, round_index)
        more = False
        for message in [*acknowledgements, *states]:
            size = self._overhead_bytes + len(message.payload)
            if size > budget_bytes:
                more = True  # what is left counts in the next round, so that even the slowest link is never silent
                break
            budget_bytes -= size
            out.append(self._packet(message, 0, round_index))
        if not more and self.in_contact(round_index):
            for entry, chunk in self._due(round_index):
                size = self._overhead_bytes + entry.size(chunk)
                if size > budget_bytes:
                    more = True
                    break
                budget_bytes -= size
                after_rounds = self._retransmit_after(entry.message.kind) + self._rate.queued_rounds
                entry.due_round[chunk] = round_index + after_rounds
                out.append(self._packet(entry.message, chunk, round_index))
        sent_bytes, trip = sum(len(o.packet) for o in out), self._round_trip
        self._rate.sent(sent_bytes, budget_bytes, most_bytes, round_index, round_trip=trip, more=more)
        return out

    @property
    def repeat_after_rounds(self) -> int:
        """Rounds after which a state that did not change should go out again: the sooner the more is lost."""
        return self._retransmit_after(Kind.TREE)

    def _retransmit_after(self, kind: Kind) -> int:
        """Rounds until a packet counts as lost: never less than there and back take.

        What others wait for goes out again the sooner the more is lost: an answer that will not come is no use.
        """
        rounds = max(self.config.retransmit_after_rounds, self._round_trip)
        return max(1, round(rounds * self._share_heard)) if kind in URGENT_KINDS else rounds

    @property
    def _share_heard(self) -> float:
        """Share of the neighbor's packets that arrived here, by the gaps in their sequence numbers."""
        return self._packets_heard / (self._highest_sequence + 1)

    @property
    def _round_trip(self) -> int:
        """Rounds there and back when nothing waits, with room for the two ends."""
        return 2 * (self._observer.least_delay or 0) + 2

    def _due(self, round_index: int) -> Iterator[tuple[OpenMessage, int]]:
        """Chunks to send, in order; overdue ones later if acknowledgements have to wait.

        Where packets are lost, the last chunks of a message that is no evidence go in every round: while the neighbor
        waits for them, the link has little else to do.
        """
        waits = self._observer.excess_rounds(round_index)
        repeats = self._share_heard < LOSSY and waits + self._rate.queued_rounds < FULL_ROUNDS
        for entry in sorted(self._open.values(), key=priority):
            late = np.where(entry.due_round > 0, waits, 0)
            missing = ~entry.acknowledged
            last = missing.sum() <= LAST_CHUNKS and entry.message.kind not in EVIDENCE_KINDS
            if not (repeats and last):
                missing &= entry.due_round + late <= round_index
            for chunk in np.flatnonzero(missing).tolist():
                yield entry, chunk

    def _packet(self, message: Message, chunk: int, round_index: int) -> Outgoing:
        step = chunk_bytes(message.kind)
        packet = Packet(
            kind=message.kind,
            sender=self.own,
            receiver=self.peer,
            sequence=self.sequence,
            round=round_index,
            message=message.id,
            offset=chunk * step,
            total=len(message.payload),
            payload=message.payload[chunk * step : (chunk + 1) * step],
        )
        self.sequence += 1
        return Outgoing(self.peer_name, packet.sequence, self._seal(packet), message)

    def _acknowledgements(self, round_index: int) -> list[Message]:
        """ACK messages for every chunk that arrived lately, with what arrived around it."""
        parts: list[bytes] = []
        for message in sorted(self._to_acknowledge):
            news = self._to_acknowledge[message]
            for base in range(news.first - news.first % 8, news.last + 1, ACK_CHUNKS):
                bits = self._bits(message, base, ACK_CHUNKS)  # up to the last one that is here
                head = _ACK_HEAD.pack(message, base, len(bits))
                parts.append(head + np.packbits(bits, bitorder="little").tobytes())
            if news.until_round <= round_index:
                del self._to_acknowledge[message]
        full = self._observer.congestion(round_index)
        if full is not None:
            self._rate.guess(full, round_index)
            said = (full.bytes_per_round, min(full.excess_rounds, MOST_ROUNDS), full.sent_round)
            parts.insert(0, _FULL_LINK.pack(_FULL_LINK_ID, *said))
        payloads: list[bytes] = []
        for part in parts:
            if payloads and len(payloads[-1]) + len(part) <= MAX_PAYLOAD_BYTES:
                payloads[-1] += part
            else:
                payloads.append(part)
        return [Message(self.new_id(), Kind.ACK, payload) for payload in payloads]

    def _repeats(self) -> int:
        """In how many further rounds to repeat an acknowledgement, so that 19 of 20 get through.

        The loss is that of the packets heard, seen from the gaps in their sequence numbers: none, no repetition.
        """
        loss = 1.0 - self._share_heard
        if loss <= 0.0:
            return 0
        return min(MAX_REPEATS, math.ceil(math.log(0.05) / math.log(loss)))

    def _bits(self, message: int, base: int, most: int) -> NDArray[np.bool_]:
        """Which of the chunks from `base` on, at most so many, are here."""
        if message in self._received:
            n = chunk_count(*self._received[message])
            return np.ones(min(most, n - base), dtype=bool)
        partial = self._partial[message]
        bits = np.zeros(min(most, chunk_count(partial.kind, partial.total) - base), dtype=bool)
        here = np.fromiter(partial.chunks, dtype=np.int64, count=len(partial.chunks)) - base
        here = here[(here >= 0) & (here < len(bits))]
        bits[here] = True
        return bits[: here.max(initial=-1) + 1]

    # --- incoming

    def receive(self, packet: Packet, round_index: int) -> Arrival | None:
        """Take one parsed packet from this neighbor.

        Args:
            packet: from this neighbor to this robot.
            round_index: the current round.
        Returns:
            A complete message, or a chunk of evidence not seen before; None if there is nothing to act on.
        Raises:
            MalformedError: it contradicts what came before, or asks for too much; it is then ignored.
        """
        block, bit = packet.sequence // SEQUENCE_BLOCK, 1 << packet.sequence % SEQUENCE_BLOCK
        heard = self._heard.get(block, 0)
        if heard & bit:
            return None  # a copy that the network made, or a replayed packet
        self._heard[block] = heard | bit  # however far sequence numbers jump
        self.last_heard = round_index
        self._packets_heard += 1
        size = self._overhead_bytes + len(packet.payload)
        self._observer.heard(packet.sequence, packet.round, round_index, size)
        self._highest_sequence = max(self._highest_sequence, packet.sequence)
        if packet.kind is Kind.ACK:
            self._take_acknowledgements(packet.payload, round_index)
            return None
        if packet.kind is Kind.STATE:
            return Arrival(packet.kind, packet.message, packet.payload, complete=True)
        return self._take_chunk(packet, round_index)

    def _take_chunk(self, packet: Packet, round_index: int) -> Arrival | None:
        known = self._received.get(packet.message)
        partial = self._partial.get(packet.message)
        if partial is not None:
            known = (partial.kind, partial.total)
        if known is not None and known != (packet.kind, packet.total):
            raise MalformedError(
                f"message {packet.message} was {known[0].name} of {known[1]} bytes, "
                f"now {packet.kind.name} of {packet.total}"
            )
        chunk = packet.offset // chunk_bytes(packet.kind)
        if known is None:
            if packet.total > self.config.max_message_bytes:
                raise MalformedError(
                    f"message of {packet.total} bytes, at most {self.config.max_message_bytes}"
                )
            if len(self._partial) >= self.config.max_open_messages:
                raise MalformedError(f"more than {self.config.max_open_messages} incomplete messages")
            partial = self._partial[packet.message] = PartialMessage(packet.kind, packet.total)
        news = self._to_acknowledge.setdefault(packet.message, ChunkNews(chunk, chunk, 0))
        news.first, news.last = min(news.first, chunk), max(news.last, chunk)
        news.until_round = round_index + self._repeats()
        if partial is None or chunk in partial.chunks:
            return None
        partial.chunks[chunk] = packet.payload
        n = chunk_count(packet.kind, packet.total)
        complete = len(partial.chunks) == n
        if complete:
            del self._partial[packet.message]
            self._received[packet.message] = (packet.kind, packet.total)
            return Arrival(
                packet.kind, packet.message, b"".join(partial.chunks[i] for i in range(n)), complete=True
            )
        if packet.kind in EVIDENCE_KINDS:
            return Arrival(packet.kind, packet.message, packet.payload, complete=False)
        return None

    def accept_rest(self, message: int, round_index: int) -> None:
        """Acknowledge all of a message that is not needed any more: its content is here already.

        Args:
            message: its id.
            round_index: the current round.
        """
        partial = self._partial.pop(message, None)
        if partial is not None:
            self._received[message] = (partial.kind, partial.total)
            last = chunk_count(partial.kind, partial.total) - 1
            self._to_acknowledge[message] = ChunkNews(0, last, round_index + self._repeats())

    def _take_acknowledgements(self, payload: bytes, round_index: int) -> None:
        """Mark what the neighbor acknowledges; acknowledgements of anything else have no effect."""
        position = 0
        while position < len(payload):
            if position + _ACK_HEAD.size > len(payload):
                raise MalformedError("acknowledgement is cut short")
            message, base, count = _ACK_HEAD.unpack_from(payload, position)
            if message == _FULL_LINK_ID and position + _FULL_LINK.size <= len(payload):
                _, carried, excess, sent_round = _FULL_LINK.unpack_from(payload, position)
                position += _FULL_LINK.size
                late = self._rate.take(Congestion(excess, carried, sent_round), round_index)
                for waiting in self._open.values():
                    waiting.due_round[waiting.due_round > 0] += late
                continue
            position += _ACK_HEAD.size
            size = -(-count // 8)
            if position + size > len(payload):
                raise MalformedError("bits of an acknowledgement are cut short")
            raw = np.frombuffer(payload, np.uint8, size, position)
            position += size
            entry = self._open.get(message)
            if entry is None or base + count > len(entry.acknowledged):
                continue
            entry.acknowledged[base : base + count] |= np.unpackbits(
                raw, count=count, bitorder="little"
            ).astype(bool)
            if entry.acknowledged.all():
                del self._open[message]
