"""What a team's error could be: its poses next to those that all images together ask for, and next to the truth.

All keyframes of all robots are optimized in one place by the images themselves, as a front end does with its own, from
the run's poses and from the true ones; other frames keep their place relative to their keyframe.
A reference trajectory has
errors of its own, and own alignments hide what a common one shows: where every answer of the images, even begun at the
truth, ends with the same error under one alignment, the exchange does not make it. Ground truth is read here alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.evaluation import depth_agreement, groundtruth, trajectory_errors
from duagc.pipeline.evaluation.network import Session, is_inlier
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired
from duagc.pipeline.frontend import bundle
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import Recording, RgbdLog, open_rgbd
from duagc.pipeline.registration import Level, Reference, RgbdPyramid
from duagc.pipeline.registration.features import Features
from duagc.pipeline.runs.folder import RobotRun, RunFolder

Poses = dict[str, Array]  # T_world_camera [n, 4, 4] of a robot's frames that have a true pose
VIEWS = 20  # held-out ones of a robot whose depth images are compared
CUTS = (2, 3, 4)
NOTHING = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))


@dataclass(frozen=True)
class ReferenceView:
    """A keyframe as `bundle.optimize` wants it; no features, because it looks for no loops."""

    reference: Reference
    coarsest: Level
    features: Features = NOTHING


@dataclass(frozen=True)
class Robot:
    """One robot's frames that have a true pose. keyframe: [n], the row of the one that each is anchored to."""

    run: RobotRun
    log: RgbdLog
    pairs: Paired
    frame_index: NDArray[np.int64]
    keyframe: NDArray[np.int64]
    held_out: NDArray[np.bool_]

    @property
    def keyframes(self) -> list[int]:
        """Rows of the keyframes, in their order."""
        return sorted(set(self.keyframe.tolist()))


def run(run_folder: RunFolder, recording: Recording, config: FrontendConfig) -> dict[str, Any]:
    """Errors of the team's poses, of what its images say from two starts, and what the truth's own poses are worth.

    Args:
        run_folder: of a run whose robots share one world.
        recording: that the run was made of, with ground truth.
        config: of the run's front ends.
    Returns:
        "rows", one per trajectory: team_ate_rmse_m under one alignment, own_ate_rmse_m, the mean of those under an own
        alignment of each robot, cut_ate_rmse_m, the same of one robot's path cut in 2, 3, 4, and agreement_m of depth
        images, within robots and across them. "closures": of the run that tie the robots' keyframes from the start.
        "views": pairs of held-out views, within and across.
    Raises:
        DuagError: a robot has no ground truth, or the robots do not share one world.
    """
    members = run_folder.largest_component
    if len(members) < len(run_folder.robots):
        raise DuagError(
            f"{run_folder.path}: found a world of {', '.join(members)} alone, expected one of all its robots"
        )
    robots = [_robot(run_folder.robots[name], recording) for name in members]
    try:
        if any(robot.log.camera != robots[0].log.camera for robot in robots):
            raise DuagError(f"{recording.path}: the robots' cameras differ, expected one kind")
        answers: dict[str, Poses] = {"the run": {r.run.robot: r.pairs.estimated for r in robots}}
        truth = {r.run.robot: r.pairs.true for r in robots}
        team = _Team(run_folder, robots, config)
        answers["images, from the run"] = team.optimized(answers["the run"], "joint")
        answers["images, from the truth"] = team.optimized(truth, "joint")
        answers["depth alone, from the run"] = team.optimized(answers["the run"], "depth")
        answers["depth alone, from the truth"] = team.optimized(truth, "depth")
        pairs, agreement = _agreement(robots, answers | {"the truth": truth})
    finally:
        for robot in robots:
            robot.log.close()
    rows = [{"poses": name, **_errors(robots, poses)} for name, poses in answers.items()]
    cuts = dict.fromkeys(rows[0]["cut_ate_rmse_m"], 0.0)
    rows.append({"poses": "the truth", "team_ate_rmse_m": 0.0, "own_ate_rmse_m": 0.0, "cut_ate_rmse_m": cuts})
    rows = [row | {"agreement_m": agreement[row["poses"]]} for row in rows]
    return {"closures": team.closures, "views": pairs, "rows": rows}


