"""Contradictions that come of a place which repeats itself: shelves of an aisle, rows of seats, columns.

Where the same things stand again and again, features of two views agree on the motion from one to the next of these
things, and it may spread as wide as the true one, or wider. But between the two views lie others. If features that fill
the views confirm the motion from each to the next, all of them together cannot be off by as much as such a motion.
What moves in the place never fills the views: of what follows that, each pair is narrow.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import JudgmentConfig
from duagc.pipeline.frontend.bundle import KeyframeView
from duagc.pipeline.frontend.followed_things import Ends, fills_views
from duagc.pipeline.geometry import se3


def of_repeated_places(
    contradictions: Mapping[Ends, Array],
    confirmed: Mapping[Ends, float],
    T_map_keyframes: Array,
    *,
    views: Sequence[KeyframeView],
    config: JudgmentConfig,
) -> set[Ends]:
    """Contradicted pairs whose other motion is farther off than the confirmed pairs between them allow.

    Args:
        contradictions: pairs that are contradicted, with the motion T_first_second [4, 4] that features agree on.
        confirmed: pairs that features confirm, with the angle by which these are off in the median, rad.
        T_map_keyframes: [k, 4, 4].
        views: of the k keyframes.
        config: which features agree with a motion, and the angle from which they contradict one.
    """
    if not contradictions:
        return set()

    def motion_between(first: int, second: int) -> Array:
        return se3.inverse(T_map_keyframes[first]) @ T_map_keyframes[second]

    ways: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for (i, j), rad in confirmed.items():
        between = any(first <= i and j <= last for first, last in contradictions)
        if between and fills_views(views[i], views[j], motion_between(i, j), config):
            ways[j].append((i, max(rad, config.max_angle_rad)))
    out = set()
    for (first, second), T_other in contradictions.items():
        moved_m, turned_rad = se3.distance(T_other, motion_between(first, second))
        apart_rad = moved_m / float(np.median(views[first].features.points[:, 2])) + turned_rad
        if apart_rad > _least_off_rad(first, second, ways):
            out.add((first, second))
    return out


def _least_off_rad(first: int, last: int, ways: Mapping[int, Sequence[tuple[int, float]]]) -> float:
    """Angle by which the surest way from one keyframe forward to a later one is off at most; infinite without one.

    Args:
        first: the one keyframe.
        last: the later one.
        ways: to each keyframe: from which earlier ones pairs lead, and the angle by which each is off at most, rad.
    """
    least_rad = {first: 0.0}
    for k in range(first + 1, last + 1):
        found = [least_rad[i] + rad for i, rad in ways.get(k, ()) if i in least_rad]
        if found:
            least_rad[k] = min(found)
    return least_rad.get(last, np.inf)
