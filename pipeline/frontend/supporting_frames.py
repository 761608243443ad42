"""Which frames between keyframes take part in the final optimization of a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, tracked_path
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.geometry.image_motion import image_speeds, slowest_of_parts
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.messages import Keyframe
from duagc.pipeline.splat.gaussians import seen_distance_m

CONSIDERED = 4
"""Frames whose gain is computed, as a multiple of those that are chosen."""


def supporting_frames(
    frames: Sequence[TrackedFrame],
    keyframes: Sequence[Keyframe],
    config: FrontendConfig,
    gain: ViewGain,
    *,
    tiles: int = 1,
) -> list[TrackedFrame]:
    """Frames for the final optimization of the map: tracked, no keyframes, not held out; as `support_choice` says.

    Args:
        frames: of the log.
        keyframes: of the map.
        config: of the front end.
        gain: of the map that the keyframes have made.
        tiles: of the map; each gets a share.
    """
    taken = {keyframe.frame_index for keyframe in keyframes}
    candidates = [
        frame
        for frame in frames
        if frame.status is not Status.LOST
        and frame.reason is Reason.NONE  # its depth and its color belong together
        and frame.frame_index not in taken
        and not is_held_out(frame.frame_index)
    ]
    count = min(tiles * config.mapping.support_views, len(candidates))
    T_map_keyframe = np.array([k.T_map_camera for k in keyframes])
    choice = config.mapping.support_choice
    if choice == "auto":
        choice = "spread" if gain.depth == "ray_plane" else "steady"
    if choice == "steady":
        path = tracked_path(frames, T_map_keyframe)
        speeds = image_speeds(path, seen_distance_m(gain.gaussians, T_map_keyframe))
        of_stamp = dict(zip(path.stamps_ns.tolist(), speeds, strict=True))
        chosen = slowest_of_parts([of_stamp[frame.stamp_ns] for frame in candidates], count)
        return [candidates[k] for k in chosen]
    if choice == "spread":
        return [candidates[k] for k in evenly_spaced(len(candidates), count)]
    if choice == "random":
        draw = random_streams.generator(gain.seed, "mapping.support")
        return [candidates[k] for k in sorted(draw.permutation(len(candidates))[:count])]
    considered = evenly_spaced(len(candidates), min(CONSIDERED * count, len(candidates)))
    candidates = [candidates[k] for k in considered]
    poses = [T_map_keyframe[frame.keyframe_index] @ frame.T_keyframe_camera for frame in candidates]
    chosen = gain.chosen(list(T_map_keyframe), poses, count, least=choice == "reversed")
    return [candidates[k] for k in chosen]