def _robot(robot: RobotRun, recording: Recording) -> Robot:
    """Frames that were tracked and hang on a keyframe, if both have a true pose."""
    true = groundtruth.trajectory(recording, robot.robot)
    if isinstance(true, Absent):
        raise DuagError(f"{recording.path}: {robot.robot} has no ground truth, expected a trajectory")
    if not groundtruth.knows_rotations(recording, robot.robot):
        raise DuagError(
            f"{recording.path}: the ground truth of {robot.robot} has positions only, expected poses"
        )
    pairs = trajectory_errors.pair(true, robot.trajectory)
    frame_of = {f.stamp_ns: f for f in robot.frames if f.status != "lost"}
    row_of = {stamp: row for row, stamp in enumerate(pairs.stamps_ns.tolist())}
    stamp_of = {k.keyframe_index: k.stamp_ns for k in robot.keyframes}
    missing = [k for k, stamp in stamp_of.items() if stamp not in row_of]
    if missing:
        raise DuagError(f"{recording.path}: {robot.robot} has no true pose of keyframes {missing}")
    rows = [row for stamp, row in row_of.items() if stamp in frame_of]
    frames = [frame_of[int(pairs.stamps_ns[row])] for row in rows]
    new_row = {row: k for k, row in enumerate(rows)}
    log = open_rgbd(recording.log(robot.robot))
    log.move_depth_by(robot.folder / "frontend.mcap")
    return Robot(
        robot,
        log,
        Paired(pairs.stamps_ns[rows], pairs.true[rows], pairs.estimated[rows]),
        np.array([f.frame_index for f in frames]),
        np.array([new_row[row_of[stamp_of[f.keyframe_index]]] for f in frames]),
        np.array([f.held_out for f in frames]),
    )


class _Team:
    """All keyframes of all robots, one after the other."""

    def __init__(self, run_folder: RunFolder, robots: Sequence[Robot], config: FrontendConfig) -> None:
        self.robots, self.config = robots, config
        self.where = [(robot, row) for robot in robots for row in robot.keyframes]
        self.views = []
        for k in range(len(self.where)):
            pyramid = self.images(k, len(config.tracking.strides))
            reference = Reference.from_pyramid(pyramid, config.tracking.strides)
            self.views.append(ReferenceView(reference, pyramid.levels[-1]))
        first, count = {}, 0
        for robot in robots:
            first[robot.run.robot] = count
            count += len(robot.keyframes)
        self.ends = {
            (first[robot.run.robot] + k.previous_index, first[robot.run.robot] + k.keyframe_index)
            for robot in robots
            for k in robot.run.keyframes
            if k.previous_index >= 0
        }
        closures = [c for c in Session(run_folder).loop_closures if is_inlier(c)]
        for c in closures:
            a, b = first[c.robot] + c.own_keyframe, first[c.peer] + c.peer_keyframe
            self.ends.add((min(a, b), max(a, b)))
        self.closures = len(closures)

    def images(self, keyframe: int, levels: int) -> RgbdPyramid:
        robot, row = self.where[keyframe]
        frame = robot.log.frame(int(robot.frame_index[row]))
        return pyramid_of(frame, robot.log.camera, levels)

    def optimized(self, start: Poses, residuals: Literal["joint", "depth"]) -> Poses:
        """Where all images together put all robots, from a start."""
        T = np.array([start[robot.run.robot][row] for robot, row in self.where])
        T = se3.inverse(T[0]) @ T
        tracked = [RelativePose(a, b, se3.inverse(T[a]) @ T[b], np.eye(6)) for a, b in sorted(self.ends)]
        registration = self.config.tracking.registration.model_copy(update={"residuals": residuals})
        settings = self.config.keyframes
        found, _ = bundle.optimize(
            T, self.views, self.images, tracked, config=settings, registration=registration
        )
        out, placed = {}, iter(found.T_map_keyframe)
        for robot in self.robots:
            new = {row: next(placed) for row in robot.keyframes}
            T_keyframe = np.array([new[row] for row in robot.keyframe.tolist()])
            estimated = robot.pairs.estimated
            out[robot.run.robot] = T_keyframe @ se3.inverse(estimated[robot.keyframe]) @ estimated
        return out


