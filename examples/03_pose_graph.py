"""Solve a pose graph: a ring of keyframes whose odometry drifts, closed by one loop closure.

python examples/03_pose_graph.py
"""

import duagc  # isort: skip  (before numpy: it sets what makes results reproducible)
import numpy as np

KEYFRAMES = 40
SIGMA_M, SIGMA_RAD = 0.01, 0.005  # of every measured relative pose
RADIUS_M = 3.0


def ring() -> np.ndarray:
    """True poses T_world_keyframe [KEYFRAMES, 4, 4] on a circle."""
    forward_m = 2 * np.pi * RADIUS_M / KEYFRAMES
    step = duagc.se3.exp(np.array([forward_m, 0, 0, 0, 0, 2 * np.pi / KEYFRAMES]))
    poses = [np.eye(4)]
    for _ in range(KEYFRAMES - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def measured(T: np.ndarray, rng: np.random.Generator) -> duagc.RelativePoses:
    """Noisy relative poses from each keyframe to the next, and from the last to the first."""
    i, j = np.arange(KEYFRAMES), np.roll(np.arange(KEYFRAMES), -1)
    sigma = np.array([SIGMA_M] * 3 + [SIGMA_RAD] * 3)
    noise = duagc.se3.exp(rng.normal(size=(KEYFRAMES, 6)) * sigma)
    information = np.tile(np.diag(1 / sigma**2), (KEYFRAMES, 1, 1))
    return duagc.RelativePoses(i, j, duagc.se3.inverse(T[i]) @ T[j] @ noise, information)


def main() -> None:
    """Chain the odometry, solve the graph, and print how far both are from the true poses."""
    T_true = ring()
    graph = measured(T_true, np.random.default_rng(0))
    T_odometry = [np.eye(4)]
    for T_i_j in graph.T_i_j[:-1]:
        T_odometry.append(T_odometry[-1] @ T_i_j)
    solution = duagc.solve_pose_graph(graph, np.array(T_odometry))
    for name, T in (("odometry", np.array(T_odometry)), ("pose graph", solution.poses)):
        print(f"{name:>10}: {1000 * duagc.ate_rmse_m(T_true[:, :3, 3], T[:, :3, 3]):.1f} mm ATE")
    print(f"cost {solution.cost:.1f} after {solution.iterations} steps, converged: {solution.converged}")


if __name__ == "__main__":
    main()
