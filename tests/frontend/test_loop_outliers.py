"""A wrong loop closure within a robot's path is found by the cycles that it is in."""

import numpy as np

from duagc.pipeline.config.frontend import LoopConfig
from duagc.pipeline.frontend.loop_outliers import consistent_loops
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose

INFORMATION = np.diag([1e6] * 3 + [1e6] * 3)  # registrations believe that they are good to a millimeter
COUNT = 40


def true_path() -> np.ndarray:
    """Two rounds on a circle of 2 m, looking outward."""
    angles = 4 * np.pi * np.arange(COUNT) / COUNT
    return np.array(
        [se3.exp(np.array([0, 0, 0, 0, a, 0])) @ se3.exp(np.array([0, 0, 2.0, 0, 0, 0])) for a in angles]
    )


def drifting(truth: np.ndarray) -> tuple[np.ndarray, list[RelativePose]]:
    """Odometry that errs by 5 mm and 4 mrad a keyframe, far more than it says."""
    rng = np.random.default_rng(0)
    pairs, T = [], [truth[0]]
    for i in range(len(truth) - 1):
        noise = rng.normal(scale=[0.005] * 3 + [0.004] * 3)
        step = se3.inverse(truth[i]) @ truth[i + 1] @ se3.exp(noise)
        pairs.append(RelativePose(i, i + 1, step, INFORMATION))
        T.append(T[-1] @ step)
    return np.array(T), pairs


def closure(truth: np.ndarray, i: int, j: int, off: np.ndarray | None = None) -> RelativePose:
    T = se3.inverse(truth[i]) @ truth[j]
    return RelativePose(i, j, T if off is None else T @ se3.exp(off), INFORMATION)


def test_true_loop_closures_over_drift_are_kept() -> None:
    truth = true_path()
    start, pairs = drifting(truth)
    loops = [closure(truth, i, i + 20) for i in (0, 4, 9, 15)]
    assert consistent_loops(start, pairs, loops, LoopConfig()) == loops


def test_a_wrong_loop_closure_is_left_out() -> None:
    truth = true_path()
    start, pairs = drifting(truth)
    loops = [closure(truth, i, i + 20) for i in (0, 4, 9, 15)]
    alike = closure(truth, 6, 17, np.array([0.5, 0.0, -0.4, 0.0, 0.3, 0.0]))
    alone = closure(truth, 2, 30, np.array([0.0, 0.0, 0.7, 0.0, 0.0, 0.4]))
    found = consistent_loops(start, pairs, [*loops[:2], alike, *loops[2:], alone], LoopConfig())
    assert found == loops
    assert consistent_loops(start, pairs, [alike], LoopConfig()) == []
    assert consistent_loops(start, pairs, [alike], LoopConfig(robust=False)) == [alike]


def test_floors_built_alike_do_not_bend_the_path() -> None:
    """Loop closures between two floors of a staircase outnumber the path between them, and agree with each other."""
    up = np.eye(4)
    up[1, 3] = -0.04  # a keyframe, 0.8 m a round
    truth = np.array([np.linalg.matrix_power(up, k) @ T for k, T in enumerate(true_path())])
    start, pairs = drifting(truth)
    floor = [se3.inverse(truth[i]) @ truth[i + 1] for i in range(COUNT - 1)]
    alike = [
        RelativePose(i, 20 + i + more, floor[i] if more else np.eye(4), INFORMATION)
        for more in (0, 1)
        for i in range(20 - more)
    ]
    truly = [closure(truth, i, i + 10) for i in (2, 12, 22)]
    assert consistent_loops(start, pairs, alike, LoopConfig()) == []
    assert consistent_loops(start, pairs, [*alike, *truly], LoopConfig()) == truly


def test_loop_closures_correct_a_place_where_tracking_was_wrong() -> None:
    truth = true_path()
    start, pairs = drifting(truth)
    slip = se3.exp(np.array([0.3, 0.0, 0.2, 0.0, 0.1, 0.0]))
    pairs[14] = RelativePose(14, 15, pairs[14].T_i_j @ slip, INFORMATION)
    start[15:] = start[14] @ pairs[14].T_i_j @ se3.inverse(start[15]) @ start[15:]
    loops = [closure(truth, i, i + 20) for i in range(15)]  # all across that place
    assert consistent_loops(start, pairs, loops, LoopConfig()) == loops
