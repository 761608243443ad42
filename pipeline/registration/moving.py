"""Moving objects: surfaces in space that other views saw to be free.

In a rigid world a surface is in front of no other surface in any view that could see it: a point that a second view
looks through was not there at that time, or is not there any more. One view may err, so several must agree, and a
region must be of some size. What moves by less than the gate, or does not move in most views of its place, is missed.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import chance_difference, inverse_or_zero
from duagc.pipeline.geometry.masks import large_regions
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.kernels.free_space import free_space
from duagc.pipeline.kernels.free_space_definition import FREE, ON_SURFACE
from duagc.pipeline.registration.pyramid import Level

Image = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _View:
    T_map_camera: Array
    inverse_depth: Image
    nearest: Image  # largest inverse depth of 3x3 pixels
    inverse_depth_sigma: float  # standard deviation of the inverse depth of what is far, 1/m
    center_map: Array


class FreeSpace:
    """Space that a set of views of one camera saw to be free."""

    def __init__(self, camera: PinholeCamera, config: MovingConfig) -> None:
        """Begin without a view.

        Args:
            camera: of all views.
            config: gates, number of views, sizes.
        """
        self.config, self._camera = config, camera
        self._small = camera
        for _ in range(config.halvings):
            self._small = self._small.halved()
        self._views: list[_View] = []
        # T_map_camera and center_map of the views, a row each
        self._poses, self._centers = np.zeros((0, 16)), np.zeros((0, 3))
        self._known: dict[tuple[int, bytes], bytes | None] = {}

    def add(self, depth_m: Image, T_map_camera: Array) -> None:
        """Take a view.

        Args:
            depth_m: [h, w], meters, 0 = unknown or masked.
            T_map_camera: [4, 4].
        """
        self._known = {}
        if self.config.enabled:
            view = self._view(depth_m, T_map_camera)
            self._views.append(SHELF.put(view))
            self._poses = np.concatenate([self._poses, view.T_map_camera.reshape(1, 16)])
            self._centers = np.concatenate([self._centers, view.center_map[None]])

    def moving(self, depth_m: Image, T_map_camera: Array) -> Mask:
        """Pixels [h, w] of a view that show what was not there in other views of the set; it may be one of them.

        Args:
            depth_m: [h, w], meters, 0 = unknown or masked.
            T_map_camera: [4, 4].
        """
        view = self._view(depth_m, T_map_camera)
        v, u = np.nonzero(view.inverse_depth)
        through, there = np.zeros(len(v), np.int32), np.zeros(len(v), np.int32)
        z = 1 / view.inverse_depth[v, u].astype(np.float64)
        points_map = se3.transform(view.T_map_camera, back_project(self._small, u, v, z))
        for other in self._nearest(view):
            where = free_space(
                points_map,
                se3.inverse(other.T_map_camera),
                other.nearest,
                self._small,
                gate_m=self.config.gate_m,
                gate_relative=self.config.gate_relative,
                gate_inverse=chance_difference(view.inverse_depth_sigma, other.inverse_depth_sigma),
            )
            through += where == FREE
            there += where == ON_SURFACE
        found = np.zeros(view.inverse_depth.shape, bool)
        found[v, u] = (through >= self.config.min_views) & (through > there)
        return self._regions(found)

    def usable(
        self, depth_m: Image, T_map_camera: Array, mask: Mask | None, *, index: int | None = None
    ) -> Mask | None:
        """The pixels of a mask that show nothing that moved, bool [h, w]; None = all.

        Args:
            depth_m: [h, w], meters, 0 = unknown or masked.
            T_map_camera: [4, 4].
            mask: bool [h, w]; None = all.
            index: of the frame: what moves in it at this pose is kept until a view is added; None: it is not kept.
        """
        if not self.config.enabled:
            return mask
        moving = self._moving(depth_m, T_map_camera, index)
        if moving is None:
            return mask
        return ~moving if mask is None else mask & ~moving

    def _moving(self, depth_m: Image, T_map_camera: Array, index: int | None) -> Mask | None:
        """What moves in a frame; None: nothing."""
        key = None if index is None else (index, np.asarray(T_map_camera, dtype=np.float64).tobytes())
        if key is not None and key in self._known:
            packed = self._known[key]
            if packed is None:
                return None
            bits = np.unpackbits(np.frombuffer(zlib.decompress(packed), np.uint8), count=depth_m.size)
            return bits.reshape(depth_m.shape).astype(bool)
        moving = self.moving(depth_m, T_map_camera)
        found = moving if moving.any() else None
        if key is not None:
            self._known[key] = None if found is None else zlib.compress(np.packbits(found).tobytes(), 1)
        return found

    def _view(self, depth_m: Image, T_map_camera: Array) -> _View:
        inverse = inverse_or_zero(depth_m).astype(np.float32)
        level = Level(self._camera, inverse, inverse)
        for _ in range(self.config.halvings):
            level = level.halved()
        small = level.inverse_depth
        center = np.zeros(3)
        v, u = np.nonzero(small)
        if len(v):
            center = np.median(back_project(self._small, u, v, 1 / small[v, u].astype(np.float64)), axis=0)
        T = np.array(T_map_camera, dtype=np.float64)
        return _View(T, small, level.nearest, level.inverse_depth_sigma, se3.transform(T, center[None])[0])

    def _nearest(self, view: _View) -> list[_View]:
        """The views that look at the nearest places, itself excepted."""
        others = np.flatnonzero((self._poses != view.T_map_camera.reshape(16)).any(axis=1))
        if len(others) > self.config.views:
            distance = np.linalg.norm(self._centers[others] - view.center_map, axis=1)
            others = others[np.argsort(distance, kind="stable")[: self.config.views]]
        return [self._views[k] for k in others]

    def _regions(self, found: Mask) -> Mask:
        """Connected regions that are large enough, enlarged, at full size."""
        import cv2

        full, scale = np.zeros((self._camera.height, self._camera.width), bool), 2**self.config.halvings
        grown = large_regions(found, self.config.min_region)
        if not grown.any():
            return full
        if steps := self.config.grow_px // scale:
            grown = cv2.dilate(grown.view(np.uint8), np.ones((3, 3)), iterations=steps).astype(bool)
        whole = grown.repeat(scale, axis=0).repeat(scale, axis=1)
        full[: whole.shape[0], : whole.shape[1]] = whole
        return full
