"""The rasterizer of the pipeline: compiled kernels behind checked numpy arrays."""

from __future__ import annotations

from numbers import Real
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import (
    NEGATIVE,
    NOT_FINITE,
    Image,
    KernelStatus,
    arrays_of,
    check_array,
    check_share,
    check_sums,
    check_type,
    check_wanted,
    checked_bytes,
    checked_exposure,
    checked_image,
    checked_isa,
    checked_threads,
    complaint_about,
    refuse_bad_image,
)
from duagc.pipeline.kernels.checked_view import CheckedView
from duagc.pipeline.kernels.definition import SAME_LAYER, TRANSMITTANCE_MIN
from duagc.pipeline.kernels.outputs import NOTHING, empty, gradients_of, outputs_for, view_loss, zeros
from duagc.pipeline.kernels.types import (
    FISHER_DIAGONAL_COLUMNS,
    FisherSums,
    Gradients,
    LossWeights,
    Render,
    Statistics,
    ViewLoss,
)
from duagc.pipeline.splat.gaussians import Gaussians

_NO_DOUBLES = np.zeros(0)


class Rasterizer:
    """Draws Gaussians into a camera, and takes derivatives back to them.

    `backward`, `fisher` and `contributions` refer to the last `forward`, with or without the layer; the arrays of its
    Gaussians must not have changed since. Scratch memory stays between calls. One Rasterizer serves one thread at a
    time; the GIL is released. All results are the same bits for any number of threads and on every instruction set.
    """

    def __init__(self, isa: str = "auto", threads: SupportsIndex = 1) -> None:
        """Choose how to compute.

        Args:
            isa: instruction set, one of `available_isas()`; "auto" takes the fastest of this machine.
            threads: of every call, 1 or more; changes no bit of any result.
        Raises:
            ValueError: an instruction set that this machine lacks, or a number of threads out of range.
        """
        checked_threads(threads)
        self.threads = threads
        self._raster = _raster.Raster(checked_isa(isa))
        self._gaussians: Gaussians | None = None
        self._closed_early = False
        self._size = (0, 0)

    @property
    def isa(self) -> str:
        """The instruction set in use: "avx512", "avx2", "neon" or "portable"."""
        return self._raster.isa

    def forward(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        background: ArrayLike = (0.0, 0.0, 0.0),
        *,
        depth_kind: DepthKind = "blended",
        mask: NDArray[np.bool_] | None = None,
    ) -> Render:
        """Draw the Gaussians into a camera.

        Args:
            gaussians: n Gaussians in the frame `map`.
            camera: pinhole camera that draws; its size is that of the images.
            T_camera_map: [4, 4], takes points of the frame `map` to the camera (x right, y down, z forward).
            background: RGB (0..1) seen where the Gaussians let light through; its depth is 0.
            depth_kind: depth of a Gaussian at a pixel: that of its center ("blended"), or its mean along the
                pixel's ray ("ray_plane": of a flat disc, that of its plane).
            mask: bool [H, W]; where it is False nothing is drawn, all images are 0, and no derivative or
                information is taken later. None: all pixels.
        Returns:
            Color [H, W, 3], depth [H, W] (m, not divided by alpha) and alpha [H, W], float32.
        Raises:
            ValueError: an argument that no camera or Gaussian can have; the message names it.
        """
        view = CheckedView.of(gaussians, camera, T_camera_map, background, mask=mask, depth_kind=depth_kind)
        return self._render(gaussians, view, NOTHING, SAME_LAYER)

    def forward_with_layer(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        *,
        depth_kind: DepthKind = "blended",
        mask: NDArray[np.bool_] | None = None,
        tolerance: float = SAME_LAYER,
    ) -> tuple[Render, Image]:
        """Draw the Gaussians before black, and the depth of the surface that stops the light of each pixel.

        The median Gaussian of a pixel is the one at which half of the light is stopped; the depth of its layer is the
        mean, by blending weight, of the Gaussians within `tolerance` (relative) of its depth. At an edge, where the
        blended depth mixes two surfaces, it is that of one of them. No derivative is taken of it.

        Args:
            gaussians: as in `forward`.
            camera: as in `forward`.
            T_camera_map: as in `forward`.
            depth_kind: as in `forward`.
            mask: as in `forward`.
            tolerance: relative difference of depth, 0..1.
        Returns:
            The same as `forward`; and the depth of the layer [H, W], meters, 0 where more than half of the light
            passes.
        Raises:
            ValueError: as `forward`; or the tolerance is out of range.
        """
        if not (isinstance(tolerance, Real) and 0 <= float(tolerance) <= 1):
            raise ValueError(f"tolerance is {tolerance!r}, expected a number from 0 to 1")
        view = CheckedView.of(gaussians, camera, T_camera_map, mask=mask, depth_kind=depth_kind)
        layer = empty(view.height, view.width)
        return self._render(gaussians, view, layer, float(tolerance)), layer

    def _render(self, gaussians: Gaussians, view: CheckedView, layer: Image, tolerance: float) -> Render:
        """Draw a view, and the depth of its layer into an array that has pixels."""
        height, width = view.height, view.width
        color, depths, alpha = empty(height, width, 3), empty(height, width), empty(height, width)
        self._gaussians = None  # whatever ends the call, nothing may follow on what is half drawn
        images = color, depths, alpha, layer
        status = self._raster.forward(
            *arrays_of(gaussians), *view.arguments(self.threads), *images, tolerance
        )
        self._finish(gaussians, (height, width), status)
        return Render(color, depths, alpha)

    def view_gradients(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        *,
        color: Image | NDArray[np.uint8],
        depth_m: Image,
        loss: LossWeights,
        exposure: tuple[float, float] = (0.0, 0.0),
        background: ArrayLike = (0.0, 0.0, 0.0),
        mask: NDArray[np.bool_] | None = None,
        depth_kind: DepthKind = "blended",
        pose: bool = False,
        parameters: bool = True,
        depth_certainty: Image | None = None,
        closing: float = 0.0,
        color_table: Image | None = None,
    ) -> tuple[ViewLoss, Gradients]:
        """Forward, loss and backward of one view in one pass: `splat.losses.rgbd_loss` and its derivatives.

        The surface term (`LossWeights.surface_weight`) is this function's own: the mean over measured pixels of the sum
        over Gaussians of blending weight times the Huber loss of the Gaussian's depth at the pixel minus the measured
        one. The blended depth may be right because what lies in front and behind cancels; this one may not.

        `fisher` and the others may follow as after a `forward`; where `closing` drew another image, only `visible`.

        Args:
            gaussians: as in `forward`.
            camera: as in `forward`.
            T_camera_map: as in `forward`.
            color: measured, float32 [H, W, 3], RGB 0..1, compared with exp(a) * rendered + b; or uint8 with
                `color_table`.
            depth_m: measured, float32 [H, W], 0 where there is none.
            loss: weights of the terms.
            exposure: (a, b), log gain and offset of this image.
            background: as in `forward`.
            mask: as in `forward`.
            depth_kind: as in `forward`.
            pose: also differentiate by the right tangent of T_map_camera.
            parameters: False takes the derivative of the pose alone, which is cheaper, or none at all.
            depth_certainty: factor [H, W] of the depth residuals, 0..1; None: all 1.
            closing: the Gaussian that takes the light of a pixel below this stops all that is left: about the same
                image from fewer Gaussians. At most `TRANSMITTANCE_MIN`: as `forward` draws.
            color_table: float32 [256, 3], the measured color by value of a channel in `color`; None: `color` is it.
        Returns:
            The loss with its terms, and the derivatives of its value.
        Raises:
            ValueError: an argument of a wrong type, shape or value; the message names it.
        """
        view = CheckedView.of(gaussians, camera, T_camera_map, background, mask=mask, depth_kind=depth_kind)
        height, width = view.height, view.width
        depth_m = checked_image("depth_m", depth_m, (height, width), "the camera")
        measured, optional = NOTHING, dict[str, NDArray[Any]]()
        if color_table is None:
            measured = checked_image("color", color, (height, width, 3), "the camera")
        else:
            optional["bytes"] = checked_bytes("color", color, (height, width, 3))
            optional["of_bytes"] = checked_image("color_table", color_table, (256, 3), "a table of bytes")
        gain_and_offset = checked_exposure(exposure)
        check_type("loss", loss, LossWeights)
        of_images = loss.color_huber, loss.depth_weight, loss.depth_huber_m, loss.alpha_weight
        check_share("closing", closing)
        weights = np.array([*of_images, *gain_and_offset, loss.surface_weight, closing], np.float32)
        out = outputs_for(gaussians, parameters)
        by_pose, values = np.zeros(6 if pose else 0), np.zeros(6)
        arguments = [
            *arrays_of(gaussians),
            *view.arguments(self.threads),
            measured,
            depth_m,
            weights,
            values,
            *out,
            by_pose,
        ]
        if depth_certainty is not None:
            size = height, width
            optional["certainty"] = checked_image("depth_certainty", depth_certainty, size, "the camera")
        self._gaussians = None
        status = self._raster.fit(*arguments, **optional)
        refuse_bad_image(status, {"color": NOT_FINITE, "depth_m": NEGATIVE, "depth_certainty": NEGATIVE})
        self._finish(gaussians, (height, width), status)
        self._closed_early = closing > TRANSMITTANCE_MIN
        return view_loss(values, loss), gradients_of(out if parameters else None, by_pose if pose else None)

    def _finish(self, gaussians: Gaussians, size: tuple[int, int], status: int) -> None:
        """Remember what was drawn, or refuse what could not be."""
        self._gaussians = None
        if status == KernelStatus.BAD_GAUSSIANS:
            raise ValueError(complaint_about(gaussians))
        if status == KernelStatus.TOO_MANY:
            raise ValueError(
                f"gaussians: {len(gaussians)} are so large on the screen that their tiles do not fit into memory"
            )
        self._gaussians, self._size, self._closed_early = gaussians, size, False

    def backward(
        self,
        d_color: Image,
        d_depth: Image | None = None,
        d_alpha: Image | None = None,
        *,
        pose: bool = False,
        fisher: bool = False,
        parameters: bool = True,
    ) -> Gradients:
        """Derivatives of a scalar L by the Gaussians of the last `forward`, from those of L by its images.

        Args:
            d_color: dL/dcolor, float32 [H, W, 3].
            d_depth: dL/ddepth, float32 [H, W]; None is zero.
            d_alpha: dL/dalpha, float32 [H, W]; None is zero.
            pose: also differentiate by the right tangent of T_map_camera.
            fisher: also give the `empirical` diagonal, the sum over pixels of (d L_p / d theta)^2 with L_p =
                <d_color_p, color_p> + d_depth_p depth_p + d_alpha_p alpha_p: pass cotangents without a 1/N in
                front.
            parameters: False takes the derivative of the pose alone, which is cheaper.
        Returns:
            The derivatives; those that were not asked for are None.
        Raises:
            ValueError: an image of a wrong type, shape or value; the message names it.
        """
        check_wanted(pose, parameters, fisher)
        gaussians, (height, width) = self._last_forward()
        n = len(gaussians)
        images = (
            checked_image("d_color", d_color, (height, width, 3)),
            NOTHING if d_depth is None else checked_image("d_depth", d_depth, (height, width)),
            NOTHING if d_alpha is None else checked_image("d_alpha", d_alpha, (height, width)),
        )
        out = outputs_for(gaussians, parameters)
        by_pose = np.zeros(6 if pose else 0)
        diagonal = zeros(n, FISHER_DIAGONAL_COLUMNS) if fisher else NOTHING
        status = self._raster.backward(*arrays_of(gaussians), *images, *out, diagonal, by_pose)
        refuse_bad_image(status, dict.fromkeys(("d_color", "d_depth", "d_alpha"), NOT_FINITE))
        shown = diagonal if fisher else None
        return gradients_of(out if parameters else None, by_pose if pose else None, shown)

    def fisher(
        self, inv_var_color: Image, inv_var_depth: Image, sums: FisherSums, residual: Image | None = None
    ) -> None:
        """Add the `gauss_newton` information of the last view, sum over pixels of J^T R^-1 J, to `sums`.

        Args:
            inv_var_color: float32 [H, W], 1/sigma^2 of every color channel; 0 leaves the pixel out.
            inv_var_depth: float32 [H, W], 1/sigma^2 of the depth as drawn, 1/m^2; 0 leaves it out.
            sums: of as many Gaussians; changed in place.
            residual: float32 [H, W], not negative; summed by weight into sums.residual.
        Raises:
            ValueError: an argument of a wrong type, shape or value; the message names it.
        """
        gaussians, size = self._last_forward()
        images = (
            checked_image("inv_var_color", inv_var_color, size),
            checked_image("inv_var_depth", inv_var_depth, size),
            NOTHING if residual is None else checked_image("residual", residual, size),
        )
        check_sums(sums, len(gaussians))
        diagonal = _NO_DOUBLES if sums.diagonal is None else sums.diagonal
        added = (
            sums.geometry,
            sums.color,
            sums.opacity,
            sums.weight,
            sums.residual,
            diagonal,
            sums.observations,
        )
        status = self._raster.fisher(*arrays_of(gaussians), *images, *added)
        refuse_bad_image(status, dict.fromkeys(("inv_var_color", "inv_var_depth", "residual"), NEGATIVE))

    def opacity_information(
        self,
        inv_var_color: Image,
        inv_var_depth: Image,
        information: NDArray[np.float64],
        observations: NDArray[np.uint32],
    ) -> None:
        """What `fisher` adds to `FisherSums.opacity` and `observations`, to the same bits, without the others.

        Args:
            inv_var_color: as in `fisher`.
            inv_var_depth: as in `fisher`.
            information: float64 [n], of the logits; added to.
            observations: uint32 [n], views in which a pixel of non-zero precision saw the Gaussian; added to.
        """
        gaussians, size = self._last_forward()
        color = checked_image("inv_var_color", inv_var_color, size)
        depth = checked_image("inv_var_depth", inv_var_depth, size)
        check_array("information", information, (len(gaussians),), np.float64)
        check_array("observations", observations, (len(gaussians),), np.uint32)
        added = information, observations
        status = self._raster.opacity_information(*arrays_of(gaussians), color, depth, *added)
        refuse_bad_image(status, dict.fromkeys(("inv_var_color", "inv_var_depth"), NEGATIVE))

    def full_fisher(self, inv_var_color: Image, inv_var_depth: Image) -> NDArray[np.float64]:
        """J^T R^-1 J [n, 14, 14] of the last view with all its cross terms; for validation, not for speed.

        Columns: mean 3, quaternion 4, log-scale 3, color 3, logit 1.

        Args:
            inv_var_color: as in `fisher`.
            inv_var_depth: as in `fisher`.
        """
        gaussians, size = self._last_forward()
        color = checked_image("inv_var_color", inv_var_color, size)
        depth = checked_image("inv_var_depth", inv_var_depth, size)
        information = np.zeros((len(gaussians), FISHER_DIAGONAL_COLUMNS, FISHER_DIAGONAL_COLUMNS))
        status = self._raster.full_fisher(*arrays_of(gaussians), color, depth, information)
        refuse_bad_image(status, dict.fromkeys(("inv_var_color", "inv_var_depth"), NEGATIVE))
        return information

    def contributions(self) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """What each Gaussian gave to the last view: sum of its blending weights [n] and number of its pixels [n]."""
        gaussians, _ = self._last_forward()
        weights = np.zeros(len(gaussians), dtype=np.float32)
        pixels = np.zeros(len(gaussians), dtype=np.uint32)
        self._raster.contributions(weights, pixels)
        return weights, pixels

    @property
    def visible(self) -> int:
        """Gaussians on the screen in the last view, also if it was closed early; `statistics` takes longer."""
        self._drawn()
        return self._raster.visible

    def statistics(self) -> Statistics:
        """The work of the last view."""
        self._last_forward()
        evaluated, blended = self._raster.pairs
        return Statistics(
            self._raster.visible, self._raster.intersections, evaluated, blended, self._raster.scratch_bytes
        )

    def _last_forward(self) -> tuple[Gaussians, tuple[int, int]]:
        if self._closed_early:
            raise RuntimeError("the last view was closed early, expected one that forward has drawn")
        return self._drawn()

    def _drawn(self) -> tuple[Gaussians, tuple[int, int]]:
        if self._gaussians is None:
            raise RuntimeError("forward has not drawn anything yet")
        return self._gaussians, self._size
