"""Whether the keyframes of two robots, or of two submaps, see the same surfaces when one map is laid into the other.

Loop closures show that two places look alike. Aligned by them, the maps must agree everywhere else too: where own
keyframes see the surface of a neighbor's samples, they must see it at the same depth. A place that only looks like
another does not pass this test.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import inside

STRIDE_PX = 4  # of the own depth images
GATE_M, GATE_RELATIVE = 0.1, 0.05  # same surface: the larger of the two, the second by the depth
MIN_COMPARED = 50  # samples that a keyframe must be able to judge
KEYFRAMES = 24  # own keyframes that are compared with one of the neighbor's, the nearest


def coarse_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """What is kept of a depth image: every `STRIDE_PX`-th row and column.

    Args:
        depth_m: [h, w], 0 = unknown.
    """
    return np.ascontiguousarray(depth_m[::STRIDE_PX, ::STRIDE_PX])


def surface_agreement(
    coarse_m: Sequence[NDArray[np.float32]],
    camera: PinholeCamera,
    samples: Sequence[NDArray[np.floating]],
    *,
    T_ownmap_keyframe: Array,
    T_ownmap_peer: Array,
    stride_px: int = STRIDE_PX,
) -> float:
    """Share of a neighbor's samples that own keyframes see at the same place, of all that they can compare.

    Args:
        coarse_m: `coarse_depth` of the own keyframes.
        camera: of the whole images.
        samples: [m, 3] of every keyframe of the neighbor that is known, in its camera frame.
        T_ownmap_keyframe: [n, 4, 4], own keyframes.
        T_ownmap_peer: [k, 4, 4], these keyframes where they lie in the own map.
        stride_px: pixels of the camera between pixels of `coarse_m`.
    Returns:
        0 to 1; 0 if no own keyframe can compare anything.
    """
    compared = agree = 0
    for points, T_ownmap_sample in zip(samples, T_ownmap_peer, strict=True):
        placed = se3.transform(T_ownmap_sample, np.asarray(points, dtype=np.float64))
        distance = np.linalg.norm(T_ownmap_keyframe[:, :3, 3] - T_ownmap_sample[:3, 3], axis=1)
        for k in np.argsort(distance, kind="stable")[:KEYFRAMES].tolist():
            q = se3.transform(se3.inverse(T_ownmap_keyframe[k]), placed)
            found, seen = _compared(coarse_m[k], camera, q[q[:, 2] > 0.05], stride_px)
            if seen >= MIN_COMPARED:
                compared, agree = compared + seen, agree + found
    return agree / compared if compared else 0.0


def _compared(
    coarse_m: NDArray[np.float32], camera: PinholeCamera, q: Array, stride_px: int
) -> tuple[int, int]:
    """How many of the points q [n, 3] in the camera frame lie on the surface seen, and how many could be compared."""
    u, v = np.rint(camera.project(q) / stride_px).T
    seen = inside(u, v, coarse_m.shape)
    depth = q[seen, 2]
    seen_m = coarse_m[v[seen].astype(np.int64), u[seen].astype(np.int64)]
    known = seen_m > 0
    near = np.abs(seen_m - depth) < np.maximum(GATE_M, GATE_RELATIVE * depth)
    return int(np.count_nonzero(near & known)), int(np.count_nonzero(known))
