"""New Gaussians from one RGB-D image: flat, footprint-sized discs where the map does not explain what was seen.

The image is cut into square cells of a quadtree: a cell with detail in color, or with more than one surface, is
split down to the finest size. Each remaining cell becomes one disc on the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import SeedingConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import inside
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import Rendered

Image = NDArray[np.float32]

_CELLS_AT_A_TIME = 256  # windows of as many stay in the cache


def unexplained(
    render: Rendered,
    color: Image,
    depth_m: Image,
    config: SeedingConfig,
    *,
    depth_sigma_m: Image | None = None,
) -> NDArray[np.bool_]:
    """Measured pixels [H, W] whose opacity, depth or color the rendered map does not explain.

    Args:
        render: of the map.
        color: of the image, RGB 0..1 [H, W, 3].
        depth_m: of the image, meters [H, W], 0 where nothing was measured.
        config: thresholds.
        depth_sigma_m: [H, W], standard deviation of the depth; depth within three of these is explained.
    """
    from scipy.ndimage import uniform_filter

    alpha = np.maximum(render.alpha, np.float32(1e-3))
    thin = render.alpha < config.min_alpha
    allowed = config.depth_error_m + config.depth_error_relative * depth_m
    if depth_sigma_m is not None:
        allowed = np.maximum(allowed, 3 * depth_sigma_m)
    displaced = np.abs(render.depth / alpha - depth_m) > allowed
    error = uniform_filter(_mean_of_channels(np.abs(render.color - color)), config.cell_sizes_px[0] // 2 + 1)
    return (depth_m > 0) & (thin | displaced | (error > config.color_error))


def worst_drawn(
    render: Rendered, color: Image, depth_m: Image, *, count: int, config: SeedingConfig
) -> NDArray[np.bool_]:
    """Pixels [H, W] of the finest cells with the largest squared color error, of those measured throughout.

    Args:
        render: of the map.
        color: of the image, RGB 0..1 [H, W, 3].
        depth_m: of the image, meters [H, W], 0 where nothing was measured.
        count: of the cells.
        config: size of the cells.
    """
    side = config.cell_sizes_px[-1]
    h, w = (length // side for length in depth_m.shape)

    def cells(image: NDArray) -> NDArray:
        """[h, w, pixels of a cell]"""
        whole = image[: h * side, : w * side].reshape(h, side, w, side)
        return whole.swapaxes(1, 2).reshape(h, w, side * side)

    error = cells(_mean_of_channels((render.color - color) ** 2)).mean(axis=2)
    error = np.where((cells(depth_m) > 0).all(axis=2), error, np.float32(0))
    order = np.argsort(-error, axis=None, kind="stable")[:count]
    chosen = np.zeros(h * w, bool)
    chosen[order] = error.ravel()[order] > config.worst_color_error**2
    wanted = np.zeros(depth_m.shape, bool)
    wanted[: h * side, : w * side] = chosen.reshape(h, w).repeat(side, axis=0).repeat(side, axis=1)
    return wanted


def _mean_of_channels(rgb: NDArray) -> NDArray:
    return (rgb[..., 0] + rgb[..., 1] + rgb[..., 2]) / 3  # numpy takes longer over so short an axis


@dataclass(frozen=True)
class Cells:
    """Leaves of the quadtree: pixel center uv [n, 2], side [n] px, depth [n] m, color [n, 3], detail [n]."""

    uv: NDArray[np.float64]
    side_px: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    color: NDArray[np.float64]


def seed_discs(
    color: Image,
    depth_m: Image,
    wanted: NDArray[np.bool_],
    camera: PinholeCamera,
    *,
    T_map_camera: NDArray[np.float64],
    budget: int,
    first_id: int,
    anchor: int,
    config: SeedingConfig,
) -> Gaussians:
    """At most `budget` discs for the wanted pixels, in the map frame.

    Args:
        color: of the image, RGB 0..1 [H, W, 3].
        depth_m: of the image, meters [H, W].
        wanted: pixels [H, W] to be explained.
        camera: of the image.
        T_map_camera: pose of the camera.
        budget: most discs.
        first_id: ids count up from here, in the order of the cells (coarse to fine, row by row).
        anchor: index of the keyframe that the Gaussians are anchored to.
        config: sizes of cells and discs.
    """
    depth_m = np.where((depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m), depth_m, 0)
    cells = quadtree(color, depth_m, wanted & (depth_m > 0), budget=budget, config=config)
    normals = surface_normals(depth_m, cells, camera)
    rays = np.stack(
        [
            (cells.uv[:, 0] - camera.cx) / camera.fx,
            (cells.uv[:, 1] - camera.cy) / camera.fy,
            np.ones(len(cells.uv)),
        ],
        axis=1,
    )
    cos_tilt = np.abs((normals * rays).sum(axis=1)) / np.linalg.norm(rays, axis=1)
    R_camera_disc = _disc_axes(normals, rays)
    pitch = cells.side_px * cells.depth_m / np.sqrt(camera.fx * camera.fy)
    # a tilted surface is sampled more sparsely along its slope
    sigma = config.spread * np.stack([pitch, pitch / np.clip(cos_tilt, 0.4, 1.0)], axis=1)
    if config.shape == "ball":
        scales = np.repeat(sigma[:, :1], 3, axis=1)
    else:
        scales = np.concatenate([sigma, np.full((len(pitch), 1), config.thickness_m)], axis=1)
    scales = np.maximum(scales, config.thickness_m)
    n = len(pitch)
    T = np.asarray(T_map_camera, dtype=np.float64)
    return Gaussians(
        ids=np.arange(first_id, first_id + n, dtype=np.int64),
        anchors=np.full(n, anchor, np.int32),
        means=se3.transform(T, rays * cells.depth_m[:, None]).astype(np.float32),
        quats_wxyz=so3.to_quat_wxyz(T[:3, :3] @ R_camera_disc).astype(np.float32),
        log_scales=np.log(scales).astype(np.float32),
        colors=cells.color.astype(np.float32),
        opacity_logits=np.full(n, np.log(config.opacity / (1 - config.opacity)), np.float32),
    )


def quadtree(
    color: Image, depth_m: Image, wanted: NDArray[np.bool_], *, budget: int, config: SeedingConfig
) -> Cells:
    """Leaves that hold wanted pixels, at most `budget` of them.

    A leaf takes part if at least half of its pixels are wanted; its depth, position and color are means over its
    wanted pixels within 5 % of the nearest one, so that a leaf on an edge belongs to the front surface. The detail
    threshold rises by steps of sqrt(2) until the leaves fit the budget; if the coarsest cells alone do not, every
    second, third, ... is taken.

    Args:
        color: [H, W, 3], RGB 0..1.
        depth_m: [H, W], meters, 0 = unknown.
        wanted: bool [H, W], pixels with depth that the map does not explain.
        budget: largest number of leaves.
        config: sides of the cells, pixels, and the detail threshold.
    """
    sides = config.cell_sizes_px
    grids = [_grid(color, depth_m, wanted, side) for side in sides]
    threshold, coarsest_only = config.detail, False
    while True:
        leaves = _leaves(grids, np.inf if coarsest_only else threshold)
        total = sum(int(np.count_nonzero(mask)) for mask in leaves)
        if total <= budget or coarsest_only:
            break
        threshold *= np.sqrt(2.0)
        coarsest_only = threshold > 1.0
    parts = [
        (
            np.stack([grid.u[mask], grid.v[mask]], axis=1),
            np.full(mask.sum(), side),
            grid.z[mask],
            grid.color[mask],
        )
        for grid, mask, side in zip(grids, leaves, sides, strict=True)
    ]
    uv, side_px, z, rgb = (np.concatenate([part[k] for part in parts]) for k in range(4))
    keep = slice(None) if total <= budget else np.arange(total)[:: -(-total // max(budget, 1))][:budget]
    return Cells(uv[keep], side_px[keep].astype(np.float64), z[keep], rgb[keep])


@dataclass(frozen=True)
class _Grid:
    """Statistics of the cells [rows, columns] of one size; 0 where a cell is not filled."""

    side: int
    filled: NDArray[np.bool_]  # at least half of its pixels are wanted
    detail: NDArray[np.float64]  # standard deviation of gray; infinite where two surfaces meet
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    z: NDArray[np.float64]
    color: NDArray[np.float64]


def _cells(image: NDArray, side: int) -> NDArray:
    """Cells of an image [H, W, ...], row by row, as [side * side, cells, ...]; zero-padded at the right and bottom."""
    h, w = image.shape[:2]
    image = np.pad(image, [(0, -h % side), (0, -w % side), *[(0, 0)] * (image.ndim - 2)])
    rows, columns, tail = image.shape[0] // side, image.shape[1] // side, image.shape[2:]
    pixels_first = np.moveaxis(image.reshape(rows, side, columns, side, *tail), (1, 3), (0, 1))
    return pixels_first.reshape(side * side, rows * columns, *tail)


def _pixels_of(cells: NDArray[np.int64], image: NDArray, side: int) -> NDArray:
    """`_cells(image, side)[:, cells]`, with the same order in memory: few cells are filled, and an image is large."""
    overhang = [(0, -length % side) for length in image.shape[:2]]
    if any(after for _, after in overhang):
        image = np.pad(image, [*overhang, *[(0, 0)] * (image.ndim - 2)])
    row, column = np.divmod(cells[:, None], image.shape[1] // side)
    pixel = np.arange(side * side)
    return image[side * row + pixel // side, side * column + pixel % side].swapaxes(0, 1)


def _grid(color: Image, depth_m: Image, wanted: NDArray[np.bool_], side: int) -> _Grid:
    """Only filled cells are measured: the others are split whatever they hold."""
    rows, columns = -(-depth_m.shape[0] // side), -(-depth_m.shape[1] // side)
    mask = _cells(wanted, side)
    filled = mask.sum(axis=0) * 2 >= side * side
    cells = np.flatnonzero(filled)
    mask = mask[:, cells]
    z = _pixels_of(cells, depth_m, side).astype(np.float64)
    rgb = _pixels_of(cells, color, side).astype(np.float64)
    nearest = np.where(mask, z, np.inf).min(axis=0)
    farthest = np.where(mask, z, -np.inf).max(axis=0)
    front = mask & (z <= 1.05 * nearest)
    weight = front / front.sum(axis=0)
    inverse_z = np.where(front, 1.0 / np.where(front, z, 1.0), 0.0)
    pixel = np.arange(side * side)[:, None]
    u = side * (cells % columns) + pixel % side
    v = side * (cells // columns) + pixel // side
    gray = _mean_of_channels(rgb)
    mean = (weight * gray).sum(axis=0)
    detail = np.sqrt(np.maximum((weight * gray * gray).sum(axis=0) - mean * mean, 0.0))

    def everywhere(values: NDArray) -> NDArray[np.float64]:
        image = np.zeros((rows * columns, *values.shape[1:]))
        image[cells] = values
        return image.reshape(rows, columns, *values.shape[1:])

    return _Grid(
        side=side,
        filled=filled.reshape(rows, columns),
        detail=everywhere(np.where(farthest > 1.05 * nearest, np.inf, detail)),
        u=everywhere((weight * u).sum(axis=0)),
        v=everywhere((weight * v).sum(axis=0)),
        z=everywhere(1.0 / (weight * inverse_z).sum(axis=0)),
        color=everywhere((weight[..., None] * rgb).sum(axis=0)),
    )


def _leaves(grids: list[_Grid], threshold: float) -> list[NDArray[np.bool_]]:
    """Masks of the cells, size by size, that are leaves and filled."""
    leaves = []
    open_cells = np.ones_like(grids[0].filled)  # cells whose parents were all split
    for level, grid in enumerate(grids):
        finest = level == len(grids) - 1 or np.isinf(threshold)
        split = np.zeros_like(open_cells) if finest else grid.detail > threshold
        # a half-empty cell is split too: its filled quarters may still stand for themselves
        split = split if finest else split | ~grid.filled
        leaves.append(open_cells & ~split & grid.filled)
        if level + 1 < len(grids):
            children = grids[level + 1].filled.shape
            inherited = (open_cells & split).repeat(2, axis=0).repeat(2, axis=1)
            open_cells = inherited[: children[0], : children[1]]
    return leaves


def surface_normals(
    depth_m: Image, cells: Cells, camera: PinholeCamera, radius_px: int = 4
) -> NDArray[np.float64]:
    """Unit normals [n, 3] in the camera frame, facing the camera, at the cells' centers.

    A plane n . X = 1 has inverse depth 1 / z = n . ray, affine in the pixel: fit that affine function over the
    pixels of a (2 radius + 1)^2 window within 5 % of the cell's inverse depth. Where it is not determined the
    normal is the viewing ray.

    Args:
        depth_m: [H, W], meters, 0 = unknown.
        cells: n leaves of the quadtree.
        camera: of the depth image.
        radius_px: half side of the window, pixels.
    """
    n = len(cells.uv)
    slope, determined = np.zeros((n, 2)), np.zeros(n, bool)
    for start in range(0, n, _CELLS_AT_A_TIME):
        part = slice(start, start + _CELLS_AT_A_TIME)
        slope[part], determined[part] = _inverse_depth_slope(
            depth_m, cells.uv[part], 1.0 / cells.depth_m[part], radius_px
        )
    offset = cells.uv - np.array([camera.cx, camera.cy])
    level = 1.0 / cells.depth_m - slope[:, 0] * offset[:, 0] - slope[:, 1] * offset[:, 1]
    normal = np.column_stack([slope * np.array([camera.fx, camera.fy]), level])
    ray = np.column_stack([offset / np.array([camera.fx, camera.fy]), np.ones(n)])
    normal = np.where(determined[:, None], normal, ray)
    return -normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _inverse_depth_slope(
    depth_m: Image, uv: NDArray[np.float64], q_cell: NDArray[np.float64], radius_px: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Slope [n, 2] of inverse depth along u and v around pixels uv, by least squares, and whether it is determined."""
    h, w = depth_m.shape
    side = 2 * radius_px + 1
    x, y = (np.arange(side * side)[:, None] // step % side - radius_px for step in (1, side))
    u, v = (np.rint(column).astype(np.int64) for column in uv.T)
    u, v = u + x, v + y
    z = depth_m[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)].astype(np.float64)
    measured = inside(u, v, (h, w)) & (z > 0)
    q = 1.0 / np.where(measured, z, np.inf)
    weight = (measured & (np.abs(q / q_cell - 1) < 0.05)).astype(np.float64)
    wx, wy = weight * x, weight * y
    s = weight.sum(axis=0)
    safe = np.maximum(s, 1.0)
    mx, my, mq = (value.sum(axis=0) / safe for value in (wx, wy, weight * q))
    cxx = (wx * x).sum(axis=0) / safe - mx * mx
    cyy = (wy * y).sum(axis=0) / safe - my * my
    cxy = (wx * y).sum(axis=0) / safe - mx * my
    cxq = (wx * q).sum(axis=0) / safe - mx * mq
    cyq = (wy * q).sum(axis=0) / safe - my * mq
    det = cxx * cyy - cxy * cxy
    determined = (s >= 6) & (det > 0.25)
    slope = np.stack([cyy * cxq - cxy * cyq, cxx * cyq - cxy * cxq], axis=1)
    return slope / np.where(determined, det, 1.0)[:, None] * determined[:, None], determined


def _disc_axes(normals: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations [n, 3, 3] with columns (across the slope, along the slope, normal) in the camera frame."""
    across = np.cross(normals, rays)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    # seen head on there is no slope: any direction in the surface will do
    horizontal = np.cross(normals, np.array([0.0, 1.0, 0.0]) * np.ones_like(normals))
    across = np.where(length > 1e-6, across, horizontal)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(normals, across), normals], axis=2)
