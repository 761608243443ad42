"""Matched Gaussians of two robots, as terms of their poses: the distances of the means in the common frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.spd import add_covariance
from duagc.pipeline.network.packets import MalformedError

SCATTER_M = 0.01
"""Standard deviation by which the means of two matched Gaussians differ where both maps are right."""
SPLATS_PER_SAMPLE = 30.0
"""Gaussians that share a pixel: their information is of the same measurements and counts once."""
Positions = tuple[NDArray[np.int64], Array, Array]
"""Keyframes [p], means in them [p, 3], and information about these [p, 3, 3]."""


@dataclass
class MatchedPairs:
    """Matched Gaussians with one neighbor.

    Attributes:
        anchor: [p] own keyframes.
        mean: [p, 3], own means in these keyframes.
        peer_anchor: [p] keyframes of the neighbor.
        peer_mean: [p, 3], its means there, as it sent its evidence.
        weight: [p, 3, 3], of the distance, in the common frame.
        own_share: [p, 3], of the own value in an average.
        peer_common: [p, 3], the neighbor's means in the common frame, as they last came; as printed only.
    """

    anchor: NDArray[np.int64]
    mean: Array
    peer_anchor: NDArray[np.int64]
    peer_mean: Array
    weight: Array
    own_share: Array
    peer_common: Array

    @classmethod
    def of(
        cls, own: Positions, peer: Positions, T_world_own: Array, T_world_peer: Array, *, printed: bool
    ) -> MatchedPairs:
        """The terms of matched Gaussians.

        Args:
            own: of one robot.
            peer: of the other.
            T_world_own: [n, 4, 4], keyframes of the one.
            T_world_peer: [m, 4, 4], keyframes of the other.
            printed: whether a pair weighs the sum of the information of both, as printed, or the parallel sum.

        Raises:
            MalformedError: a keyframe does not exist.
        """
        (anchor, mean, of_own), (peer_anchor, peer_mean, of_peer) = own, peer
        if len(anchor) and (anchor.max() >= len(T_world_own) or peer_anchor.max() >= len(T_world_peer)):
            raise MalformedError("pairs: of a keyframe that does not exist")
        R, Q = T_world_own[anchor, :3, :3], T_world_peer[peer_anchor, :3, :3]
        of_own, of_peer = R @ of_own @ np.swapaxes(R, -1, -2), Q @ of_peer @ np.swapaxes(Q, -1, -2)
        a, b = (np.maximum(np.diagonal(w, axis1=1, axis2=2), 1e-9) for w in (of_own, of_peer))
        if printed:
            weight = (a + b)[..., None] * np.eye(3)
        else:
            spread = 0.5 * SCATTER_M**2 * np.eye(3)
            inverse = np.linalg.inv(add_covariance(of_own, spread) + 1e-9 * np.eye(3))
            inverse = inverse + np.linalg.inv(add_covariance(of_peer, spread) + 1e-9 * np.eye(3))
            weight = np.linalg.inv(inverse) / SPLATS_PER_SAMPLE
        common = moved(T_world_peer[peer_anchor], peer_mean)
        return cls(
            anchor,
            mean,
            peer_anchor,
            peer_mean,
            weight=weight,
            own_share=a / (a + b),
            peer_common=common,
        )

    def common(self, T_world_own: Array) -> Array:
        """Own means [p, 3] in the common frame.

        Args:
            T_world_own: [n, 4, 4], own keyframes.
        """
        return moved(T_world_own[self.anchor], self.mean)

    def average(self, T_world_own: Array) -> None:
        """(12): own means become the average with the neighbor's, per dimension of the common frame.

        Args:
            T_world_own: [n, 4, 4], own keyframes.
        """
        common = self.own_share * self.common(T_world_own) + (1 - self.own_share) * self.peer_common
        self.mean = moved(se3.inverse(T_world_own[self.anchor]), common)


def moved(T: Array, points: Array) -> Array:
    """Points [p, 3] by one motion each.

    Args:
        T: [p, 4, 4].
        points: [p, 3].
    """
    return (T[:, :3, :3] @ points[..., None])[..., 0] + T[:, :3, 3]
