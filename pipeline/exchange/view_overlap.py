"""Which views of two robots should overlap, as far as verified loop closures between them tell.

A loop closure between two keyframes says where the other keyframes near them on both paths are from each other. Where
their views should overlap, a further loop closure is probable, however few of their descriptors match.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, inside
from duagc.pipeline.posegraph.loop_closures import KeyframePoses
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.posegraph.surface_agreement import STRIDE_PX

ALONG_PATH = 8  # keyframes to either side of a loop closure, on both paths
POINTS = 600  # of an own depth image, at most about so many
CELLS = 6, 8  # rows and columns of the neighbor's image that the points fall into
LEAST_COSINE = math.cos(math.radians(45))  # between both lines of sight: SIFT does not match beyond
MOST_SCALE = 2.0  # ratio of both distances, likewise
NEAREST_M = 0.05


def overlaps(
    closures: Iterable[LoopClosure],
    coarse_m: Sequence[NDArray[np.float32]],
    camera: PinholeCamera,
    peer_camera: PinholeCamera,
    *,
    own: KeyframePoses,
    peer: KeyframePoses,
) -> dict[tuple[int, int], float]:
    """How much of their views two robots' keyframes share, for all pairs near a loop closure on both paths.

    The relative pose of a pair is that of the loop closure with least drift between. Of a neighbor's keyframe no depth
    is needed.

    Args:
        closures: verified, from the own side.
        coarse_m: `surface_agreement.coarse_depth` of the own keyframes.
        camera: of the whole own images.
        peer_camera: of the neighbor's.
        own: own keyframes, in any one frame.
        peer: the neighbor's keyframes, likewise.
    Returns:
        `shared_view`, by (own keyframe, neighbor's keyframe).
    """
    nearest: dict[int, dict[int, tuple[float, LoopClosure]]] = {}
    for c in sorted(closures, key=lambda c: (c.own_keyframe, c.peer_keyframe)):
        k, m = c.own_keyframe, c.peer_keyframe
        for i in _near(k, len(own.drift)):
            for j in _near(m, len(peer.drift)):
                between = abs(own.drift[i, 0] - own.drift[k, 0]) + abs(peer.drift[j, 0] - peer.drift[m, 0])
                found = nearest.setdefault(i, {}).get(j)
                if found is None or between < found[0]:
                    nearest[i][j] = (float(between), c)
    out: dict[tuple[int, int], float] = {}
    for i, by_peer in sorted(nearest.items()):
        by = [by_peer[j][1] for j in sorted(by_peer)]
        ends = [c.own_keyframe for c in by], [c.peer_keyframe for c in by]
        T_own_closure = se3.inverse(own.T_frame_keyframe[i]) @ own.T_frame_keyframe[ends[0]]
        T_closure_peer = se3.inverse(peer.T_frame_keyframe[ends[1]]) @ peer.T_frame_keyframe[sorted(by_peer)]
        T_own_peer = T_own_closure @ np.array([c.T_own_peer for c in by]) @ T_closure_peer
        shares = shared_view(coarse_m[i], camera, T_own_peer, peer_camera)
        out |= {(i, j): share for j, share in zip(sorted(by_peer), shares.tolist(), strict=True)}
    return out


def shared_view(
    coarse_m: NDArray[np.float32], camera: PinholeCamera, T_own_peer: Array, peer_camera: PinholeCamera
) -> Array:
    """How much an own view shares with other views, seen from directions and distances that are not too different.

    Args:
        coarse_m: `surface_agreement.coarse_depth` of the own view.
        camera: of the whole image of the own view.
        T_own_peer: [k, 4, 4], the other views.
        peer_camera: of these.
    Returns:
        [k], 0 to 1: the share of the own points that the other view sees, or if larger the share of the other image
        that they fall into.
    """
    step = math.ceil(math.sqrt(coarse_m.size / POINTS))
    sparse = coarse_m[::step, ::step]
    row, column = np.nonzero(sparse > 0)
    if not len(row):
        return np.zeros(len(T_own_peer))
    scale = float(step * STRIDE_PX)
    points = back_project(camera, column * scale, row * scale, sparse[row, column].astype(np.float64))
    seen = se3.transform(se3.inverse(T_own_peer), points)
    in_front = seen[..., 2] > NEAREST_M
    u, v = np.moveaxis(peer_camera.project(np.where(in_front[..., None], seen, [0.0, 0.0, 1.0])), -1, 0)
    own_m, peer_m = np.linalg.norm(points, axis=-1), np.linalg.norm(seen, axis=-1)
    along = np.sum(points * (points - T_own_peer[:, None, :3, 3]), axis=-1)
    good = (
        in_front
        & inside(u, v, (peer_camera.height, peer_camera.width))
        & (along > LEAST_COSINE * own_m * peer_m)
    )
    good &= (peer_m < MOST_SCALE * own_m) & (own_m < MOST_SCALE * peer_m)
    covered = np.zeros((len(T_own_peer), *CELLS), dtype=bool)
    view, point = np.nonzero(good)
    at = [
        (x[view, point] * (n / size)).astype(np.int64)
        for x, n, size in ((v, CELLS[0], peer_camera.height), (u, CELLS[1], peer_camera.width))
    ]
    covered[view, at[0], at[1]] = True
    return np.maximum(good.mean(axis=-1), covered.mean(axis=(1, 2)))


def _near(keyframe: int, count: int) -> range:
    return range(max(0, keyframe - ALONG_PATH), min(count, keyframe + ALONG_PATH + 1))
