"""What features contradict after the joint optimization is corrected, or called lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.pose_optimization import OptimizedPath, PathOptimization
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Features
from tests.fixtures.films import CAMERA, FRAMES, filmed
from tests.frontend.conftest import STARTS

CONFIG = FrontendConfig.model_validate(
    {"tracking": {"strides": (2, 1, 1, 1)}, "keyframes": {"loops": {"enabled": False}}}
)
OFF = se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.15, 0.0]))


def images(frame_index: int, levels: int) -> RgbdPyramid:
    shot = filmed(0, FRAMES)[frame_index]
    return RgbdPyramid.build(shot.color / np.float32(255), shot.depth, CAMERA, levels)


@pytest.fixture(scope="module")
def tracked(run: Undisturbed) -> tuple[Tracker, list[TrackedFrame]]:
    return run.tracker(STARTS[-1]), run.frames[: STARTS[-1]]


def broken(tracker: Tracker, at: int) -> Tracker:
    """A tracker that went wrong at a keyframe, and from there on tracked as before."""
    wrong = tracker.copied()
    T = wrong.keyframes[at].T_map_keyframe
    wrong.state.keyframes[at:] = [
        replace(k, T_map_keyframe=T @ OFF @ se3.inverse(T) @ k.T_map_keyframe) for k in tracker.keyframes[at:]
    ]
    wrong.state.pairs[:] = [p for p in tracker.pairs if (p.i < at) == (p.j < at)]
    T_wrong = se3.inverse(wrong.keyframes[at - 1].T_map_keyframe) @ wrong.keyframes[at].T_map_keyframe
    wrong.state.pairs.append(RelativePose(at - 1, at, T_wrong, 1e6 * np.eye(6)))
    return wrong


def optimized(tracker: Tracker, frames: list[TrackedFrame]) -> OptimizedPath:
    return PathOptimization(images, CONFIG, 0, "alpha").run(tracker.keyframes, frames, tracker.pairs)


def frame_indices(keyframes: Sequence[TrackedKeyframe]) -> list[int]:
    return [keyframe.frame_index for keyframe in keyframes]


def test_a_true_path_stays_as_it_is_optimized(tracked) -> None:
    tracker, frames = tracked
    path = optimized(tracker, frames)
    assert frame_indices(path.keyframes) == frame_indices(tracker.keyframes)
    assert path.frames == frames


def test_features_correct_a_wrong_step(tracked) -> None:
    tracker, frames = tracked
    path = optimized(broken(tracker, len(tracker.keyframes) - 3), frames)
    assert frame_indices(path.keyframes) == frame_indices(tracker.keyframes)
    for keyframe, T in zip(tracker.keyframes, path.solution.T_map_keyframe, strict=True):
        assert se3.distance(keyframe.T_map_keyframe, T)[0] < 0.005


def test_what_cannot_be_corrected_is_lost(tracked) -> None:
    """Views without features before the wrong step: depth contradicts, and nothing says where the camera was."""
    tracker, frames = tracked
    at = len(tracker.keyframes) - 2
    wrong = broken(tracker, at)
    none = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
    wrong.state.keyframes[:] = [replace(k, features=none) for k in wrong.keyframes]
    T = wrong.keyframes[at].T_map_keyframe @ se3.exp(np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0]))
    wrong.state.keyframes[at] = replace(wrong.keyframes[at], T_map_keyframe=T)
    wrong.state.pairs[:] = [p for p in tracker.pairs if p.i < at and p.j < at]
    wrong.state.pairs.append(
        RelativePose(at - 1, at, se3.inverse(wrong.keyframes[at - 1].T_map_keyframe) @ T, 1e6 * np.eye(6))
    )
    wrong.state.keyframes[at + 1 :] = []
    kept = [frame for frame in frames if frame.keyframe_index <= at]
    path = optimized(wrong, kept)
    assert frame_indices(path.keyframes) == frame_indices(wrong.keyframes[:at])
    lost = [frame for frame in kept if frame.keyframe_index == at]
    assert lost
    for frame in path.frames[-len(lost) :]:
        assert frame.status is Status.LOST
        assert frame.reason is Reason.CONTRADICTED_BY_DEPTH
        assert not frame.information.any()
        assert frame.keyframe_index < at
