"""What an agent shares besides poses: evidence with robots that lack it; space, agreed poses and matches with all."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.recall import Recalling, computed
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.consensus.evidence import rows_by_id
from duagc.pipeline.exchange import injection
from duagc.pipeline.exchange.current_poses import CurrentPoses
from duagc.pipeline.exchange.evidence_records import (
    match_pairs,
    order_of_sending,
    own_records,
    seen_voxels,
    within,
)
from duagc.pipeline.exchange.knowledge import Knowledge
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.pose_solver import Matcher
from duagc.pipeline.exchange.shared_data import SendTo
from duagc.pipeline.exchange.wire import anchors_wire, evidence_wire, state_wire
from duagc.pipeline.exchange.wire.anchors_wire import Anchors, PlacedKeyframes
from duagc.pipeline.exchange.wire.state_wire import PairList, State
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.messages import Arrival
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.runs.robot_data import RobotData
from duagc.pipeline.splat.information import MEAN, mean_block

EVIDENCE_WIRES = {
    "compact": Kind.EVIDENCE,
    "float32": Kind.EVIDENCE_EXACT,
    "float64": Kind.EVIDENCE_DOUBLE,
}


class Sharing:
    """Own evidence as it is sent, and what is passed on of others'."""

    enabled = True

    def __init__(
        self,
        data: RobotData,
        team: Sequence[str],
        config: ExchangeConfig,
        seed: int,
        *,
        recall: Recalling = computed,
    ) -> None:
        """Start with own data only.

        Args:
            data: of this robot.
            team: names of all robots that may exist.
            config: the same at all robots.
            seed: of this run.
            recall: slow results; they change no bit.
        """
        self.data, self.team, self.config, self.seed = data, sorted(team), config, seed
        self.recall = recall
        self.own = self.team.index(data.robot)
        self.kind = EVIDENCE_WIRES[config.evidence_wire]
        self.knowledge = Knowledge(self.own, len(self.team), self.kind)
        self.current = CurrentPoses(self.own, len(self.team))
        self._body: NDArray[Any] | None = None
        self._records: NDArray[Any] | None = None
        self._body_sent: NDArray[Any] | None = None

    # --- own evidence

    def own_body(self) -> NDArray[Any]:
        """Own evidence as it is sent, best first."""
        if self._body is None:
            self._body = self.recall(f"evidence of {self.data.robot}", self._ordered_body)
        return self._body

    def _ordered_body(self) -> NDArray[Any]:
        records = own_records(self.data, self.kind, self.config.weights)
        order = order_of_sending(records, self.config.evidence_order, self.seed, self.data.robot)
        body = SHELF.put(evidence_wire.to_body(self.kind, records[order]))
        del records
        SHELF.sweep(heap=True)
        return body

    def own_records(self) -> NDArray[Any]:
        """Own evidence as the others read it, best first."""
        if self._records is None:
            self._records = SHELF.put(evidence_wire.from_body(self.kind, self.own_body()))
        return self._records

    def _sent(self) -> slice:
        """Which of the own records others get."""
        return slice(math.ceil(self.config.evidence_share * len(self.own_body())))

    def _sent_body(self) -> NDArray[Any]:
        """Own evidence as others get it."""
        if self._body_sent is None:
            records = injection.sent_evidence(
                self.own_records(), self.config.injection, seed=self.seed, robot=self.data.robot
            )
            self._body_sent = (
                self.own_body() if records is None else SHELF.put(evidence_wire.to_body(self.kind, records))
            )
        return self._body_sent[self._sent()]

    def _as_sent(self, poses: Anchors) -> Anchors:
        """Own poses as others get them."""
        T = poses.T_common_keyframe.copy()
        T[:, :3, 3] = injection.sent_positions(
            T[:, :3, 3], np.arange(len(T)), self.config.injection, seed=self.seed, robot=self.data.robot
        )
        return replace(poses, T_common_keyframe=T)

    def _own_evidence(self) -> bytes:
        k = self.knowledge
        if self.own not in k.evidence_bytes:
            k.evidence_bytes[self.own] = evidence_wire.write_evidence(
                self.kind, self.own, self.data.depth, self._sent_body()
            )
        return k.evidence_bytes[self.own]

    # --- incoming

    def take(
        self, n: Neighbor, arrival: Arrival, round_index: int, neighbors: Mapping[int, Neighbor]
    ) -> None:
        """Use what a neighbor sent.

        Args:
            n: the neighbor.
            arrival: a message of it, or a part of its evidence.
            round_index: the current round.
            neighbors: all of them, by index; evidence that is complete need not come from the others any
                more.
        Raises:
            MalformedError: it is not what it should be.
        """
        k, payload = self.knowledge, arrival.payload
        if arrival.kind is Kind.VOXELS:
            _, n.voxels = state_wire.read_voxels(payload, len(self.team))
        elif arrival.kind is Kind.CURRENT_POSES:
            self.current.take(n, payload)
        elif arrival.kind is Kind.ANCHORS:
            n.passed.poses.add(k.take_anchors(payload))
        elif arrival.kind is Kind.PAIRS:
            n.passed.pairs.setdefault(k.take_pairs(payload), 0)
        elif arrival.kind is self.kind:
            owner = k.take_evidence(n.index, arrival.message, payload, arrival.complete)
            if owner is not None:
                for provider, message in k.forget_incoming(owner):
                    neighbors[provider].transport.accept_rest(message, round_index)
                n.transport.accept_rest(arrival.message, round_index)

    def offer_poses(
        self, T_common_keyframe: Array, T_map_first: Array, revoked: int, round_index: int
    ) -> None:
        """Own poses of this round, which are not final: they are flooded, should this contact end before.

        Args:
            T_common_keyframe: [n, 4, 4], own keyframes in the common frame of the consensus.
            T_map_first: [4, 4], the first keyframe in the own map.
            revoked: links that do not count.
            round_index: the current round.
        """
        poses = self._as_sent(self._anchors(T_common_keyframe, T_map_first))
        self.current.offer(poses, revoked, round_index)

    def add_poses(self, T_common_keyframe: Array, T_map_first: Array) -> None:
        """Own poses became final: they are flooded.

        Args:
            T_common_keyframe: [n, 4, 4], own keyframes in the common frame of the consensus.
            T_map_first: [4, 4], the first keyframe in the own map.
        """
        anchors = self._anchors(T_common_keyframe, T_map_first)
        self.knowledge.anchors[self.own] = anchors
        self.knowledge.anchors_bytes[self.own] = anchors_wire.write_anchors(self._as_sent(anchors))

    def complete(self, members: Sequence[int]) -> bool:
        """Whether agreed poses, evidence and matches of all members are here.

        Args:
            members: indices of all of them, this robot included.
        """
        k = self.knowledge
        return (
            all(m in k.anchors for m in members)
            and all(m in k.evidence for m in members if m != self.own)
            and all((a, b) in k.pairs for a in members for b in members if a < b)
        )

    def supplied(self, state: State, members: Sequence[int]) -> bool:
        """Whether a neighbor has the evidence of all members.

        Args:
            state: the last one of the neighbor.
            members: indices of the robots of the component.
        """
        return all(state.sources[m] == state_wire.COMPLETE for m in members)

    # --- outgoing

    def send_missing(
        self, send: SendTo, joined: Sequence[Neighbor], members: Sequence[int], T_world_map: Array | None
    ) -> None:
        """Send every joined neighbor what it lacks.

        Args:
            send: queues a message.
            joined: the neighbors.
            members: of the component.
            T_world_map: [4, 4], own map frame in the common one once poses are agreed, else None.
        """
        k = self.knowledge
        self.current.send_missing(send, joined, set(k.anchors))
        for n in joined:
            if self.config.coverage == "overlap" and T_world_map is not None and not n.passed.voxels:
                n.passed.voxels = True
                keys = seen_voxels(self.data.gaussians, T_world_map, self.config.overlap_voxel_m)
                send(n, Kind.VOXELS, state_wire.write_voxels(self.own, keys))
            self._send_evidence(send, n, members, T_world_map)
            for owner in sorted(k.anchors_bytes):
                if owner != n.index and owner not in n.passed.poses:
                    n.passed.poses.add(owner)
                    send(n, Kind.ANCHORS, k.anchors_bytes[owner])
            for pair in sorted(k.pairs_bytes):
                if pair[0] != n.index and pair not in n.passed.pairs:
                    n.passed.pairs[pair] = send(n, Kind.PAIRS, k.pairs_bytes[pair])

    def send_early(self, send: SendTo, n: Neighbor) -> None:
        """Begin to send a neighbor own evidence if the two robots will probably be joined; stop if they are not.

        While a robot waits for samples, nothing else uses its direction of the link.

        Args:
            send: queues a message.
            n: the neighbor, which is not joined.
        """
        if n.loop_closing is not None and self.data.keyframes:
            self.current.tell(send, n, self._from_first())
        if n.loop_closing is not None and n.loop_closing.promising:
            self._send_evidence(send, n, [self.own], None)
        elif n.decided and self.own in n.passed.evidence:
            n.transport.cancel(n.passed.evidence.pop(self.own))

    def _from_first(self) -> Anchors:
        """Own keyframes as seen from the first."""
        T_map_keyframe = self.data.T_map_keyframe
        return self._anchors(se3.inverse(T_map_keyframe[0]) @ T_map_keyframe, T_map_keyframe[0])

    def _anchors(self, T_common_keyframe: Array, T_map_first: Array) -> Anchors:
        return Anchors(self.own, T_common_keyframe, T_map_first, self.data.camera)

    def _send_evidence(
        self, send: SendTo, n: Neighbor, members: Sequence[int], T_world_map: Array | None
    ) -> None:
        if n.state is None:
            return
        for owner in [self.own, *sorted(self.knowledge.evidence)]:
            if owner not in members:
                continue
            wanted = owner != n.index and n.state.sources[owner] in (state_wire.NOBODY, self.own)
            if not wanted and owner in n.passed.evidence:  # it is there, or comes from another robot
                n.transport.cancel(n.passed.evidence.pop(owner))
            if not wanted or owner in n.passed.evidence:
                continue
            if self.config.coverage == "overlap":
                payload = self._overlapping(n, owner, T_world_map)
            elif owner == self.own:
                payload = self._own_evidence()
            else:
                payload = self.knowledge.evidence_bytes[owner]
            if payload is not None:
                n.passed.evidence[owner] = send(n, self.kind, payload)

    def _overlapping(self, n: Neighbor, owner: int, T_world_map: Array | None) -> bytes | None:
        """Evidence of an owner in the space that a neighbor saw; None before both are known."""
        k = self.knowledge
        if n.voxels is None or T_world_map is None:
            return None
        if owner == self.own:
            records, body, depth = self.own_records()[self._sent()], self._sent_body(), self.data.depth
            T_common = T_world_map @ self.data.T_map_keyframe
        elif owner in k.anchors and (kind := k.depth(owner)) is not None:
            records, body, depth = k.evidence[owner], k.bodies[owner], kind
            T_common = k.anchors[owner].T_common_keyframe
        else:
            return None
        known = records["anchor"] < len(T_common)
        keep = within(records[known], T_common, n.voxels, self.config.overlap_voxel_m)
        return evidence_wire.write_evidence(self.kind, owner, depth, body[known][keep])

    # --- matching

    def matched(self, a: PlacedKeyframes, b: PlacedKeyframes) -> NDArray[np.int64]:
        """Ids [n, 2] of matched Gaussians of two robots, of what is here of them.

        Args:
            a: poses of the lower-named one.
            b: poses of the other.
        """
        matching = self.config.matching.of_maps(self.data.thickness_floor_m)
        lower, higher = self._placed(a), self._placed(b)
        name = f"matches {lower[0]} {higher[0]} {_digest(*lower[1:], *higher[1:])}"
        return self.recall(name, partial(match_pairs, lower, higher, matching))

    @property
    def matcher(self) -> Matcher:
        """What a solver asks for matched Gaussians: this object."""
        return self

    def is_here(self, owner: int) -> bool:
        """Whether the evidence of a robot is here.

        Args:
            owner: index of the robot.
        """
        return owner == self.own or owner in self.knowledge.evidence

    def matched_at(self, other: int, T_own: Array, T_other: Array) -> NDArray[np.int64] | None:
        """Ids [p, 2] of own Gaussians and those of a robot that match; None if those are not here.

        Args:
            other: index of the robot, after this one in the team.
            T_own: [n, 4, 4], own keyframes in the common frame.
            T_other: [k, 4, 4], those of the other.
        """
        if not self.is_here(other):
            return None
        return self.matched(PlacedKeyframes(self.own, T_own), PlacedKeyframes(other, T_other))

    def positions(self, owner: int, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array, Array]:
        """Anchors [p] of Gaussians, their means [p, 3] and the information of these [p, 3, 3], in the anchors' frames.

        Args:
            owner: index of the robot.
            ids: [p] of its Gaussians.

        Raises:
            MalformedError: one of them is not here.
        """
        records = self.own_records() if owner == self.own else self.knowledge.records(owner)
        rows = rows_by_id(ids, records["id"])
        if len(rows) and rows.min() < 0:
            raise MalformedError("pairs: a Gaussian that is not here")
        information = mean_block(records["information"][rows].astype(np.float64))
        return (
            records["anchor"][rows].astype(np.int64),
            records["theta"][rows, MEAN].astype(np.float64),
            information,
        )

    def _placed(self, poses: PlacedKeyframes) -> tuple[str, NDArray[Any], Array]:
        """Name of a robot, what is here of its evidence, and its poses."""
        own = poses.owner == self.own
        records = self.own_records()[self._sent()] if own else self.knowledge.sound_records(poses)
        return self.team[poses.owner], records, poses.T_common_keyframe

    def match(self, others: Sequence[int]) -> None:
        """Match own Gaussians with those of every higher-named member, once everything needed is here.

        Args:
            others: indices of the other members.
        """
        k = self.knowledge
        for other in others:
            ready = other in k.anchors and other in k.evidence and (self.own, other) not in k.pairs
            if self.own < other and ready:
                ids = self.matched(k.anchors[self.own], k.anchors[other])
                ids = injection.false_matches(
                    ids, self.config.injection, seed=self.seed, robot=self.data.robot, peer=self.team[other]
                )
                pairs = PairList(self.own, other, 1, ids)
                k.pairs[self.own, other] = pairs
                k.pairs_bytes[self.own, other] = state_wire.write_pairs(pairs)


def _digest(*arrays: NDArray[Any]) -> str:
    """Of what matches follow from: evidence changes while it arrives, and poses with the links of the team."""
    whole = hashlib.sha256()
    for array in arrays:
        whole.update(np.ascontiguousarray(array).data)
    return whole.hexdigest()
