"""Accuracy of a run of the front end, against ground truth and held-out views."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.evaluation import groundtruth, map_agreement, trajectory_errors, views
from duagc.pipeline.evaluation.rendering import PosedMap, RenderTask
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RobotRun


def trajectory_errors_of(
    source: Recording, robot: str, estimated: Trajectory, log_stamps_ns: NDArray[np.int64]
) -> dict[str, Any]:
    """ATE after an SE(3) alignment of its own and relative errors frame to frame, where there is ground truth.

    Args:
        source: the recording.
        robot: whose path it is.
        estimated: the path; lost frames are not in it.
        log_stamps_ns: of all frames of the log, int64 [n].
    """
    true = groundtruth.trajectory(source, robot)
    if isinstance(true, Absent):
        return dict.fromkeys(("ate_rmse_m", "rpe_trans_m", "rpe_rot_rad"), true)
    pairs = trajectory_errors.pair(true, estimated)
    relative = trajectory_errors.rpe(pairs, log_stamps_ns)
    trans_m, rot_rad = (relative, relative) if isinstance(relative, Absent) else relative
    return {
        "ate_rmse_m": trajectory_errors.ate_rmse_m(pairs),
        "rpe_trans_m": trans_m,
        "rpe_rot_rad": rot_rad,
    }


def agreement_of(source: Recording, robot: RobotRun, estimated: Trajectory) -> dict[str, Any]:
    """How well held-out views agree, under the estimate and under the ground truth.

    Args:
        source: the recording.
        robot: that was tracked.
        estimated: T_map_camera of its frames.
    """
    true = groundtruth.trajectory(source, robot.robot)
    pairs: Paired | Absent = true if isinstance(true, Absent) else trajectory_errors.pair(true, estimated)
    if not isinstance(pairs, Absent):
        pairs = replace(pairs, positions_only=not groundtruth.knows_rotations(source, robot.robot))
    held_out = {f.frame_index: f.stamp_ns for f in robot.frames if f.held_out and f.status != "lost"}
    path = dict(zip(estimated.stamps_ns.tolist(), estimated.poses, strict=True))
    return map_agreement.section(
        source.log(robot.robot), held_out, {"": path}, pairs, frontend=robot.folder / "frontend.mcap"
    )


def map_errors_of(source: Recording, robot: RobotRun, estimated: Trajectory, threads: int) -> dict[str, Any]:
    """Scores of the map over the held-out views, after and before its final refinement.

    Args:
        source: the recording.
        robot: that was mapped.
        estimated: T_map_camera of its frames.
        threads: views rendered at the same time; changes no bit of the result.
    """
    maps = {"refined": robot.own_map, "unrefined": robot.unrefined_map}
    row: dict[str, Any] = {"gaussians": len(robot.own_map.gaussians)}
    for name, found in maps.items():
        if found is None:
            row[name] = Absent("the front end wrote no map before its refinement")
            continue
        task = RenderTask({name: PosedMap(found.gaussians, estimated)}, robot, "held_out", found.depth)
        scores = views.summary(
            [s[name] for _, s in task.scores(source, threads, None)], "no view is held out"
        )
        kept = ("views", "psnr_db", "ssim", "depth_l1_m", "depth_l1_exact_m", "depth_l1_layer_m")
        row[name] = {key: scores[key] for key in (*kept, "depth_completeness")}
    return row
