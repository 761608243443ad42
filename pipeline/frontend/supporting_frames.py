"""Which frames between keyframes take part in the final optimization of a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, tracked_path
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.messages import Keyframe
from duagc.pipeline.splat.training_frames import blur_distance_m, seen_distance_m, training_frames

CONSIDERED = 4
"""Frames whose gain is computed, as a multiple of those that are chosen."""


def supporting_frames(
    frames: Sequence[TrackedFrame],
    keyframes: Sequence[Keyframe],
    config: FrontendConfig,
    gain: ViewGain,
    *,
    tiles: int = 1,
    seed: int = 0,
) -> list[TrackedFrame]:
    """Frames for the final optimization of the map: tracked, no keyframes, not held out; as `support_choice` says.

    Args:
        frames: of the log.
        keyframes: of the map.
        config: of the front end.
        gain: of the map that the keyframes have made.
        tiles: of the map; each gets a share.
        seed: of the run.
    """
    T_map_keyframe = np.array([k.T_map_camera for k in keyframes])
    taken = {keyframe.frame_index for keyframe in keyframes}
    placed = [frame for frame in frames if frame.status is not Status.LOST]
    candidates = [
        place
        for place, frame in enumerate(placed)
        if frame.reason is Reason.NONE  # its depth and its color belong together
        and frame.frame_index not in taken
        and not is_held_out(frame.frame_index)
    ]
    count = min(tiles * config.mapping.support_views, len(candidates))
    path, choice = tracked_path(placed, T_map_keyframe), config.mapping.support_choice
    if choice == "random":
        draw = random_streams.generator(seed, "mapping.support")
        chosen = sorted(candidates[k] for k in draw.permutation(len(candidates))[:count])
    elif choice in ("information", "reversed"):
        some = training_frames(path, candidates, min(CONSIDERED * count, len(candidates)), None)
        least = choice == "reversed"
        chosen = [some[k] for k in gain.chosen(T_map_keyframe, path.poses[some], count, least=least)]
    else:
        seen_m = {
            "auto": blur_distance_m(gain.gaussians, T_map_keyframe, gain.depth),
            "steady": seen_distance_m(gain.gaussians, T_map_keyframe),
            "spread": None,
        }[choice]
        chosen = training_frames(path, candidates, count, seen_m)
    return [placed[k] for k in chosen]
