"""Poses that are not final yet, flooded so that a contact may end at any time.

Evidence is anchored to keyframes: without their poses none of it is of use. Final poses come when the whole component
has converged, which may be after the robots have lost each other. So every robot sends its neighbors where its
keyframes lie from its first one, as soon as they meet, and floods its poses when the solver starts, and again when they
have moved. They count only where final ones have not arrived.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.wire import anchors_wire, state_wire
from duagc.pipeline.exchange.wire.anchors_wire import Anchors
from duagc.pipeline.network.packets import Kind, MalformedError

MOVED = 1e-3
"""Change of a coordinate of a keyframe (m, or of its rotation matrix) for which its poses are sent again."""
LEAST_ROUNDS = 8
"""Between two versions."""
FROM_FIRST = 0
"""Instead of a round: poses as seen from the first keyframe, which the receiver places. No solver starts in round 0."""
_VERSION = struct.Struct("<I")


@dataclass(frozen=True)
class _Version:
    """Poses of one robot as it had them in one round.

    Attributes:
        round: in which its owner had them; newer ones replace older ones.
        revoked: links that did not count.
        poses: of all keyframes.
        payload: the same as it is sent.
    """

    round: int
    revoked: int
    poses: Anchors
    payload: bytes


class CurrentPoses:
    """The newest poses of every robot of the team, as one agent knows them."""

    def __init__(self, own: int, team: int) -> None:
        """Nothing is known.

        Args:
            own: index of the robot in the sorted team.
            team: number of robots.
        """
        self.own, self.team = own, team
        self._newest: dict[int, _Version] = {}
        self._from_first: dict[int, Anchors] = {}

    def tell(self, send: Callable[[Neighbor, Kind, bytes], int], n: Neighbor, poses: Anchors) -> None:
        """Tell a neighbor once where own keyframes lie as seen from the first.

        Args:
            send: queues a message and returns its id.
            n: the neighbor.
            poses: own ones, the first keyframe at the origin.
        """
        if self.own not in n.passed.current:
            payload = _VERSION.pack(FROM_FIRST) + anchors_wire.write_anchors(poses)
            n.passed.current[self.own] = (
                FROM_FIRST,
                send(n, Kind.CURRENT_POSES, state_wire.write_labeled(0, self.team, payload)),
            )

    def offer(self, poses: Anchors, revoked: int, round_index: int) -> None:
        """Own poses of this round; they become a new version where they have moved.

        Args:
            poses: own.
            revoked: links that do not count.
            round_index: the current round.
        """
        last = self._newest.get(self.own)
        if last is not None and last.revoked == revoked:
            moved = float(np.abs(poses.T_common_keyframe - last.poses.T_common_keyframe).max())
            if moved < MOVED or round_index < last.round + LEAST_ROUNDS:
                return
        payload = state_wire.write_labeled(
            revoked, self.team, _VERSION.pack(round_index) + anchors_wire.write_anchors(poses)
        )
        self._newest[self.own] = _Version(round_index, revoked, poses, payload)

    def take(self, n: Neighbor, payload: bytes) -> None:
        """Use what a neighbor sent.

        Args:
            n: the neighbor.
            payload: of its message.
        Raises:
            MalformedError: it is not what it should be, or speaks for this robot.
        """
        revoked, rest = state_wire.read_labeled(payload, self.team)
        if len(rest) < _VERSION.size:
            raise MalformedError("current poses: cut short")
        poses = anchors_wire.read_anchors(rest[_VERSION.size :], self.team)
        if poses.owner == self.own:
            raise MalformedError("current poses: a neighbor speaks for this robot")
        version = _Version(_VERSION.unpack_from(rest)[0], revoked, poses, payload)
        if version.round == FROM_FIRST:
            if poses.owner != n.index:
                raise MalformedError("current poses: a neighbor speaks for another robot")
            self._from_first[poses.owner] = poses
            return
        known = self._newest.get(poses.owner)
        if known is None or version.round > known.round:
            self._newest[poses.owner] = version
        sent, message = n.passed.current.get(poses.owner, (-1, 0))
        n.passed.current[poses.owner] = max(sent, version.round), message

    def send_missing(
        self, send: Callable[[Neighbor, Kind, bytes], int], joined: Sequence[Neighbor], final: set[int]
    ) -> None:
        """Send every joined neighbor the versions that it lacks; newer ones instead of older ones.

        Args:
            send: queues a message and returns its id.
            joined: the neighbors.
            final: owners of poses that are final and known here.
        """
        for n in joined:
            for owner, version in sorted(self._newest.items()):
                sent, message = n.passed.current.get(owner, (-1, 0))
                if owner in final:
                    n.transport.cancel(message)
                elif owner != n.index and sent < version.round:
                    n.transport.cancel(message)
                    message = send(n, Kind.CURRENT_POSES, version.payload)
                    n.passed.current[owner] = version.round, message

    def known(
        self, revoked: int, members: Sequence[int], T_world_first: Callable[[int], Array]
    ) -> dict[int, Anchors]:
        """The newest poses by owner, of those that were sought without these links; else from its first keyframe.

        Args:
            revoked: links that do not count.
            members: robots of the component.
            T_world_first: where the first keyframe of a member was placed, [4, 4].
        """
        placed = {
            owner: replace(poses, T_common_keyframe=T_world_first(owner) @ poses.T_common_keyframe)
            for owner, poses in sorted(self._from_first.items())
            if owner in members
        }
        return placed | {o: v.poses for o, v in sorted(self._newest.items()) if v.revoked == revoked}
