"""Settings of the evaluation."""

from __future__ import annotations

from duagc.pipeline.config.base import Config


class EvaluationConfig(Config):
    """What a run is measured against."""

    matching: bool = False
    """Also hold the matches of Gaussians against the true surface: `consensus.matching_precision` and its recall."""
    central_map: bool = False
    """Also train and score one map from the maps and images of all robots that share a world, as a server would that
    gets them all; with the agreed poses, and as many steps as all final maps together."""
