"""Errors of trajectories, per robot and for the team (docs/reference/metrics.md, "Trajectories")."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory, align, associate, rpe_rmse

ASSOCIATION_TOLERANCE_NS = 20_000_000  # that of the TUM tools


NO_ROTATIONS = Absent("the ground truth has positions only")


@dataclass(frozen=True)
class Paired:
    """Poses of one camera that have a ground-truth pose of the same time.

    stamps_ns: int64 [n], of the estimate. true: T_gt_camera [n, 4, 4]. estimated: T_frame_camera [n, 4, 4].
    positions_only: the rotations of `true` mean nothing.
    """

    stamps_ns: NDArray[np.int64]
    true: Array
    estimated: Array
    positions_only: bool = False

    def __len__(self) -> int:
        return len(self.stamps_ns)


def pair(true: Trajectory, estimated: Trajectory) -> Paired:
    """Pair every estimated pose with the nearest ground-truth pose within 20 ms; poses without one are left out.

    Where truth is sparser than the frames, each of its poses goes to the frame that is nearest to it.

    Args:
        true: T_gt_camera, stamps in ns.
        estimated: T_frame_camera of the same camera.
    """
    i, j = associate(estimated, true, ASSOCIATION_TOLERANCE_NS)
    first, nearest = associate(true, estimated, ASSOCIATION_TOLERANCE_NS)
    taken = np.isin(j * len(estimated) + i, first * len(estimated) + nearest)
    return Paired(estimated.stamps_ns[i[taken]], true.poses[j[taken]], estimated.poses[i[taken]])


def alignment(pairs: list[Paired]) -> Array | Absent:
    """T_gt_frame [4, 4], the one SE(3) that brings all pairs onto the ground truth; Absent if not determined.

    Args:
        pairs: of one or more cameras, all estimated in one frame.
    """
    true = np.concatenate([p.true[:, :3, 3] for p in pairs]) if pairs else np.zeros((0, 3))
    estimated = np.concatenate([p.estimated[:, :3, 3] for p in pairs]) if pairs else np.zeros((0, 3))
    try:
        return align(true, estimated)
    except DuagError as error:
        return Absent(str(error))


def squared_errors_m2(pairs: Paired, T_gt_frame: Array) -> Array:
    """Squared distance of every aligned position from the true one, m^2 [n].

    Args:
        pairs: of one camera.
        T_gt_frame: [4, 4], the alignment.
    """
    difference = pairs.true[:, :3, 3] - se3.transform(T_gt_frame, pairs.estimated[:, :3, 3])
    return np.sum(difference**2, axis=1)


def ate_rmse_m(pairs: Paired) -> float | Absent:
    """Root mean squared position error after the robot's own SE(3) alignment, all paired frames, meters.

    Args:
        pairs: of one robot.
    """
    T_gt_frame = alignment([pairs])
    if isinstance(T_gt_frame, Absent):
        return T_gt_frame
    return float(np.sqrt(np.mean(squared_errors_m2(pairs, T_gt_frame))))


def rpe(pairs: Paired, log_stamps_ns: NDArray[np.int64]) -> tuple[float, float] | Absent:
    """Relative pose error from frame to frame of the log: RMSE of translation (m) and of rotation (rad).

    A step across frames that are lost or have no ground truth counts nowhere.

    Args:
        pairs: of one robot.
        log_stamps_ns: of all frames of its log, int64 [n], in their order.
    """
    if len(pairs) < 2:
        return Absent(f"relative errors need at least 2 paired poses, found {len(pairs)}")
    if pairs.positions_only:
        return NO_ROTATIONS
    place = np.searchsorted(log_stamps_ns, pairs.stamps_ns)
    stretches = np.split(np.arange(len(pairs)), 1 + np.flatnonzero(np.diff(place) != 1))
    stretches = [rows for rows in stretches if len(rows) > 1]
    if not stretches:
        return Absent("no two consecutive frames of the log are paired with ground truth")
    errors = [rpe_rmse(pairs.true[rows], pairs.estimated[rows], step=1) for rows in stretches]
    if len(errors) == 1:
        return errors[0]
    steps = np.array([len(rows) - 1 for rows in stretches])
    translation, rotation = np.sqrt(np.average(np.square(errors), axis=0, weights=steps)).tolist()
    return translation, rotation


@dataclass(frozen=True)
class TeamError:
    """One alignment T_gt_world [4, 4] for all robots of a component; pooled RMSE and that of each robot, meters."""

    T_gt_world: Array
    ate_rmse_m: float
    ate_rmse_m_of: dict[str, float]


def team_error(pairs_of: Mapping[str, Paired]) -> TeamError | Absent:
    """Align all robots of a component with one SE(3) transform and pool their errors over all paired frames.

    Only a joint alignment sees the error between robots: each robot may lie well by itself and the team lie apart.
    The components of a robot count as one.

    Args:
        pairs_of: paired poses by robot, all estimated in the world of the component.
    """
    robots = sorted({robot_of(name) for name in pairs_of})
    if len(robots) < 2:
        found = f"only {robots[0]}" if robots else "none"
        return Absent(
            f"a joint alignment needs at least 2 robots with ground truth in one component, found {found}"
        )
    T_gt_world = alignment([pairs_of[robot] for robot in sorted(pairs_of)])
    if isinstance(T_gt_world, Absent):
        return T_gt_world
    squared = {robot: squared_errors_m2(pairs_of[robot], T_gt_world) for robot in sorted(pairs_of)}
    pooled = np.concatenate([squared[robot] for robot in sorted(squared)])
    return TeamError(
        T_gt_world,
        float(np.sqrt(np.mean(pooled))),
        {robot: float(np.sqrt(np.mean(values))) for robot, values in squared.items()},
    )
