"""Penalties of a link of the pose consensus, which its two ends agree on while they iterate.

Penalty handshake. The end with the lower name decides. Versions count up from 0, and a packet is used only by a
receiver of the same version.

    * Every packet carries the sender's version; the decider's also its penalties; the follower's also its curvature
      once it has received enough in this version.
    * The decider, having received enough itself and holding a curvature of this version, takes new penalties, moves
      its y so that its force W d stays, and counts the version up.
    * The follower adopts penalties and version from the first newer packet that reaches it, keeping its force
      likewise, and then uses that packet.

So the ends differ by at most one version (the decider cannot decide again before it has heard the follower in the new
version), a lost packet only delays the follower's change, and what the follower sent before it is dropped by the
decider, as if lost. Keeping the force keeps every fixed point: there m = y before and after.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import BLOCK, AdmmEdge
from duagc.pipeline.posegraph.least_squares import difference

CURVATURES = (1e-9, 1e8)
"""Where a measured one is beyond them, nothing pulls, or nothing moves; a receiver refuses what is much further."""


def curvature(link: AdmmEdge, T: Array, config: PoseConsensusConfig) -> Array | None:
    """Curvature [2] measured since the last change of penalties: |change of force| / |change of pose|.

    In the metric, for translation and rotation apart; None before enough was received or if nothing moved.

    Args:
        link: one end of it.
        T: [s, 4, 4], its poses at this end.
        config: how much must be received.
    """
    if link.received < config.penalty_period:
        return None
    if link.reference is None:
        _begin(link, T)
        return None
    force, poses = link.reference
    root = np.sqrt(link.metric)
    d_force = (link.force() - force) / root
    d_pose = difference(T, poses) * root * link.active[:, None]
    stiffness = []
    for block in (slice(0, 3), slice(3, 6)):
        moved = float(np.linalg.norm(d_pose[:, block]))
        changed = float(np.linalg.norm(d_force[:, block]))
        if moved == 0.0 or changed == 0.0:
            return None
        stiffness.append(changed / moved)
    return np.clip(stiffness, *CURVATURES)


def next_penalties(link: AdmmEdge, own: Array, peer: Array, config: PoseConsensusConfig) -> Array:
    """Penalties [2] for the curvatures of both ends, the closer to the last ones the more was received.

    Args:
        link: the end that decides.
        own: [2], `curvature` here.
        peer: [2], `curvature` at the other end.
        config: bounds of the penalties.
    """
    received = link.received_total - link.adapting_from
    limit = 1.0 + 2.0 / max(1.0, received / config.penalty_decay)
    penalties = np.sqrt(own * peer)
    penalties = np.clip(penalties, link.penalties / limit, link.penalties * limit)
    penalties = np.clip(penalties, config.penalty_min, config.penalty_max)
    return np.asarray(penalties.astype(np.float32).astype(np.float64))


def change(link: AdmmEdge, penalties: Array, version: int, T: Array) -> None:
    """Change W and move y so that the force W (x - y) stays.

    Args:
        link: one end of it.
        penalties: [2], the new ones.
        version: theirs.
        T: [s, 4, 4], poses of the link at this end.
    """
    link.offset = link.offset * (link.penalties / penalties)[BLOCK]
    link.penalties, link.version = penalties, version
    _begin(link, T)


def _begin(link: AdmmEdge, T: Array) -> None:
    """Begin a new window of the curvature."""
    link.reference = (link.force(), T.copy())
    link.received = 0.0
    link.peer_curvature = None
