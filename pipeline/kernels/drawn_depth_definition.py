"""What the compiled passes of `kernels.drawn_depth` compute, in numpy, to be read and to test against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

Indices = NDArray[np.int64]
Samples = tuple[Indices, Array]
"""Pixels (row by row) that samples of a surface fall on, and their depth there, meters."""
SAME_SURFACE = 0.03  # relative step of depth up to which neighbors are one surface
ONE_LAYER = 0.01  # relative depth behind the nearest sample of a pixel up to which samples are averaged
NEAREST_M = 0.05
LEAST_AREA_PX2 = 1e-9  # twice that of a triangle
ON_THE_BORDER_PX = 1e-9


def drawn_triangles(
    corners: Array, inverse: Array, triangles: Indices, camera: PinholeCamera
) -> tuple[Array, Array]:
    """Inverse depth of the nearest triangle at every pixel, and by how much that triangle changes in depth.

    Args:
        corners: [m, 2], columns and rows of points, pixels.
        inverse: [m], their inverse depth, 1/m; it is linear over a triangle, which is exact on a plane.
        triangles: [t, 3], of which points each one is; of equally near ones the first wins.
        camera: of the image.

    Returns:
        [h, w] each, 1/m and meters, 0 where there is none.
    """
    nearest, change = np.zeros(camera.height * camera.width), np.zeros(camera.height * camera.width)
    at, inverse = corners[triangles], inverse[triangles]
    # sides as a u + b v + c >= 0 inside, row by row the span of columns where all three hold
    p, q = at[:, [1, 2, 0]], at[:, [2, 0, 1]]
    a, b = p[..., 1] - q[..., 1], q[..., 0] - p[..., 0]
    c = -(a * p[..., 0] + b * p[..., 1])
    area = a[:, 0] * at[:, 0, 0] + b[:, 0] * at[:, 0, 1] + c[:, 0]
    usable = np.abs(area) > LEAST_AREA_PX2
    at, inverse, area = at[usable], inverse[usable], area[usable, None]
    a, b, c = a[usable] / area, b[usable] / area, c[usable] / area  # barycentric coordinates of (u, v, 1)
    first = np.clip(np.ceil(at[..., 1].min(axis=1)), 0, camera.height).astype(np.int64)
    last = np.clip(np.floor(at[..., 1].max(axis=1)), -1, camera.height - 1).astype(np.int64)
    triangle, row = _expanded(first, last)
    slope, rest = a[triangle], b[triangle] * row[:, None] + c[triangle]
    with np.errstate(divide="ignore", invalid="ignore"):
        border = -rest / slope
    low = np.where(slope > 0, border, np.where((slope == 0) & (rest < 0), np.inf, -np.inf)).max(axis=1)
    high = np.where(slope < 0, border, np.inf).min(axis=1)
    start = np.ceil(np.clip(low - ON_THE_BORDER_PX, 0, camera.width)).astype(np.int64)
    stop = np.floor(np.clip(high + ON_THE_BORDER_PX, -1, camera.width - 1)).astype(np.int64)
    span, column = _expanded(start, stop)
    triangle, row = triangle[span], row[span]
    shares = a[triangle] * column[:, None] + b[triangle] * row[:, None] + c[triangle]
    terms = shares * inverse[triangle]
    found = terms[:, 0] + terms[:, 1] + terms[:, 2]
    pixel = row * camera.width + column
    chosen = largest(pixel, found)
    chosen = chosen[found[chosen] > 0]
    nearest[pixel[chosen]] = found[chosen]
    depths = 1 / inverse[triangle[chosen]]
    change[pixel[chosen]] = depths.max(axis=1) - depths.min(axis=1)
    shape = camera.height, camera.width
    return nearest.reshape(shape), change.reshape(shape)


def _expanded(first: Indices, last: Indices) -> tuple[Indices, Indices]:
    """Index k and value of all whole numbers from first[k] to last[k], in order."""
    count = np.maximum(last - first + 1, 0)
    index = np.repeat(np.arange(len(first)), count)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count) + first[index]


def largest(group: Indices, value: Array) -> Indices:
    """Position of the largest value of every group, the first of equals.

    Args:
        group: [n], of each value.
        value: [n].
    """
    order = np.lexsort((-np.arange(len(group)), value, group))
    last = np.append(group[order][1:] != group[order][:-1], True)[: len(order)]
    return np.asarray(order[last], dtype=np.int64)


def registered_depth(
    inverse: Array, depth_camera: PinholeCamera, T_camera_depth: Array, camera: PinholeCamera, *, steps: int
) -> NDArray[np.float32]:
    """The depth image of one camera as another one would see it.

    Args:
        inverse: [h, w], inverse depth along z of the depth camera, 1/m, 0 = unknown.
        depth_camera: that measured it.
        T_camera_depth: [4, 4], pose of the depth camera in the other one.
        camera: the other one.
        steps: samples per pixel along either axis; between pixels of one surface inverse depth is interpolated.

    Returns:
        float32 [camera.height, camera.width], meters along z of `camera`, 0 = unknown.
    """
    drawn = []
    for b in range(steps):
        for a in range(steps):
            rho = inverse if a == b == 0 else _between(inverse, a / steps, b / steps)
            v, u = np.nonzero(rho)
            z = 1 / rho[v, u]
            x = (u + a / steps - depth_camera.cx) / depth_camera.fx * z
            y = (v + b / steps - depth_camera.cy) / depth_camera.fy * z
            drawn.append(_fallen((x, y, z), T_camera_depth, camera))
    return _nearest(drawn, camera)


def _between(inverse: Array, a: float, b: float) -> Array:
    """Inverse depth a px right of and b px below every pixel, 0 where its four neighbors are not one surface."""
    corners = inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]
    lowest, highest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    weights = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    mixed = sum(weight * corner for weight, corner in zip(weights, corners, strict=True))
    out = np.zeros_like(inverse)
    out[:-1, :-1] = np.where((lowest > 0) & (highest <= (1 + SAME_SURFACE) * lowest), mixed, 0)
    return out


def _fallen(points: tuple[Array, Array, Array], T: Array, camera: PinholeCamera) -> Samples:
    """The points that fall into the image, moved by T."""
    x, y, z = points
    X, Y, Z = (T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3] for k in range(3))
    front = Z > NEAREST_M
    X, Y, Z = X[front], Y[front], Z[front]
    u, v = np.rint(camera.fx * X / Z + camera.cx), np.rint(camera.fy * Y / Z + camera.cy)
    seen = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return v[seen].astype(np.int64) * camera.width + u[seen].astype(np.int64), Z[seen]


def _nearest(drawn: Sequence[Samples], camera: PinholeCamera) -> NDArray[np.float32]:
    """The nearest surface in every pixel, of samples in several lots; its samples are averaged in inverse depth."""
    size = camera.width * camera.height
    nearest = np.full(size, np.inf)
    for pixel, z in drawn:
        np.minimum.at(nearest, pixel, z)
    count, total = np.zeros(size), np.zeros(size)
    for pixel, z in drawn:
        front = z <= (1 + ONE_LAYER) * nearest[pixel]
        np.add.at(count, pixel[front], 1)
        np.add.at(total, pixel[front], 1 / z[front])
    depth = np.where(count > 0, count / np.where(count > 0, total, 1), 0)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def displaced_depth(
    depth: Array, depth_camera: PinholeCamera, camera: PinholeCamera, baseline_m: float
) -> Array:
    """The depth image of one camera as another one would see it that stands next to it along x, turned the same way.

    With w = 1 / z a point of depth pixel (u, v) falls on column A u + B - f b w and row A v + C: rows map to rows.
    First the rows are resampled, then each row is redrawn as a chain of segments between neighbors. Inverse depth is
    interpolated, in which planes are linear, and only within a surface; where surfaces overlap the nearest wins; at
    the border of a surface a pixel covers half its width.

    Args:
        depth: [h, w], meters along z of the depth camera, 0 = unknown; two rows or more.
        depth_camera: that measured it.
        camera: the other one.
        baseline_m: its place along x of the depth camera.

    Returns:
        [camera.height, camera.width], meters along z of `camera`, 0 = unknown.
    """
    w = _rows_between(depth, depth_camera, camera)
    zoom = camera.fx / depth_camera.fx
    x = (
        zoom * np.arange(depth_camera.width)
        + (camera.cx - zoom * depth_camera.cx)
        - camera.fx * baseline_m * w
    )
    out = np.zeros((camera.height, camera.width))
    left, right, w_left, w_right = x[:, :-1], x[:, 1:], w[:, :-1], w[:, 1:]
    joined = _one_surface(w_left, w_right)
    first = np.ceil(left)
    for column in (first, first + 1):  # connected neighbors are less than two columns apart
        part = (column - left) / np.where(right > left, right - left, 1.0)
        _keep_nearest(out, joined & (column <= right), column, w_left + part * (w_right - w_left))
    column = np.rint(x)
    border_left, border_right = np.ones(w.shape, bool), np.ones(w.shape, bool)
    border_left[:, 1:] = ~joined
    border_right[:, :-1] = ~joined
    covered = np.where(column < x, border_left, border_right) & (np.abs(column - x) <= 0.5 * zoom)
    _keep_nearest(out, covered & (w > 0), column, w)
    return _inverted(out)


def _rows_between(depth: Array, depth_camera: PinholeCamera, camera: PinholeCamera) -> Array:
    """Inverse depth [camera.height, depth_camera.width] along the rows of the other camera, 0 where there is none."""
    row = (np.arange(camera.height) - camera.cy) * (depth_camera.fy / camera.fy) + depth_camera.cy
    near = np.clip(np.floor(row).astype(np.int64), 0, depth_camera.height - 2)
    part = (row - near)[:, None]
    w = _inverted(depth)
    upper, lower = w[near], w[near + 1]
    between = _one_surface(upper, lower) & (part >= 0) & (part <= 1)
    inside = (row >= -0.5) & (row <= depth_camera.height - 0.5)
    found = np.where(between, upper + part * (lower - upper), np.where(part < 0.5, upper, lower))
    return np.where(inside[:, None], found, 0.0)


def _inverted(values: Array) -> Array:
    """Depth as inverse depth, or the other way round; 0 stays 0."""
    with np.errstate(divide="ignore"):
        return np.where(values > 0, 1.0 / values, 0.0)


def _one_surface(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether two inverse depths belong to one surface; no measurement belongs to none."""
    return (a > 0) & (b > 0) & (np.abs(a - b) <= SAME_SURFACE * np.minimum(a, b))


def _keep_nearest(out: Array, mask: NDArray[np.bool_], column: Array, inverse: Array) -> None:
    """Write inverse depths into the columns of their rows where none is larger."""
    drawn = np.flatnonzero(mask & (column >= 0) & (column < out.shape[1]))
    rows, columns = drawn // mask.shape[1], column.ravel()[drawn].astype(np.int64)
    np.maximum.at(out.ravel(), rows * out.shape[1] + columns, inverse.ravel()[drawn])
