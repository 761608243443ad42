"""What an agent knows of its team beyond itself: evidence, agreed poses and pair lists, by owner.

Kept as they arrived, so that they can be passed on unchanged, however many hops away their owner is.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.exchange.wire import anchors_wire, evidence_wire, state_wire
from duagc.pipeline.exchange.wire.anchors_wire import Anchors, PlacedKeyframes
from duagc.pipeline.exchange.wire.state_wire import PairList
from duagc.pipeline.network.packets import EVIDENCE_HEAD_BYTES, Kind, MalformedError

Records = NDArray[Any]


@dataclass
class Incoming:
    """Evidence of one owner that is arriving from one neighbor.

    Attributes:
        owner: index of the robot whose evidence it is.
        provider: index of the neighbor.
        chunks: those that are here, each checked on its arrival.
    """

    owner: int
    provider: int
    chunks: list[bytes] = field(default_factory=list)


class Knowledge:
    """Evidence, anchors and pairs of the team, as one agent holds them."""

    def __init__(self, own: int, team: int, kind: Kind) -> None:
        """Nothing is known.

        Args:
            own: index of the robot in the sorted team.
            team: number of robots.
            kind: of the evidence that this team exchanges.
        """
        self.own, self.team, self.kind = own, team, kind
        self.evidence: dict[int, Records] = {}  # complete, by owner
        self.bodies: dict[int, Records] = {}  # the same as they were sent
        self.evidence_bytes: dict[int, bytes] = {}
        self.incoming: dict[tuple[int, int], Incoming] = {}  # by (provider, message)
        self.anchors: dict[int, Anchors] = {}
        self.anchors_bytes: dict[int, bytes] = {}
        self.pairs: dict[tuple[int, int], PairList] = {}
        self.pairs_bytes: dict[tuple[int, int], bytes] = {}

    def take_evidence(self, provider: int, message: int, payload: bytes, complete: bool) -> int | None:
        """Take a chunk, or the complete message.

        Args:
            provider: index of the neighbor that sent it.
            message: its id, unique for that neighbor.
            payload: bytes of the chunk, or of the whole message.
            complete: whether it is the whole message.

        Returns:
            Index of the owner if its evidence is here completely, else None.

        Raises:
            MalformedError: it is not what it should be; nothing of it is kept.
        """
        if complete:
            self.incoming.pop((provider, message), None)
            owner, body, records = evidence_wire.read_evidence(self.kind, payload, self.team)
        else:
            owner = evidence_wire.check_chunk(self.kind, payload, self.team)
        if owner == self.own:
            raise MalformedError("evidence: a neighbor speaks for this robot")
        if not complete:
            if owner not in self.evidence:
                entry = self.incoming.setdefault((provider, message), Incoming(owner, provider))
                if entry.owner != owner:
                    raise MalformedError("evidence: chunks of different owners in one message")
                entry.chunks.append(payload)
            return owner if owner in self.evidence else None
        if owner not in self.evidence:
            self.evidence[owner], self.bodies[owner] = SHELF.put((records, body))
            self.evidence_bytes[owner] = payload
        return owner

    def forget_incoming(self, owner: int) -> list[tuple[int, int]]:
        """Drop what else is arriving of an owner that is complete; returns (provider, message).

        Args:
            owner: index of the robot whose evidence it is.
        """
        keys = sorted(k for k, entry in self.incoming.items() if entry.owner == owner)
        for key in keys:
            del self.incoming[key]
        return keys

    def sources(self, direct: set[int], senders: set[int]) -> NDArray[np.uint8]:
        """Where the evidence of each owner comes from: COMPLETE, a neighbor, or NOBODY.

        Args:
            direct: neighbors that will send their own evidence themselves.
            senders: neighbors from which what began to arrive may still come.
        """
        out = np.full(self.team, state_wire.NOBODY, np.uint8)
        for owner in range(self.team):
            if owner == self.own or owner in self.evidence:
                out[owner] = state_wire.COMPLETE
            elif owner in direct:
                out[owner] = owner
            else:
                providers = sorted({e.provider for e in self.incoming.values() if e.owner == owner} & senders)
                if providers:
                    out[owner] = providers[0]
        return out

    def take_anchors(self, payload: bytes) -> int:
        """Take agreed poses, if they are new; returns their owner.

        Args:
            payload: of ANCHORS.

        Raises:
            MalformedError: it is not what it should be, or speaks for this robot.
        """
        anchors = anchors_wire.read_anchors(payload, self.team)
        if anchors.owner == self.own:
            raise MalformedError("anchors: a neighbor speaks for this robot")
        if anchors.owner not in self.anchors:
            self.anchors[anchors.owner], self.anchors_bytes[anchors.owner] = anchors, payload
        return anchors.owner

    def take_pairs(self, payload: bytes) -> tuple[int, int]:
        """Take a pair list, if it is new; returns the pair. The lower-named robot of a pair speaks for it.

        Args:
            payload: of PAIRS.

        Raises:
            MalformedError: it is not what it should be, or speaks for this robot.
        """
        pairs = state_wire.read_pairs(payload, self.team)
        key = (pairs.lower, pairs.higher)
        if pairs.lower == self.own:
            raise MalformedError("pairs: a neighbor speaks for this robot")
        if key not in self.pairs:
            self.pairs[key], self.pairs_bytes[key] = pairs, payload
        return key

    def records(self, owner: int) -> Records:
        """All records of an owner that are here, whether complete or not, each id once, sorted by id.

        Args:
            owner: index of the robot.

        Returns:
            [n] of `record_dtype` of the kind of this team, in the frames of the owner's keyframes.
        """
        if owner in self.evidence:
            records = self.evidence[owner]
        else:
            parts = []
            for key in sorted(k for k, entry in self.incoming.items() if entry.owner == owner):
                for chunk in self.incoming[key].chunks:
                    parts.append(evidence_wire.read_evidence(self.kind, chunk, self.team)[2])
            records = np.concatenate(parts) if parts else np.zeros(0, evidence_wire.record_dtype(self.kind))
        _, first = np.unique(records["id"], return_index=True)
        return records[first]

    def depth(self, owner: int) -> DepthKind | None:
        """Of a Gaussian at a pixel, as the owner's map was made; None if nothing of its evidence is here.

        Args:
            owner: index of the robot.
        """
        head = self._head(owner)
        return None if head is None else head[0]

    def share(self, owner: int) -> float:
        """Share of an owner's evidence that is here, by what it says of the number of its Gaussians.

        Args:
            owner: index of the robot.

        Returns:
            0 to 1.
        """
        head = self._head(owner)
        if owner in self.evidence or head is None:
            return float(owner in self.evidence)
        return min(1.0, len(self.records(owner)) / max(1, head[1]))

    def _head(self, owner: int) -> tuple[DepthKind, int] | None:
        """Kind of depth and number of Gaussians of an owner; None if nothing of its evidence is here."""
        chunks = [self.evidence_bytes[owner]] if owner in self.evidence_bytes else []
        for key in sorted(k for k, entry in self.incoming.items() if entry.owner == owner):
            chunks += self.incoming[key].chunks
        if not chunks:
            return None
        return evidence_wire.read_evidence_head(self.kind, chunks[0][:EVIDENCE_HEAD_BYTES], self.team)[1:]

    def sound_records(self, poses: PlacedKeyframes) -> Records:
        """`records` of an owner whose anchor is among its poses.

        Args:
            poses: of the owner's keyframes; only the owner and their number count.
        """
        records = self.records(poses.owner)
        return records[records["anchor"] < len(poses.T_common_keyframe)]
