"""What the kernels take of a view besides its Gaussians, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.arguments import (
    check_type,
    checked_background,
    checked_camera,
    checked_mask,
    checked_pose,
    checked_threads,
)
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians

MAX_GAUSSIANS = 2**30
NO_MASK = np.zeros(0, dtype=np.uint8)


@dataclass(frozen=True)
class CheckedView:
    """A camera as the kernels take it.

    Attributes:
        height: of the images, pixels.
        width: of the images, pixels.
        pose: T_camera_map, [4, 4].
        intrinsics: fx, fy, cx, cy, pixels.
        background: RGB, 0..1.
        mask: [H, W], pixels that are drawn; empty: all.
        ray_plane: whether the depth of a Gaussian is its mean along the ray.
    """

    height: int
    width: int
    pose: NDArray[np.float32]
    intrinsics: NDArray[np.float32]
    background: NDArray[np.float32]
    mask: NDArray[np.uint8]
    ray_plane: bool

    @staticmethod
    def of(
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        background: ArrayLike = (0.0, 0.0, 0.0),
        *,
        mask: NDArray[np.bool_] | None,
        depth_kind: DepthKind,
    ) -> CheckedView:
        """The view of a drawing.

        Args:
            gaussians: as of `Rasterizer.forward`.
            camera: as of `Rasterizer.forward`.
            T_camera_map: as of `Rasterizer.forward`.
            background: as of `Rasterizer.forward`.
            mask: as of `Rasterizer.forward`.
            depth_kind: as of `Rasterizer.forward`.

        Raises:
            ValueError: an argument that no camera or Gaussian can have; the message names it.
        """
        check_type("gaussians", gaussians, Gaussians)
        height, width, intrinsics = checked_camera(camera)
        pose = checked_pose("T_camera_map", T_camera_map)
        behind = checked_background(background)
        if not isinstance(depth_kind, str) or depth_kind not in DEPTH_KINDS:
            raise ValueError(f"depth_kind is {depth_kind!r}, expected one of {', '.join(DEPTH_KINDS)}")
        if len(gaussians) > MAX_GAUSSIANS:
            raise ValueError(f"gaussians are {len(gaussians)}, expected at most {MAX_GAUSSIANS}")
        drawn = NO_MASK if mask is None else checked_mask(mask, (height, width))
        return CheckedView(
            height=height,
            width=width,
            pose=pose,
            intrinsics=intrinsics,
            background=behind,
            mask=drawn,
            ray_plane=depth_kind == "ray_plane",
        )

    def arguments(self, threads: SupportsIndex) -> tuple[Any, ...]:
        """In the order of the kernels.

        Args:
            threads: of the call.
        """
        of_camera = self.pose, self.intrinsics, self.background, self.mask
        return (*of_camera, self.ray_plane, self.width, self.height, checked_threads(threads))
