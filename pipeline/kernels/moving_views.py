"""Loss and derivatives of a view whose camera moves while its shutter is open.

The map is drawn from several places; the color of their mean light is compared with the image, depth from the middle
one alone: a depth camera has a shutter of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.training import DepthKind, LossConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.open_shutter import mean_color, mean_color_slope
from duagc.pipeline.kernels.arguments import NEGATIVE, NOT_FINITE, checked_image
from duagc.pipeline.kernels.rasterizer import Rasterizer
from duagc.pipeline.kernels.types import Gradients, LossWeights, Render, ViewLoss
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import rgbd_loss
from duagc.pipeline.splat.optimizer import TRAINED

Image = NDArray[np.float32]


def draw_moving(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    camera: PinholeCamera,
    T_map_moment: Array,
    *,
    depth_kind: DepthKind,
) -> Render:
    """The map as a camera sees it that moves: color of the mean light, depth and opacity of the middle place.

    Args:
        rasterizer: draws all places.
        gaussians: in the frame `map`.
        camera: that moves.
        T_map_moment: [k, 4, 4], k odd, its places in the order of time.
        depth_kind: as of `Rasterizer.forward`.
    """
    return _seen(
        [rasterizer.forward(gaussians, camera, se3.inverse(T), depth_kind=depth_kind) for T in T_map_moment]
    )


def _seen(drawn: Sequence[Render]) -> Render:
    """From renders of all places what the open shutter sees."""
    middle = drawn[len(drawn) // 2]
    return Render(mean_color([render.color for render in drawn]), middle.depth, middle.alpha)


class MovingViews:
    """Draws maps from the places that a camera passes, with a rasterizer for each, which its derivatives need."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        """Begin with one rasterizer; those of other places are added when they are needed.

        Args:
            rasterizer: of the first place; the others are as this one.
        """
        self._rasterizers = [rasterizer]

    def gradients(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_map_camera: Array,
        T_camera_moment: Array,
        *,
        color: Image,
        depth_m: Image,
        loss: LossWeights,
        mask: NDArray[np.bool_] | None,
        depth_certainty: Image | None,
        depth_kind: DepthKind,
        pose: bool,
        parameters: bool,
    ) -> tuple[ViewLoss, Gradients]:
        """Loss of a view and its derivatives, as of `Rasterizer.view_gradients`, without the term of surfaces.

        Args:
            gaussians: in the frame `map`.
            camera: that moves.
            T_map_camera: [4, 4], in the middle of the exposure.
            T_camera_moment: [k, 4, 4], k odd: its places, seen from there; they move along with it.
            color: measured.
            depth_m: measured.
            loss: weights of the terms.
            mask: pixels that count; None: all.
            depth_certainty: factor of the depth residuals; None: all 1.
            depth_kind: depth of a Gaussian at a pixel.
            pose: also differentiate by the right tangent of T_map_camera.
            parameters: False: the derivative of the pose alone, or none at all.
        Raises:
            DuagError: the loss has the term of surfaces.
            ValueError: an image of a wrong type, shape or value; the message names it.
        """
        if loss.surface_weight:
            raise DuagError(
                f"loss.surface_weight: {loss.surface_weight:g}, expected 0 where a log states its shutter time "
                "(exposure_s): single Gaussians have no depth along a motion"
            )
        while len(self._rasterizers) < len(T_camera_moment):
            first = self._rasterizers[0]
            self._rasterizers.append(Rasterizer(first.isa, first.threads))
        drawn = [
            rasterizer.forward(gaussians, camera, se3.inverse(T), depth_kind=depth_kind, mask=mask)
            for rasterizer, T in zip(self._rasterizers, T_map_camera @ T_camera_moment, strict=False)
        ]
        _check_images(color, depth_m, depth_certainty, camera)
        seen = _seen(drawn)
        weights = LossConfig(
            color_huber=loss.color_huber,
            depth_weight=loss.depth_weight,
            depth_huber_m=loss.depth_huber_m,
            alpha_weight=loss.alpha_weight,
        )
        found = rgbd_loss(seen, color, depth_m, weights, mask=mask, certainty=depth_certainty)
        value = ViewLoss(found.value, found.color, found.depth, found.d_exposure)
        if not parameters and not pose:
            return value, Gradients(None, None, None, None, None)
        parts = []
        for k, (rasterizer, render) in enumerate(zip(self._rasterizers, drawn, strict=False)):
            slope: Image = found.d_color * mean_color_slope(render.color, seen.color, len(drawn))
            of_depth = (found.d_depth, found.d_alpha) if k == len(drawn) // 2 else (None, None)
            parts.append(rasterizer.backward(slope, *of_depth, pose=pose, parameters=parameters))
        return value, _summed(parts, T_camera_moment)


def _check_images(color: object, depth_m: object, certainty: object, camera: PinholeCamera) -> None:
    """Refuse what `Rasterizer.view_gradients` refuses."""
    size = (camera.height, camera.width)
    if not np.isfinite(checked_image("color", color, (*size, 3), "the camera")).all():
        raise ValueError(f"color holds {NOT_FINITE}")
    for name, image in (("depth_m", depth_m), ("depth_certainty", certainty)):
        found = np.zeros(1) if image is None else checked_image(name, image, size, "the camera")
        if not (np.isfinite(found) & (found >= 0)).all():
            raise ValueError(f"{name} holds {NEGATIVE}")


def _summed(parts: Sequence[Gradients], T_camera_moment: Array) -> Gradients:
    """Derivatives by Gaussians and pose, from those of the places by Gaussians and their own poses."""
    total: dict[str, Any] = {name: getattr(parts[0], name) for name in TRAINED}
    for part in parts[1:]:
        for name in TRAINED:
            if total[name] is not None:
                total[name] += getattr(part, name)
    if parts[0].pose is None:
        return Gradients(**total)
    # T_map_camera exp(x) T = T_map_camera T exp(Ad(T^-1) x)
    carried = se3.adjoint(se3.inverse(T_camera_moment))
    by_pose = np.zeros(6)
    for part, of_place in zip(parts, carried, strict=True):
        by_pose += of_place.T @ part.pose
    return Gradients(**total, pose=by_pose)
