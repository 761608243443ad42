"""Faults made on purpose, at given rates, to see what they do: false loop closures, false matches, missing poses.

Every draw comes from a stream named after its place, so that a fault is the same in a replay, and two runs that
differ elsewhere have the same faults.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.exchange import InjectionConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.relative_poses import LoopClosure

DETAIL = "injected: false on purpose"


def false_closures(
    closures: Sequence[LoopClosure],
    keyframes: int,
    peer_keyframes: int,
    config: InjectionConfig,
    *,
    seed: int,
    robot: str,
    peer: str,
) -> list[LoopClosure]:
    """Loop closures that are `config.false_closures` of all together with those that were found; as sure as they are.

    Args:
        closures: that were found.
        keyframes: number of own keyframes; a false loop closure joins any two.
        peer_keyframes: number of the peer's keyframes.
        config: how many there are to be.
        seed: of this run.
        robot: own name.
        peer: name of the other robot.
    """
    share = config.false_closures
    count = round(share / (1 - share) * len(closures))
    out = []
    for k in range(count):
        rng = random_streams.generator(seed, "injection.closure", robot=robot, peer=peer, number=k)
        model = closures[int(rng.integers(len(closures)))]
        R = so3.from_quat_wxyz(rng.normal(size=4))
        t = rng.uniform(-config.false_closure_m, config.false_closure_m, 3)
        T = se3.from_rotation_translation(R, t)
        ends = int(rng.integers(keyframes)), int(rng.integers(peer_keyframes))
        out.append(LoopClosure(*ends, T, model.information))
    return out


def false_matches(
    pairs: NDArray[np.int64], config: InjectionConfig, *, seed: int, robot: str, peer: str
) -> NDArray[np.int64]:
    """Pairs [n, 2] of which `config.false_matches` have exchanged partners."""
    rng = random_streams.generator(seed, "injection.matches", robot=robot, peer=peer)
    chosen = np.flatnonzero(rng.random(len(pairs)) < config.false_matches)
    out = pairs.copy()
    out[chosen, 1] = pairs[np.roll(chosen, 1), 1]
    return out


def poses_are_missing(config: InjectionConfig, *, seed: int, robot: str, peer: str, round_index: int) -> bool:
    """Whether a robot sends no poses to a neighbor in this round."""
    if config.pose_dropouts == 0.0:
        return False
    rng = random_streams.generator(seed, "injection.poses", robot=robot, peer=peer, round=round_index)
    return bool(rng.random() < config.pose_dropouts)
