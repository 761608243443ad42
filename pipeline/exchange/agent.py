"""One robot's agent: a tick per round, from delivered packets to packets sent.

    loop closing    protocols with every neighbor                             loop_closing.py
    alignment       relative frames of all pairs, flooded; agents that know the same pairs place the team alike
                                                                              map_alignment.py, frame_flooding.py
    poses           rounds of a solver until all robots have converged        solvers.py, pose_solver.py
    sharing         evidence of every robot to every robot, agreed poses; the lower-named robot of a pair matches
                    Gaussians and floods the matches                          sharing.py, knowledge.py

The steps overlap: evidence is anchored to keyframes and travels while the poses still move. Two conditions must hold
in the whole component before an agent goes on: all agents have decided on all their links and know all relative frames
(before the poses), and all have converged (after). Each is found by counting hops: an agent for which the condition
holds sends one more than the least count of its neighbors, and an agent that reaches the size of the team knows that
it holds in the whole component.

A link may turn out to be false during the pose rounds: the graduated weights leave too few of its loop closures. The
end that holds them revokes it for good, and every agent that learns of it places the team again, without the link. The
set of revoked links only grows; it is part of every state and labels everything that depends on it. No agent can agree
before the whole component knows the same set, because a holder does not converge before its weights are final.

An agent knows its own data, its configuration and the packets it was given. It never raises because of a packet.
Where its loop closures come from and what it shares besides poses are given to it: `MapAgent` (`map_agent.py`) has
images and a map, the agents of `duagc posegraph` have a file (`team_posegraph`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange import injection
from duagc.pipeline.exchange.frame_flooding import FrameFlooding
from duagc.pipeline.exchange.link_starts import LinkStarts, closures_selected
from duagc.pipeline.exchange.loop_closing import LoopClosing
from duagc.pipeline.exchange.map_alignment import MapAlignment
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.pose_solver import LinkStart, PoseSolver, SolverFactory, SolverStart
from duagc.pipeline.exchange.radio import LOOP_CLOSING_KINDS, Radio
from duagc.pipeline.exchange.shared_data import SharedData
from duagc.pipeline.exchange.solvers import solver_of
from duagc.pipeline.exchange.wire import state_wire
from duagc.pipeline.exchange.wire.state_wire import State, pair_bit
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.messages import Arrival, Message, Outgoing
from duagc.pipeline.network.packets import MAX_PAYLOAD_BYTES, Kind, MalformedError

WHOLE_COMPONENT = 255  # a hop count that has reached the whole component, for good
MAX_EARLY_MESSAGES = 64


class Agent:
    """One robot of the team; `tick` is the only way in and out.

    Attributes:
        graph: own keyframes and the relative poses between them.
        config: the same at all robots.
        team: names of all robots that may exist, sorted.
        own: index of this robot in the team.
        radio: own end of all radio links.
        neighbors: robots that this one has a radio link to, by index.
        loop_closing: where loop closures come from.
        sharing: what is shared besides poses.
        alignment: where the maps of the team lie.
        poses: the solver, while the poses are sought and after.
        links: joined neighbors as the solver has them, by index.
        agreed: the poses are final.
        done: nothing is missing.
        converged: the robot has all that it should have.
        refused: reasons of packets that could not be used, and how many.
        round: the current one.
        first_pose_round: the round in which the solver first started; None before.
        rounds_to_agreement: the round in which the poses became final; None before.
    """

    def __init__(
        self,
        graph: OwnGraph,
        team: Sequence[str],
        neighbors: Sequence[str],
        config: ExchangeConfig,
        *,
        seed: int,
        loop_closing: LoopClosing,
        sharing: SharedData,
        solver: SolverFactory | None = None,
    ) -> None:
        """Start with own data only.

        Args:
            graph: of this robot.
            team: names of all robots that may exist.
            neighbors: names of those that this robot has a radio link to.
            config: the same at all robots.
            seed: of this run.
            loop_closing: where loop closures come from.
            sharing: what is shared besides poses.
            solver: makes the solver of the poses; default by the settings.
        """
        self.graph, self.config, self.seed = graph, config, seed
        self.loop_closing, self.sharing = loop_closing, sharing
        self.radio = Radio(
            graph.robot, team, neighbors, config.transport, seed=seed, loop_closing=loop_closing
        )
        self.team, self.own, self.neighbors = self.radio.team, self.radio.own, self.radio.neighbors
        self._make_solver = solver or solver_of(config, len(self.team), seed)
        self.round = -1
        self.refused: Counter[str] = Counter()
        margin = config.consensus.closures.margin if loop_closing.revokes else np.inf
        self.alignment = MapAlignment(self.own, self.team, margin, short=not sharing.enabled)
        self._frames = FrameFlooding(self.radio, self.alignment)
        self.alignment_hops = self.converged_hops = 0
        self.poses: PoseSolver | None = None
        self.links: dict[int, LinkStart] = {}
        self.agreed = self.done = self.converged = False
        self.first_pose_round: int | None = None
        self.rounds_to_agreement: int | None = None

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        """Own keyframes [n, 4, 4] in the common frame while there are pose rounds, else in the own map."""
        return self.graph.T_map_keyframe if self.poses is None else self.poses.T_world_keyframe

    # --- one round

    def tick(self, round_index: int, delivered: Sequence[bytes]) -> list[Outgoing]:
        """Handle what was delivered, compute, and send at most one burst to each neighbor.

        Args:
            round_index: counts from 0.
            delivered: packets, in order of arrival.
        """
        self.round = round_index
        for data in delivered:
            self._take(data)
        self._drop_silent_neighbors()
        self.radio.greet()
        self._merge_revocations()
        self._update_alignment()
        self._update_poses()
        T_world_map = self._T_world_map() if self.agreed else None
        self.sharing.send_missing(self.radio.send, self.radio.joined, self.alignment.members, T_world_map)
        for neighbor in self.radio.in_contact:
            if not neighbor.joined and not neighbor.link.revoked:
                self.sharing.send_early(self.radio.send, neighbor)
        if self.agreed:
            self.sharing.match(self.others)
        self._finish()
        state = self._state()
        return [packet for neighbor in self.radio.in_contact for packet in self._burst(neighbor, state)]

    @property
    def others(self) -> list[int]:
        """Members of the component besides this robot."""
        return [robot for robot in self.alignment.members if robot != self.own]

    def _T_world_map(self) -> Array:  # noqa: N802 (a transform)
        """Own map frame where it was placed before the pose rounds."""
        return self.alignment.T_world_first(self.own) @ se3.inverse(self.graph.T_map_keyframe[0])

    def _drop_silent_neighbors(self) -> None:
        """Give up neighbors that were silent for too long; do not wait for them any more.

        A link that died during the pose rounds would leave its two ends with different last packets of each other,
        so the rest of the team begins again without it. If no neighbor is left or still heard, or one has agreed
        already, the poses stay as they are.
        """
        died = 0
        for neighbor in self.radio.in_contact:
            heard = neighbor.transport.last_heard
            silent = self.round - (0 if heard is None else heard)
            if silent > self.config.transport.silent_after_rounds and not self.done:
                died |= pair_bit(self.own, neighbor.index) if neighbor.joined else 0
                neighbor.lost = True
        others = self.radio.joined
        final = self.agreed or any(n.state is not None and n.state.agreed for n in others)
        if died and not final and any(n.transport.in_contact(self.round) for n in others):
            self._revoke_links(self.alignment.revoked | died)

    # --- incoming

    def _take(self, data: bytes) -> None:
        """Parse and handle one packet; what cannot be used is counted with its reason and has no other effect."""
        try:
            neighbor, arrival = self.radio.open(data, self.round)
            if arrival is not None:
                self._handle(neighbor, arrival)
        except ValueError as error:
            self.refused[str(error)] += 1

    def _handle(self, n: Neighbor, arrival: Arrival) -> None:
        payload = arrival.payload
        if arrival.kind is Kind.STATE:
            self._take_state(n, payload)
        elif arrival.kind in LOOP_CLOSING_KINDS:
            self.radio.take_loop_closing(n, arrival.kind, payload)
        elif arrival.kind is Kind.RELATIVE_FRAME:
            if self.poses is not None:
                raise MalformedError("relative frame: all of them were known before the poses began")
            self._frames.take(n, payload)
        elif arrival.kind is Kind.TREE:
            self._take_tree(n, payload)
        else:
            self.sharing.take(n, arrival, self.round, self.neighbors)

    def _take_state(self, n: Neighbor, payload: bytes) -> None:
        n.state, poses = state_wire.read_state(payload, len(self.team))
        same = n.state.revoked_links == self.alignment.revoked
        if poses and same and self.poses is not None and n.index in self.links:
            self.poses.take_state(self.links[n.index], poses)

    def _take_tree(self, n: Neighbor, payload: bytes) -> None:
        """A message of the solver. One of a start that is still to come here waits for it."""
        revoked, rest = state_wire.read_labeled(payload, len(self.team))
        if self.poses is not None and revoked == self.alignment.revoked:
            if n.index not in self.links:
                raise MalformedError("solver: from a neighbor that is not joined")
            self.poses.take_message(n.index, rest)
        elif revoked & self.alignment.revoked == self.alignment.revoked:
            if len(n.early) >= MAX_EARLY_MESSAGES:
                raise MalformedError("elimination: too many messages before its start")
            n.early.append((revoked, rest))

    # --- outgoing

    def _burst(self, neighbor: Neighbor, state: bytes) -> list[Outgoing]:
        finished = self.done and neighbor.state is not None and neighbor.state.done
        states = [] if finished else self._states(neighbor, state)
        return neighbor.transport.burst(self.round, states, self.config.link.budget_bytes)

    def _state(self) -> bytes:
        """The state of this round, the same for every neighbor."""
        direct = {n.index for n in self.radio.joined}
        senders = {n.index for n in self.neighbors.values() if n.may_send_evidence}
        state = State(
            links=self.alignment.links,
            revoked_links=self.alignment.revoked,
            alignment_hops=self.alignment_hops,
            converged_hops=self.converged_hops,
            agreed=self.agreed,
            done=self.done,
            sources=self.sharing.knowledge.sources(direct, senders),
        )
        return state_wire.write_state(state, short=not self.sharing.enabled)

    def _states(self, neighbor: Neighbor, state: bytes) -> list[Message]:
        """The state of this round, with the poses of this round if there are any."""
        payloads, own, peer = [state], self.graph.robot, neighbor.name
        missing = injection.poses_are_missing(
            self.config.injection, seed=self.seed, robot=own, peer=peer, round_index=self.round
        )
        sends_poses = neighbor.index in self.links and not missing and not self._all_agreed()
        if self.poses is not None and sends_poses:
            parts = self.poses.states(self.links[neighbor.index], MAX_PAYLOAD_BYTES - len(state))
            payloads = [state + part for part in parts] or payloads
        # with evidence to share, states go out in every round
        if payloads == [state] and not self.sharing.enabled:
            if neighbor.was_sent(state, self.round):
                return []
            neighbor.note_sent(state, self.round)
        return [Message(self.radio.new_id(), Kind.STATE, payload) for payload in payloads]

    def _all_agreed(self) -> bool:
        return self.agreed and all(n.state is not None and n.state.agreed for n in self.radio.joined)

    # --- revoked links

    def _merge_revocations(self) -> None:
        """Add the revoked links that joined neighbors know. Once the poses are agreed there are no new ones."""
        known = self.alignment.revoked
        for n in self.radio.joined:
            if n.state is not None:
                known |= n.state.revoked_links
        if known != self.alignment.revoked and not self.agreed:
            self._revoke_links(known)

    def _revoke_links(self, known: int) -> None:
        """Begin again with the alignment, without the links of this mask; forget what depended on them."""
        undecided = self.alignment.placement.undecided
        self.alignment.revoke(known)
        for n in self.neighbors.values():
            if not n.link.revoked and known & pair_bit(self.own, n.index):
                n.link.revoked = True
                reason = undecided.get((min(self.graph.robot, n.name), max(self.graph.robot, n.name)))
                if reason is not None:
                    n.link.undecided, n.link.contradiction = True, reason
                if self.poses is not None and n.index in self.links:
                    n.link.weights = self.poses.weights(n.name).tolist()
                elif n.loop_closing is not None and n.loop_closing.joined is not None:
                    n.link.weights = [0.0] * len(n.loop_closing.joined.closures)
                n.transport.cancel_all()
                n.passed.evidence.clear()
        self.alignment_hops = self.converged_hops = 0
        self.poses, self.links = None, {}

    def _one_more_hop(self, joined: Sequence[Neighbor], count_of: Callable[[State], int]) -> int:
        """One more than the least count of the joined neighbors; 0 of one that knows other links of the team."""
        links, counts = (self.alignment.links, self.alignment.revoked), [WHOLE_COMPONENT - 1]
        for n in joined:
            same = n.state is not None and (n.state.links, n.state.revoked_links) == links
            counts.append(count_of(n.state) if n.state is not None and same else 0)
        return min(counts) + 1

    # --- alignment

    def _update_alignment(self) -> None:
        """Flood relative frames, and count how far around all robots have decided and know the same ones.

        To have decided is also that the neighbors have what this robot knows: when all have, nothing new comes.
        """
        joined, acknowledged = self.radio.joined, self._frames.advance()
        if self.alignment_hops == WHOLE_COMPONENT:
            return
        self.alignment_hops = 0
        if acknowledged and all(n.decided for n in self.neighbors.values()):
            self.alignment_hops = self._one_more_hop(joined, lambda state: state.alignment_hops)
        if self.alignment_hops >= len(self.team):
            self.alignment_hops = WHOLE_COMPONENT

    # --- poses

    def _update_poses(self) -> None:
        """One round of the solver; the poses are final when all robots of the component have converged."""
        joined = self.radio.joined
        if self.alignment_hops < WHOLE_COMPONENT or not joined:
            return
        if self.poses is None:
            if any(self._frames.pair_with(n) not in self.alignment.pairs for n in joined):
                return  # a forged state counted hops that are not there
            if self.loop_closing.revokes and (undecided := self.alignment.undecided):
                self._revoke_links(self.alignment.revoked | undecided)
                return
            if not closures_selected(self.radio, self.alignment):
                return
            self._start_poses()
        assert self.poses is not None
        if not self._all_agreed():
            self.poses.advance()
            self.refused.update(self.poses.refused)
            self.poses.refused.clear()
            for receiver, payload in self.poses.messages():
                labeled = state_wire.write_labeled(self.alignment.revoked, len(self.team), payload)
                self.radio.send(self.neighbors[receiver], Kind.TREE, labeled)
        if self.agreed:
            return
        first = self.graph.T_map_keyframe[0]
        self.sharing.offer_poses(self.poses.T_world_keyframe, first, self.alignment.revoked, self.round)
        refuted = sum(pair_bit(self.own, n.index) for n in joined if self.poses.refuted(n.name))
        if refuted and self.loop_closing.revokes:
            self._revoke_links(self.alignment.revoked | refuted)
            return
        self.converged_hops = 0
        if self.poses.converged:
            self.converged_hops = self._one_more_hop(joined, lambda state: state.converged_hops)
        if self.converged_hops > len(self.team):
            self.agreed, self.converged_hops = True, WHOLE_COMPONENT
            self.rounds_to_agreement = self.round
            self.sharing.add_poses(self.poses.T_world_keyframe, self.graph.T_map_keyframe[0])

    def _start_poses(self) -> None:
        """Give the solver the own graph where it was placed, and the joined neighbors."""
        if self.first_pose_round is None:
            self.first_pose_round = self.round
        starts = LinkStarts(
            self.graph, self.alignment, self.config.consensus.closures, self.loop_closing.trusted
        )
        self.links = {n.index: starts.of(n) for n in self.radio.joined}
        T_world_map = self.alignment.T_world_first(self.own)
        tree, links = self.alignment.tree(), list(self.links.values())
        matcher = self.sharing.matcher
        self.poses = self._make_solver(SolverStart(self.graph, self.own, T_world_map, tree, links, matcher))
        for n in self.radio.joined:
            for revoked, payload in n.early:
                if revoked == self.alignment.revoked:
                    self.poses.take_message(n.index, payload)
            n.early.clear()

    # --- end

    def _finish(self) -> None:
        """Done when nothing is missing, nothing is unacknowledged and no neighbor lacks what only passes here."""
        if self.done:
            return
        if self.alignment_hops == WHOLE_COMPONENT and not self.radio.joined:
            self.done = True  # alone from the start, or all neighbors were given up
            self.converged = self.poses is None and self.alignment.members == [self.own]
            return
        members = self.alignment.members
        if self.agreed and self.sharing.complete(members):
            self.done = all(
                n.transport.idle and n.state is not None and self.sharing.supplied(n.state, members)
                for n in self.radio.joined
            )
            self.converged = self.done
