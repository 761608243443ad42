"""What goes into the transport and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass

from duagc.pipeline.network.packets import Kind


@dataclass(frozen=True)
class Message:
    """A message to send.

    Attributes:
        id: unique for its sender.
        kind: of its content.
        payload: its bytes.
    """

    id: int
    kind: Kind
    payload: bytes


@dataclass(frozen=True)
class Outgoing:
    """One packet to send.

    Attributes:
        receiver: name of the robot that it is for.
        sequence: its number on this directed link.
        packet: its bytes.
        message: what it is cut from.
    """

    receiver: str
    sequence: int
    packet: bytes
    message: Message


@dataclass(frozen=True)
class Arrival:
    """What a delivered packet brought.

    Attributes:
        kind: of the message.
        message: its id.
        payload: of the message, or of a chunk of evidence.
        complete: it is a message, not a chunk.
    """

    kind: Kind
    message: int
    payload: bytes
    complete: bool
