"""Poses of views, refined together with the map."""

from __future__ import annotations

import numpy as np

from duagc.pipeline.frontend.keyframe_graph import solve_pose_graph
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.view_poses import LARGEST_SIGMA, PoseSteps, moved_factors, moved_frames
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose

KEYFRAMES = np.stack([np.eye(4), se3.exp(np.array([0.2, 0.0, 0.1, 0.0, 0.1, 0.0]))])
REFINED = np.stack([np.eye(4), KEYFRAMES[1] @ se3.exp(np.array([0.004, 0.0, -0.002, 0.001, 0.0, 0.0]))])


def frame(
    index: int, keyframe: int, T_keyframe_camera: np.ndarray, status: Status = Status.OK
) -> TrackedFrame:
    return TrackedFrame(
        frame_index=index,
        stamp_ns=index * 33_333_333,
        keyframe_index=keyframe,
        T_keyframe_camera=T_keyframe_camera,
        information=np.eye(6),
        status=status,
        overlap=1.0,
        rms_depth_m=0.0,
        rms_gray=0.0,
    )


FRAMES = [
    frame(0, 0, np.eye(4)),
    frame(1, 0, se3.exp(np.array([0.05, 0.0, 0.02, 0.0, 0.02, 0.0]))),
    frame(2, 0, se3.exp(np.array([0.1, 0.0, 0.05, 0.0, 0.05, 0.0])), Status.LOST),
    frame(4, 1, np.eye(4)),
    frame(5, 1, se3.exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.01]))),
]


def pose(of: TrackedFrame, keyframes: np.ndarray) -> np.ndarray:
    return keyframes[of.keyframe_index] @ of.T_keyframe_camera


def test_views_are_where_they_were_moved_to() -> None:
    views = {0: REFINED[0], 4: REFINED[1]}
    moved = moved_frames(FRAMES, KEYFRAMES, REFINED, views)
    np.testing.assert_allclose(pose(moved[0], REFINED), REFINED[0], atol=1e-12)
    np.testing.assert_allclose(pose(moved[3], REFINED), REFINED[1], atol=1e-12)
    assert moved[2] is FRAMES[2]  # a lost frame has no pose that could move


def test_other_frames_move_as_most_views_around_them() -> None:
    """Nine views share a drift, and one was off by itself; a frame far from all moves as the nearest."""
    shared, alone = (
        np.array([0.004, 0.0, -0.003, 0.0, 0.002, 0.0]),
        np.array([0.0, 0.02, 0.0, 0.02, 0.0, 0.0]),
    )
    tracked = [frame(k, 0, se3.exp(0.01 * k * np.ones(6))) for k in (*range(11), 60)]
    poses = {f.frame_index: f.T_keyframe_camera for f in tracked}
    views = {k: poses[k] @ se3.exp(alone if k == 6 else shared) for k in range(11) if k != 5}
    moved = moved_frames(tracked, KEYFRAMES, KEYFRAMES, views)
    for place, index in ((5, 5), (11, 60)):
        move = se3.log(se3.inverse(poses[index]) @ moved[place].T_keyframe_camera)
        np.testing.assert_allclose(move, shared, atol=5e-4)


def test_without_a_view_nothing_moves() -> None:
    assert moved_frames(FRAMES, KEYFRAMES, KEYFRAMES, {}) == FRAMES


def test_a_first_step_has_the_length_of_the_rate_and_goes_downhill() -> None:
    sigmas = np.array([2e-3, 1e-3, 4e-3, 1e-3, 3e-3, 1e-3])
    steps = PoseSteps([np.zeros((6, 6)), np.diag(sigmas**-2)])
    gradient = np.array([1.0, -2.0, 0.5, 1e-3, -1e-3, 3.0])
    np.testing.assert_allclose(steps.step(1, gradient, 0.1), -0.1 * sigmas * np.sign(gradient), rtol=0.1)
    # of a pose of which nothing is known, sigma is LARGEST_SIGMA
    np.testing.assert_allclose(steps.step(0, -gradient, 0.1), 0.1 * LARGEST_SIGMA * np.sign(gradient))


def test_a_view_moves_where_tracking_left_it_open() -> None:
    """Turning left looks as moving left: what the images open together moves together, whatever the gradient."""
    open_direction = np.array([1.0, 0.0, 0.0, 0.0, -1.0, 0.0]) / np.sqrt(2)
    information = 1e8 * (np.eye(6) - 0.9999 * np.outer(open_direction, open_direction))
    gradient = np.random.default_rng(4).normal(size=6)
    step = PoseSteps([information]).step(0, gradient, 0.1)
    assert abs(step @ open_direction) > 10 * np.linalg.norm(step - (step @ open_direction) * open_direction)
    assert step @ gradient < 0


def test_factors_keep_their_residuals() -> None:
    noise = 0.01 * np.random.default_rng(1).normal(size=(3, 6))
    factors = [
        RelativePose(0, 1, KEYFRAMES[1] @ se3.exp(noise[k]), (k + 1.0) * 1e4 * np.eye(6)) for k in range(3)
    ]
    solution = solve_pose_graph(KEYFRAMES, factors, 3.0)
    moved = moved_factors(factors, solution, REFINED)
    for before, after in zip(factors, moved, strict=True):
        old = se3.inverse(before.T_i_j) @ se3.inverse(solution.T_map_keyframe[0]) @ solution.T_map_keyframe[1]
        new = se3.inverse(after.T_i_j) @ se3.inverse(REFINED[0]) @ REFINED[1]
        np.testing.assert_allclose(new, old, atol=1e-12)
        assert after.information is before.information
    again = solve_pose_graph(REFINED, moved, 3.0)
    np.testing.assert_allclose(again.T_map_keyframe, REFINED, atol=1e-9)
