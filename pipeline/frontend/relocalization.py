"""Where a lost camera may be: its features against those of all keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Features, extract_from_gray, matches
from duagc.pipeline.registration.geometric_verification import motion_from_features

Array = NDArray[np.float64]


def features_of(pyramid: RgbdPyramid, config: RelocalizationConfig) -> Features:
    """The strongest features of a view, from the finest image that is not wider than `max_width_px`."""
    narrow = [level for level in pyramid.levels if level.camera.width <= config.max_width_px]
    level = narrow[0] if narrow else pyramid.levels[-1]
    gray = np.rint(np.clip(level.gray, 0, 1) * 255).astype(np.uint8)
    known = level.inverse_depth > 0
    depth_m = np.where(known, 1 / np.where(known, level.inverse_depth, 1), 0).astype(np.float32)
    return extract_from_gray(gray, depth_m, level.camera, config.features)


def guesses(
    view: Features, keyframes: Sequence[Features], frame_index: int, config: RelocalizationConfig
) -> Iterator[tuple[int, Array]]:
    """Keyframes that the view may show, the best first, each with the motion that its matched features agree on.

    Args:
        view: features of the lost view. keyframes: of every keyframe. frame_index: names the random draws.
    Yields:
        Keyframe index and T_keyframe_camera [4, 4].
    """
    most = config.features_compared
    scores = [
        len(matches(f.descriptors[:most], view.descriptors[:most], config.ratio)) if len(f) else 0
        for f in keyframes
    ]
    ranked = sorted(range(len(keyframes)), key=lambda k: (-scores[k], -k))
    for k in ranked[: config.candidates]:
        if scores[k] < config.min_matches:
            return
        # the draws only choose which samples are tried: the same in every run
        rng = random_streams.generator(0, "relocalization", frame=frame_index, keyframe=k)
        found = motion_from_features(keyframes[k], view, config, rng)
        if found.T_first_second is not None and found.accepted:
            yield k, found.T_first_second
