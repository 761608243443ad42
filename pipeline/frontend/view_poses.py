"""Poses of views refined together with the map: by the derivatives that the training of the map takes anyway.

Tracking registers a frame to one keyframe. Where depth is noisy, color and depth are of different times, or the shutter
rolls, the poses of a real camera are millimeters off, and the map is blurred by as much. In the final optimization
every view also moves to where the map, which is made of all views, shows what it saw. The first keyframe stays: it is
the frame of the map. Frames that are no views move as most views around them did: what they share is the drift of
tracking; what one view had alone, another frame has not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose

FIRST_MOMENT, SECOND_MOMENT = 0.8, 0.9
"""Memory of Adam, in visits of a view; a view is visited a few dozen times."""
EPSILON = 1e-12
LARGEST_SIGMA = 0.01
"""Standard deviation of a pose, meters and radians, from which a view moves no faster."""
SHARED_S = 0.2
"""Time over which frames share an error of tracking (standard deviation of the weights)."""
FARTHEST = 1e-9
"""Weight of views far away in time: they count where no other is near."""
MEDIAN_ROUNDS = 5
SMALLEST_DEVIATION = 1e-3
"""Of a move from the median, meters and radians: what is nearer counts as equal."""


PoseStep: TypeAlias = Callable[[Array], Array]
"""From the gradient [6] by the right tangent of a pose to the tangent by which it moves."""


class PoseSteps:
    """Adam on the poses of views, each by its own gradients and in units of what tracking left open.

    A pose that tracking determined well moves little, and one that it determined poorly moves most where it is open.
    """

    def __init__(self, information: Sequence[Array]) -> None:
        """Begin with no gradient.

        Args:
            information: [6, 6] of the pose of every view, by tracking.
        """
        views = len(information)
        floor = LARGEST_SIGMA**-2.0 * np.eye(6)
        self._roots = [np.linalg.cholesky(np.linalg.inv(of_view + floor)) for of_view in information]
        self._first = np.zeros((views, 6))
        self._second = np.zeros((views, 6))
        self._visits = np.zeros(views, np.int64)

    def state(self) -> tuple[Any, ...]:
        """All that it knows of gradients; `go_on` takes it."""
        return self._first, self._second, self._visits

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self._first, self._second, self._visits = state

    def of(self, view: int, rate: float) -> PoseStep:
        """The next step of a view, once its gradient is known.

        Args:
            view: its position.
            rate: as of `step`.
        """
        return lambda gradient: self.step(view, gradient, rate)

    def step(self, view: int, gradient: Array, rate: float) -> Array:
        """How a view moves: a right tangent [6] of its pose (translation m, rotation rad).

        Args:
            view: its position.
            gradient: [6], of the loss by that tangent.
            rate: length of the step, in standard deviations of the pose, while the gradient keeps its sign.
        """
        gradient = self._roots[view].T @ gradient
        self._visits[view] += 1
        visits = int(self._visits[view])
        first = self._first[view] = FIRST_MOMENT * self._first[view] + (1 - FIRST_MOMENT) * gradient
        second = self._second[view] = SECOND_MOMENT * self._second[view] + (1 - SECOND_MOMENT) * gradient**2
        mean = first / (1 - FIRST_MOMENT**visits)
        spread = np.sqrt(second / (1 - SECOND_MOMENT**visits))
        return np.asarray(self._roots[view] @ (-rate * mean / (spread + EPSILON)))


def moved_factors(
    factors: Sequence[RelativePose], solution: OptimizedKeyframes, T_map_keyframe: Array
) -> list[RelativePose]:
    """The factors of a pose graph that has its optimum at other poses, with the residuals that they had.

    Args:
        factors: of the graph.
        solution: its optimum.
        T_map_keyframe: [k, 4, 4], the other poses.
    """
    moved = []
    for factor in factors:
        before = se3.inverse(solution.T_map_keyframe[factor.i]) @ solution.T_map_keyframe[factor.j]
        after = se3.inverse(T_map_keyframe[factor.i]) @ T_map_keyframe[factor.j]
        moved.append(replace(factor, T_i_j=after @ se3.inverse(before) @ factor.T_i_j))
    return moved


def moved_frames(
    frames: Sequence[TrackedFrame],
    T_map_keyframe: Array,
    T_map_refined: Array,
    views: Mapping[int, Array],
) -> list[TrackedFrame]:
    """Every view where it was moved to, and every other frame moved as most views around it in time.

    Args:
        frames: of the log.
        T_map_keyframe: [k, 4, 4], poses of the keyframes that the frames are anchored to.
        T_map_refined: [k, 4, 4], the same after the refinement.
        views: refined T_map_camera [4, 4] by frame index; keyframes are views.
    """
    posed = [frame for frame in frames if frame.status is not Status.LOST]
    tracked = {f.frame_index: T_map_keyframe[f.keyframe_index] @ f.T_keyframe_camera for f in posed}
    at = [frame for frame in posed if frame.frame_index in views]
    if not at:
        return list(frames)
    stamps_ns = np.array([frame.stamp_ns for frame in at], dtype=np.int64)
    moves = np.array([se3.log(se3.inverse(tracked[f.frame_index]) @ views[f.frame_index]) for f in at])
    out = []
    for frame in frames:
        if frame.frame_index in tracked:
            T_map_camera = views.get(frame.frame_index)
            if T_map_camera is None:
                elapsed_s = (stamps_ns - frame.stamp_ns).astype(np.float64) * 1e-9
                shared = _shared_move(elapsed_s, moves)
                T_map_camera = tracked[frame.frame_index] @ se3.exp(shared)
            T_keyframe_camera = se3.inverse(T_map_refined[frame.keyframe_index]) @ T_map_camera
            frame = replace(frame, T_keyframe_camera=T_keyframe_camera)
        out.append(frame)
    return out


def _shared_move(elapsed_s: Array, moves: Array) -> Array:
    """The geometric median [6] of moves [n, 6], weighted by how near in time they are (Weiszfeld's iteration)."""
    near = np.exp(-0.5 * (elapsed_s / SHARED_S) ** 2) + FARTHEST / (1 + np.abs(elapsed_s))
    found = near @ moves / near.sum()
    for _ in range(MEDIAN_ROUNDS):
        weight = near / np.maximum(np.linalg.norm(moves - found, axis=1), SMALLEST_DEVIATION)
        found = weight @ moves / weight.sum()
    return np.asarray(found)
