"""One robot of the team: its own graph, the packets that reached it, and nothing else.

Before the iteration every robot solves its own graph in its own frame; then

    1. rosters are flooded: who is neighbor of whom;
    2. neighbors tell each other where the keyframes that their closures name lie in their own maps;
    3. the lower name of a pair decides which closures agree (with robust weights; else all of them) on which relative
       frame, tells the other end, and floods the frame;
    4. who knows the frames of all pairs of its component chains them along the best supported tree, from the lowest
       name, and starts its solver.

`tick` is the only way in, the packets that it returns the only way out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.network import TransportConfig
from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, MalformedError, Packet, parse
from duagc.pipeline.network.transport import Message, Outgoing, Transport
from duagc.pipeline.posegraph.factors import Factors
from duagc.pipeline.posegraph.files import RobotGraph
from duagc.pipeline.posegraph.initialization import own_start
from duagc.pipeline.posegraph.loop_closures import (
    Closure,
    chain_frames,
    consistent,
    drift,
    plausible,
    robust_frame,
)
from duagc.pipeline.team_posegraph import wire
from duagc.pipeline.team_posegraph.wire import Code, NamedKeyframes, PairFrame, Roster

Array = NDArray[np.float64]
_NEVER = 1 << 30
_TRANSPORT = TransportConfig(contact_lost_after_rounds=_NEVER, silent_after_rounds=_NEVER)
_UNLIMITED = 1 << 40  # bytes per round and link: what a solver sends is counted, not held back


@dataclass
class Neighbor:
    """What a robot knows about one neighbor. closures: of the pair, from this robot's side."""

    name: str
    index: int
    transport: Transport
    closures: list[Closure]
    told: NamedKeyframes | None = None  # where it has the keyframes that the closures name
    keep: NDArray[np.bool_] | None = None  # closures that the iteration starts with

    @property
    def own_keyframes(self) -> NDArray[np.int32]:
        """Own keyframes that the closures name, ascending."""
        return np.unique([c.own_keyframe for c in self.closures]).astype(np.int32)

    @property
    def peer_keyframes(self) -> NDArray[np.int32]:
        """The neighbor's keyframes that the closures name, ascending."""
        return np.unique([c.peer_keyframe for c in self.closures]).astype(np.int32)


