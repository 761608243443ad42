"""Where every robot's map lies: relative frames of pairs, flooded, and what follows from them.

The end of a pair that decides on its loop closures floods the relative pose of the two first keyframes, with one
proposal for each group of loop closures that agrees. Agents that know the same pairs place the team alike
(`posegraph.cycle_consistency`), to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.consensus.tree import TreePlace
from duagc.pipeline.exchange.wire import state_wire
from duagc.pipeline.exchange.wire.state_wire import RelativeFrames, pair_bit
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Placement, place

Pair = tuple[int, int]


class MapAlignment:
    """What one robot knows of the pairs of its team."""

    def __init__(self, own: int, team: Sequence[str], margin: float, *, short: bool = False) -> None:
        """Nothing is known.

        Args:
            own: index of the robot in the sorted team.
            team: names of all robots, sorted.
            margin: factor on variances around a cycle.
            short: send relative frames in float32.
        """
        self.own, self.team, self.margin, self.short = own, list(team), margin, short
        self.pairs: dict[Pair, RelativeFrames] = {}
        self.payloads: dict[Pair, bytes] = {}
        self.links = 0  # all pairs known, revoked ones too, a mask of pair_bit
        self.revoked = 0  # links known to have been revoked, likewise
        self._pair_of: dict[bytes, Pair] = {}  # by payload
        self._members: list[int] = []
        self._placement: Placement | None = None

    def receive(self, payload: bytes, held: Callable[[Pair], bool]) -> Pair:
        """Use what a neighbor sent of a pair, if it is new; returns the pair.

        Args:
            payload: of the message.
            held: whether this robot decides on a pair.
        Raises:
            MalformedError: it is not what it should be, or decides on a pair of this robot.
        """
        if payload in self._pair_of:  # most of what is flooded comes from several neighbors
            return self._pair_of[payload]
        frames = state_wire.read_relative_frames(payload, len(self.team))
        pair = (frames.lower, frames.higher)
        if pair not in self.pairs:
            if held(pair):
                raise MalformedError("relative frame: a neighbor speaks for this robot")
            self._know(pair, frames, payload)
        return pair

    def add(self, frames: RelativeFrames) -> None:
        """Add what this robot itself decided, as all others will read it.

        Args:
            frames: of one pair, from the higher-named robot's frame to the lower-named one's.

        Raises:
            MalformedError: other robots would refuse to read them.
        """
        payload = state_wire.write_relative_frames(frames, short=self.short)
        read = state_wire.read_relative_frames(payload, len(self.team))
        self._know((frames.lower, frames.higher), read, payload)

    def _know(self, pair: Pair, frames: RelativeFrames, payload: bytes) -> None:
        self.pairs[pair], self.payloads[pair], self._pair_of[payload] = frames, payload, pair
        self.links |= pair_bit(*pair)
        self._members, self._placement = [], None

    def revoke(self, known: int) -> None:
        """Revoke these links: they do not count any more.

        Args:
            known: all revoked links, earlier ones too, a mask of `pair_bit`.
        """
        self.revoked, self._members, self._placement = known, [], None

    def _alive(self) -> list[Pair]:
        return [pair for pair in sorted(self.pairs) if not self.revoked & pair_bit(*pair)]

    @property
    def members(self) -> list[int]:
        """Robots that the links join with this one, itself included, ascending."""
        if not self._members:
            reached, alive = {self.own}, self._alive()
            while more := {robot for pair in alive if reached & set(pair) for robot in pair} - reached:
                reached |= more
            self._members = sorted(reached)
        return list(self._members)

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
        """Links of the component that contradict each other without a sign of which are false, as a mask."""
        pairs = self.placement.undecided
        return sum(pair_bit(self.team.index(a), self.team.index(b)) for a, b in pairs)

    def T_world_first(self, robot: int) -> Array:  # noqa: N802 (a transform)
        """First keyframe of a member in that of the root, [4, 4].

        Args:
            robot: index of the member in the sorted team.
        """
        return self.placement.T_world_map[self.team[robot]]

    def tree(self) -> TreePlace:
        """The own place in the tree that the maps were placed along."""
        parent = {
            self.team.index(robot): None if nearer is None else self.team.index(nearer)
            for robot, nearer in self.placement.parent.items()
        }
        return TreePlace.of(self.own, parent)
