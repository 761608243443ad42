"""How far the robots' poses are from the centralised answer: the same objective, solved in one place.

The objective is rebuilt from what the run recorded: registrations between own keyframes from every frontend.mcap,
closures with their information and final robust weights from consensus.mcap, noise floors from config.toml. Only who
computes differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pipeline.consensus.central import solve_central, team_graph
from pipeline.consensus.closures import Closure
from pipeline.consensus.config import PoseConsensusConfig
from pipeline.consensus.factors import Factors
from pipeline.consensus.poses import with_floor
from pipeline.errors import DuagError
from pipeline.evaluation.results import Absent
from pipeline.geometry import se3
from pipeline.messages import unpack_pose
from pipeline.recording import read_log
from pipeline.robot import Step, factors_of, registrations_of
from pipeline.run_folder import RobotRun, RunFolder
from schemas import topics

Array = NDArray[np.float64]
NOBODY = Absent("no two robots share a world")
NO_INFORMATION = Absent("consensus.mcap does not hold the information of the closures")


@dataclass(frozen=True)
class Gap:
    """Largest difference of a keyframe pose from the centralised answer: metres, radians."""

    metres: float
    radians: float


@dataclass(frozen=True)
class WeightedClosure:
    """A closure that took part in the pose consensus: between whom, and its final robust weight."""

    robot: str
    peer: str
    closure: Closure
    weight: float


def gap_to_oracle(run: RunFolder, decisions: Sequence[Any]) -> Gap | Absent:
    """Largest gap over all components of two robots or more.

    Args:
        decisions: every duagc.v1.ClosureDecision of the run.
    Raises:
        DuagError: the settings of the run are not what they should be.
    """
    config = _config(run)
    claims = {robot.component for robot in run.robots.values() if len(robot.component) > 1}
    gaps = []
    for members in sorted(claims):
        if any(run.robots[name].component != members for name in members):
            return Absent(f"{', '.join(members)} do not agree on who shares their world")
        closures = _closures(members, decisions)
        if isinstance(closures, Absent):
            return closures
        poses = {name: run.robots[name].corrected.T_world_keyframe for name in members}
        odometry = {
            name: with_floor(factors_of(_registrations(run.robots[name])), config) for name in members
        }
        gaps.append(gap_of_component(poses, odometry, closures, config))
    found = [gap for gap in gaps if isinstance(gap, Gap)]
    if len(found) < len(gaps):
        return next(gap for gap in gaps if isinstance(gap, Absent))
    if not found:
        return NOBODY
    return Gap(max(gap.metres for gap in found), max(gap.radians for gap in found))


def gap_of_component(
    T_world_keyframe: Mapping[str, Array],
    odometry: Mapping[str, Factors],
    closures: Sequence[WeightedClosure],
    config: PoseConsensusConfig,
) -> Gap | Absent:
    """The gap of one component.

    The central solver starts from the robots' own answer and goes downhill from there, so that the gap is that to the
    minimum whose basin the robots are in. Its answer is moved so that the first keyframe of the lowest-named robot is
    where that robot has it, which is how the robots fix the gauge.

    Args:
        T_world_keyframe: [n, 4, 4] of every member, by its own estimate. odometry: with the floor of `config`.
        closures: between members, with final weights. config: of the run.
    """
    team = team_graph(
        T_world_keyframe, odometry, [(c.robot, c.peer, [c.closure]) for c in closures], config.closures
    )
    own_factors = sum(len(factors) for factors in odometry.values())
    weights = np.concatenate([np.ones(own_factors), [c.weight for c in closures]])
    solution = solve_central(team.factors, team.T_start, weights)
    if not solution.converged:
        return Absent(f"the centralised solver did not converge in {solution.iterations} steps")
    root = team.first[min(T_world_keyframe)]
    gauge = team.T_start[root] @ se3.inverse(solution.poses[root])
    metres, radians = se3.distance(gauge @ solution.poses, team.T_start)
    return Gap(float(np.max(metres)), float(np.max(radians)))


def _registrations(robot: RobotRun) -> list[Step]:
    """A robot's own registrations, as its agent reads them."""
    path = robot.folder / "frontend.mcap"
    factors = [record.message() for record in read_log(path, [topics.KEYFRAME_FACTOR.of(robot.robot)])]
    return registrations_of(path, robot.keyframes, factors)


def _closures(members: Sequence[str], decisions: Sequence[Any]) -> list[WeightedClosure] | Absent:
    """The closures between members that took part, in order of the log."""
    out = []
    for d in decisions:
        if d.weight < 0 or d.robot not in members or d.peer not in members:
            continue
        if len(d.information) != 36:
            return NO_INFORMATION
        information = np.array(d.information, dtype=np.float64).reshape(6, 6)
        closure = Closure(d.own_keyframe, d.peer_keyframe, unpack_pose(d.pose_own_peer), information)
        out.append(WeightedClosure(d.robot, d.peer, closure, d.weight))
    return out


def _config(run: RunFolder) -> PoseConsensusConfig:
    section = run.config.get("exchange", {}).get("consensus", {})
    try:
        return PoseConsensusConfig.model_validate(section)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        path = run.path / "config.toml"
        raise DuagError(f"{path}: exchange.consensus.{name}: {first['msg']}") from error
