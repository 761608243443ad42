"""A robot's final map with the images that it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer, Render
from duagc.pipeline.registration.moving import FreeSpace
from duagc.pipeline.splat.gaussians import Gaussians


@dataclass(frozen=True)
class MapViews:
    """A map and its keyframes' images, posed in the frame of the map.

    Attributes:
        gaussians: the map.
        camera: of the images.
        images: in order of the keyframes.
        depth_kind: depth of a Gaussian at a pixel, as the map was made.
        threads: of the rasterizer; changes no bit of any result.
    """

    gaussians: Gaussians
    camera: PinholeCamera
    images: Sequence[PosedRgbd]
    depth_kind: DepthKind = "blended"
    threads: SupportsIndex = 1

    def rasterizer(self) -> Rasterizer:
        """A rasterizer with these threads."""
        return Rasterizer(threads=self.threads)

    def draw(self, rasterizer: Rasterizer, image: PosedRgbd, mask: NDArray[np.bool_] | None) -> Render:
        """The map as the camera of an image sees it, where the mask allows.

        Args:
            rasterizer: draws.
            image: with its pose, of the same camera.
            mask: bool [h, w], pixels that are drawn; None: all.
        """
        T_camera_world = se3.inverse(image.T_world_camera)
        return rasterizer.forward(
            self.gaussians, self.camera, T_camera_world, mask=mask, depth_kind=self.depth_kind
        )


def free_space(images: Sequence[PosedRgbd], camera: PinholeCamera, config: MovingConfig) -> FreeSpace:
    """Space that the images saw to be free.

    Args:
        images: posed in one frame; their usable depth counts.
        camera: of the images.
        config: how free space is found.
    """
    free = FreeSpace(camera, config)
    for image in images:
        free.add(image.usable_depth, image.T_world_camera)
    return free


def without_moving(images: Sequence[PosedRgbd], free: FreeSpace) -> ShelvedList[PosedRgbd]:
    """The images with what moved masked, as the front end did before it mapped them.

    Args:
        images: posed in the frame of `free`.
        free: space that they saw to be free.
    """
    return ShelvedList(
        replace(image, mask=free.usable(image.usable_depth, image.T_world_camera, image.mask))
        for image in images
    )
