"""What an agent needs of what it shares besides poses, and the sharing of teams that share nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.exchange.knowledge import Knowledge
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.solvers import Matcher
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

        Raises:
            MalformedError: it is not what it should be.
        """

    def send_missing(
        self, send: SendTo, joined: Sequence[Neighbor], members: Sequence[int], T_world_map: Array | None
    ) -> None:
        """Send every joined neighbor what it lacks."""

    def send_early(self, send: SendTo, n: Neighbor) -> None:
        """Begin to send a neighbor what it will need if the two robots are joined, or stop if they are not."""

    def match(self, others: Sequence[int]) -> None:
        """Match own Gaussians with those of other members, once everything needed is here."""

    def offer_poses(
        self, T_common_keyframe: Array, T_map_first: Array, revoked: int, round_index: int
    ) -> None:
        """Own poses of this round, which are not final."""

    def add_poses(self, T_common_keyframe: Array, T_map_first: Array) -> None:
        """Own poses became final."""

    def complete(self, members: Sequence[int]) -> bool:
        """Whether all is here that the members of the component share."""

    def supplied(self, state: State, members: Sequence[int]) -> bool:
        """Whether a neighbor in this state lacks nothing that only this robot may bring."""


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
        """Refuse whatever comes."""
        raise MalformedError(f"{arrival.kind.name} is not for a team that agrees on poses only")

    def send_missing(
        self, send: SendTo, joined: Sequence[Neighbor], members: Sequence[int], T_world_map: Array | None
    ) -> None:
        """There is nothing to send."""

    def send_early(self, send: SendTo, n: Neighbor) -> None:
        """There is nothing to send."""

    def match(self, others: Sequence[int]) -> None:
        """There is nothing to match."""

    def offer_poses(
        self, T_common_keyframe: Array, T_map_first: Array, revoked: int, round_index: int
    ) -> None:
        """No other robot needs them."""

    def add_poses(self, T_common_keyframe: Array, T_map_first: Array) -> None:
        """No other robot needs them."""

    def complete(self, members: Sequence[int]) -> bool:
        """Nothing is missing."""
        return True

    def supplied(self, state: State, members: Sequence[int]) -> bool:
        """A neighbor needs this robot until it has agreed too."""
        return state.agreed
