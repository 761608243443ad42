"""Loop closures that both robots of a pair have from a file: a pose graph that was measured elsewhere.

The end that copies fewer keyframes by holding them decides; the other end sends it the keyframes that they name

    KEYFRAMES    own keyframes that the loop closures name, in the own map    ->    the end that decides

If loop closures may be false, those that cannot be true where the team was placed take no part in the solver. When all
relative frames are known, the end that decides says which ones take part

    REQUEST      one bit per loop closure, the first in the lowest bit        ->    the other end
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes, link_metric
from duagc.pipeline.exchange.loop_closing import JoinedPair, LoopClosureProtocol, Send, join
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import NamedKeyframes
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.posegraph.loop_closures import (
    Group,
    KeyframePoses,
    holder,
    plausible,
    robust_frame,
    within,
)
from duagc.pipeline.posegraph.pair_consistency import agreeing
from duagc.pipeline.posegraph.relative_poses import LoopClosure


class KnownLoopClosures:
    """The source of loop closures of `duagc posegraph`.

    Attributes:
        trusted: all loop closures are true.
        revokes: False; where one loop closure joins two robots, links without inliers are common, and to begin again
            without one costs more than to carry it with weight zero.
        greeting: None, the roles follow from the loop closures.
    """

    greeting = None
    revokes = False

    def __init__(
        self,
        own: OwnGraph,
        closures: Mapping[str, Sequence[LoopClosure]],
        config: PoseConsensusConfig,
        *,
        precision: str = "float64",
        held_by_both: bool = False,
    ) -> None:
        """Take a robot's part of the graph.

        Args:
            own: its keyframes.
            closures: by neighbor, from this robot's side; both ends list those of a pair in the same order.
            config: the same at all robots; if not `robust`, all loop closures are trusted.
            precision: of keyframes on the wire, float32 or float64. Elimination needs float64: a copy must
                start where its owner starts.
            held_by_both: the solver wants the loop closures at both ends; then they are trusted too.
        """
        self.own, self.closures, self.config = own, closures, config
        self.precision, self.held_by_both = precision, held_by_both
        self.trusted = held_by_both or not config.robust

    def initial(self, peer: str) -> LoopClosureProtocol:
        """The protocol with a neighbor.

        Args:
            peer: name of the neighbor, with which there are loop closures.
        """
        return KnownPair(self, peer)

    def protocol(self, peer: str, kind: Kind, payload: bytes) -> LoopClosureProtocol:
        """Never needed: `initial` gives every protocol.

        Args:
            peer: name of the neighbor.
            kind: of its message.
            payload: not read.

        Raises:
            MalformedError: always.
        """
        raise MalformedError(f"{kind.name} is not for known loop closures")


class KnownPair(LoopClosureProtocol):
    """One end of a pair whose loop closures are known.

    Attributes:
        in_solver: bool per loop closure of the file, whether it takes part in the solver.
    """

    def __init__(self, source: KnownLoopClosures, peer: str) -> None:
        """Take the loop closures of the pair; an end that does not hold them has decided.

        Args:
            source: of this robot.
            peer: name of the neighbor, with which there are loop closures.
        """
        super().__init__(source.own.robot, peer)
        self.source, self.closures = source, source.closures[peer]
        self.decides = holder(self.own, peer, self.closures) == self.own
        self._holds = self.decides or source.held_by_both
        self._peer_holds = not self.decides or source.held_by_both
        self.selected = source.trusted
        self.in_solver = np.ones(len(self.closures), dtype=bool)
        if not self._holds:
            self.decided, self.joined = True, JoinedPair(self._shared_at_peer())

    def _shared_at_peer(self) -> SharedKeyframes:
        """The own keyframes that the other end copies; it finds the same metric."""
        selected = self._selected_closures()
        keyframes = np.unique([c.own_keyframe for c in selected])
        mirrored = [c.reversed() for c in selected]
        metric = link_metric(mirrored, keyframes, self.source.config.closures)
        return SharedKeyframes(keyframes.astype(np.int32), metric)

    def begin(self, send: Send) -> None:
        """Send the own keyframes that loop closures name, if the other end holds these.

        Args:
            send: queues a message for the neighbor.
        """
        if self._peer_holds:
            own = self.source.own
            named = np.unique([c.own_keyframe for c in self.closures]).astype(np.int32)
            keyframes = NamedKeyframes(named, own.T_first_keyframe[named], own.drift[named])
            send(Kind.KEYFRAMES, loop_closing_wire.write_keyframes(keyframes, self.source.precision))

    def _selected_closures(self) -> list[LoopClosure]:
        return [c for c, selected in zip(self.closures, self.in_solver.tolist(), strict=True) if selected]

    def select(self, T_world_own: Array, T_world_peer: Array, send: Send) -> None:
        """Select the plausible loop closures where the two robots were placed, at the end that decides.

        Args:
            T_world_own: [4, 4], where the first own keyframe was placed.
            T_world_peer: [4, 4], where the first keyframe of the neighbor was placed.
            send: queues a message for the neighbor.
        """
        if not self._holds:
            return
        assert self.joined is not None
        assert self.peer_keyframes is not None
        config = self.source.config.closures
        own, peer = self.source.own.from_first.moved(T_world_own), self.peer_keyframes.moved(T_world_peer)
        possible = plausible(self.closures, own, peer, config)
        self.in_solver = possible if possible.any() else self.joined.groups[0]
        selected = self._selected_closures()
        keyframes = np.unique([c.peer_keyframe for c in selected])
        shared = SharedKeyframes(keyframes.astype(np.int32), link_metric(selected, keyframes, config))
        near = within(self.closures, own, peer, config)
        groups = tuple((group & near)[self.in_solver] for group in self.joined.groups)
        self.joined = replace(self.joined, shared=shared, closures=tuple(selected), groups=groups)
        self.selected = True
        send(Kind.REQUEST, np.packbits(self.in_solver, bitorder="little").tobytes())

    def _take_selection(self, payload: bytes) -> None:
        """What the other end selected."""
        bits = np.unpackbits(np.frombuffer(payload, np.uint8), bitorder="little")
        count = len(self.closures)
        if len(payload) != -(-count // 8) or bits[count:].any() or not bits.any():
            raise MalformedError(
                f"selection: {len(payload)} bytes that do not select of {count} loop closures"
            )
        self.in_solver, self.selected = bits[:count].astype(bool), True
        self.joined = JoinedPair(self._shared_at_peer())

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        """Use the keyframes that loop closures name, or what the other end selected.

        Args:
            kind: KEYFRAMES or REQUEST.
            payload: of the message.
            send: not used.

        Raises:
            MalformedError: it is not for this end, came twice, or is not what it should be.
        """
        if kind is Kind.REQUEST and not self._holds and not self.selected:
            self._take_selection(payload)
            return
        if kind is not Kind.KEYFRAMES or not self._holds or self.decided:
            raise MalformedError(f"{kind.name} is not for this end, or came twice")
        expected = np.unique([c.peer_keyframe for c in self.closures]).astype(np.int32)
        named = loop_closing_wire.read_keyframes(payload, expected, self.source.precision)
        size = int(expected[-1]) + 1
        T, drift = np.tile(np.eye(4), (size, 1, 1)), np.zeros((size, 2))  # the rest is never read
        T[expected], drift[expected] = named.T_first_keyframe, named.drift
        self.peer_keyframes = KeyframePoses(T, drift)
        joined = join(
            self.closures,
            self._groups(self.peer_keyframes),
            self.source.own.from_first,
            self.peer_keyframes,
            agreement=lambda _: 1.0,  # there are no images to compare
            config=self.source.config.closures,
        )
        if not self.decides:
            joined = JoinedPair(joined.shared, joined.closures)
        self.decided, self.joined = True, joined

    def _groups(self, peer: KeyframePoses) -> list[Group]:
        """Loop closures that agree on a relative frame: all of them if they are trusted."""
        config, own = self.source.config.closures, self.source.own
        if self.source.trusted:
            i, j = ([c.own_keyframe for c in self.closures], [c.peer_keyframe for c in self.closures])
            T_own_peer = np.array([c.T_own_peer for c in self.closures])
            frames = own.T_first_keyframe[i] @ T_own_peer @ se3.inverse(peer.T_frame_keyframe[j])
            return [Group(np.ones(len(self.closures), dtype=bool), robust_frame(frames, config))]
        return [agreeing(self.closures, own.from_first, peer, self.source.config)]