class GraphAgent:
    """Set-up of one robot; a solver adds what follows it.

    precision: of the keyframes that neighbors tell each other in the set-up.
    """

    precision = "float32"

    def __init__(self, graph: RobotGraph, team: Sequence[str], config: PoseGraphConfig) -> None:
        """graph: what this robot measured. team: names of all robots that may exist, sorted."""
        self.graph, self.team, self.config = graph, list(team), config
        self.own = self.team.index(graph.name)
        self.T_map_keyframe, self.keep_loops = own_start(
            graph.odometry, graph.loops, graph.keyframes, config.consensus
        )
        self.neighbors = {
            self.team.index(peer): Neighbor(
                peer,
                self.team.index(peer),
                Transport(self.own, self.team.index(peer), peer, _TRANSPORT, self._new_id),
                closures,
            )
            for peer, closures in sorted(graph.closures.items())
        }
        self.T_world_map: dict[int, Array] = {}  # of every robot of the component, once known
        self.round = -1
        self.refused: list[str] = []
        self.first_round: int | None = None  # of its solver
        self._messages = 0
        self._rosters: dict[int, Roster] = {}
        self._frames: dict[tuple[int, int], PairFrame] = {}

    # --- the only way in and out

    def tick(self, round_index: int, delivered: Sequence[bytes]) -> list[Outgoing]:
        """One round: take what was delivered, compute, and say what to send."""
        self.round = round_index
        if round_index == 0:
            self._begin()
        for data in delivered:
            try:
                packet = parse(data)
                self._take(packet)
            except MalformedError as error:
                self.refused.append(str(error))
        if not self.T_world_map:
            self._set_up()
        if self.T_world_map:
            self.advance()
        return [
            out
            for n in self.neighbors.values()
            for out in n.transport.burst(self.round, self._states(n), _UNLIMITED)
        ]

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        """Own keyframes [n, 4, 4] in the common frame as far as it is known; of the own map before that."""
        raise NotImplementedError

    @property
    def settled(self) -> bool:
        """Whether this robot has nothing more to say."""
        raise NotImplementedError

    def start(self) -> None:
        """Frames are known: lay out the solver."""
        raise NotImplementedError

    def advance(self) -> None:
        """One round of the solver."""
        raise NotImplementedError

    def states(self, neighbor: Neighbor) -> list[bytes]:
        """What the solver sends to a neighbor in this round, never again; at most one packet each."""
        return []

    def take_state(self, neighbor: Neighbor, payload: bytes) -> None:
        """Use what a neighbor's solver sent in a round."""

    def take_message(self, neighbor: Neighbor, code: int, payload: bytes) -> None:
        """Use a message of a neighbor's solver."""
        raise MalformedError(f"unknown message {code}")

    def kept(self) -> tuple[Array, dict[str, Array]]:
        """Robust weights of own loops, and of the closures that this robot holds, by neighbor; before the start of the
        solver none of these."""
        return self.keep_loops.astype(np.float64), {}

    # --- packets

    def _new_id(self) -> int:
        self._messages += 1
        return self._messages

    def send(self, neighbors: Sequence[Neighbor], payload: bytes) -> None:
        """Queue one reliable message."""
        message = Message(self._new_id(), Kind.POSE_GRAPH, payload)
        for n in neighbors:
            n.transport.send(message)

    def _states(self, n: Neighbor) -> list[Message]:
        payloads = self.states(n) if self.T_world_map else []
        if n.transport.last_heard is None and not payloads:
            payloads = [b""]  # a beacon: nobody sends much to a neighbor that was never heard
        return [Message(self._new_id(), Kind.STATE, payload) for payload in payloads]

    def _take(self, packet: Packet) -> None:
        if packet.receiver != self.own or packet.sender not in self.neighbors:
            raise MalformedError("not addressed to this robot, or from no neighbor")
        n = self.neighbors[packet.sender]
        arrival = n.transport.receive(packet, self.round)
        if arrival is None:
            return
        if arrival.kind is Kind.STATE:
            if arrival.payload and self.T_world_map:
                self.take_state(n, arrival.payload)
        elif arrival.kind is Kind.POSE_GRAPH and arrival.payload:
            self._handle(n, arrival.payload)
        else:
            raise MalformedError(f"{arrival.kind.name} is not for a pose graph")

    def _handle(self, n: Neighbor, payload: bytes) -> None:
        code = payload[0]
        if code == Code.ROSTER:
            roster = wire.read_roster(payload, len(self.team))
            if self._rosters.setdefault(roster.robot, roster) is roster:
                self._pass_on(n, payload)
        elif code == Code.FRAME:
            frame = wire.read_frame(payload, len(self.team))
            if self._frames.setdefault((frame.lower, frame.higher), frame) is frame:
                self._pass_on(n, payload)
        elif code == Code.KEYFRAMES:
            n.told = wire.read_keyframes(payload, n.peer_keyframes, self.precision)
        elif code == Code.VERDICT:
            n.keep = wire.read_verdict(payload, len(n.closures))
        else:
            self.take_message(n, code, payload)

    def _pass_on(self, source: Neighbor, payload: bytes) -> None:
        self.send([n for n in self.neighbors.values() if n is not source], payload)

    # --- set-up

    def _begin(self) -> None:
        mask = sum(1 << index for index in self.neighbors)
        self._rosters[self.own] = Roster(self.own, mask)
        everyone = list(self.neighbors.values())
        self.send(everyone, wire.write_roster(self._rosters[self.own]))
        self.drift = drift(self.graph.odometry, self.graph.keyframes, self.config.consensus.closures)
        for n in everyone:
            own = n.own_keyframes
            named = NamedKeyframes(own, self.T_map_keyframe[own], self.drift[own])
            self.send([n], wire.write_keyframes(named, self.precision))

    def _set_up(self) -> None:
        """Decide on pairs of which this is the lower end; start once all is known."""
        for n in self.neighbors.values():
            if self.own < n.index and n.told is not None and n.keep is None:
                self._decide(n, n.told)
        members = self._component()
        if members is None or any(n.keep is None or n.told is None for n in self.neighbors.values()):
            return
        pairs = [(a, b) for a in members for b in members if a < b and self._rosters[a].neighbors >> b & 1]
        if any(pair not in self._frames for pair in pairs):
            return
        self.T_world_map = self._chain(members, [self._frames[pair] for pair in pairs])
        self._check_plausible()
        self.start()

    def _component(self) -> list[int] | None:
        """The robots of the component in order, or None as long as a roster is missing."""
        reached: set[int] = set()
        border = {self.own}
        while border:
            if not border <= set(self._rosters):
                return None
            reached |= border
            masks = [self._rosters[a].neighbors for a in border]
            border = {b for b in range(len(self.team)) if any(mask >> b & 1 for mask in masks)} - reached
        return sorted(reached)

    def _chain(self, members: list[int], frames: list[PairFrame]) -> dict[int, Array]:
        names = [self.team[m] for m in members]
        pairs = {
            (self.team[f.lower], self.team[f.higher]): (f.T_lower_higher, float(f.support)) for f in frames
        }
        chained = chain_frames(pairs, names)
        return {m: chained[self.team[m]] for m in members}

    def peer_in_own_map(self, n: Neighbor) -> tuple[Array, Array]:
        """What the neighbor told, by its keyframe index: T_map_keyframe in its map, and drift; zero where unnamed."""
        assert n.told is not None
        size = int(n.told.keyframes[-1]) + 1
        T, grown = np.tile(np.eye(4), (size, 1, 1)), np.zeros((size, 2))
        T[n.told.keyframes], grown[n.told.keyframes] = n.told.T_map_keyframe, n.told.drift
        return T, grown

    def _decide(self, n: Neighbor, told: NamedKeyframes) -> None:
        """Which closures of a pair agree, and on which frame; tell the other end and everybody."""
        c = self.config.consensus
        T_peer, drift_peer = self.peer_in_own_map(n)
        if c.robust:
            found = consistent(n.closures, self.T_map_keyframe, T_peer, self.drift, drift_peer, c.closures)
            assert found.T_ownmap_peermap is not None  # min_support is one
            n.keep, T, support = found.keep, found.T_ownmap_peermap, found.support
        else:
            n.keep, support = np.ones(len(n.closures), dtype=bool), len(n.closures)
            T_own_peer = np.array([k.T_own_peer for k in n.closures])
            i, j = ([k.own_keyframe for k in n.closures], [k.peer_keyframe for k in n.closures])
            T = robust_frame(self.T_map_keyframe[i] @ T_own_peer @ se3.inverse(T_peer[j]), c.closures)
        payload = wire.write_frame(PairFrame(self.own, n.index, support, T))
        self._frames[self.own, n.index] = wire.read_frame(payload, len(self.team))  # as everybody reads it
        self.send(list(self.neighbors.values()), payload)
        self.send([n], wire.write_verdict(n.keep))

    def _check_plausible(self) -> None:
        """With robust weights: closures that contradict where the frames put both robots start with weight zero."""
        if not self.config.consensus.robust:
            return
        T_own = self.T_world_map[self.own] @ self.T_map_keyframe
        for n in self.neighbors.values():
            T_peer, drift_peer = self.peer_in_own_map(n)
            T_peer = self.T_world_map[n.index] @ T_peer
            assert n.keep is not None
            n.keep = n.keep & plausible(
                n.closures, T_own, T_peer, self.drift, drift_peer, self.config.consensus.closures
            )

    def own_factors(self) -> Factors:
        """Odometry and loops, in this order."""
        return Factors.concatenate([self.graph.odometry, self.graph.loops])
