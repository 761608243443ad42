"""How many matched Gaussians lie on the same true surface, and how many of those that could be matched are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.consensus.evidence import rows_by_id
from duagc.pipeline.evaluation import groundtruth, trajectory_errors
from duagc.pipeline.evaluation.oracle import NO_LISTS, NO_MATCHES, unlisted
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.true_paths import TruePaths
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder


def matching_section(
    run: RunFolder, source: Recording, truth: TruePaths, pairs: Mapping[tuple[str, str], NDArray[np.int64]]
) -> dict[str, float | Absent]:
    """Precision and recall of matching, of all pairs of robots together.

    Means are moved onto the true surface, each map where its robot's true path has it. A match is right if its two
    means lie within the radius of matching there; a Gaussian of the lower-named robot could be matched if any of the
    other's lies so near.

    Args:
        run: the run.
        source: its recording.
        truth: paths next to the true ones.
        pairs: ids of matched Gaussians [n, 2] by robots, lower name first.
    """
    names = ("matching_precision", "matching_recall")
    surface = groundtruth.surface(source)
    if isinstance(surface, Absent):
        return dict.fromkeys(names, surface)
    if unlisted([robot.component for robot in run.robots.values()], pairs):
        return dict.fromkeys(names, NO_LISTS)
    points, ids = dict[str, Array](), dict[str, NDArray[np.int64]]()
    for name in sorted({name for pair in pairs for name in pair}):
        path = truth.before[name]
        T_gt_map = path if isinstance(path, Absent) else trajectory_errors.alignment([path])
        if isinstance(T_gt_map, Absent):
            return dict.fromkeys(names, T_gt_map)
        own = run.robots[name].own_map.gaussians
        points[name] = surface.nearest(se3.transform(T_gt_map, own.means.astype(np.float64)))
        ids[name] = own.ids
    radius_m = run.config.exchange.matching.radius_m
    found = right = possible = 0
    for (lower, higher), matched in sorted(pairs.items()):
        at = [rows_by_id(matched[:, k], ids[name]) for k, name in enumerate((lower, higher))]
        apart = points[lower][at[0]] - points[higher][at[1]]
        found += len(matched)
        right += int(np.count_nonzero(np.sum(apart**2, axis=1) <= radius_m**2))
        possible += _have_one_near(points[lower], points[higher], radius_m)
    values = [right / whole if whole else NO_MATCHES for whole in (found, possible)]
    return dict(zip(names, values, strict=True))


def _have_one_near(points: Array, others: Array, radius_m: float) -> int:
    """How many points [n, 3] have one of the others [m, 3] within a radius."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(others).query(points, k=1)
    return int(np.count_nonzero(distance <= radius_m))
