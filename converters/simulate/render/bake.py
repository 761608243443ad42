"""Light and texture of a scene, baked once: after it every surface has one color at a point, whatever the view.

The light is Lambert's: shining panels with soft shadows, plus an even light that corners get less of. All surfaces
share one image (the atlas) with its halvings (mip levels). Tiles are separated by margins that repeat the tile's
border, wide enough for the coarsest level.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.scenes.scene import Ball, Box, Cylinder, Flat, Scene, Solid, Surface
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.arrays import Array

LEVELS = 5
MARGIN = 2 ** (LEVELS - 1)
ATLAS_WIDTH = 8192
BAND_LIMIT_TEXELS = 1.1  # sigma of the blur that leaves nothing finer than about five texels
LIGHT_GRID_M = 0.07
AMBIENT_RAYS = 24
AMBIENT_REACH_M, OUTDOOR_REACH_M = 1.2, 6.0
SUN_REACH_M = 200.0


@dataclass(frozen=True)
class Atlas:
    """Colors of all surfaces.

    Attributes:
        levels: uint8 [h >> k, w >> k, 3] each, RGB.
        origin: texel of (s, t) = (0, 0) of every surface, [n, 2] (x, y), where the center of the first texel
            is 0.
        texel_m: size of a texel.
    """

    levels: list[NDArray[np.uint8]]
    origin: Array
    texel_m: float

    def sample(self, level: int, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Colors [n, 3] between the texels of one level.

        Args:
            level: index into `levels`; 0: the finest.
            x: columns [n], in texels of the finest level.
            y: rows [n], in texels of the finest level.
        """
        n, row = len(x), 1024
        if n == 0:
            return np.zeros((0, 3), dtype=np.uint8)
        padded = -(-n // row) * row
        maps = np.zeros((2, padded), dtype=np.float32)
        scale, shift = np.float32(0.5**level), np.float32(0.5 * 0.5**level - 0.5)
        np.multiply(x, scale, out=maps[0, :n])
        np.multiply(y, scale, out=maps[1, :n])
        maps += shift
        mx, my = maps.reshape(2, -1, row)
        colors = cv2.remap(self.levels[level], mx, my, cv2.INTER_LINEAR)
        return np.asarray(colors, dtype=np.uint8).reshape(-1, 3)[:n]


# whether anything lies between points [n, 3] and points + offset [n, 3]
Blocked = Callable[[Array, Array], NDArray[np.bool_]]


def bake(scene: Scene, texel_m: float, blocked: Blocked | None = None) -> Atlas:
    """Paint and light all surfaces of a scene.

    Args:
        scene: the surfaces, solids and lamps.
        texel_m: width of a texel, meters.
        blocked: whether anything lies between points [n, 3] and points + offset [n, 3], world frame; None: by
            the solids of the scene, and small things cast no shadow.
    """
    shapes = [
        (int(np.ceil(surface.size[1] / texel_m)) + 1, int(np.ceil(surface.size[0] / texel_m)) + 1)
        for surface in scene.surfaces
    ]
    corners, height = _pack(shapes)
    lights = _lights(scene, blocked)
    atlas = np.zeros((height, ATLAS_WIDTH, 3), dtype=np.uint8)

    def painted(k: int) -> NDArray[np.uint8]:
        return _tile(scene, scene.surfaces[k], shapes[k], lights[k], texel_m=texel_m)

    tiles = in_order(painted, range(len(shapes)))
    for tile, surface, shape, (x, y) in zip(tiles, scene.surfaces, shapes, corners, strict=True):
        wrap = cv2.BORDER_REPLICATE if isinstance(surface, Flat) else cv2.BORDER_WRAP
        m = MARGIN
        wide = cv2.copyMakeBorder(tile, 0, 0, m, m, wrap)
        framed = cv2.copyMakeBorder(wide, m, m, 0, 0, cv2.BORDER_REPLICATE)
        atlas[y : y + shape[0] + 2 * m, x : x + shape[1] + 2 * m] = framed
    levels = [atlas]
    for _ in range(1, LEVELS):
        h, w = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.uint8))
    origin = np.array(corners, dtype=np.float64) + MARGIN - 0.5
    return Atlas(levels, origin, texel_m)