def _errors(robots: Sequence[Robot], poses: Poses) -> dict[str, Any]:
    """Under one alignment, under an own one of each robot, and of one robot's path in parts."""
    paired = [Paired(r.pairs.stamps_ns, r.pairs.true, poses[r.run.robot]) for r in robots]
    T_gt_world = trajectory_errors.alignment(paired)
    if isinstance(T_gt_world, Absent):
        raise DuagError(f"the team cannot be aligned with its ground truth: {T_gt_world.reason}")
    squared = np.concatenate([trajectory_errors.squared_errors_m2(p, T_gt_world) for p in paired])
    cuts = CUTS if len(robots) == 1 else ()
    return {
        "team_ate_rmse_m": float(np.sqrt(squared.mean())),
        "own_ate_rmse_m": _mean_ate(paired),
        "cut_ate_rmse_m": {n: _mean_ate(_cut(paired[0], n)) for n in cuts},
    }


def _cut(pairs: Paired, parts: int) -> list[Paired]:
    rows = np.array_split(np.arange(len(pairs)), parts)
    return [Paired(pairs.stamps_ns[r], pairs.true[r], pairs.estimated[r]) for r in rows]


def _mean_ate(parts: Sequence[Paired]) -> float | None:
    """Mean of the errors of parts, each under its own alignment; None if one has none."""
    errors = [trajectory_errors.ate_rmse_m(part) for part in parts]
    found = [error for error in errors if not isinstance(error, Absent)]
    return float(np.mean(found)) if len(found) == len(errors) else None


def _agreement(
    robots: Sequence[Robot], answers: Mapping[str, Poses]
) -> tuple[dict[str, int], dict[str, dict[str, float | None]]]:
    """Depth agreement of pairs of held-out views, by trajectory, within robots and across; and how many pairs."""
    chosen = []
    for robot in robots:
        rows = np.flatnonzero(robot.held_out)
        few = rows[evenly_spaced_to_ends(len(rows), VIEWS)]
        chosen += [(robot, int(row)) for row in few]
    depths = [robot.log.usable_depth(int(robot.frame_index[row])) for robot, row in chosen]
    T = {name: np.array([p[r.run.robot][row] for r, row in chosen]) for name, p in answers.items()}
    medians = depth_agreement.pair_medians(depths, robots[0].log.camera, T)
    together = np.array([chosen[a][0] is chosen[b][0] for a, b in medians.pairs], dtype=bool)
    kinds = {"within": together, "across": ~together}
    values = {
        name: {kind: float(np.median(m[which])) if which.any() else None for kind, which in kinds.items()}
        for name, m in medians.of.items()
    }
    return {kind: int(which.sum()) for kind, which in kinds.items()}, values


def format_table(result: dict[str, Any]) -> str:
    """One line per trajectory, millimeters.

    Args:
        result: of `run`.
    """
    cuts = list(result["rows"][0]["cut_ate_rmse_m"])
    head = ["poses", "one alignment", "own alignments", *(f"cut in {n}" for n in cuts)]
    head += [f"depth images {kind} ({pairs} pairs)" for kind, pairs in result["views"].items() if pairs]
    rows = []
    for row in result["rows"]:
        numbers = [
            row["team_ate_rmse_m"],
            row["own_ate_rmse_m"],
            *(row["cut_ate_rmse_m"][n] for n in cuts),
        ]
        numbers += [row["agreement_m"][kind] for kind, pairs in result["views"].items() if pairs]
        rows.append([row["poses"], *(None if value is None else f"{1e3 * value:.2f}" for value in numbers)])
    return "\n".join(markdown(head, rows))
