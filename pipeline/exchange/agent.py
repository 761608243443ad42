"""One robot's agent: a tick per round, from delivered packets to packets sent.

    meet        places, candidates, closures with every neighbor          meeting.py
    frames      relative frames of all pairs, flooded; who knows the same pairs places the team alike    frames.py
    poses       rounds of a solver until everybody holds still              solvers.py
    tell        evidence of every robot to every robot, agreed poses         sharing.py, knowledge.py
    match       the lower-named robot of a pair matches Gaussians and tells

The steps overlap: evidence hangs on keyframes and travels while the poses still move. Two conditions must hold in the
whole component before an agent goes on: that everybody has decided on all its links and knows all frames (before
poses), and that everybody holds still (after). Each is found by counting hops: an agent for which it holds itself says
one more than the least of its neighbors, and whoever reaches the size of the team knows that it holds everywhere.

A link may turn out to be false during the pose rounds: the graduated weights leave too few of its closures. The end
that holds them parts it for good, and whoever hears of that places the team again, without the link. The set of
parted links only grows; it stands in every state and labels everything that depends on it. Nobody can be agreed
before the whole component knows the same set, because a holder does not hold still before its weights are final.

An agent knows its own data, its configuration and the packets it was given. It never raises because of a packet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange import injection
from duagc.pipeline.exchange.loop_closing import HigherEnd, LowerEnd, Meeting, OwnPlaces, Send
from duagc.pipeline.exchange.map_alignment import Frames
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.sharing import Sharing
from duagc.pipeline.exchange.solvers import AdmmSolver, EliminationSolver, LinkStart, PoseSolver, SolverStart
from duagc.pipeline.exchange.wire import places_wire, state_wire
from duagc.pipeline.exchange.wire.state_wire import Anchors, PairFrames, State, pair_bit
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MAX_PAYLOAD_BYTES, Kind, MalformedError, Packet, parse
from duagc.pipeline.network.signatures import Identity
from duagc.pipeline.network.transport import Arrival, Message, Outgoing, Transport
from duagc.pipeline.posegraph.loop_closures import plausible
from duagc.pipeline.runs.robot_data import RobotData

Array = NDArray[np.float64]
EVERYWHERE = 255  # a hop count that has reached the whole component, for good
MAX_EARLY_MESSAGES = 64
LOWER_END_KINDS = frozenset({Kind.DESCRIPTORS, Kind.SAMPLE})  # what the lower end gets
MEETING_KINDS = LOWER_END_KINDS | {Kind.REQUEST, Kind.CLOSURES}


class Agent:
    """One robot of the team; `tick` is the only way in and out."""

    def __init__(
        self,
        data: RobotData,
        team: Sequence[str],
        neighbors: Sequence[str],
        config: ExchangeConfig,
        seed: int,
    ) -> None:
        """Start with nothing but own data.

        Args:
            team: names of all robots that may exist. neighbors: those that this robot has a radio link to.
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
        self.neighbors = {self.team.index(name): self._neighbor(name) for name in sorted(neighbors)}
        self.round = -1
        self.refused: Counter[str] = Counter()
        self.sharing = Sharing(data, self.team, config, seed, self._send)
        self.knowledge = self.sharing.knowledge
        self.frames = Frames(self.own, self.team, config.consensus.closures.margin)
        self.frames_hops = self.still_hops = 0
        self.poses: PoseSolver | None = None
        self.links: dict[int, LinkStart] = {}  # joined neighbors as the solver has them
        self.agreed = self.done = self.converged = False
        self.rounds_to_agreement: int | None = None

    def _neighbor(self, name: str) -> Neighbor:
        index = self.team.index(name)
        transport = Transport(
            self.own, index, name, self.config.transport, self._new_id, identity=self.identity
        )
        return Neighbor(index, name, transport)

    # --- one round

    def tick(self, round_index: int, now_ns: int, delivered: Sequence[bytes]) -> list[Outgoing]:
        """Handle what was delivered, compute, and send at most one burst to each neighbor.

        Args:
            round_index: counts from 0. now_ns: time of this round. delivered: packets, in order of arrival.
        """
        self.round = round_index
        for data in delivered:
            self._take(data)
        self._watch()
        for neighbor in self._living():
            if neighbor.transport.last_heard is not None and not neighbor.greeted:
                neighbor.greeted = True
                self._send(neighbor, Kind.HELLO, self.places.digest)
        self._hear_of_partings()
        self._settle_frames()
        self._settle_poses()
        self.sharing.tell(self._joined(), self.frames.members, self._T_world_map() if self.agreed else None)
        if self.agreed:
            self.sharing.match(self.others)
        self._finish()
        return [packet for neighbor in self._living() for packet in self._burst(neighbor)]

    def _living(self) -> list[Neighbor]:
        return [n for n in self.neighbors.values() if not n.gone]

    @property
    def others(self) -> list[int]:
        """Members of the component besides this robot."""
        return [robot for robot in self.frames.members if robot != self.own]

    def _T_world_map(self) -> Array:  # noqa: N802 (a transform)
        """Own map frame where it was placed before the pose rounds."""
        return self.frames.T_world_first(self.own) @ se3.inverse(self.data.T_map_keyframe[0])

    def _joined(self) -> list[Neighbor]:
        return [n for n in self.neighbors.values() if n.joined]

    def _watch(self) -> None:
        """Give up neighbors that were silent for too long; do not wait for them any more.

        A link that died while the poses were sought would leave its two ends with different last words of each other
        for ever, so the rest of the team begins again without it. If nobody is left, or a neighbor has agreed
        already, what there is stays.
        """
        died = 0
        for neighbor in self._living():
            heard = neighbor.transport.last_heard
            silent = self.round - (0 if heard is None else heard)
            if silent > self.config.transport.silent_after_rounds and not self.done:
                died |= pair_bit(self.own, neighbor.index) if neighbor.joined else 0
                neighbor.gone = True
        others = self._joined()
        settled = self.agreed or any(n.state is not None and n.state.agreed for n in others)
        if died and others and not settled:
            self._part(self.frames.parted | died)

    # --- incoming

    def _take(self, data: bytes) -> None:
        """Parse and handle one packet; what cannot be used is counted with its reason and has no other effect."""
        try:
            packet = parse(data) if self.identity is None else self.identity.open(data)
            neighbor = self._addressed(packet)
            arrival = neighbor.transport.receive(packet, self.round)
            if arrival is not None:
                self._handle(neighbor, arrival)
        except ValueError as error:
            self.refused[str(error)] += 1

    def _addressed(self, packet: Packet) -> Neighbor:
        if packet.receiver != self.own:
            raise MalformedError("addressed to another robot")
        if packet.sender not in self.neighbors:
            raise MalformedError("from a robot that is no neighbor")
        if self.neighbors[packet.sender].gone:
            raise MalformedError("from a neighbor that was given up")
        return self.neighbors[packet.sender]

    def _handle(self, n: Neighbor, arrival: Arrival) -> None:
        payload, team = arrival.payload, len(self.team)
        if arrival.kind is Kind.STATE:
            self._take_state(n, payload)
        elif arrival.kind is Kind.HELLO:
            digest = places_wire.read_digest(payload)
            self._meet(n, lower=(self.places.digest, self.data.robot) < (digest, n.name))
        elif arrival.kind in MEETING_KINDS:
            self._meet(n, lower=arrival.kind in LOWER_END_KINDS).take(arrival.kind, payload, self._sender(n))
        elif arrival.kind is Kind.FRAME:
            if self.poses is not None:
                raise MalformedError("frame: all of them were known before the poses began")
            n.frames_told.setdefault(self.frames.learn(payload, self._held_pairs()), 0)
        elif arrival.kind is Kind.TREE:
            self._take_tree(n, payload)
        elif arrival.kind is Kind.VOXELS:
            _, n.voxels = state_wire.read_voxels(payload, team)
        elif arrival.kind is Kind.ANCHORS:
            n.anchors_told.add(self.knowledge.take_anchors(payload))
        elif arrival.kind is Kind.PAIRS:
            n.pairs_told.setdefault(self.knowledge.take_pairs(payload), 0)
        elif arrival.kind is self.sharing.kind:
            owner = self.knowledge.take_evidence(n.index, arrival.message, payload, arrival.complete)
            if owner is not None:
                for provider, message in self.knowledge.forget_incoming(owner):
                    self.neighbors[provider].transport.accept_rest(message, self.round)
                n.transport.accept_rest(arrival.message, self.round)

    def _meet(self, n: Neighbor, lower: bool) -> Meeting:
        """The meeting with a neighbor; it begins when it is known which end this robot is."""
        if n.meeting is None:
            end = LowerEnd if lower else HigherEnd
            n.meeting = end(self.data.robot, n.name, self.places, self.config, self.seed)
            n.meeting.begin(self._sender(n))
        return n.meeting

    def _held_pairs(self) -> set[tuple[int, int]]:
        """Pairs of this robot that nobody else may speak for."""
        return {
            _pair(self.own, n.index) for n in self.neighbors.values() if not isinstance(n.meeting, HigherEnd)
        }

    def _take_state(self, n: Neighbor, payload: bytes) -> None:
        n.state, poses = state_wire.read_state(payload, len(self.team))
        if (
            poses
            and n.state.parted == self.frames.parted
            and self.poses is not None
            and n.index in self.links
        ):
            self.poses.take_state(self.links[n.index], poses)

    def _take_tree(self, n: Neighbor, payload: bytes) -> None:
        """A message of the solver. One of a start that is still to come here waits for it."""
        parted, rest = state_wire.read_labeled(payload, len(self.team))
        if self.poses is not None and parted == self.frames.parted:
            self.poses.take_message(n.index, rest)
        elif parted & self.frames.parted == self.frames.parted:
            if len(n.early) >= MAX_EARLY_MESSAGES:
                raise MalformedError("elimination: too many messages before its start")
            n.early.append((parted, rest))

    # --- outgoing

    def _new_id(self) -> int:
        self._messages += 1
        return self._messages

    def _sender(self, neighbor: Neighbor) -> Send:
        def send(kind: Kind, payload: bytes) -> None:
            message = self._send(neighbor, kind, payload)
            if kind is Kind.CLOSURES:
                neighbor.verdict_message = message

        return send

    def _send(self, neighbor: Neighbor, kind: Kind, payload: bytes) -> int:
        """Queue one reliable message; returns its id."""
        message = Message(self._new_id(), kind, payload)
        neighbor.transport.send(message)
        return message.id

    def _burst(self, neighbor: Neighbor) -> list[Outgoing]:
        finished = self.done and neighbor.state is not None and neighbor.state.done
        states = [] if finished else self._states(neighbor)
        return neighbor.transport.burst(self.round, states, self.config.link.budget_bytes)

    def _states(self, neighbor: Neighbor) -> list[Message]:
        """The state of this round, with the poses of this round if there are any."""
        direct = {n.index for n in self._joined()}
        state = state_wire.write_state(
            State(
                self.frames.links,
                self.frames.parted,
                self.frames_hops,
                self.still_hops,
                self.agreed,
                self.done,
                self.knowledge.sources(direct, {n.index for n in self._living() if not n.parted}),
            )
        )
        payloads = [state]
        missing = injection.poses_are_missing(
            self.config.injection, self.seed, self.data.robot, neighbor.name, self.round
        )
        speaks = neighbor.index in self.links and not missing and not self._all_agreed()
        if self.poses is not None and speaks:
            room_bytes = MAX_PAYLOAD_BYTES - len(state)
            parts = self.poses.states(self.links[neighbor.index], room_bytes)
            payloads = [state + part for part in parts] or payloads
        return [Message(self._new_id(), Kind.STATE, payload) for payload in payloads]

    def _all_agreed(self) -> bool:
        return self.agreed and all(n.state is not None and n.state.agreed for n in self._joined())

    # --- parted links

    def _hear_of_partings(self) -> None:
        """Take over what joined neighbors know of parted links. Once poses are agreed there is nothing to hear."""
        known = self.frames.parted
        for n in self._joined():
            if n.state is not None:
                known |= n.state.parted
        if known != self.frames.parted and not self.agreed:
            self._part(known)

    def _part(self, known: int) -> None:
        """Begin again with frames, without the links of this mask; forget what depended on them."""
        undecided = self.frames.placement.undecided
        self.frames.part(known)
        for n in self.neighbors.values():
            if not n.parted and known & pair_bit(self.own, n.index):
                n.parted = True
                reason = undecided.get((min(self.data.robot, n.name), max(self.data.robot, n.name)))
                if reason is not None:
                    n.undecided, n.contradiction = True, reason
                if self.poses is not None and n.index in self.links:
                    n.last_weights = self.poses.weights(n.name).tolist()
                elif n.meeting is not None and n.meeting.joined is not None:
                    n.last_weights = [0.0] * len(n.meeting.joined.closures)
                n.transport.cancel_all()
                n.evidence_sent.clear()
        self.frames_hops = self.still_hops = 0
        self.poses, self.links = None, {}

    def _same_links(self, n: Neighbor) -> bool:
        """Whether a neighbor's last state is about the team with the same links."""
        state = n.state
        return state is not None and (state.links, state.parted) == (self.frames.links, self.frames.parted)

    # --- frames

    def _settle_frames(self) -> None:
        """Tell frames on, and count how far around everybody has decided and knows the same ones.

        To have decided is also that the neighbors have what this robot knows: when everybody has, nothing new comes.
        """
        joined = self._joined()
        for n in joined:
            pair = _pair(self.own, n.index)
            if isinstance(n.meeting, LowerEnd) and n.meeting.joined and pair not in self.frames.pairs:
                proposals = n.meeting.joined.proposals
                if pair[0] != self.own:
                    proposals = tuple(p.turned() for p in proposals)
                self.frames.tell(PairFrames(*pair, proposals))
        for n in joined:
            for pair in sorted(self.frames.payloads):
                if pair not in n.frames_told:
                    n.frames_told[pair] = self._send(n, Kind.FRAME, self.frames.payloads[pair])
        if self.frames_hops == EVERYWHERE:
            return
        self.frames_hops = 0
        told = not any(n.transport.is_open(m) for n in joined for m in n.frames_told.values())
        if told and all(n.decided for n in self.neighbors.values()):
            hops = [n.state.frames_hops if n.state and self._same_links(n) else 0 for n in joined]
            self.frames_hops = min([EVERYWHERE - 1, *hops]) + 1
        if self.frames_hops >= len(self.team):
            self.frames_hops = EVERYWHERE

    # --- poses

    def _settle_poses(self) -> None:
        """One round of the solver; final when everybody in the component holds still."""
        joined = self._joined()
        if self.frames_hops < EVERYWHERE or not joined:
            return
        if self.poses is None:
            if undecided := self.frames.undecided:
                self._part(self.frames.parted | undecided)
                return
            self._start_poses()
        assert self.poses is not None
        if not self._all_agreed():
            self.poses.advance()
            self.refused.update(self.poses.refused)
            self.poses.refused.clear()
            for receiver, payload in self.poses.messages():
                labeled = state_wire.write_labeled(self.frames.parted, len(self.team), payload)
                self._send(self.neighbors[receiver], Kind.TREE, labeled)
        if self.agreed:
            return
        refuted = sum(pair_bit(self.own, n.index) for n in joined if self.poses.refuted(n.name))
        if refuted:
            self._part(self.frames.parted | refuted)
            return
        self.still_hops = 0
        if self.poses.settled:
            hops = [n.state.still_hops if n.state and self._same_links(n) else 0 for n in joined]
            self.still_hops = min([EVERYWHERE - 1, *hops]) + 1
        if self.still_hops > len(self.team):
            self.agreed, self.still_hops = True, EVERYWHERE
            self.rounds_to_agreement = self.round
            anchors = Anchors(self.own, self.poses.T_world_keyframe, self.data.T_map_keyframe[0])
            self.knowledge.anchors[self.own] = anchors
            self.knowledge.anchors_bytes[self.own] = state_wire.write_anchors(anchors)

    def _start_poses(self) -> None:
        """Give the solver the own map where it was placed, and the joined neighbors."""
        self.links = {n.index: self._link_start(n) for n in self._joined()}
        start = SolverStart(
            self.data.robot,
            self.own,
            self.places.T_first_keyframe,
            self.places.registrations,
            self.frames.T_world_first(self.own),
            self.frames.tree(),
            list(self.links.values()),
        )
        if self.config.solver == "admm":
            self.poses = AdmmSolver(start, self.config.consensus)
        else:
            precision = self.config.elimination_wire
            self.poses = EliminationSolver(start, self.config.consensus, len(self.team), precision)
        for n in self._joined():
            for parted, payload in n.early:
                if parted == self.frames.parted:
                    self.poses.take_message(n.index, payload)
            n.early.clear()

    def _link_start(self, n: Neighbor) -> LinkStart:
        """A joined neighbor; closures start with weight if they fit to where both robots were placed."""
        assert n.meeting is not None
        meeting = n.meeting.joined
        assert meeting is not None
        if not isinstance(n.meeting, LowerEnd):
            return LinkStart(n.index, n.name, meeting.shared, (), np.zeros(0, bool), np.zeros((0, 4, 4)))
        assert n.meeting.book is not None
        T_world_peer = self.frames.T_world_first(n.index) @ n.meeting.book.T_first_keyframe
        pair = (min(self.data.robot, n.name), max(self.data.robot, n.name))
        chosen = self.frames.placement.chosen[pair]
        n.contradiction = self.frames.placement.contradictions.get(pair, "")
        keep = np.zeros(len(meeting.closures), bool) if chosen is None else meeting.groups[chosen]
        placed = plausible(
            meeting.closures,
            self.frames.T_world_first(self.own) @ self.places.T_first_keyframe,
            T_world_peer,
            self.places.drift,
            n.meeting.book.drift,
            self.config.consensus.closures,
        )
        return LinkStart(n.index, n.name, meeting.shared, meeting.closures, keep & placed, T_world_peer)

    # --- end

    def _finish(self) -> None:
        """Done when nothing is missing, nothing is unacknowledged and no neighbor lacks what only passes here."""
        if self.done:
            return
        if self.frames_hops == EVERYWHERE and not self._joined():
            self.done = True  # alone from the start, or whoever it met has gone
            self.converged = self.poses is None
            return
        k, everyone = self.knowledge, self.frames.members
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
    def _supplied(n: Neighbor, everyone: list[int]) -> bool:
        return n.state is not None and all(n.state.sources[m] == state_wire.COMPLETE for m in everyone)


def _pair(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)
