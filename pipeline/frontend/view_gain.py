"""Which views a map would gain most from, by the information of its Gaussians, before their images are looked at."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import SupportsIndex

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians

PRIOR = 1.0
"""Information of an opacity's logit that no view has seen."""


@dataclass(frozen=True)
class ViewGain:
    """A map that says which views would tell it more.

    Attributes:
        gaussians: n of the map.
        depth: of a Gaussian at a pixel.
        camera: of the views.
        config: noise of the images.
        threads: of the rasterizer; changes no bit.
    """

    gaussians: Gaussians
    depth: DepthKind
    camera: PinholeCamera
    config: MappingConfig
    threads: SupportsIndex

    def information(self, T_map_camera: Array) -> Array:
        """Information [n] of the opacities' logits in the half-size image from a pose, in which all depth is known.

        Args:
            T_map_camera: [4, 4].
        """
        half = self.camera.halved()
        size = half.height, half.width
        rasterizer = Rasterizer(threads=self.threads)
        rasterizer.forward(self.gaussians, half, se3.inverse(T_map_camera), depth_kind=self.depth)
        information = np.zeros(len(self.gaussians))
        rasterizer.opacity_information(
            np.full(size, self.config.contribution_color_sigma**-2, np.float32),
            np.full(size, self.config.contribution_depth_sigma_m**-2, np.float32),
            information,
            np.zeros(len(self.gaussians), np.uint32),
        )
        return information

    def chosen(
        self, seen: Iterable[Array], candidates: Iterable[Array], count: int, *, least: bool = False
    ) -> list[int]:
        """Candidates, one after the other, of the largest gain over all before; in ascending order.

        The gain of a view is the sum of log((F + f) / F) over all Gaussians, with F what is known and f its own.

        Args:
            seen: T_map_camera [4, 4] of the views that made the map.
            candidates: the same of those to choose from.
            count: how many are chosen.
            least: of the smallest gain instead.
        """
        known = np.full(len(self.gaussians), PRIOR)
        for T_map_camera in seen:
            known += self.information(T_map_camera)
        own = [self.information(T_map_camera) for T_map_camera in candidates]
        taken: list[int] = []
        left = list(range(len(own)))
        while left and len(taken) < count:
            gains = [float(np.sum(np.log1p(own[k] / known))) for k in left]
            best = left.pop(int(np.argmin(gains) if least else np.argmax(gains)))
            known += own[best]
            taken.append(best)
        return sorted(taken)
