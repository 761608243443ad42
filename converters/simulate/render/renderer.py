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
from duagc.converters.simulate.render.surfaces import CURVED, DISC, SurfaceArrays, SurfacesFromPose
from duagc.converters.simulate.scenes.scene import Scene
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

try:
    from duagc.converters.simulate.render import _flat_surfaces
except ImportError as error:
    raise ImportError(
        f"the compiled room: {error}, expected the module that `make setup` or `pip install .` builds",
        name="duagc.converters.simulate.render._flat_surfaces",
    ) from error

EDGE_TOLERANCE_M = 1e-9  # rays that pass exactly between two faces of a box hit one of them
FINEST_STEP2 = 4.0  # squared texels
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
        """Depth (z, m, [h, w]; 0 = nothing) at the pixel centers, and what is seen there (-1 = nothing).

        Args:
            T_world_camera: camera pose, [4, 4].
        """

    def render(self, T_world_camera: ArrayLike) -> RenderedView:
        """Color and depth from a camera pose.

        Args:
            T_world_camera: camera pose, [4, 4].
        """


class Renderer:
    """Renders one baked scene with one camera."""

    def __init__(
        self, scene: Scene, atlas: Atlas | None, camera: PinholeCamera, *, isa: str = "auto"
    ) -> None:
        """Collect the surfaces in arrays, and list the columns and rows of the image.

        Args:
            scene: what is seen.
            atlas: its colors; None: depth alone is rendered.
            camera: that sees it.
            isa: how colors are drawn, which changes no bit: "fused" or "portable", compiled, "auto", the faster of
                these, or "numpy".
        """
        self.camera, self.atlas, self.isa = camera, atlas, isa
        self.scene = SurfaceArrays(scene)
        self.u = np.arange(camera.width, dtype=np.float64)
        self.v = np.arange(camera.height, dtype=np.float64)

    def depth(self, T_world_camera: ArrayLike) -> tuple[Array, NDArray[np.int16]]:
        """Exact depth (z, m, [h, w]; 0 = nothing) and index of the surface seen (-1 = none) at pixel centers.

        Args:
            T_world_camera: camera pose, [4, 4].
        """
        inverse, surface = self._nearest(SurfacesFromPose(self.scene, self.camera, T_world_camera))
        depth = np.zeros_like(inverse)
        np.divide(1.0, inverse, out=depth, where=inverse > 0)
        return depth, surface

    def render(self, T_world_camera: ArrayLike) -> RenderedView:
        """Color and exact depth from a camera pose.

        Args:
            T_world_camera: camera pose, [4, 4].
        """
        pose = SurfacesFromPose(self.scene, self.camera, T_world_camera)
        inverse, surface = self._nearest(pose)
        depth = np.zeros_like(inverse)
        np.divide(1.0, inverse, out=depth, where=inverse > 0)
        return RenderedView(self._colors(pose, surface), depth, surface)

    def _colors(self, pose: SurfacesFromPose, surface: NDArray[np.int16]) -> NDArray[np.uint8]:
        """Colors [h, w, 3] of an image of surfaces."""
        assert self.atlas is not None
        image = np.zeros((*surface.shape, 3), dtype=np.uint8)
        left, step2 = np.zeros(surface.shape, dtype=np.uint8), np.zeros(surface.shape, dtype=np.float32)
        if self.isa == "numpy":
            left[:] = 1
            self._color_others(pose, surface, left, image)
            return image
        of_scene = self.isa, pose.linear, self.scene.extent, self.scene.kind, self.atlas.origin
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
        self,
        pose: SurfacesFromPose,
        surface: NDArray[np.int16],
        left: NDArray[np.uint8],
        image: NDArray[np.uint8],
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

    def _nearest(self, pose: SurfacesFromPose) -> tuple[Array, NDArray[np.int16]]:
        """Greatest inverse depth and its surface at every pixel center."""
        nearest = np.zeros((self.camera.height, self.camera.width))
        surface = np.full(nearest.shape, -1, dtype=np.int16)
        order, windows = pose.flat_windows()
        isa = "auto" if self.isa == "numpy" else self.isa
        of_scene = isa, pose.linear, self.scene.extent, self.scene.kind
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
        width, height = self.scene.extent[k]
        if self.scene.kind[k] == DISC:
            r = width / 2
            return (s_inverse - r * inverse) ** 2 + (t_inverse - r * inverse) ** 2 <= (r * inverse) ** 2
        slack = EDGE_TOLERANCE_M * inverse
        hit = s_inverse >= -slack
        hit &= s_inverse <= width * inverse + slack
        hit &= t_inverse >= -slack
        hit &= t_inverse <= height * inverse + slack
        return hit

    def _inside(
        self, pose: SurfacesFromPose, at: NDArray[np.int64], surface: NDArray[np.int16]
    ) -> NDArray[np.float32]:
        """Mean colors [n, 3] of pixels that one surface fills; `at` are their flat indices, surface by surface."""
        assert self.atlas is not None
        v, u = self.v[at // self.camera.width], self.u[at % self.camera.width]
        x, y = np.empty((4, at.size), dtype=np.float32), np.empty((4, at.size), dtype=np.float32)
        scale = 1 / self.atlas.texel_m
        for k, part in _runs(surface):
            if self.scene.kind[k] == CURVED:
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

    def _curved_inside(self, pose: SurfacesFromPose, k: int, u: Array, v: Array) -> tuple[Array, Array]:
        """Texels (x, y) [4, n] of the four samples of pixels that curved surface k fills."""
        assert self.atlas is not None
        du, dv = np.array(INSIDE_OFFSETS).T[:, :, None]
        inverse, s, t = pose.curved(k, u + du, v + dv)
        middle = pose.curved(k, u, v)
        missed = inverse <= 0
        s, t = np.where(missed, middle[1], s), np.where(missed, middle[2], t)
        s = middle[1] + _wrapped(s - middle[1], self.scene.period[k])
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
        self, pose: SurfacesFromPose, at: NDArray[np.int64], surface: NDArray[np.int16]
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
            if self.scene.kind[k] == CURVED:
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


def _rounded(color: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(color), 0, 255).astype(np.uint8)


def _runs(values: NDArray[np.int16]) -> Iterator[tuple[int, slice]]:
    """Every value of a sorted array, and where it stands."""
    starts = np.flatnonzero(np.diff(values, prepend=-1)).tolist()
    for first, last in zip(starts, [*starts[1:], len(values)], strict=True):
        yield int(values[first]), slice(first, last)


def _wrapped(difference: Array, period: float) -> Array:
    """A difference of positions on a circle, between minus and plus half its length."""
    return difference - period * np.rint(difference / period)
