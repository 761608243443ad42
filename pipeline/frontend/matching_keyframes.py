"""Keyframes that share most features with a view."""

from __future__ import annotations

from collections.abc import Sequence

from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.registration.features import Features, count_matches


def most_matching(
    view: Features, keyframes: Sequence[Features], config: RelocalizationConfig, among: Sequence[int]
) -> list[int]:
    """Keyframes that share enough features with a view, the most first; of equals the later ones first.

    Args:
        view: its features.
        keyframes: features of every keyframe.
        config: how many are given, and what they must share.
        among: indices of the keyframes that are compared.
    """
    most, ratio = config.features_compared, config.ratio
    scores = {k: count_matches(keyframes[k], view, most, ratio) for k in among}
    ranked = sorted(among, key=lambda k: (-scores[k], -k))[: config.candidates]
    return [k for k in ranked if scores[k] >= config.min_matches]
