"""Loop closures that both robots of a pair have from a file: a pose graph that was measured elsewhere.

The end that copies fewer keyframes by holding them decides; the other end sends it the keyframes that they name

    KEYFRAMES    own keyframes that the loop closures name, in the own map    ->    the end that decides
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes, link_metric
from duagc.pipeline.exchange.loop_closing import JoinedPair, LoopClosureProtocol, Send, join
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import NamedKeyframes
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.posegraph.loop_closures import Group, KeyframePoses, consistent, holder, robust_frame
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
        """The protocol with a neighbor."""
        return KnownPair(self, peer)

    def protocol(self, peer: str, kind: Kind, payload: bytes) -> LoopClosureProtocol:
        """Never needed: `initial` gives every protocol."""
        raise MalformedError(f"{kind.name} is not for known loop closures")


class KnownPair(LoopClosureProtocol):
    """One end of a pair whose loop closures are known."""

    def __init__(self, source: KnownLoopClosures, peer: str) -> None:
        super().__init__(source.own.robot, peer)
        self.source, self.closures = source, source.closures[peer]
        self.decides = holder(self.own, peer, self.closures) == self.own
        self._holds = self.decides or source.held_by_both
        self._peer_holds = not self.decides or source.held_by_both
        if not self._holds:
            self.decided, self.joined = True, JoinedPair(self._shared_at_peer())

    def _shared_at_peer(self) -> SharedKeyframes:
        """The own keyframes that the other end copies; it finds the same metric."""
        keyframes = np.unique([c.own_keyframe for c in self.closures])
        mirrored = [c.reversed() for c in self.closures]
        metric = link_metric(mirrored, keyframes, self.source.config.closures)
        return SharedKeyframes(keyframes.astype(np.int32), metric)

    def begin(self, send: Send) -> None:
        if self._peer_holds:
            own = self.source.own
            named = np.unique([c.own_keyframe for c in self.closures]).astype(np.int32)
            keyframes = NamedKeyframes(named, own.T_first_keyframe[named], own.drift[named])
            send(Kind.KEYFRAMES, loop_closing_wire.write_keyframes(keyframes, self.source.precision))

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
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
        found = consistent(self.closures, own.from_first, peer, config)
        assert found.T_ownmap_peermap is not None, "one loop closure joins two robots here"
        return [Group(found.keep, found.T_ownmap_peermap)]  # no cycle of robots chooses another one
