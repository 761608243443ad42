"""Robust weights of a robot's loop closures in the pose ADMM: when they advance, and what its links then share."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import LoopClosureConfig, PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import AdmmEdge
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT, RobustWeights
from duagc.pipeline.posegraph.relative_poses import RelativePoses


def advance_held(link: AdmmEdge, T: Array, config: PoseConsensusConfig) -> bool:
    """A step of the weights of a link's loop closures, paced by what arrives on it; whether they changed.

    Args:
        link: the end that holds them.
        T: [n, 4, 4], the robot's variables.
        config: when a link is steady.
    """
    squared = partial(least_squares.squared_residuals, link.factors, T)
    return link.robust.advance(link.received_total, link.is_steady(config.penalty_period), squared)


def advance_loops(
    weights: RobustWeights,
    loops: RelativePoses,
    links: Sequence[AdmmEdge],
    T: Array,
    *,
    config: PoseConsensusConfig,
) -> bool:
    """A step of the weights of own loops, paced by the link on which least arrives; whether they changed.

    Args:
        weights: of the loops.
        loops: m factors between own keyframes.
        links: of the robot, at least one.
        T: [n, 4, 4], the robot's variables.
        config: when a link is steady.
    """
    squared = partial(least_squares.squared_residuals, loops, T)
    received = min(link.received_total for link in links)
    steady = all(link.is_steady(config.penalty_period) for link in links)
    return weights.advance(received, steady, squared)


def drop_idle(links: Sequence[AdmmEdge]) -> dict[str, tuple[int, NDArray[np.bool_]]]:
    """After its schedule, a link shares only the keyframes that loop closures with weight name.

    Args:
        links: of the robot; their masks change.

    Returns:
        Versions and masks that changed, by neighbor, to be sent.
    """
    masks: dict[str, tuple[int, NDArray[np.bool_]]] = {}
    for link in links:
        if link.holds and link.robust.scheduled:
            carrying = link.carrying()
            if not np.array_equal(carrying, link.active):
                link.activate(carrying, link.active_version + 1)
                masks[link.peer] = (link.active_version, carrying)
    return masks


def refuted(link: AdmmEdge, config: LoopClosureConfig) -> bool:
    """Whether the weights of the loop closures that a link holds are final, and too few of them inliers.

    Args:
        link: one end of it.
        config: how many join two robots.
    """
    kept = int(np.count_nonzero(link.robust.weights >= INLIER_WEIGHT))
    return link.holds and link.robust.done and kept < config.min_support
