"""One training step of a Gaussian map: draw, compare with an image, Adam, limits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind, LearningRates
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.exposure import by_table, unit_table
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels.adam import CompiledAdam
from duagc.pipeline.kernels.moving_views import MovingViews
from duagc.pipeline.kernels.rasterizer import Rasterizer
from duagc.pipeline.kernels.types import Gradients, LossWeights, ViewLoss
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import DepthTrust, depth_certainty

Image = NDArray[np.float32]
NO_LIMIT = np.float32(np.inf)
LARGEST_LOGIT = 6.0
"""Opacity logits stay within +- this: gradients vanish beyond."""


@dataclass(frozen=True)
class ScaleLimits:
    """Between which log-scales stay.

    Attributes:
        least: log of meters, one for all or [n, 3].
        greatest: log of meters.
    """

    least: NDArray[np.float32] | np.float32
    greatest: np.float32 = NO_LIMIT

    @classmethod
    def of(cls, config: MappingConfig) -> ScaleLimits:
        """Those of a map that is grown.

        Args:
            config: of the mapping.
        """
        return cls(np.float32(np.log(config.seeding.thickness_m)), np.float32(np.log(config.max_scale_m)))


@dataclass(frozen=True)
class TrainingView:
    """An RGB-D image as the loss takes it.

    Attributes:
        color: float32 [H, W, 3], RGB in 0..1, or above where an exposure was taken back; or uint8, by `color_table`.
        depth_m: float32 [H, W], meters, 0 where nothing was measured.
        T_map_camera: [4, 4], pose of the camera in the frame of the Gaussians.
        mask: bool [H, W], pixels that count; None: all.
        depth_certainty: float32 [H, W], factor of the depth residuals (`splat.losses.depth_certainty`); None: 1.
        T_camera_moment: [k, 4, 4], k odd: where the camera is while its shutter is open, seen from the middle; None: it
            stands still.
        color_table: float32 [256, 3], color by value of a channel; None: the color is what it says.
    """

    color: Image | NDArray[np.uint8]
    depth_m: Image
    T_map_camera: NDArray[np.float64]
    mask: NDArray[np.bool_] | None = None
    depth_certainty: Image | None = None
    T_camera_moment: NDArray[np.float64] | None = None
    color_table: Image | None = None

    @classmethod
    def of(cls, view: PosedRgbd, loss: DepthTrust) -> TrainingView:
        """An image as it was taken, in the colors of the map.

        Args:
            view: the image.
            loss: how much uncertain depth counts.
        """
        certainty = depth_certainty(view.depth_m, view.depth_sigma_m, loss)
        return cls(
            view.color,
            view.depth_m,
            view.T_world_camera,
            view.mask,
            certainty,
            view.T_camera_moment,
            color_table=unit_table(view.exposure),
        )

    @property
    def shown_color(self) -> Image:
        """float32 [H, W, 3], RGB in 0..1 and above."""
        if self.color_table is None:
            return np.asarray(self.color, np.float32)
        return by_table(np.asarray(self.color, np.uint8), self.color_table)


@dataclass(frozen=True)
class TrainingStep:
    """What stays the same from step to step.

    Attributes:
        rasterizer: that draws.
        loss: weights of the terms.
        depth_kind: depth of a Gaussian at a pixel.
    """

    rasterizer: Rasterizer
    loss: LossWeights
    depth_kind: DepthKind

    @cached_property
    def _moving(self) -> MovingViews:
        return MovingViews(self.rasterizer)

    def loss_of(self, gaussians: Gaussians, camera: PinholeCamera, view: TrainingView) -> ViewLoss:
        """Loss of a view.

        Args:
            gaussians: as of `gradients`.
            camera: as of `gradients`.
            view: as of `gradients`.
        """
        return self.gradients(gaussians, camera, view, parameters=False)[0]

    def gradients(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        view: TrainingView,
        *,
        pose: bool = False,
        closing: float = 0.0,
        parameters: bool = True,
    ) -> tuple[ViewLoss, Gradients]:
        """Loss of a view and its derivatives by the Gaussians.

        Args:
            gaussians: in the frame of the view's pose.
            camera: of the view.
            view: an image with its pose.
            pose: also differentiate by the right tangent of the pose.
            closing: as of `Rasterizer.view_gradients`; a view of a moving camera is drawn whole.
            parameters: as of `Rasterizer.view_gradients`.
        """
        if view.T_camera_moment is not None:
            return self._moving.gradients(
                gaussians,
                camera,
                view.T_map_camera,
                view.T_camera_moment,
                color=view.shown_color,
                depth_m=view.depth_m,
                loss=self.loss,
                mask=view.mask,
                depth_certainty=view.depth_certainty,
                depth_kind=self.depth_kind,
                pose=pose,
                parameters=parameters,
            )
        return self.rasterizer.view_gradients(
            gaussians,
            camera,
            se3.inverse(view.T_map_camera),
            color=view.color,
            color_table=view.color_table,
            depth_m=view.depth_m,
            loss=self.loss,
            mask=view.mask,
            depth_kind=self.depth_kind,
            depth_certainty=view.depth_certainty,
            pose=pose,
            closing=closing,
            parameters=parameters,
        )


def step_in_place(
    gaussians: Gaussians,
    adam: CompiledAdam,
    gradients: Gradients,
    *,
    rates: LearningRates,
    limits: ScaleLimits,
    rows: NDArray[np.int64] | None = None,
    chosen: NDArray[np.bool_] | None = None,
) -> None:
    """One step of Adam of Gaussians in place, within their limits; none is copied.

    Args:
        gaussians: of which some are changed.
        adam: state of the optimization of all of them; changed.
        gradients: [m], of the loss by those of the rows.
        rates: step lengths.
        limits: of the log-scales.
        rows: [m], which, each once; None: all.
        chosen: [n], which may change; None: all.
    """
    least = np.atleast_1d(np.asarray(limits.least, np.float32))
    of_all = (float(limits.greatest), LARGEST_LOGIT)
    adam.step_in_place(gaussians, gradients, rates, least=least, limits=of_all, rows=rows, chosen=chosen)
