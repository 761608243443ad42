"""Faults made on purpose, at given rates, to see what they do: false loop closures and matches, missing poses, lies.

Every draw comes from a stream named after its place, so that a fault is the same in a replay, and two runs that
differ elsewhere have the same faults.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.exchange import InjectionConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.splat.information import MEAN, MEAN_INFORMATION

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
    """Pairs [n, 2] of which `config.false_matches` have exchanged partners.

    Args:
        pairs: int64 [n, 2], ids of matched Gaussians.
        config: how many are to be false.
        seed: of this run.
        robot: own name.
        peer: name of the other robot.
    """
    rng = random_streams.generator(seed, "injection.matches", robot=robot, peer=peer)
    chosen = np.flatnonzero(rng.random(len(pairs)) < config.false_matches)
    out = pairs.copy()
    out[chosen, 1] = pairs[np.roll(chosen, 1), 1]
    return out


def poses_are_missing(config: InjectionConfig, *, seed: int, robot: str, peer: str, round_index: int) -> bool:
    """Whether a robot sends no poses to a neighbor in this round.

    Args:
        config: how often poses are left out.
        seed: of this run.
        robot: own name.
        peer: name of the neighbor.
        round_index: the current round.
    """
    if config.pose_dropouts == 0.0:
        return False
    rng = random_streams.generator(seed, "injection.poses", robot=robot, peer=peer, round=round_index)
    return bool(rng.random() < config.pose_dropouts)


def check_liar(config: InjectionConfig, team: Sequence[str]) -> None:
    """Refuse a liar that is not in the team.

    Args:
        config: may name one.
        team: names of all robots, or of their submaps.

    Raises:
        DuagError: there is no such robot.
    """
    names = sorted({robot_of(name) for name in team})
    if config.liar and config.liar not in names:
        raise DuagError(f"exchange.injection.liar: robot {config.liar!r}, expected one of {', '.join(names)}")


def sent_positions(
    positions: NDArray[Any],
    keyframes: NDArray[np.integer],
    config: InjectionConfig,
    *,
    seed: int,
    robot: str,
) -> NDArray[Any]:
    """Positions of keyframes as a robot sends them: those of a liar are off, by the same in every round.

    Args:
        positions: [n, 3], meters, as they are.
        keyframes: [n], their indices.
        config: who lies, and by how much.
        seed: of this run.
        robot: own name.
    """
    if robot_of(robot) != config.liar or config.false_poses_m == 0.0:
        return positions
    drawn = [
        random_streams.generator(seed, "injection.position", robot=robot, keyframe=k).normal(size=3)
        for k in keyframes.tolist()
    ]
    off_m = config.false_poses_m * _directions(np.reshape(drawn, (-1, 3)))
    return np.asarray((positions + off_m).astype(positions.dtype))


def sent_evidence(
    records: NDArray[Any], config: InjectionConfig, *, seed: int, robot: str
) -> NDArray[Any] | None:
    """Records [n] of evidence as a liar sends them; None if this robot sends them as they are.

    Args:
        records: as they are.
        config: who lies, and by how much.
        seed: of this run.
        robot: own name.
    """
    if robot_of(robot) != config.liar or config.false_gaussians == 0.0:
        return None
    rng = random_streams.generator(seed, "injection.evidence", robot=robot)
    chosen = np.flatnonzero(rng.random(len(records)) < config.false_gaussians)
    out = records.copy()
    out["theta"][chosen, MEAN] += config.false_gaussian_m * _directions(rng.normal(size=(len(chosen), 3)))
    out["information"][chosen, MEAN_INFORMATION] *= config.false_certainty**2
    return out


def _directions(drawn: Array) -> Array:
    """Rows [n, 3] of length one."""
    return np.asarray(drawn / np.sqrt(np.sum(drawn**2, axis=1, keepdims=True)))
