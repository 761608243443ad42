"""How two robots come to share loop closures: what an agent needs of it, whatever the source.

`DetectedLoopClosures` recognizes places from images and verifies them (`detected_loop_closures`);
`KnownLoopClosures` has them from a file (`known_loop_closures`). Either gives the agent one protocol per neighbor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes, link_metric
from duagc.pipeline.exchange.place_recognition import Candidate
from duagc.pipeline.exchange.verification import Verified
from duagc.pipeline.exchange.wire.state_wire import (
    RelativeFrames,
    read_relative_frames,
    write_relative_frames,
)
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Proposal
from duagc.pipeline.posegraph.loop_closures import Group, KeyframePoses, frame_variance
from duagc.pipeline.posegraph.relative_poses import LoopClosure

Send = Callable[[Kind, bytes], None]
"""Queues a reliable message for the neighbor."""


@dataclass(frozen=True)
class JoinedPair:
    """Two robots that share a frame.

    Attributes:
        shared: keyframes that both ends have.
        closures: m loop closures, at an end that holds them; else none.
        groups: bool [m], one array for each group of loop closures that agrees on a relative frame.
        proposals: these relative frames, own frame first; only at the end that decides.
    """

    shared: SharedKeyframes
    closures: tuple[LoopClosure, ...] = ()
    groups: tuple[NDArray[np.bool_], ...] = ()
    proposals: tuple[Proposal, ...] = ()


def join(
    closures: Sequence[LoopClosure],
    groups: Sequence[Group],
    own: KeyframePoses,
    peer: KeyframePoses,
    *,
    agreement: Callable[[Group], float],
    config: LoopClosureConfig,
) -> JoinedPair:
    """The decision that two robots share a frame, at the end that holds their loop closures.

    Args:
        closures: all of the pair, from this end's side.
        groups: of those that agree, largest first.
        own: own keyframes as seen from the first.
        peer: the neighbor's keyframes, likewise.
        agreement: share of what one robot measured that the other sees too, laid into each other by a group.
        config: for the sigma floor.
    """
    keyframes = np.unique([c.peer_keyframe for c in closures])
    shared = SharedKeyframes(keyframes.astype(np.int32), link_metric(closures, keyframes, config))
    proposals = []
    for group in groups:
        agreeing = [c for c, keep in zip(closures, group.keep.tolist(), strict=True) if keep]
        variance = frame_variance(agreeing, own, peer, config)
        proposals.append(Proposal(len(agreeing), group.T_ownmap_peermap, variance, agreement(group)))
    return JoinedPair(shared, tuple(closures), tuple(g.keep for g in groups), tuple(proposals))


def can_be_sent(own: str, peer: str, proposals: tuple[Proposal, ...]) -> bool:
    """Whether other robots will read these relative frames: motions within the range of the format.

    Args:
        own: name of the robot whose frame comes first in them.
        peer: name of the other one.
        proposals: one at least.
    """
    if peer < own:  # as they are sent
        proposals = tuple(p.reversed() for p in proposals)
    try:
        read_relative_frames(write_relative_frames(RelativeFrames(0, 1, proposals)), 2)
    except MalformedError:
        return False
    return True


@dataclass(frozen=True)
class Tried:
    """One candidate, for the record.

    Attributes:
        candidate: the two keyframes.
        result: what became of it.
    """

    candidate: Candidate
    result: Verified


class LoopClosureProtocol:
    """One end of a pair of robots.

    Attributes:
        own: name of this robot.
        peer: name of the neighbor.
        decides: this end decides which loop closures agree, and floods the relative frame.
        decided: whether the two robots share a frame is final here.
        joined: what they share; None as long as they do not.
        tried: every candidate that this end examined.
        peer_keyframes: of the neighbor as seen from its first, at an end that holds loop closures.
        selected: both ends know which of the loop closures the solver gets.
    """

    decides = False
    selected = True

    def __init__(self, own: str, peer: str) -> None:
        """Nothing is decided.

        Args:
            own: name of this robot.
            peer: name of the neighbor.
        """
        self.own, self.peer = own, peer
        self.decided = False
        self.joined: JoinedPair | None = None
        self.tried: list[Tried] = []
        self.peer_keyframes: KeyframePoses | None = None

    @property
    def promising(self) -> bool:
        """It is not decided yet, and a loop closure was verified here: the two robots will probably be joined."""
        return not self.decided and any(t.result.closure is not None for t in self.tried)

    def begin(self, send: Send) -> None:
        """Called once, when the ends know their roles.

        Args:
            send: queues a message for the neighbor.
        """

    def select(self, T_world_own: Array, T_world_peer: Array, send: Send) -> None:
        """Called until `selected`, once the whole component knows where its maps lie; default: all are selected.

        Args:
            T_world_own: [4, 4], where the first own keyframe was placed.
            T_world_peer: [4, 4], where the first keyframe of the neighbor was placed.
            send: queues a message for the neighbor.
        """

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        """Use one complete message of this protocol.

        Args:
            kind: of the message.
            payload: of the message.
            send: queues a message for the neighbor.

        Raises:
            MalformedError: it is not for this end, came twice, or is not what it should be.
        """
        raise NotImplementedError


class LoopClosing(Protocol):
    """A source of loop closures."""

    @property
    def trusted(self) -> bool:
        """Whether all loop closures are true: then none is left out."""

    @property
    def revokes(self) -> bool:
        """Whether links that contradict others, or have too few inliers, are revoked; if not, weights alone decide."""

    @property
    def greeting(self) -> bytes | None:
        """Payload of HELLO, from which the roles of the two ends follow; None if they are known without."""

    def initial(self, peer: str) -> LoopClosureProtocol | None:
        """The protocol with a neighbor that needs no greeting; else None.

        Args:
            peer: name of the neighbor.
        """

    def protocol(self, peer: str, kind: Kind, payload: bytes) -> LoopClosureProtocol:
        """The protocol with a neighbor, from its first message.

        Args:
            peer: name of the neighbor.
            kind: HELLO, or another kind of these protocols.
            payload: of the message.
        Raises:
            MalformedError: the message is none with which a protocol begins.
        """
