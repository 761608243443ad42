"""Frames between keyframes that a map is trained on: one of each of equal parts of the path, the sharpest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.image_motion import image_speeds, slowest_of_parts
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.splat.gaussians import Gaussians


def seen_distance_m(gaussians: Gaussians, T_map_keyframe: Array) -> float:
    """How far away keyframes see things: the median distance of Gaussians from the keyframes that they are anchored to.

    Args:
        gaussians: in the map frame.
        T_map_keyframe: [k, 4, 4].

    Returns:
        Meters; 1 for an empty map.
    """
    if not len(gaussians):
        return 1.0
    away = gaussians.means - T_map_keyframe[gaussians.anchors, :3, 3]
    return float(np.median(np.linalg.norm(away, axis=1)))


def blur_distance_m(gaussians: Gaussians, T_map_keyframe: Array, depth: DepthKind) -> float | None:
    """The same where images may be blurred; None where depth is exact, and with it, as is assumed, the image.

    Args:
        gaussians: in the map frame.
        T_map_keyframe: [k, 4, 4].
        depth: of a Gaussian at a pixel, as the map was made.
    """
    return None if depth == "ray_plane" else seen_distance_m(gaussians, T_map_keyframe)


def training_frames(
    path: Trajectory, candidates: NDArray[np.int64] | list[int], count: int, seen_m: float | None
) -> list[int]:
    """One frame of each of equal parts of the candidates, ascending: the one during which the image moves least.

    Args:
        path: T_map_camera of all frames that have a pose.
        candidates: places in the path, ascending.
        count: of the frames; at most as many as candidates.
        seen_m: distance of what is seen; None: the middles of the parts.
    """
    if seen_m is None:
        chosen = evenly_spaced(len(candidates), count)
    else:
        chosen = slowest_of_parts(image_speeds(path, seen_m)[candidates], count)
    return [int(candidates[k]) for k in chosen]
