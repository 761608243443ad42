"""How far the robots are from the centralized answer: the same objective, solved in one place.

The objective is rebuilt from what the run recorded: registrations between own keyframes from every frontend.mcap,
closures with their information and final robust weights from consensus.mcap, noise floors from config.toml; for the
Gaussians the robots' maps and information as they are, not as they were rounded for the wire, and the matches of the
session that the robot used. Only who computes differs: a match that a robot's own images or map contradict
(`fusion.peer_validation`) is part of no objective of that robot, and how many these are is a figure of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.consensus.matching import without
from duagc.pipeline.consensus.weighting import in_world, self_information, shared_evidence
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import OwnMap, fuse
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.messages import GaussianInformation, unpack_pose
from duagc.pipeline.posegraph.pose_graph import PoseGraph, solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import HeldLoopClosures, LoopClosure, RelativePose, RelativePoses
from duagc.pipeline.recording import read_log
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.robot_data import registrations_of
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import theta_of
from duagc.schemas import topics

NO_TEAM = Absent("no two robots share a world")
NO_MATCHES = Absent("no Gaussians were matched")
NO_INFORMATION = Absent("consensus.mcap does not hold the information of the closures")
NO_WEIGHTS = Absent("contact ended before all loop closures that were kept had a weight")
NO_LISTS = Absent("contact ended before the lists of matches were sent")


@dataclass(frozen=True)
class Gap:
    """Largest difference of a keyframe pose from the centralized answer: meters, radians.

    sigma, sigma_p99: of the coordinates of matched Gaussians in their standard deviations, the largest and the 99th
    percentile of each Gaussian's largest; absent where nothing was matched, or robots matched without a list. The
    largest shows fusion's own decisions: where members contradict each other, rounding on the wire may tip them.
    """

    meters: float
    radians: float
    sigma: float | Absent
    sigma_p99: float | Absent


def never_weighted(decision: Any) -> bool:
    """Whether a loop closure was kept, but contact ended before the poses gave it a weight.

    Args:
        decision: a duagc.v1.LoopClosureDecision.
    """
    return bool(decision.verdict == "kept" and decision.weight < 0)


def gap_to_oracle(
    run: RunFolder, decisions: Sequence[Any], pairs: Mapping[tuple[str, str], NDArray[np.int64]]
) -> Gap | Absent:
    """Largest gap over all components of two robots or more.

    Args:
        run: with the robots' results and settings.
        decisions: every duagc.v1.LoopClosureDecision of the run.
        pairs: ids of matched Gaussians [n, 2], by robots.
    Raises:
        DuagError: the settings of the run are not what they should be.
    """
    config = run.config.exchange.consensus
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
            name: with_floor(RelativePoses.of(_registrations(run.robots[name])), config) for name in members
        }
        central = solve_component(poses, odometry, closures, config)
        gaps.append(
            central if isinstance(central, Absent) else _gap(run, members, poses, central, pairs=pairs)
        )
    found = [gap for gap in gaps if isinstance(gap, Gap)]
    if len(found) < len(gaps):
        return next(gap for gap in gaps if isinstance(gap, Absent))
    if not found:
        return NO_TEAM
    return Gap(
        max(gap.meters for gap in found),
        max(gap.radians for gap in found),
        _largest([gap.sigma for gap in found]),
        _largest([gap.sigma_p99 for gap in found]),
    )


def _largest(values: Sequence[float | Absent]) -> float | Absent:
    if NO_LISTS in values:
        return NO_LISTS
    return max((v for v in values if not isinstance(v, Absent)), default=NO_MATCHES)


def _gap(
    run: RunFolder,
    members: Sequence[str],
    poses: Mapping[str, Array],
    central: Mapping[str, Array],
    *,
    pairs: Mapping[tuple[str, str], NDArray[np.int64]],
) -> Gap:
    """The gap of one component whose centralized poses are known."""
    meters, radians = pose_gap(poses, central)
    if unlisted([members], pairs):
        return Gap(meters, radians, NO_LISTS, NO_LISTS)
    weights = run.config.exchange.weights
    evidence = {
        name: in_world(shared_evidence(*_map_of(run.robots[name]), kind=weights), central[name], weights)
        for name in members
    }
    gaps = np.concatenate(
        [
            _gaussian_gaps(
                run, name, central[name], evidence=evidence, pairs=used_matches(run.robots[name], pairs)
            )
            for name in members
        ]
    )
    if not len(gaps):
        return Gap(meters, radians, NO_MATCHES, NO_MATCHES)
    return Gap(meters, radians, float(gaps.max()), float(np.percentile(gaps, 99)))


Pairs = Mapping[tuple[str, str], NDArray[np.int64]]


def unlisted(components: Iterable[Sequence[str]], pairs: Pairs) -> set[tuple[str, str]]:
    """Pairs of robots that share a world without a list of their matches: contact ended before one was sent.

    Such robots match what they have by themselves, and no message says what.

    Args:
        components: of robots, names in order.
        pairs: ids of matched Gaussians [n, 2] by robots.
    """
    return {pair for members in components for pair in combinations(members, 2)} - set(pairs)


def matches_among(members: Sequence[str], pairs: Pairs) -> Pairs:
    """The matches of the session that concern a component.

    Args:
        members: of the component.
        pairs: ids of matched Gaussians [n, 2] by robots.
    """
    return {key: ids for key, ids in pairs.items() if key[0] in members and key[1] in members}


def used_matches(robot: RobotRun, pairs: Pairs) -> Pairs:
    """The matches of the session that a robot's map is fused from: all in its component but those that it rejected.

    Matches that did not reach the robot are among them: that is a loss of the exchange, which the gap shows.

    Args:
        robot: that fuses.
        pairs: ids of matched Gaussians [n, 2] by robots.
    """
    rejected, none = robot.rejected_matches, np.zeros((0, 2), np.int64)
    among = matches_among(robot.component, pairs)
    return {key: without(ids, rejected.get(key, none)) for key, ids in among.items()}


def pose_gap(poses: Mapping[str, Array], central: Mapping[str, Array]) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) between two sets of keyframes [n, 4, 4] by robot.

    Args:
        poses: T_world_keyframe [n, 4, 4] of the robots' own answer.
        central: the same of the centralized answer; it has every robot of `poses`.
    """
    apart = [se3.distance(central[name], poses[name]) for name in poses]
    return max(float(np.max(m)) for m, _ in apart), max(float(np.max(r)) for _, r in apart)


