"""Frames registered to the map: a second registration of frames that are no keyframes.

Tracking registers a frame to one keyframe, whose depth image has the noise of one view. The map is made of all
keyframes. Drawn where a frame was tracked, with the depth of one layer per pixel, it is a better reference
where the sensor is poor, and a worse one where depth is exact and the map is not. What decides is the information of
either registration. Keyframes stay where their joint optimization put them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import ModelConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.frontend.tracked import TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.recording import RgbdFrame
from duagc.pipeline.registration import Reference, Registration, RegistrationConfig, RgbdPyramid, register
from duagc.pipeline.splat.gaussians import Gaussians


class ModelTracker:
    """Registers frames to a map that does not change."""

    def __init__(
        self,
        gaussians: Gaussians,
        depth: DepthKind,
        camera: PinholeCamera,
        config: ModelConfig,
        *,
        registration: RegistrationConfig,
        threads: int = 1,
    ) -> None:
        """Prepare the map.

        Args:
            gaussians: in the map frame.
            depth: of a Gaussian at a pixel, as the map was made.
            camera: of the frames.
            config: how the map is drawn and when a frame is moved.
            registration: settings of the registrations.
            threads: of the rasterizer; changes no bit.
        """
        self.config, self._registration = config, registration
        self._gaussians, self._depth, self._full = gaussians, depth, camera
        self._camera = camera
        for _ in range(config.level):
            self._camera = self._camera.halved()
        self._levels = max(1, len(registration.iterations) - config.level)
        self._rasterizer = Rasterizer(threads=threads)
        self._unchanged = 0  # frames in a row that were not moved

    @property
    def worthwhile(self) -> bool:
        """Whether some of the last frames were moved; if none was, the others need not be tried."""
        return self.config.enabled and self._unchanged < self.config.patience

    def register(self, tracked: TrackedFrame, frame: RgbdFrame, T_map_keyframe: Array) -> TrackedFrame:
        """Register a frame to the map, with its tracked pose as the prior.

        It stays as tracked if the map determines the pose much less well: its errors are not all noise.

        Its information stays that of tracking: map and frame share keyframes, so that adding would count them twice.

        Args:
            tracked: not lost, and no keyframe.
            frame: its images.
            T_map_keyframe: [4, 4], of the keyframe that it is anchored to.
        """
        found = self._register(frame, T_map_keyframe @ tracked.T_keyframe_camera, tracked.information)
        if not found.ok or _sigma_m(found.information) > self.config.max_sigma_ratio * _sigma_m(
            tracked.information
        ):
            self._unchanged += 1
            return tracked
        self._unchanged = 0
        return replace(tracked, T_keyframe_camera=tracked.T_keyframe_camera @ found.T_reference_target)

    def register_color(self, tracked: TrackedFrame, frame: RgbdFrame, T_map_keyframe: Array) -> TrackedFrame:
        """Register the color of a frame without depth of its own to the map, which has depth wherever it was drawn.

        What followed it before was the depth of another frame, and the error grew from frame to frame.

        Args:
            tracked: by its color alone.
            frame: its images.
            T_map_keyframe: [4, 4], of the keyframe that it is anchored to.
        """
        if not self.config.color_only:
            return tracked
        found = self._register(frame, T_map_keyframe @ tracked.T_keyframe_camera, tracked.information)
        if not found.ok:
            return tracked
        return replace(tracked, T_keyframe_camera=tracked.T_keyframe_camera @ found.T_reference_target)

    def _register(self, frame: RgbdFrame, T_map_camera: Array, information: Array) -> Registration:
        """The frame against the map drawn at T_map_camera, known with `information`; the motion is from there."""
        drawn = self._rasterizer.forward(
            self._gaussians, self._camera, se3.inverse(T_map_camera), depth_kind=self._depth
        )
        solid = drawn.alpha > self.config.min_alpha
        depth_m = np.where(solid, self._rasterizer.layer_depth(), np.float32(0))
        color = np.clip(drawn.color, np.float32(0), np.float32(1))
        model = RgbdPyramid.build(color, depth_m, self._camera, self._levels)
        reference = Reference.from_pyramid(model, self.config.strides[: self._levels])
        seen = pyramid_of(frame, self._full, self._levels + self.config.level)
        target = RgbdPyramid(seen.levels[self.config.level :])
        return register(reference, target, np.eye(4), self._registration, prior_information=information)


def _sigma_m(information: Array) -> float:
    """Standard deviation of a position, meters, from the information [6, 6] of a pose; infinite if not determined."""
    values = np.linalg.eigvalsh(information)
    if not values[0] > 1e-12 * values[-1]:
        return np.inf
    return float(np.sqrt(np.trace(np.linalg.inv(information)[:3, :3])))
