"""Where a lost camera may be: its features against those of all keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Features, extract_from_gray, matches, ransac

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
        pairs = matches(keyframes[k].descriptors, view.descriptors, config.ratio)
        if len(pairs) < config.min_inliers:
            continue
        T_keyframe_camera, agree = ransac(
            keyframes[k].points[pairs[:, 0]].astype(np.float64),
            view.points[pairs[:, 1]].astype(np.float64),
            config.inlier_m,
            config.hypotheses,
            # the draws only choose which samples are tried: the same in every run
            random_streams.generator(0, "relocalization", frame=frame_index, keyframe=k),
        )
        if agree.sum() >= max(config.min_inliers, config.min_inlier_share * len(pairs)):
            yield k, T_keyframe_camera


def supports(
    view: Features, keyframe: Features, T_keyframe_camera: Array, config: RelocalizationConfig
) -> bool:
    """Whether enough matched features of a view are, at a pose, where the keyframe has them."""
    pairs = matches(keyframe.descriptors, view.descriptors, config.ratio)
    there = keyframe.points[pairs[:, 0]].astype(np.float64)
    here = se3.transform(T_keyframe_camera, view.points[pairs[:, 1]].astype(np.float64))
    limit_m = config.inlier_m * np.maximum(1.0, there[:, 2])
    agree = np.linalg.norm(there - here, axis=-1) < limit_m
    return int(agree.sum()) >= max(config.min_inliers, config.min_inlier_share * len(pairs))