def _pack(shapes: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], int]:
    """Corners (x, y) of tiles laid out in rows, tallest first, on multiples of the margin; height of the atlas."""
    order = sorted(range(len(shapes)), key=lambda i: (-shapes[i][0], -shapes[i][1], i))
    corners = [(0, 0)] * len(shapes)
    x = y = row_height = 0
    for i in order:
        h, w = (-(-(n + 2 * MARGIN) // MARGIN) * MARGIN for n in shapes[i])
        if x + w > ATLAS_WIDTH:
            x, y, row_height = 0, y + row_height, 0
        corners[i] = (x, y)
        x, row_height = x + w, max(row_height, h)
    return corners, -(-(y + row_height) // MARGIN) * MARGIN


def _tile(
    scene: Scene, surface: Surface, shape: tuple[int, int], light: NDArray[np.float32], *, texel_m: float
) -> NDArray[np.uint8]:
    """Lit colors of one surface, uint8 [h, w, 3]; `light` is its coarse grid of brightness."""
    rng = random_streams.generator(scene.seed, "simulate.texture", scene=scene.name, surface=surface.name)
    albedo = surface.material(rng, *surface.size, texel_m)
    missing = (shape[0] - albedo.shape[0], shape[1] - albedo.shape[1])
    whole = cv2.copyMakeBorder(np.maximum(albedo, 0), 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
    soft = cv2.GaussianBlur(whole, (0, 0), BAND_LIMIT_TEXELS, borderType=cv2.BORDER_REPLICATE)
    lit = soft * cv2.resize(light, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)[..., None]
    np.rint(lit, out=lit)
    return np.clip(lit, 0, 255, out=lit).astype(np.uint8)


def _lights(scene: Scene, blocked: Blocked | None) -> list[NDArray[np.float32]]:
    """Brightness of white on a coarse grid over every surface, mostly 0.5 to 1.15."""
    grids, points, normals = [], [], []
    for surface in scene.surfaces:
        columns, rows = (max(3, int(np.ceil(extent / LIGHT_GRID_M)) + 1) for extent in surface.size)
        s, t = np.meshgrid(np.linspace(0.01, 0.99, columns), np.linspace(0.01, 0.99, rows))
        p, n = surface.points(s.ravel() * surface.size[0], t.ravel() * surface.size[1])
        grids.append((rows, columns))
        points.append(p)
        normals.append(n)
    light = exposure(scene, np.concatenate(points), np.concatenate(normals), blocked).astype(np.float32)
    pieces = np.split(light, np.cumsum([rows * columns for rows, columns in grids])[:-1])
    return [
        np.asarray(
            cv2.GaussianBlur(piece.reshape(grid), (3, 3), 0, borderType=cv2.BORDER_REPLICATE),
            dtype=np.float32,
        )
        for piece, grid in zip(pieces, grids, strict=True)
    ]


def exposure(scene: Scene, points: Array, normals: Array, blocked: Blocked | None = None) -> Array:
    """Brightness of white at points of the world, tone-mapped, [n].

    Args:
        scene: with its lamps, sun and even light.
        points: [n, 3], meters, world frame.
        normals: [n, 3], unit length, world frame.
        blocked: as in `bake`.
    """
    start = points + 0.004 * normals
    total = scene.even_light * _ambient(scene, start, normals, blocked)
    if scene.sun is not None:
        total += _sunlight(scene.sun, start, normals, blocked)
    for lamp in scene.lamps:
        facing = np.cross(lamp.half_a, lamp.half_b)
        facing = facing / np.linalg.norm(facing)
        for a, b in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
            offset = lamp.center + a * lamp.half_a + b * lamp.half_b - start
            distance2 = np.sum(offset**2, axis=1)
            cosine = np.maximum(np.sum(offset * normals, axis=1), 0.0) / np.sqrt(distance2)
            from_lamp = np.abs(offset @ facing) / np.sqrt(distance2)
            shine = lamp.strength / 4 * 3.2 * cosine * (0.3 + 0.7 * from_lamp) / (distance2 + 1.2)
            lit = np.flatnonzero(shine > 1e-3)
            # just short of the lamp: it is no obstacle to its own light
            hidden = (
                blocked(start[lit], 0.97 * offset[lit])
                if blocked
                else _blocked(scene, start[lit], offset[lit], 1.0)
            )
            shine[lit] *= ~hidden
            total += shine
    return 1.28 * (1.0 - np.exp(-1.55 * total))


def _sunlight(sun: Array, start: Array, normals: Array, blocked: Blocked | None) -> Array:
    """Light of the sun, a vector toward it as long as it is strong, at points [n, 3], with a soft edge, [n]."""
    strength = float(np.linalg.norm(sun))
    total = np.zeros(len(start))
    for across in ((0.01, 0.0), (-0.01, 0.0), (0.0, 0.01), (0.0, -0.01)):
        offset = sun / strength + np.array([*across, 0.0])
        shine = strength / 4 * np.maximum(normals @ offset, 0.0)
        lit = np.flatnonzero(shine > 0)
        if blocked:
            shine[lit] *= ~blocked(start[lit], np.broadcast_to(SUN_REACH_M * offset, (len(lit), 3)))
        total += shine
    return total


def _ambient(scene: Scene, start: Array, normals: Array, blocked: Blocked | None) -> Array:
    """Share of the even light that reaches points [n, 3]: nearby surfaces take some of it away, [n]."""
    reach_m = AMBIENT_REACH_M if scene.sun is None else OUTDOOR_REACH_M
    k = np.arange(AMBIENT_RAYS) + 0.5
    polar, turn = np.arccos(1 - 2 * k / AMBIENT_RAYS), np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=1)
    weight, open_ = np.zeros(len(start)), np.zeros(len(start))
    for direction in sphere:
        cosine = normals @ direction
        up = np.flatnonzero(cosine > 0.05)
        offset = np.broadcast_to(reach_m * direction, (len(up), 3))
        weight[up] += cosine[up]
        hidden = (
            blocked(start[up], offset) if blocked else _blocked(scene, start[up], offset, 1.0, walls=True)
        )
        open_[up] += cosine[up] * ~hidden
    return 0.35 + 0.65 * open_ / np.maximum(weight, 1e-9)


def _blocked(
    scene: Scene, start: Array, offset: Array, reach: float, *, walls: bool = False
) -> NDArray[np.bool_]:
    """Whether anything that casts shadows meets start + q offset for 0 < q < reach, [n]."""
    end = start + reach * offset
    blocked = np.zeros(len(start), dtype=np.bool_)
    if walls:
        blocked |= ((end < 0) | (end > scene.size)).any(axis=1)
    low, high = (np.ascontiguousarray(least(start, end).T) for least in (np.minimum, np.maximum))
    for solid in scene.solids:
        if solid.shades:
            center, half = _bounds(solid)
            near = ~blocked
            for axis in range(
                3
            ):  # of all points at once: a reduction over rows of three is several times slower
                near &= low[axis] < center[axis] + half[axis]
                near &= high[axis] > center[axis] - half[axis]
            some = np.flatnonzero(near)
            if some.size:
                blocked[some] = _meets(solid, start[some], offset[some], reach)
    return blocked


def _bounds(solid: Solid) -> tuple[Array, Array]:
    """Center and half extents of an upright box around a solid."""
    if isinstance(solid, Box):
        c, s = abs(np.cos(solid.yaw_rad)), abs(np.sin(solid.yaw_rad))
        x, y, z = solid.half
        return solid.center, np.array([c * x + s * y, s * x + c * y, z])
    if isinstance(solid, Cylinder):
        half = np.array([solid.radius, solid.radius, solid.height / 2])
        return solid.base + np.array([0, 0, solid.height / 2]), half
    return solid.center, np.full(3, solid.radius)


def _meets(solid: Solid, start: Array, offset: Array, reach: float) -> NDArray[np.bool_]:
    """Whether rays meet a solid; a cylinder counts as the narrower box in it."""
    if isinstance(solid, Box):
        p, d, half = solid.local(start), solid.turned(offset), solid.half
    elif isinstance(solid, Cylinder):
        center, half = _bounds(solid)
        p, d, half = start - center, offset, half * np.array([0.85, 0.85, 1.0])
    else:
        p = start - solid.center
        q = np.clip(-np.sum(p * offset, axis=1) / np.sum(offset**2, axis=1), 0, reach)
        return np.sum((p + q[:, None] * offset) ** 2, axis=1) < 0.97 * solid.radius**2
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)
    a, b = (-half - p) / d, (half - p) / d
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return (enter < leave) & (leave > 1e-6) & (enter < reach)


def surface_points(scene: Scene, atlas: Atlas, count: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Points spread evenly over what can be seen of a scene: points (m, world), normals, colors, [n, 3] each.

    Args:
        scene: the surfaces and solids.
        atlas: colors of the surfaces.
        count: about how many.
    """
    rng = random_streams.generator(scene.seed, "simulate.points", scene=scene.name)
    bounds = np.array([_bounds(solid) for solid in scene.solids]).reshape(-1, 2, 3)
    areas = np.array([surface.size[0] * surface.size[1] for surface in scene.surfaces])
    points, normals, colors = [], [], []
    for k, surface in enumerate(scene.surfaces):
        n = max(4, round(1.25 * count * float(areas[k] / areas.sum())))
        s, t = rng.random((2, n)) * np.array(surface.size)[:, None]
        keep = np.ones(n, dtype=bool)
        if isinstance(surface, Flat) and surface.round:
            r = surface.size[0] / 2
            keep = np.hypot(s - r, t - r) < r
        elif isinstance(surface, Ball):
            keep = rng.random(n) < np.sin(t / surface.radius)
        p, normal = surface.points(s, t)
        keep &= _free(scene, bounds, p + 0.002 * normal, 0.001)
        xy = atlas.origin[k] + np.stack([s, t], axis=1) / atlas.texel_m
        x, y = np.ascontiguousarray(xy.T.astype(np.float32))
        points.append(p[keep])
        normals.append(normal[keep])
        colors.append(atlas.sample(0, x, y)[keep])
    return np.concatenate(points), np.concatenate(normals), np.concatenate(colors)


def _free(scene: Scene, bounds: Array, points: Array, margin_m: float) -> NDArray[np.bool_]:
    """Whether points [n, 3] keep more than a margin from everything: `clearance`, of the solids near them only.

    Args:
        scene: the scene.
        bounds: center and half extents of all its solids, [m, 2, 3].
        points: m, world.
        margin_m: how much more.
    """
    low, high = points.min(axis=0) - 2 * margin_m, points.max(axis=0) + 2 * margin_m
    free = np.minimum(points, scene.size - points).min(axis=1) > margin_m
    center, half = bounds[:, 0], bounds[:, 1]
    near = ((low < center + half) & (high > center - half)).all(axis=1)
    for k in np.flatnonzero(near):
        free &= scene.solids[k].distance(points) > margin_m
    return free
