"""Which frames between keyframes take part in the final optimization of a map."""

from __future__ import annotations

from collections.abc import Sequence

from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.messages import Keyframe


def supporting_frames(
    frames: Sequence[TrackedFrame], keyframes: Sequence[Keyframe], config: FrontendConfig, *, tiles: int = 1
) -> list[TrackedFrame]:
    """Frames for the final optimization of the map: tracked, no keyframes, not held out; evenly spread over the log.

    Args:
        frames: of the log.
        keyframes: of the map.
        config: of the front end.
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
    return [candidates[k] for k in evenly_spaced(len(candidates), count)]
