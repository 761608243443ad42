"""What an agent keeps about one neighbor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.exchange.loop_closing import Meeting
from duagc.pipeline.exchange.wire.state_wire import State
from duagc.pipeline.network.transport import Transport

Pair = tuple[int, int]


@dataclass
class Neighbor:
    """One end of a radio link."""

    index: int
    name: str
    transport: Transport
    meeting: Meeting | None = None  # before it is known which end is which
    greeted: bool = False
    state: State | None = None
    verdict_message: int | None = None
    gone: bool = False  # silent for too long
    parted: bool = False  # its closures were refuted: as if never met
    contradiction: str = ""  # what the placement of the team has against the link
    undecided: bool = False  # parted because other links contradict it and nothing tells which is false
    last_weights: list[float] = field(default_factory=list)  # of the closures held, when the link was parted
    early: list[tuple[int, bytes]] = field(
        default_factory=list
    )  # TREE of a start still to come: parted, rest
    voxels: NDArray[np.int64] | None = None
    frames_told: dict[Pair, int] = field(default_factory=dict)  # message; 0 = it told this robot
    pairs_told: dict[Pair, int] = field(default_factory=dict)  # likewise
    anchors_told: set[int] = field(default_factory=set)  # owners
    voxels_told: bool = False
    evidence_sent: dict[int, int] = field(default_factory=dict)  # owner: message

    @property
    def decided(self) -> bool:
        """Whether it is settled if the two robots share a frame."""
        if self.gone:
            return True
        told = self.verdict_message is None or not self.transport.is_open(self.verdict_message)
        return self.meeting is not None and self.meeting.verdicts is not None and told

    @property
    def joined(self) -> bool:
        """Whether the two robots share a frame, and the neighbor knows it."""
        met = self.meeting is not None and self.meeting.joined is not None
        return met and not self.gone and not self.parted and self.decided
