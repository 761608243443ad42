"""Where the robots went, all in one frame: what report and viewer draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation import groundtruth, trajectory_errors
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder


@dataclass(frozen=True)
class Path3:
    """The ways of one robot in the frame of the component's world.

    Attributes:
        component: the robots of that world.
        before: T_world_camera from the robot's own front end alone, its first camera put where consensus puts
            it.
        after: T_world_camera after consensus.
        true: ground truth moved into the world by the alignment of the evaluation, or why there is none.
    """

    robot: str
    component: tuple[str, ...]
    before: Trajectory
    after: Trajectory
    true: Trajectory | Absent


def paths(run: RunFolder, recording: Recording) -> list[Path3]:
    """The ways of all robots, in order of their names.

    The ground truth of a component is aligned jointly if it has two robots or more, otherwise robot by robot.

    Args:
        run: whose trajectories are drawn.
        recording: of the run, for its ground truth.

    Raises:
        DuagError: a file of ground truth is damaged.
    """
    truth = {robot: groundtruth.trajectory(recording, robot) for robot in run.robots}
    pairs_of = {
        robot: trajectory_errors.pair(true, run.robots[robot].trajectory)
        for robot, true in truth.items()
        if not isinstance(true, Absent)
    }
    out = []
    for name, robot in run.robots.items():
        members = [
            pairs_of[r] for r in run.robots if r in pairs_of and run.robots[r].component == robot.component
        ]
        T_gt_world = trajectory_errors.alignment(members)
        true = truth[name]
        if not isinstance(true, Absent):
            true = (
                T_gt_world
                if isinstance(T_gt_world, Absent)
                else Trajectory(true.stamps_ns, se3.inverse(T_gt_world) @ true.poses)
            )
        out.append(
            Path3(
                name, robot.component, _put_at_start(robot.odometry, robot.trajectory), robot.trajectory, true
            )
        )
    return out


def _put_at_start(before: Trajectory, after: Trajectory) -> Trajectory:
    """`before` moved as a whole so that its first pose is the first pose of `after`."""
    T_world_map = after.poses[0] @ se3.inverse(before.poses[0])
    return Trajectory(before.stamps_ns, T_world_map @ before.poses)


def top_view_axes(poses: Array) -> Array:
    """Two unit vectors [2, 3] that span the plane seen from above: across the mean vertical of the cameras.

    Right is the direction in which the positions spread most; the other completes it, seen from above.

    Args:
        poses: T_world_camera [n, 4, 4], y of the camera pointing down.
    """
    up = -poses[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-9 else np.array([0.0, 0.0, 1.0])
    positions = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    flat = positions - np.outer(positions @ up, up)
    right = np.linalg.svd(flat, full_matrices=False)[2][0] if len(flat) else np.zeros(3)
    right = right - (right @ up) * up
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right = right / np.linalg.norm(right)
    right = right * np.sign(right[int(np.argmax(np.abs(right)))])
    return np.stack([right, np.cross(up, right)])
