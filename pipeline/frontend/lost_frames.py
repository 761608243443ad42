"""Lost frames are looked for again once all keyframes are known.

Tracking knows only the keyframes before a frame, and accepts a place only when the next frame agrees. Afterwards a
lost frame lies between two others whose poses are known, and the keyframes behind it may show it from nearer. Its pose
changes no other: nothing was built on it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.bundle import Images
from duagc.pipeline.frontend.current_frame import features_of
from duagc.pipeline.frontend.failure import Reason, free_space_violations
from duagc.pipeline.frontend.judgment import contradicts
from duagc.pipeline.frontend.reach import farthest_m, fastest_m_s
from duagc.pipeline.frontend.stable_registration import register_until_stable
from duagc.pipeline.frontend.submaps import lost
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe, tracked_path
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Registration, RgbdPyramid
from duagc.pipeline.registration.feature_judgment import judge_motion
from duagc.pipeline.registration.feature_motion import (
    features_agree,
    motion_from_features,
)
from duagc.pipeline.registration.features import Features

LOOKED_FOR = frozenset(
    {
        Reason.LOW_OVERLAP,
        Reason.ILL_CONDITIONED,
        Reason.RESIDUAL,
        Reason.JUMP,
        Reason.OBSTRUCTED,
        Reason.UNCONFIRMED,
    }
)
"""Reasons of a loss that do not lie in the images: both can be used, and may show what a keyframe shows."""


def without_jumps(
    frames: Sequence[TrackedFrame],
    keyframes: Sequence[TrackedKeyframe],
    T_map_keyframes: Array,
    config: FrontendConfig,
) -> list[TrackedFrame]:
    """The frames, lost where a camera of finite speed cannot have come from the one before, nor gone to the next.

    Such a frame was registered to a wrong minimum, if these two are within reach of each other. Keyframes are judged
    otherwise.

    Args:
        frames: every frame of the log, anchored to keyframes.
        keyframes: of the map.
        T_map_keyframes: [k, 4, 4], optimized.
        config: of the front end.
    """

    reach = _Reach.of(frames, T_map_keyframes, config)

    def reaches(one: TrackedFrame, other: TrackedFrame) -> bool:
        T, seen_m = T_map_keyframes[one.keyframe_index], keyframes[one.keyframe_index].median_depth_m
        return reach.holds(one, T @ one.T_keyframe_camera, other, seen_m)

    posed = [k for k, frame in enumerate(frames) if frame.status is not Status.LOST]
    out, made = list(frames), {keyframe.frame_index for keyframe in keyframes}
    for before, k, after in zip(posed, posed[1:], posed[2:], strict=False):
        frame, around = frames[k], (frames[before], frames[after])
        if frame.frame_index in made or any(reaches(frame, other) for other in around):
            continue
        if reaches(*around):
            out[k] = lost(frame, Reason.JUMP)
    return out


def found_afterwards(
    frames: Sequence[TrackedFrame],
    keyframes: Sequence[TrackedKeyframe],
    T_map_keyframes: Array,
    images: Images,
    *,
    config: FrontendConfig,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    part: str = "lost frames",
) -> list[TrackedFrame]:
    """The frames, with poses of those lost ones that are found between their neighbors.

    Args:
        frames: every frame of the log, anchored to keyframes.
        keyframes: of the map.
        T_map_keyframes: [k, 4, 4], optimized.
        images: reads the images of a frame of the log, by its index.
        config: of the front end.
        checkpoints: of the stage.
        part: its name there.
    """
    if not config.tracking.relocalization.look_again:
        return list(frames)
    posed = [k for k, frame in enumerate(frames) if frame.status is not Status.LOST]
    done, out = checkpoints.resume(part) or (0, list(frames))
    reach = _Reach.of(frames, T_map_keyframes, config)
    for k in range(done, len(frames)):
        found = _found(k, frames, keyframes, reach, posed=posed, images=images, config=config)
        out[k] = found or out[k]
        checkpoints.at(part, k + 1, len(frames), lambda: out)
    return out


def registered_again(
    frames: Sequence[TrackedFrame],
    before: Sequence[TrackedFrame],
    keyframes: Sequence[TrackedKeyframe],
    images: Images,
    *,
    config: FrontendConfig,
) -> list[TrackedFrame]:
    """The frames, with better poses of those that were found while nothing said how the camera moved then.

    Their depth and their rows were as they were taken; by the poses that were found they are moved now. Of those that
    were followed by color alone, because depth of another time contradicted it, depth counts where it fits now.

    Args:
        frames: every frame of the log, with those that were found.
        before: the same frames before any was looked for again.
        keyframes: of the map.
        images: reads the images of a frame of the log, by its index, as they are moved now.
        config: of the front end.
    """
    tracking = config.tracking.verified_by_features()
    usual = [
        f.rms_gray for f in frames if f.status is Status.OK and f.reason is Reason.NONE and f.rms_gray > 0
    ]
    fitting = tracking.failure.color_check_gray_of_usual * float(np.median(usual)) if usual else np.inf
    out = list(frames)
    for k, (frame, was) in enumerate(zip(frames, before, strict=True)):
        by_color = frame.reason is Reason.CONTRADICTION
        if frame.status is Status.LOST or not (by_color or was.status is Status.LOST):
            continue
        keyframe = keyframes[frame.keyframe_index]
        pyramid = images(frame.frame_index, len(tracking.strides))
        result = register_until_stable(
            keyframe, pyramid, frame.T_keyframe_camera, tracking, first=tracking.registration
        )
        if by_color and result.rms_gray > fitting:
            continue
        features = features_of(pyramid, tracking.relocalization)
        if result.ok and _confirmed(keyframe, features, result, config, rng=_draws(frame, keyframe)):
            out[k] = _relocalized(frame, keyframe, result)
    return out


def _found(
    k: int,
    frames: Sequence[TrackedFrame],
    keyframes: Sequence[TrackedKeyframe],
    reach: _Reach,
    *,
    posed: Sequence[int],
    images: Images,
    config: FrontendConfig,
) -> TrackedFrame | None:
    """Frame k with a pose, if it is a lost one that is found between its neighbors; posed: frames that have one."""
    frame, after = frames[k], int(np.searchsorted(posed, k))
    if frame.status is not Status.LOST or frame.reason not in LOOKED_FOR or after in (0, len(posed)):
        return None
    around = frames[posed[after - 1]], frames[posed[after]]
    near = _anchors(frames, posed, after, config.tracking.relocalization.look_again_keyframes)
    pyramid = images(frame.frame_index, len(config.tracking.strides))
    for keyframe, result in _registrations(frame, pyramid, [keyframes[n] for n in near], config):
        T_map_camera = reach.T_map_keyframes[keyframe.keyframe_index] @ result.T_reference_target
        if all(reach.holds(frame, T_map_camera, other, keyframe.median_depth_m) for other in around):
            return _relocalized(frame, keyframe, result)
    return None


def _relocalized(frame: TrackedFrame, keyframe: TrackedKeyframe, result: Registration) -> TrackedFrame:
    """The frame with the pose that its registration to a keyframe gives."""
    return TrackedFrame.by(
        frame.frame_index,
        frame.stamp_ns,
        keyframe_index=keyframe.keyframe_index,
        result=result,
        status=Status.RELOCALIZED,
    )


def _anchors(frames: Sequence[TrackedFrame], posed: Sequence[int], after: int, count: int) -> list[int]:
    """The keyframes that the frames around a lost one are anchored to, the nearest in time first, sides in turn."""
    before = list(dict.fromkeys(frames[k].keyframe_index for k in reversed(posed[:after])))[:count]
    behind = list(dict.fromkeys(frames[k].keyframe_index for k in posed[after:]))[:count]
    turns = [k for pair in zip_longest(before, behind) for k in pair if k is not None]
    return list(dict.fromkeys(turns))


def _registrations(
    frame: TrackedFrame, pyramid: RgbdPyramid, keyframes: Sequence[TrackedKeyframe], config: FrontendConfig
) -> Iterator[tuple[TrackedKeyframe, Registration]]:
    """Registrations of a frame to keyframes, from matched features, that features and free space confirm."""
    tracking = config.tracking.verified_by_features()
    limits, failure = tracking.relocalization, tracking.failure
    features = features_of(pyramid, limits)
    for keyframe in keyframes:
        rng = _draws(frame, keyframe)
        moved = motion_from_features(keyframe.features, features, limits, rng).accepted_motion
        if moved is None:
            continue
        result = register_until_stable(keyframe, pyramid, moved, tracking, first=tracking.registration)
        if not result.ok or not _confirmed(keyframe, features, result, config, rng=rng):
            continue
        violations, visible = free_space_violations(
            pyramid.levels[-1], keyframe.coarsest, result.T_reference_target, failure
        )
        if violations <= failure.max_free_space_violations * visible:
            yield keyframe, result


def _draws(frame: TrackedFrame, keyframe: TrackedKeyframe) -> np.random.Generator:
    """Which samples are tried: the same in every run."""
    return random_streams.generator(
        0, "look_again", frame=frame.frame_index, keyframe=keyframe.keyframe_index
    )


def _confirmed(
    keyframe: TrackedKeyframe,
    features: Features,
    result: Registration,
    config: FrontendConfig,
    *,
    rng: np.random.Generator,
) -> bool:
    """Whether features confirm a registration, and do not agree on another motion."""
    T, limits = result.T_reference_target, config.keyframes.judgment
    if not features_agree(keyframe.features, features, T, config.tracking.relocalization):
        return False
    found = judge_motion(keyframe.features, features, T, config=limits, rng=rng)
    return found is None or not contradicts(found, limits)


@dataclass(frozen=True)
class _Reach:
    """How far a camera can have come between two frames.

    Attributes:
        T_map_keyframes: [k, 4, 4].
        speed_m_s: with which it may move.
        slack_m: what it may be off besides.
    """

    T_map_keyframes: Array
    speed_m_s: float
    slack_m: float

    @staticmethod
    def of(frames: Sequence[TrackedFrame], T_map_keyframes: Array, config: FrontendConfig) -> _Reach:
        """By the speed that cameras have, or twice that of most frames that were followed: vehicles are faster."""
        limits = config.tracking.failure
        path = tracked_path(frames, T_map_keyframes)
        moved_m = np.linalg.norm(np.diff(path.poses[:, :3, 3], axis=0), axis=1)
        elapsed_s = 1e-9 * np.diff(path.stamps_ns)
        usual_m_s = float(np.median(moved_m / np.maximum(elapsed_s, 1e-9))) if len(moved_m) else 0.0
        return _Reach(T_map_keyframes, fastest_m_s(usual_m_s, limits), limits.slack_m)

    def holds(self, frame: TrackedFrame, T_map_camera: Array, other: TrackedFrame, seen_m: float) -> bool:
        """Whether a camera can have been at two places at the times of two frames.

        Args:
            frame: one of them.
            T_map_camera: [4, 4], its pose.
            other: the other, which has a pose.
            seen_m: what the first sees is so far, in the median.
        """
        T_map_other = self.T_map_keyframes[other.keyframe_index] @ other.T_keyframe_camera
        elapsed_s = abs(frame.stamp_ns - other.stamp_ns) * 1e-9
        moved_m = float(se3.distance(T_map_camera, T_map_other)[0])
        return moved_m <= farthest_m(self.speed_m_s, elapsed_s, seen_m, slack_m=self.slack_m)
