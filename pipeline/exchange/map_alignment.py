"""Where every robot's map lies: relative frames of pairs, flooded, and what follows from them.

The end of a pair that holds its closures says how the two first keyframes lie to each other, with one proposal for
each group of closures that agrees. Who knows the same pairs places the team the same way (`consensus.cycles`), to the
last bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.consensus.tree import TreePlace
from duagc.pipeline.exchange.wire import state_wire
from duagc.pipeline.exchange.wire.state_wire import PairFrames, pair_bit
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Placement, place

Array = NDArray[np.float64]
Pair = tuple[int, int]


class Frames:
    """What one robot knows of the pairs of its team."""

    def __init__(self, own: int, team: Sequence[str], margin: float) -> None:
        """own: index in the sorted team. margin: factor on variances round a cycle."""
        self.own, self.team, self.margin = own, list(team), margin
        self.pairs: dict[Pair, PairFrames] = {}
        self.payloads: dict[Pair, bytes] = {}
        self.parted = 0  # links known to have been parted, a mask of pair_bit
        self._placement: Placement | None = None

    def learn(self, payload: bytes, held: set[Pair]) -> Pair:
        """Take what is told of a pair, if it is news; returns the pair.

        Args:
            held: pairs whose closures this robot holds.
        Raises:
            MalformedError: it says nothing sensible, or speaks for this robot.
        """
        frames = state_wire.read_frames(payload, len(self.team))
        pair = (frames.lower, frames.higher)
        if pair in held and pair not in self.pairs:
            raise MalformedError("frame: a neighbor speaks for this robot")
        if pair not in self.pairs:
            self.pairs[pair], self.payloads[pair] = frames, payload
            self._placement = None
        return pair

    def tell(self, frames: PairFrames) -> None:
        """Take what this robot itself found out, as everybody will read it."""
        pair, payload = (frames.lower, frames.higher), state_wire.write_frames(frames)
        self.pairs[pair], self.payloads[pair] = state_wire.read_frames(payload, len(self.team)), payload
        self._placement = None

    def part(self, known: int) -> None:
        """These links are parted: as if they had never been."""
        self.parted, self._placement = known, None

    @property
    def links(self) -> int:
        """All pairs known, parted ones too, as a mask."""
        return sum(pair_bit(*pair) for pair in self.pairs)

    def _alive(self) -> list[Pair]:
        return [pair for pair in sorted(self.pairs) if not self.parted & pair_bit(*pair)]

    @property
    def members(self) -> list[int]:
        """Robots that the links join with this one, itself included, ascending."""
        reached, alive = {self.own}, self._alive()
        while more := {robot for pair in alive if reached & set(pair) for robot in pair} - reached:
            reached |= more
        return sorted(reached)

    @property
    def root(self) -> int:
        """The lowest-named member."""
        return self.members[0]

    @property
    def placement(self) -> Placement:
        """Where the members' first keyframes lie in that of the root."""
        if self._placement is None:
            members = self.members
            pairs = {
                (self.team[a], self.team[b]): self.pairs[a, b].proposals
                for a, b in self._alive()
                if a in members
            }
            self._placement = place(pairs, [self.team[m] for m in members], self.margin)
        return self._placement

    @property
    def undecided(self) -> int:
        """Links of the component that contradict each other while nothing tells which are false, as a mask."""
        pairs = self.placement.undecided
        return sum(pair_bit(self.team.index(a), self.team.index(b)) for a, b in pairs)

    def T_world_first(self, robot: int) -> Array:  # noqa: N802 (a transform)
        """First keyframe of a member in that of the root, [4, 4]."""
        return self.placement.T_world_map[self.team[robot]]

    def tree(self) -> TreePlace:
        """The own place in the tree that the maps were placed along."""
        parent = {
            self.team.index(robot): None if nearer is None else self.team.index(nearer)
            for robot, nearer in self.placement.parent.items()
        }
        return TreePlace.of(self.own, parent)
