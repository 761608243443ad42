"""Which frames between keyframes take part in the final optimization of a map."""

from __future__ import annotations

from collections.abc import Sequence

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.messages import Keyframe

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
    if config.mapping.support_choice == "spread":
        return [candidates[k] for k in evenly_spaced(len(candidates), count)]
    if config.mapping.support_choice == "random":
        draw = random_streams.generator(gain.seed, "mapping.support")
        return [candidates[k] for k in sorted(draw.permutation(len(candidates))[:count])]
    considered = evenly_spaced(len(candidates), min(CONSIDERED * count, len(candidates)))
    candidates = [candidates[k] for k in considered]
    poses = [keyframes[frame.keyframe_index].T_map_camera @ frame.T_keyframe_camera for frame in candidates]
    least = config.mapping.support_choice == "reversed"
    chosen = gain.chosen([k.T_map_camera for k in keyframes], poses, count, least=least)
    return [candidates[k] for k in chosen]
