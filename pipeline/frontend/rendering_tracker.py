"""Tracking by rendering, to compare with: the pose of a frame by gradient steps on a map of Gaussians.

The idea of SplaTAM (Keetha et al. 2024) and MonoGS (Matsuki et al. 2024), as their papers are remembered: from the
prediction by constant velocity, Adam moves pose and exposure against the color and depth loss of the rendered map,
where that is opaque; the pose of the least loss counts. The map grows at keyframes, by the mapper of this project, and
the poses of its keyframes stay. Step lengths are those of MonoGS, from memory too; there is neither an image pyramid
nor a test of whether the pose can be true.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.other_trackers import RenderingTrackerConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.mapping import Mapper
from duagc.pipeline.frontend.mapping_views import halve_depth
from duagc.pipeline.frontend.other_tracker import OtherTracker, Placed, ReadFrame
from duagc.pipeline.geometry import masks, se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.exposure import Exposure
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import mad_sigma
from duagc.pipeline.kernels import LossWeights, Rasterizer
from duagc.pipeline.registration.search import orthonormal
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import depth_certainty, halve

FIRST_MOMENT, SECOND_MOMENT, EPSILON = 0.9, 0.999, 1e-12  # of Adam
PARAMETERS = 8  # translation, rotation, log gain, offset


@dataclass(frozen=True)
class FitImages:
    """Images of a frame in the size that poses are fitted in.

    Attributes:
        color: uint8 RGB [H, W, 3].
        depth_m: [H, W], meters, 0 = unknown, also where a mask forbids the pixel.
        mask: bool [H, W], pixels that may be used; None = all.
        depth_sigma_m: [H, W], standard deviation of the depth; None: unknown.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    mask: NDArray[np.bool_] | None
    depth_sigma_m: NDArray[np.float32] | None

    @staticmethod
    def of(images: RgbdImages, halvings: int) -> FitImages:
        """The images of a frame, halved.

        Args:
            images: of the frame.
            halvings: how often.
        """
        color, mask, sigma_m = images.image, images.mask, images.depth_sigma_m
        depth_m = masks.masked_depth(images.depth_m, mask)
        for _ in range(halvings):
            color = np.rint(halve(color.astype(np.float32))).astype(np.uint8)
            depth_m = halve_depth(depth_m)
            mask = None if mask is None else masks.halved(mask)
            sigma_m = None if sigma_m is None else halve(sigma_m)
        return FitImages(color, depth_m, mask, sigma_m)


@dataclass(frozen=True)
class Fit:
    """A pose by its loss.

    Attributes:
        T_map_camera: [4, 4].
        exposure: log gain and offset, image = exp(a) * map + b.
        loss: the least.
    """

    T_map_camera: Array
    exposure: tuple[float, float]
    loss: float


