"""Where a registration starts when the motion prior is weak: the motion that matched features with depth agree on.

Dense registration converges from a few pixels off in its coarsest image. A camera that moves by hand leaves what its
last velocity predicts by half its acceleration times the square of the time between frames: a pixel at 30 Hz, fifty at
5 Hz. Matched features need no prediction.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.current_frame import CurrentFrame
from duagc.pipeline.frontend.matching_keyframes import most_matching
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.registration.feature_motion import FeatureMotion, motion_from_features


def initial_motions(state: TrackingState, frame: CurrentFrame) -> Iterator[tuple[int, Array]]:
    """Keyframes that a frame shows, each with the motion that its matched features agree on.

    The keyframe that frames are tracked against comes first. Then come those of the keyframes that look at the nearest
    places that share most matches with the frame: a path that turns back sees them from nearer than the latest one.

    Args:
        state: what the tracker knows.
        frame: the current frame.

    Yields:
        Keyframe index and T_keyframe_camera [4, 4].
    """
    for k in _keyframes(state, frame):
        if (motion := feature_motion(state, frame, k).accepted_motion) is not None:
            yield k, motion


def feature_motion(state: TrackingState, frame: CurrentFrame, keyframe_index: int) -> FeatureMotion:
    """The motion that matched features of a keyframe and a frame agree on.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        keyframe_index: of the keyframe.
    """
    # the draws only choose which samples are tried: the same in every run
    rng = random_streams.generator(0, "initialization", frame=frame.frame_index, keyframe=keyframe_index)
    features, config = state.keyframes[keyframe_index].features, state.config.tracking.relocalization
    return motion_from_features(features, frame.features, config, rng)


def _keyframes(state: TrackingState, frame: CurrentFrame) -> Iterator[int]:
    """Keyframes that are tried, as of `initial_motions`; the others are compared when the first one was not enough."""
    latest, keyframes = state.keyframe_index, state.keyframes
    yield latest
    centers = np.array([keyframe.center_map for keyframe in keyframes])
    distance = np.linalg.norm(centers - centers[latest], axis=1)
    nearest = np.argsort(distance, kind="stable")[: state.config.keyframes.optimization_candidates].tolist()
    others = [k for k in nearest if k != latest]
    features, config = [keyframe.features for keyframe in keyframes], state.config.tracking.relocalization
    yield from most_matching(frame.features, features, config, others)
