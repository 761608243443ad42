"""What an agent needs of what it shares besides poses, and the sharing of teams that share nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.exchange.knowledge import Knowledge
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.pose_solver import Matcher
from duagc.pipeline.exchange.wire.state_wire import State
from duagc.pipeline.network.messages import Arrival
from duagc.pipeline.network.packets import Kind, MalformedError

SendTo = Callable[[Neighbor, Kind, bytes], int]
"""Queues a reliable message for a neighbor and returns its id."""


class SharedData(Protocol):
    """What an agent needs of its sharing.

    Attributes:
        enabled: evidence is shared; if not, only poses are agreed.
        knowledge: what came from others.
        matcher: of Gaussians, for solvers that use them; None if there are none.
    """

    enabled: bool
    knowledge: Knowledge

    @property
    def matcher(self) -> Matcher | None: ...

    def take(
        self, n: Neighbor, arrival: Arrival, round_index: int, neighbors: Mapping[int, Neighbor]
    ) -> None:
        """Use what a neighbor sent.

        Args:
            n: the neighbor.
            arrival: a message of it, or a part of its evidence.
            round_index: the current round.
            neighbors: all of them, by index.

        Raises:
            MalformedError: it is not what it should be.
        """

    def send_missing(
        self, send: SendTo, joined: Sequence[Neighbor], members: Sequence[int], T_world_map: Array | None
    ) -> None:
        """Send every joined neighbor what it lacks.

        Args:
            send: queues a message.
            joined: the neighbors.
            members: indices of the robots of the component, this one included.
            T_world_map: [4, 4], own map frame in the common one once poses are agreed, else None.
        """

    def send_early(self, send: SendTo, n: Neighbor) -> None:
        """Begin to send a neighbor what it will need if the two robots are joined, or stop if they are not.

        Args:
            send: queues a message.
            n: the neighbor, which is not joined.
        """

    def match(self, others: Sequence[int]) -> None:
        """Match own Gaussians with those of other members, once everything needed is here.

        Args:
            others: indices of the other members.
        """

    def offer_poses(
        self, T_common_keyframe: Array, T_map_first: Array, revoked: int, round_index: int
    ) -> None:
        """Own poses of this round, which are not final.

        Args:
            T_common_keyframe: [n, 4, 4], own keyframes in the common frame of the consensus.
            T_map_first: [4, 4], the first keyframe in the own map.
            revoked: links that do not count, a mask of `pair_bit`.
            round_index: the current round.
        """

    def add_poses(self, T_common_keyframe: Array, T_map_first: Array) -> None:
        """Own poses became final.

        Args:
            T_common_keyframe: [n, 4, 4], own keyframes in the common frame of the consensus.
            T_map_first: [4, 4], the first keyframe in the own map.
        """

    def complete(self, members: Sequence[int]) -> bool:
        """Whether all is here that the members of the component share.

        Args:
            members: indices of all of them, this robot included.
        """

    def supplied(self, state: State, members: Sequence[int]) -> bool:
        """Whether a neighbor in this state lacks nothing that only this robot may bring.

        Args:
            state: the last one of the neighbor.
            members: indices of the robots of the component.
        """


class NoSharing:
    """Only poses are agreed; nothing else is shared."""

    enabled = False
    matcher = None

    def __init__(self, own: int, team: int) -> None:
        """Nothing is known, and nothing will be.

        Args:
            own: index of the robot in the sorted team.
            team: number of robots.
        """
        self.knowledge = Knowledge(own, team, Kind.EVIDENCE)

    def take(
        self, n: Neighbor, arrival: Arrival, round_index: int, neighbors: Mapping[int, Neighbor]
    ) -> None:
        """Refuse whatever comes.

        Args:
            n: the neighbor.
            arrival: what came.
            round_index: the current round.
            neighbors: all of them, by index.

        Raises:
            MalformedError: always.
        """
        raise MalformedError(f"{arrival.kind.name} is not for a team that agrees on poses only")

    def send_missing(
        self, send: SendTo, joined: Sequence[Neighbor], members: Sequence[int], T_world_map: Array | None
    ) -> None:
        """There is nothing to send.

        Args:
            send: queues a message; not used.
            joined: the neighbors.
            members: indices of the robots of the component.
            T_world_map: [4, 4], own map frame in the common one once poses are agreed, else None.
        """

    def send_early(self, send: SendTo, n: Neighbor) -> None:
        """There is nothing to send.

        Args:
            send: queues a message; not used.
            n: the neighbor, which is not joined.
        """

    def match(self, others: Sequence[int]) -> None:
        """There is nothing to match.

        Args:
            others: indices of the other members.
        """

    def offer_poses(
        self, T_common_keyframe: Array, T_map_first: Array, revoked: int, round_index: int
    ) -> None:
        """No other robot needs them.

        Args:
            T_common_keyframe: [n, 4, 4], own keyframes in the common frame of the consensus.
            T_map_first: [4, 4], the first keyframe in the own map.
            revoked: links that do not count, a mask of `pair_bit`.
            round_index: the current round.
        """

    def add_poses(self, T_common_keyframe: Array, T_map_first: Array) -> None:
        """No other robot needs them.

        Args:
            T_common_keyframe: [n, 4, 4], own keyframes in the common frame of the consensus.
            T_map_first: [4, 4], the first keyframe in the own map.
        """

    def complete(self, members: Sequence[int]) -> bool:
        """Nothing is missing.

        Args:
            members: indices of all members of the component.
        """
        return True

    def supplied(self, state: State, members: Sequence[int]) -> bool:
        """A neighbor needs this robot until it has agreed too.

        Args:
            state: the last one of the neighbor.
            members: indices of the robots of the component.
        """
        return state.agreed
