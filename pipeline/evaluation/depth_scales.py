"""How many times as far one robot's camera measures what another's measured, by features that both have seen.

Loop closures fit rigid motions. A camera whose depth is a few percent too long joins all the same, and the paths of the
team are wrong by these percents. In keyframes that see the same things, the features that agree on one motion spread in
the ratio of both scales.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from duagc.pipeline.base.component_names import same_robot
from duagc.pipeline.evaluation.feature_agreement import FEATURES, MatchedPair, match_views
from duagc.pipeline.evaluation.network import is_inlier
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends, mad_sigma
from duagc.pipeline.recording import Recording, RgbdLog, open_rgbd
from duagc.pipeline.registration.features import Features, extract
from duagc.pipeline.runs.folder import RobotRun, RunFolder

MOST_CLOSURES = 16
"""Loop closures of two robots that are looked at, evenly spread over those that count."""
FEWEST_CLOSURES = 4
FLOOR = 0.003
"""Smallest stated deviation of a ratio: teams of unlike cameras with equal scales measured 0.9975 to 1.0032."""


MEDIAN_TO_MEAN = math.sqrt(math.pi / 2)
"""Standard deviation of the median over that of the mean, of many numbers of a normal distribution."""


@dataclass(frozen=True)
class DepthScale:
    """The scale of a robot's depth relative to that of the first robot of its component.

    Attributes:
        ratio: this robot's distances over the first's, of the same things.
        sigma: its standard deviation.
        closures: loop closures that it is the median of.
    """

    ratio: float
    sigma: float
    closures: int


def depth_scales(run: RunFolder, source: Recording, decisions: Iterable[Any]) -> dict[str, DepthScale]:
    """Scales of all robots with enough loop closures with the first of their component, by name.

    Args:
        run: the run.
        source: its recording.
        decisions: every duagc.v1.LoopClosureDecision.
    """
    keyframes: dict[str, set[tuple[int, int]]] = defaultdict(set)
    for d in decisions:
        (first, theirs), (robot, own) = sorted([(d.robot, d.own_keyframe), (d.peer, d.peer_keyframe)])
        if is_inlier(d) and not same_robot(first, robot) and run.robots[robot].component[0] == first:
            keyframes[robot].add((theirs, own))
    found = {}
    with ExitStack() as opened:

        @cache
        def log_of(robot: str) -> RgbdLog:
            log = opened.enter_context(open_rgbd(source.log(robot)))
            log.move_depth_by(run.robots[robot].folder / "frontend.mcap")
            return log

        @cache
        def features(robot: str, keyframe: int) -> Features:
            log = log_of(robot)
            frame = log.frame(run.robots[robot].keyframes[keyframe].frame_index)
            return extract(frame.color, frame.usable_depth, log.camera, FEATURES, mask=frame.mask)

        for robot, all_ends in sorted(keyframes.items()):
            first = run.robots[robot].component[0]
            in_order = sorted(all_ends)
            ends = [in_order[k] for k in evenly_spaced_to_ends(len(in_order), MOST_CLOSURES)]
            pairs = [match_views(features(first, a), features(robot, b), a, b) for a, b in ends]
            ratios = [_log_ratio(pair) for pair in pairs if pair is not None]
            if len(ratios) >= FEWEST_CLOSURES:
                found[robot] = _median(ratios)
    return found


def section(robot: RobotRun, scales: Mapping[str, DepthScale]) -> dict[str, float | Absent]:
    """What metrics.json says of one robot.

    Args:
        robot: of the run.
        scales: of all robots, by name.
    """
    names = ("depth_ratio", "sigma_depth_ratio", "depth_ratio_closures")
    if (scale := scales.get(robot.robot)) is not None:
        return dict(zip(names, (scale.ratio, scale.sigma, scale.closures), strict=True))
    if len(robot.component) < 2:
        reason = "this robot met no other robot"
    elif robot.component[0] == robot.robot:
        reason = "the others' cameras are compared with this one"
    else:
        reason = "too few loop closures with the first robot have features in common"
    return dict.fromkeys(names, Absent(reason))


def _log_ratio(pair: MatchedPair) -> float:
    """Logarithm of the spread of the second view's points over that of the first's."""
    spread_a, spread_b = (
        float(np.sum((points - points.mean(axis=0)) ** 2)) for points in (pair.points_a, pair.points_b)
    )
    return 0.5 * float(np.log(spread_b / spread_a))


def _median(log_ratios: list[float]) -> DepthScale:
    values = np.array(log_ratios)
    median = float(np.median(values))
    sigma = MEDIAN_TO_MEAN * mad_sigma(values - median) / np.sqrt(len(values))
    ratio = float(np.exp(median))
    return DepthScale(ratio, ratio * max(FLOOR, float(sigma)), len(values))