class PoseFit:
    """Finds where a camera sees a map as in its images, by gradient steps."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: RenderingTrackerConfig,
        loss: LossWeights,
        *,
        threads: SupportsIndex = 1,
    ) -> None:
        """Prepare the rasterizer, the step lengths, and the loss without its term of opacity.

        Args:
            camera: of the images.
            config: steps and their lengths.
            loss: weights of the terms; missing opacity does not count.
            threads: of the rasterizer; changes no bit.
        """
        self.camera, self.config = camera, config
        self._loss = replace(loss, alpha_weight=0.0)
        self._rates = np.array([config.rate_m] * 3 + [config.rate_rad] * 3 + [config.rate_exposure] * 2)
        self._rasterizer = Rasterizer(threads=threads)

    def run(
        self,
        gaussians: Gaussians,
        depth: DepthKind,
        images: FitImages,
        T_map_camera: Array,
        *,
        exposure: tuple[float, float],
    ) -> Fit | None:
        """The pose of the least loss on the way; None if the map is opaque in too few pixels at the start.

        Args:
            gaussians: of the map.
            depth: of a Gaussian at a pixel.
            images: of the frame.
            T_map_camera: [4, 4], where to start.
            exposure: where to start.
        """
        config = self.config
        drawn = self._rasterizer.forward(
            gaussians, self.camera, se3.inverse(T_map_camera), depth_kind=depth, mask=images.mask
        )
        opaque = drawn.alpha >= config.min_alpha
        if np.count_nonzero(opaque) < max(1, config.min_share * opaque.size):
            return None
        color = images.color * np.float32(1 / 255)
        certainty = depth_certainty(images.depth_m, images.depth_sigma_m, self._loss)
        T, at = T_map_camera, np.array(exposure)
        best: Fit | None = None
        first, second = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
        for step in range(config.steps + 1):
            loss, gradients = self._rasterizer.view_gradients(
                gaussians,
                self.camera,
                se3.inverse(T),
                color=color,
                depth_m=images.depth_m,
                loss=self._loss,
                exposure=(float(at[0]), float(at[1])),
                mask=opaque,
                depth_kind=depth,
                pose=True,
                parameters=False,
                depth_certainty=certainty,
            )
            if best is None or loss.value < best.loss:
                best = Fit(T, (float(at[0]), float(at[1])), loss.value)
            assert gradients.pose is not None  # it was asked for
            gradient = np.array([*gradients.pose, *loss.d_exposure])
            first = FIRST_MOMENT * first + (1 - FIRST_MOMENT) * gradient
            second = SECOND_MOMENT * second + (1 - SECOND_MOMENT) * gradient**2
            mean = first / (1 - FIRST_MOMENT ** (step + 1))
            spread = np.sqrt(second / (1 - SECOND_MOMENT ** (step + 1)))
            share = config.last_rate ** (step / max(config.steps, 1))
            move = -share * self._rates * mean / (spread + EPSILON)
            T, at = orthonormal(T @ se3.exp(move[:6])), at + move[6:]
        return best

    def residuals(
        self, gaussians: Gaussians, depth: DepthKind, images: FitImages, fit: Fit
    ) -> tuple[float, float]:
        """Standard deviations of depth (m) and gray (0..1), by the median, where the map is opaque; 0 if nowhere.

        Args:
            gaussians: of the map.
            depth: of a Gaussian at a pixel.
            images: of the frame.
            fit: of them.
        """
        drawn = self._rasterizer.forward(
            gaussians, self.camera, se3.inverse(fit.T_map_camera), depth_kind=depth, mask=images.mask
        )
        opaque = drawn.alpha >= self.config.min_alpha
        known = opaque & (images.depth_m > 0)
        of_depth = drawn.depth[known] / drawn.alpha[known] - images.depth_m[known]
        shown = np.exp(fit.exposure[0]) * drawn.color[opaque] + fit.exposure[1]
        of_gray = (shown - images.color[opaque] * np.float32(1 / 255)).mean(axis=-1)
        sigmas = [mad_sigma(r) if r.size else 0.0 for r in (of_depth, of_gray)]
        return sigmas[0], sigmas[1]


class RenderingTracker(OtherTracker):
    """Tracks frames by the rendered map, which grows at keyframes."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: FrontendConfig,
        read: ReadFrame,
        *,
        seed: int = 0,
        threads: SupportsIndex = 1,
    ) -> None:
        """Begin without a keyframe.

        Args:
            camera: of all frames.
            config: of the front end.
            read: gives a frame of the log by its index.
            seed: of the run, for the map.
            threads: of the rasterizer; changes no bit.
        """
        settings = config.tracking.rendering
        super().__init__(camera, config, read, settings)
        self._halvings, small = 0, camera
        while small.width * small.height > settings.max_pixels:
            small, self._halvings = small.halved(), self._halvings + 1
        mapping = config.mapping.model_copy(
            update={
                "max_gaussians": settings.max_gaussians,
                "iterations": settings.keyframe_steps,
                "iterations_level": 0,
            }
        )
        self._mapper = Mapper(small, mapping, seed, threads=threads)
        loss = LossWeights(**mapping.loss.of(self._mapper.depth).model_dump())
        self._fit = PoseFit(small, settings, loss, threads=threads)
        self._exposure = (0.0, 0.0)
        self._exposures: list[tuple[float, float]] = []  # of the keyframes

    def place(self, images: RgbdImages, T_map_predicted: Array) -> Placed | Reason:
        """Where the map looks as the frame does, from the prediction on.

        Args:
            images: of the frame.
            T_map_predicted: [4, 4], by constant velocity.
        """
        if images.mask is not None and not images.mask.any():
            return Reason.NO_PIXEL
        small, gaussians, depth = self._small(images), self._mapper.gaussians, self._mapper.depth
        fit = self._fit.run(gaussians, depth, small, T_map_predicted, exposure=self._exposure)
        if fit is None:
            return Reason.LOW_OVERLAP
        self._exposure = fit.exposure
        return Placed(fit.T_map_camera, *self._fit.residuals(gaussians, depth, small, fit))

    def take(self, images: RgbdImages, T_map_camera: Array, keyframe: int | None) -> None:
        """Let the map grow by a keyframe; other frames change nothing.

        Args:
            images: of the frame.
            T_map_camera: [4, 4].
            keyframe: its index if it became one.
        """
        if keyframe is not None:
            self._exposures.append(self._exposure)
            self._mapper.add_keyframe(keyframe, self._posed(images, T_map_camera, self._exposure))

    def map_state(self) -> Any:
        """The map and the last exposure; images of keyframes are read again."""
        return self._mapper.state(), self._exposure, self._exposures

    def go_on_with(self, state: Any) -> None:
        """Go on from another map.

        Args:
            state: of that map.
        """
        of_map, self._exposure, self._exposures = state
        for keyframe, exposure in zip(self._keyframes, self._exposures, strict=True):
            images = RgbdImages.of(self.read(keyframe.frame_index))
            posed = self._posed(images, keyframe.T_map_keyframe, exposure)
            self._mapper.put_back(keyframe.keyframe_index, posed)
        self._mapper.go_on(of_map)

    def _posed(self, images: RgbdImages, T_map_camera: Array, exposure: tuple[float, float]) -> PosedRgbd:
        """A frame in the size of the map."""
        small = self._small(images)
        return PosedRgbd(
            small.color, small.depth_m, T_map_camera, small.mask, small.depth_sigma_m, _exposure_of(exposure)
        )

    def _small(self, images: RgbdImages) -> FitImages:
        return FitImages.of(images, self._halvings)


def _exposure_of(exposure: tuple[float, float]) -> Exposure:
    """Log gain and offset of all channels."""
    gain, offset = np.exp(exposure[0]), exposure[1]
    return Exposure(np.full(3, gain), np.full(3, offset), np.full(3, (1 - offset) / gain))
