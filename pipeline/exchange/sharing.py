"""What an agent tells on: evidence to whoever lacks it; space seen, agreed poses and pair lists to everybody."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange import injection
from duagc.pipeline.exchange.evidence_records import best_first, match_pairs, own_records, seen_voxels, within
from duagc.pipeline.exchange.knowledge import Knowledge
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.wire import evidence_wire, state_wire
from duagc.pipeline.exchange.wire.state_wire import PairList
from duagc.pipeline.network.packets import Kind
from duagc.pipeline.runs.robot_data import RobotData

Array = NDArray[np.float64]
EVIDENCE_WIRES = {
    "compact": Kind.EVIDENCE,
    "float32": Kind.EVIDENCE_EXACT,
    "float64": Kind.EVIDENCE_DOUBLE,
}


class Sharing:
    """Own evidence as it is sent, and what is handed on of others'."""

    def __init__(
        self,
        data: RobotData,
        team: Sequence[str],
        config: ExchangeConfig,
        seed: int,
        send: Callable[[Neighbor, Kind, bytes], int],
    ) -> None:
        """team: sorted. send: queues a reliable message for a neighbor and returns its id."""
        self.data, self.team, self.config, self.seed, self._send = data, list(team), config, seed, send
        self.own = self.team.index(data.robot)
        self.kind = EVIDENCE_WIRES[config.evidence_wire]
        self.knowledge = Knowledge(self.own, len(self.team), self.kind)
        self._body: NDArray[Any] | None = None
        self._records: NDArray[Any] | None = None

    # --- own evidence

    def own_body(self) -> NDArray[Any]:
        """Own evidence as it is sent, best first."""
        if self._body is None:
            records = own_records(self.data, self.kind, self.config.weights)
            self._body = evidence_wire.to_body(
                self.kind, records[best_first(records, self.config.evidence_order)]
            )
        return self._body

    def own_records(self) -> NDArray[Any]:
        """Own evidence as the others read it, best first."""
        if self._records is None:
            self._records = evidence_wire.from_body(self.kind, self.own_body())
        return self._records

    def _own_evidence(self) -> bytes:
        k = self.knowledge
        if self.own not in k.evidence_bytes:
            k.evidence_bytes[self.own] = evidence_wire.write_evidence(
                self.kind, self.own, self.data.depth, self.own_body()
            )
        return k.evidence_bytes[self.own]

    # --- telling others

    def tell(self, joined: Sequence[Neighbor], members: Sequence[int], T_world_map: Array | None) -> None:
        """Everything that a neighbor lacks.

        Args:
            members: of the component. T_world_map: own map frame in the common one once poses are agreed, else None.
        """
        k = self.knowledge
        for n in joined:
            if self.config.coverage == "overlap" and T_world_map is not None and not n.voxels_told:
                n.voxels_told = True
                keys = seen_voxels(self.data.gaussians, T_world_map, self.config.overlap_voxel_m)
                self._send(n, Kind.VOXELS, state_wire.write_voxels(self.own, keys))
            self._tell_evidence(n, members, T_world_map)
            for owner in sorted(k.anchors_bytes):
                if owner != n.index and owner not in n.anchors_told:
                    n.anchors_told.add(owner)
                    self._send(n, Kind.ANCHORS, k.anchors_bytes[owner])
            for pair in sorted(k.pairs_bytes):
                if pair[0] != n.index and pair not in n.pairs_told:
                    n.pairs_told[pair] = self._send(n, Kind.PAIRS, k.pairs_bytes[pair])

    def _tell_evidence(self, n: Neighbor, members: Sequence[int], T_world_map: Array | None) -> None:
        if n.state is None:
            return
        for owner in [self.own, *sorted(self.knowledge.evidence)]:
            if owner not in members:
                continue
            wanted = owner != n.index and n.state.sources[owner] in (state_wire.NOBODY, self.own)
            if not wanted and owner in n.evidence_sent:  # it is there, or somebody else brings it
                n.transport.cancel(n.evidence_sent.pop(owner))
            if not wanted or owner in n.evidence_sent:
                continue
            if self.config.coverage == "overlap":
                payload = self._overlapping(n, owner, T_world_map)
            elif owner == self.own:
                payload = self._own_evidence()
            else:
                payload = self.knowledge.evidence_bytes[owner]
            if payload is not None:
                n.evidence_sent[owner] = self._send(n, self.kind, payload)

    def _overlapping(self, n: Neighbor, owner: int, T_world_map: Array | None) -> bytes | None:
        """Evidence of an owner in the space that a neighbor saw; None until that can be told."""
        k = self.knowledge
        if n.voxels is None or T_world_map is None:
            return None
        if owner == self.own:
            records, body, depth = self.own_records(), self.own_body(), self.data.depth
            T_common = T_world_map @ self.data.T_map_keyframe
        elif owner in k.anchors and (told := k.depth(owner)) is not None:
            records, body, depth = k.evidence[owner], k.bodies[owner], told
            T_common = k.anchors[owner].T_common_keyframe
        else:
            return None
        known = records["anchor"] < len(T_common)
        keep = within(records[known], T_common, n.voxels, self.config.overlap_voxel_m)
        return evidence_wire.write_evidence(self.kind, owner, depth, body[known][keep])

    # --- matching

    def match(self, others: Sequence[int]) -> None:
        """Match own Gaussians with those of every higher-named member, once everything needed is here."""
        k = self.knowledge
        for other in others:
            ready = other in k.anchors and other in k.evidence and (self.own, other) not in k.pairs
            if self.own < other and ready:
                ids = match_pairs(
                    self.data.robot,
                    self.own_records(),
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
                k.pairs_bytes[self.own, other] = state_wire.write_pairs(pairs)
