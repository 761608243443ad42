"""One robot's agent: a tick per round, from delivered packets to packets sent.

    meet        places, candidates, closures with every neighbour          meeting.py
    frames      root (lowest name) of the component and own map frame in the root's, flooded
    poses       rounds of the pose consensus until everybody holds still    pipeline.consensus.poses
    tell        evidence of every robot to every robot, agreed poses         knowledge.py
    match       the lower-named robot of a pair matches Gaussians and tells

The steps overlap: evidence hangs on keyframes and travels while the poses still move. Two conditions must hold in the
whole component before an agent goes on: that everybody has decided on all its links (before poses), and that
everybody holds still (after). Each is found by counting hops: an agent for which it holds itself says one more than
the least of its neighbours, and whoever reaches the size of the team knows that it holds everywhere.

A link may turn out to be false during the pose rounds: the graduated weights leave too few of its closures. The end
that holds them parts it for good, and whoever hears of that begins again with frames, without the link. The set of
parted links only grows; it stands in every state and labels everything that depends on it. Nobody can be agreed
before the whole component knows the same set, because a holder does not hold still before its weights are final.

An agent knows its own data, its configuration and the packets it was given. It never raises because of a packet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus.closures import Closure, plausible
from pipeline.consensus.poses import PoseAgent
from pipeline.consensus.robust import COUNTS
from pipeline.exchange import injection, wire
from pipeline.exchange.config import ExchangeConfig
from pipeline.exchange.evidence import (
    best_first,
    match_pairs,
    own_records,
    seen_voxels,
    to_evidence,
    within,
)
from pipeline.exchange.knowledge import Knowledge
from pipeline.exchange.meeting import HigherEnd, LowerEnd, Meeting, OwnPlaces, Send
from pipeline.exchange.packets import MAX_PAYLOAD_BYTES, Kind, MalformedError, Packet, parse
from pipeline.exchange.poses_wire import read_poses, write_poses_in_parts
from pipeline.exchange.signatures import Identity
from pipeline.exchange.transport import Arrival, Message, Outgoing, Transport
from pipeline.exchange.verification import Verdict
from pipeline.exchange.wire import Anchors, Frame, PairList, State, pair_bit
from pipeline.geometry import se3
from pipeline.robot import AgentResult, ClosureRecord, RobotData

Array = NDArray[np.float64]
EVERYWHERE = 255  # a hop count that has reached the whole component, for good
EVIDENCE_WIRES = {
    "compact": Kind.EVIDENCE,
    "float32": Kind.EVIDENCE_EXACT,
    "float64": Kind.EVIDENCE_DOUBLE,
}
MEETING_KINDS = frozenset({Kind.DESCRIPTORS, Kind.REQUEST, Kind.SAMPLE, Kind.CLOSURES})


@dataclass
class Neighbour:
    """All that an agent keeps about one neighbour."""

    index: int
    name: str
    transport: Transport
    meeting: Meeting
    state: State | None = None
    frame: Frame | None = (
        None  # the one that counts: without most parted links, then nearest to the lowest root
    )
    voxels: NDArray[np.int64] | None = None
    verdict_message: int | None = None
    gone: bool = False  # silent for too long
    parted: bool = False  # its closures were refuted: as if never met
    last_weights: list[float] = field(default_factory=list)  # of the closures held, when the link was parted
    evidence_sent: dict[int, int] = field(default_factory=dict)  # owner: message

    @property
    def decided(self) -> bool:
        """Whether it is settled if the two robots share a frame."""
        if self.gone:
            return True
        told = self.verdict_message is None or not self.transport.is_open(self.verdict_message)
        return self.meeting.verdicts is not None and told

    @property
    def joined(self) -> bool:
        """Whether the two robots share a frame, and the neighbour knows it."""
        return not self.gone and not self.parted and self.decided and self.meeting.joined is not None


class Agent:
    """One robot of the team; `tick` is the only way in and out."""

    def __init__(
        self,
        data: RobotData,
        team: Sequence[str],
        neighbours: Sequence[str],
        config: ExchangeConfig,
        seed: int,
    ) -> None:
        """Start with nothing but own data.

        Args:
            team: names of all robots that may exist. neighbours: those that this robot has a radio link to.
            config: the same at all robots. seed: of this run.
        """
        self.data, self.config, self.seed = data, config, seed
        self.team = sorted(team)
        self.own = self.team.index(data.robot)
        self.identity = None
        if config.transport.signatures == "ed25519":
            self.identity = Identity.simulated(seed, self.team, data.robot)
        self.places = OwnPlaces(data, config)
        self._messages = 0
        self.neighbours = {self.team.index(name): self._neighbour(name) for name in sorted(neighbours)}
        self.round = -1
        self.refused: Counter[str] = Counter()
        self.evidence_kind = EVIDENCE_WIRES[config.evidence_wire]
        self.knowledge = Knowledge(self.own, len(self.team), self.evidence_kind)
        self.frame = Frame(self.own, wire.WHOLE, 0, np.eye(4))
        self.members = 1 << self.own
        self.parted = 0  # links known to have been parted, a mask of pair_bit
        self.frames_hops = self.still_hops = 0
        self.poses: PoseAgent | None = None
        self.agreed = self.done = self.converged = False
        self.rounds_to_agreement: int | None = None
        self._body: NDArray[Any] | None = None
        self._records: NDArray[Any] | None = None
        self._frame_told: dict[int, tuple[Frame, int]] = {}  # what, in which message
        self._voxels_told: set[int] = set()
        self._anchors_told: set[tuple[int, int]] = set()
        self._pairs_told: dict[tuple[int, tuple[int, int]], int] = {}  # message; 0 = they told this robot

    def _neighbour(self, name: str) -> Neighbour:
        index = self.team.index(name)
        end = LowerEnd if self.data.robot < name else HigherEnd
        meeting = end(self.data.robot, name, self.places, self.config, self.seed)
        transport = Transport(
            self.own, index, name, self.config.transport, self._new_id, identity=self.identity
        )
        return Neighbour(index, name, transport, meeting)

    # --- one round

    def tick(self, round_index: int, now_ns: int, delivered: Sequence[bytes]) -> list[Outgoing]:
        """Handle what was delivered, compute, and send at most one burst to each neighbour.

        Args:
            round_index: counts from 0. now_ns: time of this round. delivered: packets, in order of arrival.
        """
        self.round = round_index
        for data in delivered:
            self._take(data)
        self._watch()
        for neighbour in self._living():
            if neighbour.transport.last_heard is not None and not neighbour.meeting.begun:
                neighbour.meeting.begin(self._sender(neighbour))
        self._hear_of_partings()
        self._settle_frames()
        self._settle_poses()
        self._tell()
        self._match()
        self._finish()
        return [packet for neighbour in self._living() for packet in self._burst(neighbour)]

    def _living(self) -> list[Neighbour]:
        return [n for n in self.neighbours.values() if not n.gone]

    @property
    def root(self) -> int:
        """Lowest-named robot known to be in the component."""
        return self.frame.root

    @property
    def T_world_map(self) -> Array:  # noqa: N802 (a transform)
        """Own map frame in the root's, as it was placed before the pose rounds."""
        return self.frame.T_world_map

    def _joined(self) -> list[Neighbour]:
        return [n for n in self.neighbours.values() if n.joined]

    def _watch(self) -> None:
        """Give up neighbours that were silent for too long; do not wait for them any more.

        A link that died while the poses were sought would leave its two ends with different last words of each other
        for ever, so the rest of the team begins again without it. If nobody is left, or a neighbour has agreed
        already, what there is stays.
        """
        died = 0
        for neighbour in self._living():
            heard = neighbour.transport.last_heard
            silent = self.round - (0 if heard is None else heard)
            if silent > self.config.transport.silent_after_rounds and not self.done:
                died |= pair_bit(self.own, neighbour.index) if neighbour.joined else 0
                neighbour.gone = True
        others = self._joined()
        settled = self.agreed or any(n.state is not None and n.state.agreed for n in others)
        if died and others and not settled:
            self._part(self.parted | died)

    # --- incoming

    def _take(self, data: bytes) -> None:
        """Parse and handle one packet; what cannot be used is counted with its reason and has no other effect."""
        try:
            packet = parse(data) if self.identity is None else self.identity.open(data)
            neighbour = self._addressed(packet)
            arrival = neighbour.transport.receive(packet, self.round)
            if arrival is not None:
                self._handle(neighbour, arrival)
        except MalformedError as error:
            self.refused[str(error)] += 1

    def _addressed(self, packet: Packet) -> Neighbour:
        if packet.receiver != self.own:
            raise MalformedError("addressed to another robot")
        if packet.sender not in self.neighbours:
            raise MalformedError("from a robot that is no neighbour")
        if self.neighbours[packet.sender].gone:
            raise MalformedError("from a neighbour that was given up")
        return self.neighbours[packet.sender]

    def _handle(self, neighbour: Neighbour, arrival: Arrival) -> None:
        team = len(self.team)
        if arrival.kind is Kind.STATE:
            self._take_state(neighbour, arrival.payload)
        elif arrival.kind in MEETING_KINDS:
            if not neighbour.meeting.begun:
                neighbour.meeting.begin(self._sender(neighbour))
            neighbour.meeting.take(arrival.kind, arrival.payload, self._sender(neighbour))
        elif arrival.kind is Kind.FRAME:
            frame = wire.read_frame(arrival.payload, team)
            if neighbour.frame is None or _rank(frame) < _rank(neighbour.frame):
                neighbour.frame = frame
        elif arrival.kind is Kind.VOXELS:
            _, neighbour.voxels = wire.read_voxels(arrival.payload, team)
        elif arrival.kind is Kind.ANCHORS:
            self._anchors_told.add((neighbour.index, self.knowledge.take_anchors(arrival.payload)))
        elif arrival.kind is Kind.PAIRS:
            self._pairs_told.setdefault((neighbour.index, self.knowledge.take_pairs(arrival.payload)), 0)
        elif arrival.kind is self.evidence_kind:
            owner = self.knowledge.take_evidence(
                neighbour.index, arrival.message, arrival.payload, arrival.complete
            )
            if owner is not None:
                for provider, message in self.knowledge.forget_incoming(owner):
                    self.neighbours[provider].transport.accept_rest(message, self.round)
                neighbour.transport.accept_rest(arrival.message, self.round)

    def _take_state(self, neighbour: Neighbour, payload: bytes) -> None:
        neighbour.state, poses = wire.read_state(payload, len(self.team))
        if neighbour.state.parted != self.parted:
            return
        if poses and self.poses is not None and neighbour.name in self.poses.links:
            shared = self.poses.links[neighbour.name].keyframes
            self.poses.receive(neighbour.name, read_poses(poses, shared, neighbour.index < self.own))

    # --- outgoing

    def _new_id(self) -> int:
        self._messages += 1
        return self._messages

    def _sender(self, neighbour: Neighbour) -> Send:
        def send(kind: Kind, payload: bytes) -> None:
            message = self._send([neighbour], kind, payload)
            if kind is Kind.CLOSURES:
                neighbour.verdict_message = message

        return send

    def _send(self, neighbours: Sequence[Neighbour], kind: Kind, payload: bytes) -> int:
        """Queue one reliable message for some neighbours; returns its id."""
        message = Message(self._new_id(), kind, payload)
        for neighbour in neighbours:
            neighbour.transport.send(message)
        return message.id

    def _burst(self, neighbour: Neighbour) -> list[Outgoing]:
        finished = self.done and neighbour.state is not None and neighbour.state.done
        states = [] if finished else self._states(neighbour)
        return neighbour.transport.burst(self.round, states, self.config.link.budget_bytes)

    def _states(self, neighbour: Neighbour) -> list[Message]:
        """The state of this round, with the poses of this round if there are any."""
        direct = {n.index for n in self._joined()}
        state = wire.write_state(
            State(
                self.root,
                self.members,
                self.frames_hops,
                self.still_hops,
                self.agreed,
                self.done,
                self.knowledge.sources(direct, {n.index for n in self._living() if not n.parted}),
                self.parted,
            )
        )
        payloads = [state]
        missing = injection.poses_are_missing(
            self.config.injection, self.seed, self.data.robot, neighbour.name, self.round
        )
        speaks = self.poses is not None and neighbour.name in self.poses.links and not missing
        if self.poses is not None and speaks and not self._all_agreed():
            packet, decides = self.poses.outgoing(neighbour.name), self.own < neighbour.index
            parts = write_poses_in_parts(packet, MAX_PAYLOAD_BYTES - len(state), decides)
            payloads = [state + part for part in parts]
        return [Message(self._new_id(), Kind.STATE, payload) for payload in payloads]

    def _all_agreed(self) -> bool:
        return self.agreed and all(n.state is not None and n.state.agreed for n in self._joined())

    # --- parted links

    def _hear_of_partings(self) -> None:
        """Take over what joined neighbours know of parted links. Once poses are agreed there is nothing to hear."""
        known = self.parted
        for n in self._joined():
            if n.state is not None:
                known |= n.state.parted
        if known != self.parted and not self.agreed:
            self._part(known)

    def _part(self, known: int) -> None:
        """Begin again with frames, without the links of this mask; forget what depended on them."""
        self.parted = known
        for n in self.neighbours.values():
            if not n.parted and known & pair_bit(self.own, n.index):
                n.parted = True
                if self.poses is not None and n.name in self.poses.links:
                    n.last_weights = self.poses.weights(n.name).tolist()
                n.transport.cancel_all()
                n.evidence_sent.clear()
        self.frame = Frame(self.own, wire.WHOLE, 0, np.eye(4), known)
        self.members = 1 << self.own
        self.frames_hops = self.still_hops = 0
        self.poses = None
        self._frame_told.clear()

    def _same_links(self, n: Neighbour) -> bool:
        """Whether a neighbour's last state is about the team without the same parted links."""
        return n.state is not None and n.state.parted == self.parted

    # --- frames

    def _settle_frames(self) -> None:
        """Adopt the lowest root and its frame, tell it on, and count how far around everybody has decided.

        To have decided is also that the neighbours have the own frame: when everybody has, no frame changes any more.
        """
        joined = self._joined()
        for n in joined:
            frame = n.frame
            if frame is None or frame.parted != self.parted or self.poses is not None:
                continue
            assert n.meeting.joined is not None
            assert n.meeting.verdicts is not None
            support = min(frame.support, n.meeting.verdicts.consistent)
            T_world_map = frame.T_world_map @ se3.inverse(n.meeting.joined.T_own_peer)
            way = Frame(frame.root, support, frame.hops + 1, T_world_map, self.parted)
            if way.rank < self.frame.rank:
                self.frame = way
        for n in joined:
            if n.index not in self._frame_told or self._frame_told[n.index][0] is not self.frame:
                message = self._send([n], Kind.FRAME, wire.write_frame(self.frame, len(self.team)))
                self._frame_told[n.index] = (self.frame, message)
            if n.state is not None and self._same_links(n) and n.state.root == self.root:
                self.members |= n.state.members
        if self.frames_hops == EVERYWHERE:
            return
        self.frames_hops = 0
        told = not any(n.transport.is_open(self._frame_told[n.index][1]) for n in joined)
        if told and all(n.decided for n in self.neighbours.values()):
            least = min((self._frames_hops_of(n) for n in joined), default=EVERYWHERE - 1)
            self.frames_hops = min(least + 1, EVERYWHERE)
        if self.frames_hops >= len(self.team):
            self.frames_hops = EVERYWHERE

    def _frames_hops_of(self, neighbour: Neighbour) -> int:
        state = neighbour.state
        if state is None or not self._same_links(neighbour):
            return 0
        if state.root != self.root or state.members != self.members:
            return 0
        return min(state.frames_hops, EVERYWHERE - 1)

    # --- poses

    def _settle_poses(self) -> None:
        """One round of the pose consensus; final when everybody in the component holds still."""
        joined = self._joined()
        if self.frames_hops < EVERYWHERE or not joined:
            return
        if self.poses is None:
            self._start_poses()
        assert self.poses is not None
        if not self._all_agreed():
            self.poses.step()
        if self.agreed:
            return
        refuted = sum(pair_bit(self.own, n.index) for n in joined if self.poses.refuted(n.name))
        if refuted:
            self._part(self.parted | refuted)
            return
        self.still_hops = 0
        if self.poses.settled:
            least = min((n.state.still_hops if n.state and self._same_links(n) else 0) for n in joined)
            self.still_hops = min(least + 1, EVERYWHERE)
        if self.still_hops > len(self.team):
            self.agreed, self.still_hops = True, EVERYWHERE
            self.rounds_to_agreement = self.round
            anchors = Anchors(self.own, self.poses.T_world_keyframe, self.data.T_map_keyframe[0])
            self.knowledge.anchors[self.own] = anchors
            self.knowledge.anchors_bytes[self.own] = wire.write_anchors(anchors)

    def _start_poses(self) -> None:
        self.poses = PoseAgent(
            self.data.robot, self.data.T_map_keyframe, self.places.registrations, self.config.consensus
        )
        self.poses.set_frame(self.T_world_map)
        for n in self._joined():
            meeting = n.meeting.joined
            assert meeting is not None
            if isinstance(n.meeting, LowerEnd):
                assert n.meeting.book is not None
                assert n.frame is not None
                T_world_peer = n.frame.T_world_map @ n.meeting.book.T_map_keyframe
                placed = plausible(
                    meeting.closures,
                    self.T_world_map @ self.data.T_map_keyframe,
                    T_world_peer,
                    self.places.drift,
                    n.meeting.book.drift,
                    self.config.consensus.closures,
                )
                self.poses.add_link(
                    n.name,
                    meeting.closures,
                    keep=meeting.keep & placed,
                    T_world_keyframe_peer=dict(enumerate(T_world_peer)),
                )
            else:
                self.poses.add_link(n.name, shared=meeting.shared)

    # --- telling others

    def _tell(self) -> None:
        """Evidence to whoever lacks it; space seen, agreed poses and pair lists to everybody."""
        for n in self._joined():
            if self.config.coverage == "overlap" and self.agreed and n.index not in self._voxels_told:
                self._voxels_told.add(n.index)
                keys = seen_voxels(self.data.gaussians, self.T_world_map, self.config.overlap_voxel_m)
                self._send([n], Kind.VOXELS, wire.write_voxels(self.own, keys))
            self._tell_evidence(n)
            for owner in sorted(self.knowledge.anchors_bytes):
                if owner != n.index and (n.index, owner) not in self._anchors_told:
                    self._anchors_told.add((n.index, owner))
                    self._send([n], Kind.ANCHORS, self.knowledge.anchors_bytes[owner])
            for pair in sorted(self.knowledge.pairs_bytes):
                if pair[0] != n.index and (n.index, pair) not in self._pairs_told:
                    message = self._send([n], Kind.PAIRS, self.knowledge.pairs_bytes[pair])
                    self._pairs_told[n.index, pair] = message

    def _tell_evidence(self, n: Neighbour) -> None:
        if n.state is None:
            return
        for owner in [self.own, *sorted(self.knowledge.evidence)]:
            if not self.members >> owner & 1:
                continue
            wanted = owner != n.index and n.state.sources[owner] in (wire.NOBODY, self.own)
            if not wanted and owner in n.evidence_sent:  # it is there, or somebody else brings it
                n.transport.cancel(n.evidence_sent.pop(owner))
            if not wanted or owner in n.evidence_sent:
                continue
            if self.config.coverage == "overlap":
                payload = self._overlapping(n, owner)
            elif owner == self.own:
                payload = self._own_evidence()
            else:
                payload = self.knowledge.evidence_bytes[owner]
            if payload is not None:
                n.evidence_sent[owner] = self._send([n], self.evidence_kind, payload)

    def _own_body(self) -> NDArray[Any]:
        """Own evidence as it is sent, best first."""
        if self._body is None:
            records = own_records(self.data, self.evidence_kind)
            self._body = wire.to_body(self.evidence_kind, records[best_first(records)])
        return self._body

    def _own_records(self) -> NDArray[Any]:
        """Own evidence as the others read it, best first."""
        if self._records is None:
            self._records = wire.from_body(self.evidence_kind, self._own_body())
        return self._records

    def _own_evidence(self) -> bytes:
        k = self.knowledge
        if self.own not in k.evidence_bytes:
            k.evidence_bytes[self.own] = wire.write_evidence(
                self.evidence_kind, self.own, 1, self._own_body()
            )
        return k.evidence_bytes[self.own]

    def _overlapping(self, n: Neighbour, owner: int) -> bytes | None:
        """Evidence of an owner in the space that a neighbour saw; None until that can be told."""
        k = self.knowledge
        if n.voxels is None or self.poses is None:
            return None
        if owner == self.own:
            records, body, T_common = (
                self._own_records(),
                self._own_body(),
                self.T_world_map @ self.data.T_map_keyframe,
            )
        elif owner in k.anchors:
            records, body, T_common = k.evidence[owner], k.bodies[owner], k.anchors[owner].T_common_keyframe
        else:
            return None
        known = records["anchor"] < len(T_common)
        keep = within(records[known], T_common, n.voxels, self.config.overlap_voxel_m)
        return wire.write_evidence(self.evidence_kind, owner, 1, body[known][keep])

    # --- matching

    def _others(self) -> list[int]:
        """Members of the component besides this robot."""
        return [i for i in range(len(self.team)) if self.members >> i & 1 and i != self.own]

    def _match(self) -> None:
        """Match own Gaussians with those of every higher-named member, once everything needed is here."""
        if not self.agreed:
            return
        k = self.knowledge
        for other in self._others():
            ready = other in k.anchors and other in k.evidence and (self.own, other) not in k.pairs
            if self.own < other and ready:
                ids = match_pairs(
                    self.data.robot,
                    self._own_records(),
                    k.anchors[self.own].T_common_keyframe,
                    self.team[other],
                    k.sound_records(other),
                    k.anchors[other].T_common_keyframe,
                    self.config.matching,
                )
                ids = injection.false_matches(
                    ids, self.config.injection, self.seed, self.data.robot, self.team[other]
                )
                pairs = PairList(self.own, other, 1, ids)
                k.pairs[self.own, other] = pairs
                k.pairs_bytes[self.own, other] = wire.write_pairs(pairs)

    # --- end

    def _finish(self) -> None:
        """Done when nothing is missing, nothing is unacknowledged and no neighbour lacks what only passes here."""
        if self.done:
            return
        if self.frames_hops == EVERYWHERE and not self._joined():
            self.done = True  # alone from the start, or whoever it met has gone
            self.converged = self.poses is None
            return
        k, everyone = self.knowledge, sorted([self.own, *self._others()])
        complete = (
            self.agreed
            and all(m in k.anchors for m in everyone)
            and all(m in k.evidence for m in everyone if m != self.own)
            and all((a, b) in k.pairs for a in everyone for b in everyone if a < b)
        )
        if complete:
            self.done = all(n.transport.idle and self._supplied(n, everyone) for n in self._joined())
            self.converged = self.done

    @staticmethod
    def _supplied(n: Neighbour, everyone: list[int]) -> bool:
        return n.state is not None and all(n.state.sources[m] == wire.COMPLETE for m in everyone)

    def result(self) -> AgentResult:
        """What the robot takes home. Alone, its poses are those of its own map, bit for bit."""
        robot = self.data.robot
        T_common = {robot: self.data.T_map_keyframe}
        gauge = np.eye(4)
        others: list[int] = []
        if self.poses is not None:
            others = self._others()
            T_common = {self.team[i]: a.T_common_keyframe for i, a in sorted(self.knowledge.anchors.items())}
            T_common.setdefault(robot, self.poses.T_world_keyframe)
            gauge = self._gauge()
        T_world = {name: gauge @ T for name, T in T_common.items()} if self.poses is not None else T_common
        names = [robot, *(self.team[i] for i in others)]
        pairs = {
            (self.team[p.lower], self.team[p.higher]): p.ids
            for p in self.knowledge.pairs.values()
            if self.team[p.lower] in names and self.team[p.higher] in names and self._active(p)
        }
        own = self._own_records()
        evidence = {
            self.team[i]: self.knowledge.sound_records(i) for i in others if i in self.knowledge.anchors
        }
        return AgentResult(
            robot=robot,
            component=tuple(sorted(names)),
            T_world_keyframe=T_world[robot],
            T_world_keyframe_of=T_world,
            own_evidence=to_evidence(robot, own[np.argsort(own["id"])]),
            evidence={name: to_evidence(name, records) for name, records in evidence.items()},
            pairs=pairs,
            closures=tuple(self._closures()),
            agreed=self.agreed or not others,
            converged=self.converged,
            rounds=self.round + 1,
            rounds_to_agreement=self.rounds_to_agreement,
            refused=dict(sorted(self.refused.items())),
        )

    def _active(self, pairs: PairList) -> bool:
        """Whether a pair list counts: at the end that made it, only when the other end is known to have it."""
        if pairs.lower != self.own or self.done:
            return True
        message = self._pairs_told.get((pairs.higher, (pairs.lower, pairs.higher)))
        return message is not None and not self.neighbours[pairs.higher].transport.is_open(message)

    def _gauge(self) -> Array:
        """T_world_common: the root's first keyframe is where its own map has it. Identity before the root said so."""
        root = self.knowledge.anchors.get(self.root)
        if root is None:
            return np.eye(4)
        return root.T_map_first @ se3.inverse(root.T_common_keyframe[0])

    def _closures(self) -> Iterator[ClosureRecord]:
        for n in self.neighbours.values():
            for t in n.meeting.tried:
                r = t.result
                weight = None if r.closure is None else self._weight(n, r.closure)
                verdict, detail = r.verdict, r.detail
                if weight is not None and n.parted:
                    verdict = Verdict.ALONE if weight >= COUNTS else Verdict.OUTWEIGHED
                    detail, weight = f"weight {weight:.2f} when the link was parted; {detail}", 0.0
                elif weight is not None:  # the graduated weights have the last word
                    verdict = Verdict.KEPT if weight >= COUNTS else Verdict.OUTWEIGHED
                yield ClosureRecord(
                    self.data.robot,
                    n.name,
                    t.candidate.own_keyframe,
                    t.candidate.peer_keyframe,
                    t.candidate.score,
                    verdict.value,
                    r.matches,
                    r.inliers,
                    detail,
                    weight,
                    None if r.closure is None else r.closure.T_own_peer,
                    None if r.closure is None else r.closure.information,
                )

    def _weight(self, n: Neighbour, closure: Closure) -> float | None:
        """Robust weight of a closure at the end, or when its link was parted; None if it took no part."""
        if n.meeting.joined is None:
            return None
        if n.parted:
            weights = n.last_weights
        elif self.poses is not None and n.name in self.poses.links:
            weights = self.poses.weights(n.name).tolist()
        else:
            return None
        held = n.meeting.joined.closures
        return next((w for w, other in zip(weights, held, strict=True) if other is closure), None)


def _rank(frame: Frame) -> tuple[int, tuple[int, int, int]]:
    """Order in which a neighbour's frames count: its parted links only become more."""
    return -frame.parted.bit_count(), frame.rank
