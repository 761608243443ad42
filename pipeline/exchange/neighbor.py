"""What an agent keeps about one neighbor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.exchange.loop_closing import LoopClosureProtocol
from duagc.pipeline.exchange.wire.state_wire import State
from duagc.pipeline.network.transport import Transport

Pair = tuple[int, int]


@dataclass
class Revocation:
    """Whether, and why, the link to a neighbor does not count any more.

    Attributes:
        revoked: the two robots count as if they had never met.
        undecided: other links contradict this one, and nothing shows which of them is false.
        contradiction: how the placement of the team contradicts the link; empty if it does not.
        weights: of the loop closures held, when the link was revoked.
    """

    revoked: bool = False
    undecided: bool = False
    contradiction: str = ""
    weights: list[float] = field(default_factory=list)


@dataclass
class Passed:
    """Flooded messages that a neighbor has, or was sent.

    Attributes:
        frames: relative frames by pair, with the id of the message; 0: they came from the neighbor.
        pairs: pair lists, likewise.
        poses: owners of agreed poses.
        voxels: the space that this robot saw.
        evidence: ids of messages by owner of the evidence.
        current: newest version of poses that are not final, with the id of its message, by owner.
    """

    frames: dict[Pair, int] = field(default_factory=dict)
    pairs: dict[Pair, int] = field(default_factory=dict)
    poses: set[int] = field(default_factory=set)
    voxels: bool = False
    evidence: dict[int, int] = field(default_factory=dict)
    current: dict[int, tuple[int, int]] = field(default_factory=dict)


@dataclass
class Neighbor:
    """One end of a radio link.

    Attributes:
        index: of the neighbor in the sorted team.
        name: of the neighbor.
        transport: the own end of the radio link.
        loop_closing: None before it is known which end has which role.
        verdict_message: id of the own message that says what was decided.
        hello_sent: the greeting is on its way.
        lost: silent for too long.
        state: the last one that came.
        sent_state: the last one that was sent, and its round.
        link: whether the link still counts.
        passed: flooded messages that it has.
        early: messages of the solver for a start that is still to come: revoked links, the rest.
        voxels: keys of the space that it saw.
    """

    index: int
    name: str
    transport: Transport
    loop_closing: LoopClosureProtocol | None = None
    verdict_message: int | None = None
    hello_sent: bool = False
    lost: bool = False
    state: State | None = None
    sent_state: tuple[bytes, int] = (b"", 0)
    link: Revocation = field(default_factory=Revocation)
    passed: Passed = field(default_factory=Passed)
    early: list[tuple[int, bytes]] = field(default_factory=list)
    voxels: NDArray[np.int64] | None = None

    def was_sent(self, state: bytes, round_index: int) -> bool:
        """Whether it was sent this very state lately.

        Args:
            state: the bytes of the own state.
            round_index: the current round.
        """
        known, sent_round = self.sent_state
        due = round_index - sent_round >= self.transport.repeat_after_rounds
        return self.transport.last_heard is not None and state == known and not due

    def note_sent(self, state: bytes, round_index: int) -> None:
        """Remember that it is sent a state.

        Args:
            state: the bytes of the own state.
            round_index: the current round.
        """
        self.sent_state = state, round_index

    @property
    def decided(self) -> bool:
        """Whether it is final if the two robots share a frame, and the neighbor knows it."""
        if self.lost:
            return True
        acknowledged = self.verdict_message is None or not self.transport.is_open(self.verdict_message)
        return self.loop_closing is not None and self.loop_closing.decided and acknowledged

    @property
    def joined(self) -> bool:
        """Whether the two robots share a frame, and the neighbor knows it."""
        met = self.loop_closing is not None and self.loop_closing.joined is not None
        return met and not self.lost and not self.link.revoked and self.decided

    @property
    def may_send_evidence(self) -> bool:
        """Whether evidence may still come from it: a neighbor that will not be joined stops what it began to send."""
        return self.joined or not (self.lost or self.link.revoked or self.decided)
