"""The surfaces of a scene as arrays, and how a camera sees them from one pose."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.converters.simulate.scenes.scene import Ball, Flat, Scene, Side, Surface
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

NEAR_M = 0.05
RECTANGLE, DISC, CURVED = range(3)  # kinds of surfaces


class SurfaceArrays:
    """The surfaces of a scene.

    Attributes:
        surfaces: all of them.
        flat: indices [m] of the flat ones, of which corner, axis_s, axis_t and normal are, [m, 3] each, m, world.
        curved: indices of the others.
        extent: width and height of each, m, [n, 2]; 0 of curved ones.
        kind: of each, RECTANGLE, DISC or CURVED, [n].
        period: circumference of each curved one, m, [n]; 0 of flat ones.
        curved_faces: corners of a box around each curved one, m, world, [len(curved), 6, 4, 3].
    """

    def __init__(self, scene: Scene) -> None:
        """Collect the geometry of all surfaces, and put a box around each curved one.

        Args:
            scene: with the surfaces.
        """
        self.surfaces = scene.surfaces
        self.flat = np.array([k for k, s in enumerate(self.surfaces) if isinstance(s, Flat)])
        self.curved = [k for k, s in enumerate(self.surfaces) if not isinstance(s, Flat)]
        flats = [s for s in self.surfaces if isinstance(s, Flat)]
        self.corner = np.stack([s.corner for s in flats])
        self.axis_s = np.stack([s.axis_s for s in flats])
        self.axis_t = np.stack([s.axis_t for s in flats])
        self.normal = np.stack([s.normal for s in flats])
        self.extent = np.zeros((len(self.surfaces), 2))
        self.extent[self.flat] = [s.size for s in flats]
        self.kind = np.full(len(self.surfaces), CURVED, dtype=np.uint8)
        self.kind[self.flat] = [DISC if s.round else RECTANGLE for s in flats]
        self.period = np.zeros(len(self.surfaces))
        self.period[self.curved] = [self.surfaces[k].size[0] for k in self.curved]
        self.curved_faces = np.array([_faces_around(self.surfaces[k]) for k in self.curved])


class SurfacesFromPose:
    """The surfaces of a scene as a camera sees them from one pose.

    Attributes:
        linear: coefficients (of u, of v, constant) of D, s D and t D, [n, 3, 3]; flat surfaces only.
    """

    def __init__(self, scene: SurfaceArrays, camera: PinholeCamera, T_world_camera: ArrayLike) -> None:
        """Find the flat surfaces that face the camera, and compute the coefficients of all flat ones.

        Args:
            scene: the surfaces.
            camera: that sees them.
            T_world_camera: its pose, [4, 4].
        """
        T = np.asarray(T_world_camera, dtype=np.float64)
        self.scene, self.camera = scene, camera
        self.R, self.center = T[:3, :3], T[:3, 3]
        self.rays = self.R @ np.linalg.inv(self.camera.matrix())
        to_corner = scene.corner - self.center
        ahead = np.sum(scene.normal * to_corner, axis=1)
        self.faces = ahead < -1e-6
        D = (scene.normal @ self.rays) / np.where(self.faces, ahead, -1.0)[:, None]
        s = scene.axis_s @ self.rays - np.sum(scene.axis_s * to_corner, axis=1)[:, None] * D
        t = scene.axis_t @ self.rays - np.sum(scene.axis_t * to_corner, axis=1)[:, None] * D
        self.linear = np.zeros((len(scene.surfaces), 3, 3))
        self.linear[scene.flat] = np.stack([D, s, t], axis=1)

    def flat_windows(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Flat surfaces [n] that may be seen, nearest corner first, and pixels (u0, v0, u1, v1) [n, 4] around each."""
        r = self.scene
        extent = r.extent[r.flat]
        unit = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
        corners = r.corner[:, None] + (unit[None, :, :1] * extent[:, None, :1]) * r.axis_s[:, None]
        corners = corners + (unit[None, :, 1:] * extent[:, None, 1:]) * r.axis_t[:, None]
        low, high, nearest = self._bounds(corners)
        window = self._window(low, high)
        seen = self.faces & (window[:, 0] < window[:, 2]) & (window[:, 1] < window[:, 3])
        order = np.flatnonzero(seen)
        order = order[np.argsort(nearest[order], kind="stable")]
        return r.flat[order].astype(np.int32), window[order].astype(np.int32)

    def _bounds(self, corners_world: Array) -> tuple[Array, Array, Array]:
        """Pixel bounds (low, high, [n, 2]) of convex polygons [n, m, 3] cut at the near plane, and their least z."""
        p = (corners_world - self.center) @ self.R
        z = p[..., 2]
        after = np.roll(p, -1, axis=1)
        step = after[..., 2] - z
        q = np.where(step == 0, 0.0, (NEAR_M - z) / np.where(step == 0, 1.0, step))
        crossing = (z < NEAR_M) != (after[..., 2] < NEAR_M)
        cut = p + q[..., None] * (after - p)
        points = np.concatenate([p, cut], axis=1)
        valid = np.concatenate([z >= NEAR_M, crossing], axis=1)
        pixels = self.camera.project(np.where(valid[..., None], points, (0.0, 0.0, 1.0)))
        low = np.where(valid[..., None], pixels, np.inf).min(axis=1)
        high = np.where(valid[..., None], pixels, -np.inf).max(axis=1)
        return low, high, z.min(axis=1)

    def _window(self, low: Array, high: Array) -> NDArray[np.int64]:
        """Pixels (u0, v0, u1, v1) [n, 4], clipped to the image; empty where low > high."""
        size = np.array([self.camera.width, self.camera.height])
        first = np.clip(np.ceil(np.clip(low, -1, size) - 1e-6), 0, size)
        last = np.clip(np.floor(np.clip(high, -1, size) + 1e-6) + 1, 0, size)
        return np.concatenate([first, last], axis=1).astype(np.int64)

    def curved_windows(self) -> list[tuple[int, tuple[int, int, int, int]]]:
        """Curved surfaces that may be seen, with the pixels (u0, v0, u1, v1) that bound them."""
        r = self.scene
        if not r.curved:
            return []
        # the six faces of a box around each as polygons, so that the near plane cuts them correctly
        low, high, _ = self._bounds(r.curved_faces.reshape(-1, 4, 3))
        window = self._window(low.reshape(-1, 6, 2).min(axis=1), high.reshape(-1, 6, 2).max(axis=1)).tolist()
        return [
            (k, (u0, v0, u1, v1))
            for k, (u0, v0, u1, v1) in zip(r.curved, window, strict=True)
            if u0 < u1 and v0 < v1
        ]

    def curved(self, k: int, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array, Array]:
        """Inverse depth (1/m, 0 where missed) and coordinates (s, t, m) of a curved surface at pixels.

        Args:
            k: index of the surface in the scene.
            u: columns [...].
            v: rows [...].
        """
        surface = self.scene.surfaces[k]
        pixels = np.stack([np.asarray(u, dtype=np.float64), np.asarray(v), np.ones(np.shape(u))], axis=-1)
        d = pixels @ self.rays.T
        if isinstance(surface, Side):
            p = self.center - surface.base
            a = d[..., 0] ** 2 + d[..., 1] ** 2
            b = p[0] * d[..., 0] + p[1] * d[..., 1]
            c = p[0] ** 2 + p[1] ** 2 - surface.radius**2
        else:
            assert isinstance(surface, Ball)
            p = self.center - surface.center
            a, b, c = np.sum(d**2, axis=-1), d @ p, p @ p - surface.radius**2
        root = b**2 - a * c
        z = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        q = p + z[..., None] * d
        s = np.mod(np.arctan2(q[..., 1], q[..., 0]), 2 * np.pi) * surface.radius
        if isinstance(surface, Side):
            t = surface.height - q[..., 2]
            hit = (root > 0) & (z > NEAR_M) & (t >= 0) & (t <= surface.height)
        else:
            t = np.arccos(np.clip(q[..., 2] / surface.radius, -1, 1)) * surface.radius
            hit = (root > 0) & (z > NEAR_M)
        return np.where(hit, 1 / np.where(hit, z, 1.0), 0.0), s, t


def _faces_around(surface: Surface) -> Array:
    """Corners [6, 4, 3] of the faces of a box around a curved surface."""
    if isinstance(surface, Side):
        half = np.array([surface.radius, surface.radius, surface.height / 2])
        center = surface.base + np.array([0, 0, surface.height / 2])
    else:
        assert isinstance(surface, Ball)
        half, center = np.full(3, surface.radius), surface.center
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    faces = [np.insert(signs, axis, side, axis=1) for axis in range(3) for side in (-1, 1)]
    return np.asarray(center + half * np.stack(faces))
