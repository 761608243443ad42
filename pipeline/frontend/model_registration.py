"""Frames registered to the finished map, by their color.

Tracking registers a frame to one keyframe, whose depth image has the noise of one view, and the depth of the frame
itself has that of another one, which need not fit the color to the pixel. The map is made of many views and has depth
wherever it is drawn. Where the sensor's depth is not exact, color against the drawn map says better where a frame was.
What tracking knew is the prior. The frames that made the map stay where its optimization put them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import SupportsIndex

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import ModelConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.image_motion import nearby_cameras
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.recording import RgbdFrame, RgbdLog
from duagc.pipeline.registration import Reference, RegistrationConfig, RgbdPyramid, register
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.training_frames import seen_distance_m


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
        threads: SupportsIndex = 1,
    ) -> None:
        """Prepare the map.

        Args:
            gaussians: in the map frame.
            depth: of a Gaussian at a pixel, as the map was made.
            camera: of the frames.
            config: how the map is drawn.
            registration: settings of the registrations.
            threads: of the rasterizer; changes no bit.
        """
        self.config, self._registration = config, registration
        self._gaussians, self._depth, self._full = gaussians, depth, camera
        self._camera, self._halvings = camera, 0
        while self._camera.width * self._camera.height > config.max_pixels:
            self._camera, self._halvings = self._camera.halved(), self._halvings + 1
        self._levels = max(1, len(registration.iterations) - self._halvings)
        self._rasterizer = Rasterizer(threads=threads)
        self._last: tuple[bytes, Reference] | None = None

    def registration_of(
        self, frames: Iterable[TrackedFrame], T_map_keyframe: Array, log: RgbdLog
    ) -> Callable[[TrackedFrame], TrackedFrame]:
        """What registers frames one by one; those stay as tracked whose color does not say more, and all others.

        Args:
            frames: in order of time, without those that made the map.
            T_map_keyframe: [k, 4, 4], of the keyframes that they are anchored to.
            log: that has their color.
        """
        T_map_view = self._views_of(frames, T_map_keyframe)

        def registered(frame: TrackedFrame) -> TrackedFrame:
            if frame.frame_index not in T_map_view:
                return frame
            color = log.frame(frame.frame_index, depth=False)
            anchor = T_map_keyframe[frame.keyframe_index]
            return self.register(frame, color, anchor, T_map_view[frame.frame_index])

        return registered

    def _views_of(self, frames: Iterable[TrackedFrame], T_map_keyframe: Array) -> dict[int, Array]:
        """Where the map is drawn, [4, 4] by frame index, for frames whose color may say more than tracking."""
        reasons = {Reason.NO_DEPTH} if self._depth == "ray_plane" else {Reason.NO_DEPTH, Reason.NONE}
        worth = [frame for frame in frames if frame.status is not Status.LOST and frame.reason in reasons]
        placed = [T_map_keyframe[frame.keyframe_index] @ frame.T_keyframe_camera for frame in worth]
        distance_m = seen_distance_m(self._gaussians, T_map_keyframe)
        drawn = self.drawn_from(np.array(placed).reshape(-1, 4, 4), distance_m)
        return {frame.frame_index: T for frame, T in zip(worth, drawn, strict=True)}

    def drawn_from(self, T_map_camera: Array, distance_m: float) -> Array:
        """Where the map is drawn for frames, [n, 4, 4]: once for all that see nearly the same.

        Args:
            T_map_camera: [n, 4, 4], of the frames, in order of time.
            distance_m: of what they see.
        """
        most_rad = self.config.shared_view * self._full.width / self._full.fx
        return T_map_camera[nearby_cameras(T_map_camera, distance_m, most_rad)]

    def register(
        self,
        tracked: TrackedFrame,
        frame: RgbdFrame,
        T_map_keyframe: Array,
        T_map_view: Array | None = None,
    ) -> TrackedFrame:
        """Register the color of a frame to the map, with its tracked pose as the prior.

        It stays as tracked if the registration fails. Its information stays that of tracking: map and frame share
        keyframes, so that adding would count them twice.

        Args:
            tracked: not lost.
            frame: its color; no depth is needed.
            T_map_keyframe: [4, 4], of the keyframe that it is anchored to.
            T_map_view: [4, 4], where the map is drawn; None: where the frame is.
        """
        T_map_camera = T_map_keyframe @ tracked.T_keyframe_camera
        T_map_view = T_map_camera if T_map_view is None else T_map_view
        T_view_camera = se3.inverse(T_map_view) @ T_map_camera
        seen = pyramid_of(frame, self._full, self._levels + self._halvings)
        found = register(
            self._drawn(T_map_view),
            RgbdPyramid(seen.levels[self._halvings :]).without_depth(),
            T_view_camera,
            self._registration,
            prior_information=tracked.information,
        )
        if not found.ok:
            return tracked
        moved = se3.inverse(T_view_camera) @ found.T_reference_target
        return replace(tracked, T_keyframe_camera=tracked.T_keyframe_camera @ moved)

    def _drawn(self, T_map_view: Array) -> Reference:
        """The map as a camera sees it; that of the last time is kept."""
        place = T_map_view.tobytes()
        if self._last is None or self._last[0] != place:
            self._last = place, self._reference(T_map_view)
        return self._last[1]

    def _reference(self, T_map_camera: Array) -> Reference:
        drawn, layer_m = self._rasterizer.forward_with_layer(
            self._gaussians, self._camera, se3.inverse(T_map_camera), depth_kind=self._depth
        )
        depth_m = np.where(drawn.alpha > self.config.min_alpha, layer_m, np.float32(0))
        color = np.clip(drawn.color, np.float32(0), np.float32(1))
        pyramid = RgbdPyramid.build(color, depth_m, self._camera, self._levels)
        return Reference.from_pyramid(pyramid, self.config.strides[: self._levels])
