"""What a robot takes home from a session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus.evidence import Evidence

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ClosureRecord:
    """One candidate for a closure between two keyframes, and what became of it.

    robot: the end that decided. score: matches of compact descriptors. T_own_peer: [4, 4] if it was measured.
    weight: robust weight at the end; None if it took no part in the pose consensus.
    """

    robot: str
    peer: str
    own_keyframe: int
    peer_keyframe: int
    score: int
    verdict: str
    matches: int
    inliers: int
    detail: str
    weight: float | None
    T_own_peer: Array | None


@dataclass(frozen=True)
class AgentResult:
    """One robot after a session, by its own estimate.

    component: names of the robots that share its world frame, sorted; only itself if it met nobody.
    T_world_keyframe: [n, 4, 4], own keyframes in the map frame of component[0]; exactly those of its own map if it is
    alone. T_world_keyframe_of: the same of every member, itself included, as far as their agreed poses arrived.
    own_evidence: as it was sent, sorted by id. evidence: of the other members with agreed poses, by name, as far as
    it arrived. pairs: ids of matched Gaussians, int64 [n, 2], by (lower, higher) name.
    closures: every candidate that this robot decided on. agreed: its poses are final. converged: it also has
    everything it should have; a robot that is alone has. rounds: ticks it took part in. rounds_to_agreement: None if
    its poses were not agreed. refused: reasons of packets that could not be used, and how many.
    """

    robot: str
    component: tuple[str, ...]
    T_world_keyframe: Array
    T_world_keyframe_of: dict[str, Array]
    own_evidence: Evidence
    evidence: dict[str, Evidence]
    pairs: dict[tuple[str, str], NDArray[np.int64]]
    closures: tuple[ClosureRecord, ...]
    agreed: bool
    converged: bool
    rounds: int
    rounds_to_agreement: int | None
    refused: dict[str, int]
