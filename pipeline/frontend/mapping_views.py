"""Views as the mapper keeps them: a keyframe's images in two sizes, and the overlap of two views."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks, projection, se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.exposure import Exposure, unit_color, unit_table
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels.training import TrainingView
from duagc.pipeline.splat.losses import DepthTrust, depth_certainty, halve

Image = NDArray[np.float32]
Bytes = NDArray[np.uint8]

FAR_SIGMA = np.float32(0.1)
"""Standard deviation of depth that was not measured, in units of it."""


@dataclass
class View:
    """A keyframe as the mapper keeps it.

    Attributes:
        index: of the keyframe.
        color: uint8 RGB [H, W, 3].
        depth_m: [H, W], meters, 0 = unknown, also where a mask forbids the pixel.
        half_color: 0..1, at half size.
        half_depth_m: at half size.
        T_map_camera: [4, 4].
        median_depth_m: meters, 0 without depth.
        mask: bool [H, W], pixels that may be used; None = all.
        half_mask: at half size.
        depth_sigma_m: [H, W], standard deviation of the depth, meters; None = not known pixel by pixel.
        certainty: [H, W], factors of the depth residuals (`splat.losses.depth_certainty`); None = all 1.
        half_certainty: at half size.
        exposure: of the image; None = as the map.
        information: [6, 6] of the pose, by tracking (right tangent: translation m, rotation rad).
        T_map_begun: [4, 4], the pose before it was refined.
        T_camera_moment: [k, 4, 4], as of `TrainingView`; None = the camera stands still.
        guests: rows of the Gaussians of other tiles that it may see; None = not looked for.
        far_m: depth [H, W] of what was too far to be measured (`far_depth`), meters, 0 = unknown; None = nowhere.
    """

    index: int
    color: Bytes
    depth_m: Image
    half_color: Image
    half_depth_m: Image
    T_map_camera: NDArray[np.float64]
    median_depth_m: float
    mask: NDArray[np.bool_] | None = None
    half_mask: NDArray[np.bool_] | None = None
    depth_sigma_m: Image | None = None
    certainty: Image | None = None
    half_certainty: Image | None = None
    exposure: Exposure | None = None
    information: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    T_map_begun: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    T_camera_moment: NDArray[np.float64] | None = None
    guests: NDArray[np.int64] | None = None
    far_m: Image | None = None

    @classmethod
    def of(
        cls,
        index: int,
        image: PosedRgbd,
        loss: DepthTrust,
        *,
        information: NDArray[np.float64] | None = None,
        far_m: Image | None = None,
    ) -> View:
        """A view of images that are kept, not copied, but for depth where a mask forbids pixels.

        The camera stands still until `Mapper.open_shutter` says otherwise.

        Args:
            index: of the keyframe.
            image: with its pose in the map frame.
            loss: how much uncertain depth counts.
            information: [6, 6] of the pose; None = nothing is known of it.
            far_m: [H, W], depth that is no measurement, meters, 0 = unknown; None = nowhere.
        """
        if image.color.dtype != np.uint8:
            raise ValueError(f"color is an array of {image.color.dtype}, expected uint8")
        depth_m, mask = image.usable_depth, image.mask
        near = depth_m[::8, ::8]
        certainty = depth_certainty(depth_m, image.depth_sigma_m, loss)
        return cls(
            index=index,
            color=image.color,
            depth_m=depth_m,
            half_color=halve(image.unit_color),
            half_depth_m=halve_depth(depth_m),
            T_map_camera=np.array(image.T_world_camera, dtype=np.float64),
            median_depth_m=float(np.median(near[near > 0])) if near.any() else 0.0,
            mask=mask,
            half_mask=None if mask is None else masks.halved(mask),
            depth_sigma_m=image.depth_sigma_m,
            certainty=certainty,
            half_certainty=None if certainty is None else halve(certainty),
            exposure=image.exposure,
            information=np.zeros((6, 6)) if information is None else information,
            T_map_begun=np.array(image.T_world_camera, dtype=np.float64),
            far_m=None
            if far_m is None
            else np.where(depth_m > 0, np.float32(0), masks.masked_depth(far_m, mask)),
        )

    @property
    def seed_depth(self) -> tuple[Image, Image | None]:
        """Depth [H, W] of new Gaussians and its standard deviation: as measured, and as found where it is too far."""
        if self.far_m is None:
            return self.depth_m, self.depth_sigma_m
        far, known = self.far_m > 0, self.depth_sigma_m
        sigma_m = np.where(far, FAR_SIGMA * self.far_m, np.float32(0) if known is None else known)
        return np.where(far, self.far_m, self.depth_m), sigma_m

    @property
    def center_map(self) -> NDArray[np.float64]:
        """The point [3] that the camera looks at: on its axis, at the median depth."""
        return self.T_map_camera[:3, 3] + self.median_depth_m * self.T_map_camera[:3, 2]

    def images(self, level: int) -> tuple[Image, Image]:
        """Color in that of the map, 0..1 and above, and depth of a level.

        Args:
            level: 0 = full size, 1 = half.
        """
        if level == 0:
            return unit_color(self.color, self.exposure), self.depth_m
        return self.half_color, self.half_depth_m

    def training(self, level: int) -> TrainingView:
        """The images of a level as a training step takes them.

        Args:
            level: 0: full size; 1: half size.
        """
        mask, pose, moments = self.usable(level), self.T_map_camera, self.T_camera_moment
        if level:
            return TrainingView(self.half_color, self.half_depth_m, pose, mask, self.half_certainty, moments)
        table = unit_table(self.exposure)
        return TrainingView(self.color, self.depth_m, pose, mask, self.certainty, moments, color_table=table)

    def usable(self, level: int) -> NDArray[np.bool_] | None:
        """The mask of a level; None = all pixels.

        Args:
            level: 0 = full size, 1 = half.
        """
        return self.mask if level == 0 else self.half_mask


def view_overlap(view: View, other: View, camera: PinholeCamera, stride_px: int = 16) -> float:
    """Share of one view's measured pixels that another view measured too.

    A pixel counts if its point projects into the other image and lies within 10 % of the depth measured there.

    Args:
        view: whose pixels are compared.
        other: the other view.
        camera: of both.
        stride_px: every so many rows and columns, a pixel is compared.
    """
    first = stride_px // 2
    z = view.depth_m[first::stride_px, first::stride_px].astype(np.float64)
    row, column = np.nonzero(z > 0)
    u, v = first + stride_px * column, first + stride_px * row
    points = projection.back_project(camera, u, v, z[row, column])
    seen = se3.transform(se3.inverse(other.T_map_camera) @ view.T_map_camera, points)
    return projection.overlap(seen, camera, depth_m=other.depth_m)


def halve_depth(depth_m: Image) -> Image:
    """Means of 2x2 blocks of measured depths on one surface (within 2 %); 0 where a pixel is missing or differs.

    Args:
        depth_m: [H, W], 0 = unknown.
    """
    h, w = depth_m.shape[0] // 2 * 2, depth_m.shape[1] // 2 * 2
    quarters = np.stack([depth_m[i:h:2, j:w:2] for i in (0, 1) for j in (0, 1)])
    nearest, farthest = quarters.min(axis=0), quarters.max(axis=0)
    return np.where((nearest > 0) & (farthest <= 1.02 * nearest), halve(depth_m), np.float32(0))
