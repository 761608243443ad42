"""A robot's own pose graph: what it knows of its keyframes before it has met any other robot."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import KeyframePoses
from duagc.pipeline.posegraph.relative_poses import RelativePoses


@dataclass(frozen=True)
class OwnGraph:
    """Own keyframes and the relative poses measured between them.

    Attributes:
        robot: name.
        T_map_keyframe: [n, 4, 4], own keyframes in the own map.
        relative_poses: between own keyframes, trusted.
        drift: [n, 2], accumulated variance of the odometry from keyframe 0 (m^2, rad^2).
        loops: further relative poses between own keyframes, which may be false.
        keep_loops: bool per loop, the start of their robust weights.
    """

    robot: str
    T_map_keyframe: Array
    relative_poses: RelativePoses
    drift: Array
    loops: RelativePoses = field(default_factory=RelativePoses.empty)
    keep_loops: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def T_first_keyframe(self) -> Array:  # noqa: N802 (transforms)
        """Keyframes [n, 4, 4] as seen from the first: no result depends on where a robot's map has its origin."""
        T = self.T_map_keyframe
        return se3.inverse(T[0]) @ T if len(T) else T

    @property
    def from_first(self) -> KeyframePoses:
        """Keyframes as seen from the first, with their drift."""
        return KeyframePoses(self.T_first_keyframe, self.drift)
