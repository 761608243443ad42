"""What the solvers of the poses share: what each starts from, and the calls that it answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.consensus.tree import TreePlace
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.posegraph.relative_poses import LoopClosure


@dataclass(frozen=True)
class LinkStart:
    """A joined neighbor as the solver gets it.

    Attributes:
        index: of the neighbor in the sorted team.
        name: of the neighbor.
        shared: keyframes that both ends have.
        closures: m loop closures at the end that holds them; else none.
        keep: bool [m], those that the robust weights begin with.
        T_world_keyframe: [n, 4, 4], where the neighbor's keyframes start, at the end that holds the loop closures.
    """

    index: int
    name: str
    shared: SharedKeyframes
    closures: tuple[LoopClosure, ...]
    keep: NDArray[np.bool_]
    T_world_keyframe: Array


class Matcher(Protocol):
    """What a solver may know of Gaussians."""

    def is_here(self, owner: int) -> bool:
        """Whether the evidence of a robot is here.

        Args:
            owner: index of the robot.
        """

    def matched_at(self, other: int, T_own: Array, T_other: Array) -> NDArray[np.int64] | None:
        """Ids [p, 2] of own Gaussians and those of a neighbor that match at these poses; None if they are not here.

        Args:
            other: index of the neighbor.
            T_own: [n, 4, 4], own keyframes in the common frame.
            T_other: [k, 4, 4], those of the neighbor.
        """

    def positions(self, owner: int, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array, Array]:
        """Keyframes [p] that Gaussians hang on, their means [p, 3] and the information of these [p, 3, 3], there.

        Args:
            owner: index of the robot that the Gaussians are of.
            ids: [p], of the Gaussians.

        Raises:
            MalformedError: one of them is not here.
        """


@dataclass(frozen=True)
class SolverStart:
    """What a robot knows when the pose rounds begin.

    Attributes:
        own: its own graph; its keyframes count as seen from the first.
        index: of the robot in the sorted team.
        T_world_map: [4, 4], where its first keyframe was placed.
        tree: its place in the tree along which the maps were placed.
        links: joined neighbors.
        matcher: of Gaussians; None if there are none.
    """

    own: OwnGraph
    index: int
    T_world_map: Array
    tree: TreePlace
    links: Sequence[LinkStart]
    matcher: Matcher | None = None


class PoseSolver(Protocol):
    """One robot's side of the pose consensus.

    Attributes:
        refused: reasons why kept messages could not be used.
    """

    refused: list[str]

    def advance(self) -> None:
        """One round of computation."""

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """What goes to a neighbor in this round, never again; each fits into `room_bytes`.

        Args:
            neighbor: the receiver.
            room_bytes: most bytes of each part.
        """

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use what a neighbor sent in a round.

        Args:
            neighbor: the sender.
            payload: one of the parts that its `states` gave.

        Raises:
            ValueError: it is not what it should be.
        """

    def messages(self) -> list[tuple[int, bytes]]:
        """Reliable messages that are to be sent now, by receiver."""

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a neighbor's reliable message for the next round.

        Args:
            sender: index of the neighbor.
            payload: of its message; `advance` reads it.
        """

    @property
    def converged(self) -> bool:
        """This robot changes less than the tolerance, and its weights are final."""

    @property
    def largest_change(self) -> float:
        """In the last round (m, rad)."""

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        """Own keyframes [n, 4, 4] in the common frame."""

    def weights(self, peer: str) -> Array:
        """Robust weight of every loop closure held with a neighbor, in the order given.

        Args:
            peer: name of the neighbor.
        """

    @property
    def loop_weights(self) -> Array:
        """Robust weight of every own loop."""

    def refuted(self, peer: str) -> bool:
        """Whether final weights leave too few of the loop closures held with a neighbor to join the two robots.

        Args:
            peer: name of the neighbor.
        """

    def residuals(self) -> dict[str, Any]:
        """What a round looked like, for the record; keys as `PoseAgent.residuals`."""


SolverFactory = Callable[[SolverStart], PoseSolver]
