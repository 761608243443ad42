"""Ray casting: exact depth at the pixel centers, color averaged over the pixel's area.

A flat surface seen by a pinhole camera has an inverse depth D = 1/z that is linear in the pixel (u, v), and so are
s D and t D of its coordinates (s, t). Visibility is a maximum of D over surfaces, in float64, at pixel centers.
Color takes 2 x 2 samples of the surface at the center, or, next to a border between surfaces, 4 x 4 samples of
whatever each of them hits; textures are read at the mip level whose texels are as large as the samples are apart.
Pixels of flat surfaces, which most are, are drawn by compiled code (src/flat_surfaces.h); the others as below, which
gives the same bits for all.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.converters.simulate.render.bake import Atlas
from duagc.converters.simulate.scenes.scene import Ball, Flat, Scene, Side, Surface
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

try:
    from duagc.converters.simulate.render import _flat_surfaces
except ImportError as error:
    raise ImportError(
        f"the compiled room: {error}, expected the module that `make setup` or `pip install .` builds",
        name="duagc.converters.simulate.render._flat_surfaces",
    ) from error

NEAR_M = 0.05
EDGE_TOLERANCE_M = 1e-9  # rays that pass exactly between two faces of a box hit one of them
FINEST_STEP2 = 4.0  # squared texels
RECTANGLE, DISC, CURVED = range(3)  # kinds of surfaces
INSIDE_OFFSETS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
BORDER_OFFSETS = np.array(
    [(x, y) for y in (-0.375, -0.125, 0.125, 0.375) for x in (-0.375, -0.125, 0.125, 0.375)]
)


@dataclass(frozen=True)
class RenderedView:
    """What a camera sees: color uint8 [h, w, 3] RGB; depth float64 [h, w], z in m, 0 = nothing; surface its index."""

    color: NDArray[np.uint8]
    depth: Array
    surface: NDArray[np.integer]


class CameraRenderer(Protocol):
    """Renders one scene with one camera."""

    camera: PinholeCamera

    def depth(self, T_world_camera: ArrayLike) -> tuple[Array, Any]:
        """Depth (z, m, [h, w]; 0 = nothing) at the pixel centers, and what is seen there (-1 = nothing)."""

    def render(self, T_world_camera: ArrayLike) -> RenderedView:
        """Color and depth from a camera pose T_world_camera [4, 4]."""


class Renderer:
    """Renders one baked scene with one camera."""

    def __init__(
        self, scene: Scene, atlas: Atlas | None, camera: PinholeCamera, *, isa: str = "auto"
    ) -> None:
        """Initialize.

        Args:
            scene: what is seen.
            atlas: its colors; None: depth alone is rendered.
            camera: that sees it.
            isa: how colors are drawn, which changes no bit: "fused" or "portable", compiled, "auto", the faster of
                these, or "numpy".
        """
        self.camera, self.atlas, self.isa = camera, atlas, isa
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
        self.round = np.zeros(len(self.surfaces), dtype=bool)
        self.round[self.flat] = [s.round for s in flats]
        self.is_curved = np.zeros(len(self.surfaces), dtype=bool)
        self.is_curved[self.curved] = True
        self.period = np.zeros(len(self.surfaces))
        self.period[self.curved] = [self.surfaces[k].size[0] for k in self.curved]
        self.kind = np.where(self.is_curved, CURVED, np.where(self.round, DISC, RECTANGLE)).astype(np.uint8)
        self.curved_faces = np.array([_faces_around(self.surfaces[k]) for k in self.curved])
        self.u = np.arange(camera.width, dtype=np.float64)
        self.v = np.arange(camera.height, dtype=np.float64)

    def depth(self, T_world_camera: ArrayLike) -> tuple[Array, NDArray[np.int16]]:
        """Exact depth (z, m, [h, w]; 0 = nothing) and index of the surface seen (-1 = nothing) at pixel centers."""
        inverse, surface = self._nearest(_Pose(self, T_world_camera))
        depth = np.zeros_like(inverse)
        np.divide(1.0, inverse, out=depth, where=inverse > 0)
        return depth, surface

    def render(self, T_world_camera: ArrayLike) -> RenderedView:
        """Color and exact depth from a camera pose T_world_camera [4, 4]."""
        pose = _Pose(self, T_world_camera)
        inverse, surface = self._nearest(pose)
        depth = np.zeros_like(inverse)
        np.divide(1.0, inverse, out=depth, where=inverse > 0)
        return RenderedView(self._colors(pose, surface), depth, surface)

    def _colors(self, pose: "_Pose", surface: NDArray[np.int16]) -> NDArray[np.uint8]:
        """Colors [h, w, 3] of an image of surfaces."""
        assert self.atlas is not None
        image = np.zeros((*surface.shape, 3), dtype=np.uint8)
        left, step2 = np.zeros(surface.shape, dtype=np.uint8), np.zeros(surface.shape, dtype=np.float32)
        if self.isa == "numpy":
            left[:] = 1
            self._color_others(pose, surface, left, image)
            return image
        of_scene = self.isa, pose.linear, self.extent, self.kind, self.atlas.origin
        levels, scale = self.atlas.levels, 1 / self.atlas.texel_m
        _flat_surfaces.colors(
            *of_scene, seen=surface, texels=levels[0], scale=scale, color=image, step2=step2, left=left
        )
        far = np.flatnonzero(step2 > FINEST_STEP2)
        if far.size:
            level = self._level(step2.ravel()[far])
            _flat_surfaces.colors_between(
                *of_scene, seen=surface, texels=levels, scale=scale, pixels=far, level=level, color=image
            )
        if left.any():
            self._color_others(pose, surface, left, image)
        return image

    def _level(self, step2: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mip levels [n] for samples that are so far apart (squared, texels)."""
        assert self.atlas is not None
        return np.clip(0.5 * np.log2(step2) - 1, 0, len(self.atlas.levels) - 1.001).astype(np.float32)

    def _color_others(
        self, pose: "_Pose", surface: NDArray[np.int16], left: NDArray[np.uint8], image: NDArray[np.uint8]
    ) -> None:
        """Color the pixels of an image that are left."""
        window = np.ones((3, 3), dtype=np.uint8)
        border = cv2.dilate(surface, window) != cv2.erode(surface, window)
        seen, color = surface.ravel(), image.reshape(-1, 3)
        inside = np.flatnonzero((left != 0) & ~border & (surface >= 0))
        if inside.size:
            inside = inside[np.argsort(seen[inside], kind="stable")]
            color[inside] = _rounded(self._inside(pose, inside, seen[inside]))
        at = np.flatnonzero((left != 0) & border)
        if at.size:
            color[at] = _rounded(self._border(pose, at, surface))

    def _nearest(self, pose: "_Pose") -> tuple[Array, NDArray[np.int16]]:
        """Greatest inverse depth and its surface at every pixel center."""
        nearest = np.zeros((self.camera.height, self.camera.width))
        surface = np.full(nearest.shape, -1, dtype=np.int16)
        order, windows = pose.flat_windows()
        isa = "auto" if self.isa == "numpy" else self.isa
        of_scene = isa, pose.linear, self.extent, self.kind
        _flat_surfaces.nearest(*of_scene, order=order, windows=windows, nearest=nearest, seen=surface)
        u, v = self.u, self.v[:, None]
        for k, (u0, v0, u1, v1) in pose.curved_windows():
            win = (slice(v0, v1), slice(u0, u1))
            inverse, _, _ = pose.curved(k, *np.broadcast_arrays(u[u0:u1], v[v0:v1]))
            hit = inverse > nearest[win]
            np.copyto(nearest[win], inverse, where=hit)
            surface[win][hit] = k
        return nearest, surface

    def _covers(self, k: int, inverse: Array, s_inverse: Array, t_inverse: Array) -> NDArray[np.bool_]:
        """Whether s D, t D lie on flat surface k."""
        width, height = self.extent[k]
        if self.round[k]:
            r = width / 2
            return (s_inverse - r * inverse) ** 2 + (t_inverse - r * inverse) ** 2 <= (r * inverse) ** 2
        slack = EDGE_TOLERANCE_M * inverse
        hit = s_inverse >= -slack
        hit &= s_inverse <= width * inverse + slack
        hit &= t_inverse >= -slack
        hit &= t_inverse <= height * inverse + slack
        return hit

    def _inside(
        self, pose: "_Pose", at: NDArray[np.int64], surface: NDArray[np.int16]
    ) -> NDArray[np.float32]:
        """Mean colors [n, 3] of pixels that one surface fills; `at` are their flat indices, surface by surface."""
        assert self.atlas is not None
        v, u = self.v[at // self.camera.width], self.u[at % self.camera.width]
        x, y = np.empty((4, at.size), dtype=np.float32), np.empty((4, at.size), dtype=np.float32)
        scale = 1 / self.atlas.texel_m
        for k, part in _runs(surface):
            if self.is_curved[k]:
                x[:, part], y[:, part] = self._curved_inside(pose, k, u[part], v[part])
                continue
            c = pose.linear[k][:, :, None]
            center = c[:, 0] * u[part] + (c[:, 1] * v[part] + c[:, 2])
            for i, (du, dv) in enumerate(INSIDE_OFFSETS):
                inverse, *st = center + (du * c[:, 0] + dv * c[:, 1])
                z = scale / inverse
                for out, at_surface, origin in zip((x, y), st, self.atlas.origin[k], strict=True):
                    at_surface *= z
                    at_surface += origin
                    out[i, part] = at_surface
        return self._filtered(x, y)

    def _curved_inside(self, pose: "_Pose", k: int, u: Array, v: Array) -> tuple[Array, Array]:
        """Texels (x, y) [4, n] of the four samples of pixels that curved surface k fills."""
        assert self.atlas is not None
        du, dv = np.array(INSIDE_OFFSETS).T[:, :, None]
        inverse, s, t = pose.curved(k, u + du, v + dv)
        middle = pose.curved(k, u, v)
        missed = inverse <= 0
        s, t = np.where(missed, middle[1], s), np.where(missed, middle[2], t)
        s = middle[1] + _wrapped(s - middle[1], self.period[k])
        xy = self.atlas.origin[k][:, None, None] + np.stack([s, t]) / self.atlas.texel_m
        return xy[0], xy[1]

    def _filtered(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean colors [n, 3] of four samples each at texels x, y [4, n], half a pixel apart."""
        assert self.atlas is not None
        n = x.shape[1]
        step = np.maximum((x[1] - x[0]) ** 2 + (y[1] - y[0]) ** 2, (x[2] - x[0]) ** 2 + (y[2] - y[0]) ** 2)
        mean = np.empty((n, 3), dtype=np.float32)
        fine = step <= FINEST_STEP2  # the finest level holds nothing that samples two texels apart would miss
        far = np.flatnonzero(~fine)
        if not far.size:
            return self._mean_of_four(0, x, y)
        near = np.flatnonzero(fine)
        mean[near] = self._mean_of_four(0, x[:, near], y[:, near])
        level = self._level(step[far])
        whole = level.astype(np.int64)
        for k in range(len(self.atlas.levels) - 1):
            some = np.flatnonzero(whole == k)
            if some.size:
                index = far[some]
                blend = (level[some] - k)[:, None]
                texels = x[:, index], y[:, index]
                finer, coarser = self._mean_of_four(k, *texels), self._mean_of_four(k + 1, *texels)
                mean[index] = (1 - blend) * finer + blend * coarser
        return mean

    def _mean_of_four(
        self, level: int, x: NDArray[np.float32], y: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Mean colors [n, 3] of four samples each at texels x, y [4, n]."""
        assert self.atlas is not None
        samples = self.atlas.sample(level, x.ravel(), y.ravel()).reshape(4, -1, 3)
        total = np.add(samples[0], samples[1], dtype=np.uint16)
        total += samples[2]
        total += samples[3]
        return total * np.float32(0.25)

    def _border(
        self, pose: "_Pose", at: NDArray[np.int64], surface: NDArray[np.int16]
    ) -> NDArray[np.float32]:
        """Mean colors [n, 3] of pixels near a border: 4 x 4 samples, each of the nearest of the surfaces around."""
        assert self.atlas is not None
        v, u = np.divmod(at, self.camera.width)
        padded = np.pad(surface, 1, mode="edge")
        around = np.stack([padded[v + dv, u + du] for dv in range(3) for du in range(3)], axis=1)
        around.sort(axis=1)
        around[:, 1:][around[:, 1:] == around[:, :-1]] = -1
        pixel, column = np.nonzero(around >= 0)
        candidate = around[pixel, column]
        order = np.argsort(candidate, kind="stable")
        pixel, candidate = pixel[order], candidate[order]
        n = at.size
        best = np.zeros((n, 16))
        x, y = np.zeros((n, 16), dtype=np.float32), np.zeros((n, 16), dtype=np.float32)
        scale = 1 / self.atlas.texel_m
        for k, part in _runs(candidate):
            some = pixel[part]
            us, vs = u[some, None] + BORDER_OFFSETS[:, 0], v[some, None] + BORDER_OFFSETS[:, 1]
            nearest = best[some]
            if self.is_curved[k]:
                inverse, s, t = pose.curved(k, us, vs)
                hit = inverse > nearest
                s *= scale
                t *= scale
            else:
                inverse, s, t = (c[0] * us + (c[1] * vs + c[2]) for c in pose.linear[k])
                hit = inverse > nearest
                hit &= self._covers(k, inverse, s, t)
                with np.errstate(divide="ignore", invalid="ignore"):
                    z = scale / inverse
                    s *= z
                    t *= z
            best[some] = np.where(hit, inverse, nearest)
            for out, at_surface, origin in zip((x, y), (s, t), self.atlas.origin[k], strict=True):
                at_surface += origin
                texel = out[some]
                np.copyto(texel, at_surface, where=hit, casting="same_kind")
                out[some] = texel
        found = best.T > 0
        samples = self.atlas.sample(0, x.T.ravel(), y.T.ravel()).reshape(16, n, 3)
        samples[~found] = 0
        total = np.add.reduce(samples, axis=0, dtype=np.uint16)
        return (total / np.maximum(found.sum(axis=0), 1)[:, None]).astype(np.float32)


class _Pose:
    """The surfaces of a renderer seen from one pose.

    linear [n surfaces, 3, 3]: coefficients (of u, of v, constant) of D, s D and t D; flat surfaces only.
    """

    def __init__(self, renderer: Renderer, T_world_camera: ArrayLike) -> None:
        T = np.asarray(T_world_camera, dtype=np.float64)
        self.renderer, self.camera = renderer, renderer.camera
        self.R, self.center = T[:3, :3], T[:3, 3]
        self.rays = self.R @ np.linalg.inv(self.camera.matrix())
        to_corner = renderer.corner - self.center
        ahead = np.sum(renderer.normal * to_corner, axis=1)
        self.faces = ahead < -1e-6
        D = (renderer.normal @ self.rays) / np.where(self.faces, ahead, -1.0)[:, None]
        s = renderer.axis_s @ self.rays - np.sum(renderer.axis_s * to_corner, axis=1)[:, None] * D
        t = renderer.axis_t @ self.rays - np.sum(renderer.axis_t * to_corner, axis=1)[:, None] * D
        self.linear = np.zeros((len(renderer.surfaces), 3, 3))
        self.linear[renderer.flat] = np.stack([D, s, t], axis=1)

    def flat_windows(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Flat surfaces [n] that may be seen, nearest corner first, and pixels (u0, v0, u1, v1) [n, 4] around each."""
        r = self.renderer
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
        r = self.renderer
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
        """Inverse depth (0 where missed) and surface coordinates of curved surface k at pixels of any shape."""
        surface = self.renderer.surfaces[k]
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


def _rounded(color: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(color), 0, 255).astype(np.uint8)


def _runs(values: NDArray[np.int16]) -> Iterator[tuple[int, slice]]:
    """Every value of a sorted array, and where it stands."""
    starts = np.flatnonzero(np.diff(values, prepend=-1)).tolist()
    for first, last in zip(starts, [*starts[1:], len(values)], strict=True):
        yield int(values[first]), slice(first, last)


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


def _wrapped(difference: Array, period: float) -> Array:
    """A difference of positions on a circle, between minus and plus half its length."""
    return difference - period * np.rint(difference / period)
