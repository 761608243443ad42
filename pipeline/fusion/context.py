"""What all steps of fusing one robot's map share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import SupportsIndex

from duagc.pipeline.config.consensus import MapMatching, WeightKind
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera


@dataclass(frozen=True)
class MapContext:
    """Camera and settings of one robot's map.

    Attributes:
        camera: the robot's camera.
        config: of fusion.
        matching: as the pairs of the session were found.
        depth_kind: depth of a Gaussian at a pixel, as the robot's map was made.
        weights: kind of the information in the evidence.
        threads: of the rasterizer; changes no bit of any result.
        seed: of the run.
    """

    camera: PinholeCamera
    config: FusionConfig
    matching: MapMatching
    depth_kind: DepthKind = "blended"
    weights: WeightKind = "block"
    threads: SupportsIndex = 1
    seed: int = 0