def _gaussian_gaps(
    run: RunFolder,
    robot: str,
    T_world_keyframe: Array,
    *,
    evidence: Mapping[str, Evidence],
    pairs: Mapping[tuple[str, str], NDArray[np.int64]],
) -> Array:
    """Largest |x - x*| sqrt(diagonal of the information at x*) of each of a robot's matched Gaussians [m]."""
    weights = run.config.exchange.weights
    _, own, _, T_map_keyframe = mine = _map_of(run.robots[robot])
    context = MapContext(
        PinholeCamera(2, 2, 1.0, 1.0, 0.5, 0.5),  # looks at nothing: what is imported is not compared
        run.config.fusion.model_copy(update={"coverage": "overlap"}),
        run.config.matching,
        weights=weights,
    )
    best = fuse(
        OwnMap(robot, own, T_map_keyframe, T_world_keyframe),
        evidence,
        pairs,
        context,
        self_information=in_world(self_information(*mine, kind=weights), T_world_keyframe, weights),
    )
    matched = best.members[: len(own)] > 1
    theta = theta_of(run.robots[robot].fused_map.gaussians.select(slice(0, len(own))))
    information = Evidence("", own.ids, own.anchors, theta, best.information[: len(own)])
    # where no robot knows a coordinate, rounding may leave a little less than nothing
    roots = np.sqrt(np.maximum(Weights.of(information).diagonal(), 0.0))
    gaps = np.abs(theta - theta_of(best.gaussians)[: len(own)]) * roots
    return np.asarray(gaps[matched].max(axis=1, initial=0.0))


def _map_of(robot: RobotRun) -> tuple[str, Gaussians, GaussianInformation, Array]:
    """Name, own map, its information, and keyframes in it [k, 4, 4]."""
    T_map_keyframe = np.array([k.T_map_camera for k in robot.keyframes])
    return robot.robot, robot.own_map.gaussians, robot.information, T_map_keyframe


def solve_component(
    T_world_keyframe: Mapping[str, Array],
    odometry: Mapping[str, RelativePoses],
    closures: Sequence[HeldLoopClosures],
    config: PoseConsensusConfig,
) -> dict[str, Array] | Absent:
    """Keyframe poses [n, 4, 4] of every robot by the centralized answer.

    The central solver starts from the robots' own answer and goes downhill from there, so that the gap is that to the
    minimum whose basin the robots are in. Its answer is moved so that the first keyframe of the lowest-named robot is
    where that robot has it, which is how the robots fix the gauge.

    Args:
        T_world_keyframe: [n, 4, 4] of every member, by its own estimate.
        odometry: of every member, with the floor of `config`.
        closures: between members, with final weights.
        config: of the run.
    """
    team = PoseGraph.of_team(T_world_keyframe, odometry, closures, config.closures)
    solution = solve_pose_graph(team.relative_poses, team.T_start, team.weights)
    if not solution.converged:
        return Absent(f"the centralized solver did not converge in {solution.iterations} steps")
    root = team.first[min(T_world_keyframe)]
    gauge = team.T_start[root] @ se3.inverse(solution.poses[root])
    return {
        name: gauge @ solution.poses[first : first + len(T_world_keyframe[name])]
        for name, first in team.first.items()
    }


def _registrations(robot: RobotRun) -> list[RelativePose]:
    """A robot's own registrations, as its agent reads them."""
    path = robot.folder / "frontend.mcap"
    factors = [record.message() for record in read_log(path, [topics.KEYFRAME_FACTOR.of(robot.robot)])]
    return registrations_of(path, robot.keyframes, factors)


def _closures(members: Sequence[str], decisions: Sequence[Any]) -> list[HeldLoopClosures] | Absent:
    """The closures between members that took part, in order of the log."""
    out = []
    for d in decisions:
        if d.robot not in members or d.peer not in members:
            continue
        if never_weighted(d):
            return NO_WEIGHTS
        if d.weight < 0:
            continue
        if len(d.information) != 36:
            return NO_INFORMATION
        information = np.array(d.information, dtype=np.float64).reshape(6, 6)
        closure = LoopClosure(d.own_keyframe, d.peer_keyframe, unpack_pose(d.pose_own_peer), information)
        out.append(HeldLoopClosures(d.robot, d.peer, (closure,), (d.weight,)))
    return out
