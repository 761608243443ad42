"""Views of a recording for its calibration: frames with their tracked poses, and features followed through them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.progress import track
from duagc.pipeline.camera_calibration.tracked import READ_AT_ONCE, Tracked
from duagc.pipeline.camera_calibration.undetermined import UndeterminedError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.masks import distance_px
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends
from duagc.pipeline.recording import RgbdLog, open_rgbd
from duagc.pipeline.recording.rolling_shutter import Readout, share_of_readout
from duagc.pipeline.registration.definition import SAME_SURFACE
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.features import gray_of
from duagc.pipeline.registration.keypoints import nearest_pixel, strongest_keypoints
from duagc.pipeline.registration.pyramid import RgbdPyramid

FEATURES = 1200
RATIO = 0.75
LINE_PX, POINT_PX = 8.0, 25.0  # of 640 px: how far a match may be from where the tracked poses put it
MIN_MATCHES = 10
MIN_TRACK = 3  # views
MIN_VIEWS = 8
MAX_OFFSET_NS = 20_000_000  # between color and depth: in this time a camera moves evenly
NORMALS_LEVEL = (
    2  # quarter size: noisy normals add false information along a surface, and steps get too short
)
SAMPLES = 150  # of the depth of a view
FARTHEST_SAMPLE_M = 4.0
MIN_COSINE, MAX_DISTANCE_M = 0.6, 2.0  # between the axes and the centers of views that are compared


@dataclass
class Views:
    """Views of one part of a recording; poses and points are changed by the adjustment.

    Attributes:
        name: of the part.
        camera: of all views.
        T_map_camera: [n, 4, 4].
        velocity: [n, 6] of the camera, right tangent per second.
        inverse_depth: [n, h, w], 1/m, NaN where unknown.
        normals: [n, h', w', 3] of smaller images, zero where unknown.
        samples: [n, SAMPLES, 2], columns and rows with a normal.
        view: [k], of every observation of a feature.
        landmark: [k], of every observation.
        pixel: [k, 2], of every observation.
        points_map: [m, 3] of the landmarks.
        frames: [n], index of each in its log.
        late_s: [n], how much later than depth the log says that color was taken.
        readout: how long images are read, row after row; poses are those in the middle of it.
    """

    name: str
    camera: PinholeCamera
    T_map_camera: Array
    velocity: Array
    inverse_depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    samples: NDArray[np.int64]
    view: NDArray[np.int64]
    landmark: NDArray[np.int64]
    pixel: Array
    points_map: Array
    frames: NDArray[np.int64]
    late_s: Array
    readout: Readout = READ_AT_ONCE

    def share_of_readout(self, u: Array, v: Array) -> Array:
        """`rolling_shutter.share_of_readout` of pixels; beyond the border that of the border.

        Args:
            u: columns [...].
            v: rows [...].
        """
        count = self.readout.lines(self.camera)
        return share_of_readout(np.clip(u if self.readout.by_columns else v, 0, count - 1), count)


def load_views(tracked: Tracked, first: int, last: int, most: int, *, without: Collection[int] = ()) -> Views:
    """Views of a range of frames, evenly spread, and the features followed through them.

    Held-out frames are never read: a calibration must not be fitted to the images that maps are evaluated by.
    Depth is as it was taken: where that was at another time, `late_s` says so. Frames whose depth shows too little, or
    was taken long before or after color, are passed over.

    Args:
        tracked: the log.
        first: of the frames.
        last: of the frames, less one.
        most: largest number of views.
        without: frames that are not to be taken.

    Raises:
        UndeterminedError: too few frames are left.
    """
    name = f"{tracked.robot}, frames {first} to {last - 1}"
    good = first + np.flatnonzero((tracked.ok & ~tracked.held_out)[first:last])
    good = good[~np.isin(good, list(without))]
    chosen = good[evenly_spaced_to_ends(len(good), most)]
    images = []
    with open_rgbd(tracked.path) as log:
        camera = log.camera
        for index in track(chosen, f"features of {name}"):
            if (image := _image(log, int(index))) is not None:
                images.append(image)
    if len(images) < MIN_VIEWS:
        raise UndeterminedError(
            f"{tracked.path}: {len(images)} tracked frames in {name} that are not held out and have depth, "
            f"expected at least {MIN_VIEWS}"
        )
    frames = np.array([image.frame for image in images])
    T = tracked.T_map_camera[frames]
    view, landmark, pixel, points = _landmarks(
        [image.pixel for image in images],
        [image.descriptors for image in images],
        [image.depth for image in images],
        camera=camera,
        T=T,
    )
    return Views(
        name=name,
        camera=camera,
        T_map_camera=T,
        velocity=_velocities(tracked, frames),
        inverse_depth=np.array([image.inverse_depth for image in images]),
        normals=np.array([image.normals for image in images]),
        samples=np.array([image.samples for image in images]),
        view=view,
        landmark=landmark,
        pixel=pixel,
        points_map=points,
        frames=frames,
        late_s=np.array([image.late_s for image in images]),
        readout=tracked.readout,
    )


@dataclass(frozen=True)
class _Image:
    """What a frame gives to its view."""

    frame: int
    late_s: float
    pixel: Array  # [k, 2] of its features
    descriptors: NDArray[np.uint8]  # [k, 128]
    depth: Array  # [k], m, 0 = unknown
    inverse_depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    samples: NDArray[np.int64]


def _image(log: RgbdLog, index: int) -> _Image | None:
    """Features and surfaces of a frame; None if its depth shows too little of a surface, or another time."""
    frame = log.frame(index)
    if abs(frame.depth_offset_ns) > MAX_OFFSET_NS:
        return None
    depth = np.asarray(frame.usable_depth, dtype=np.float32)
    pyramid = RgbdPyramid.build(np.zeros(depth.shape, np.float32), depth, log.camera, NORMALS_LEVEL + 1)
    normals = pyramid.levels[NORMALS_LEVEL].normals
    samples = _samples(normals, depth, robot=log.robot, index=index)
    if samples is None:
        return None
    mask, (height, width) = frame.mask, depth.shape

    def usable(u: Array, v: Array, size: Array) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(len(u), dtype=bool)
        return distance_px(mask)[nearest_pixel(v, height), nearest_pixel(u, width)] > size

    found = strongest_keypoints(gray_of(frame.color), FEATURES, usable)
    u, v = found.pixels.T
    w = pyramid.levels[0].inverse_depth
    return _Image(
        frame=index,
        late_s=-1e-9 * frame.depth_offset_ns,
        pixel=found.pixels,
        descriptors=found.descriptors,
        depth=depth[nearest_pixel(v, height), nearest_pixel(u, width)].astype(np.float64),
        inverse_depth=np.where(w > 0, w, np.float32(np.nan)),
        normals=normals,
        samples=samples,
    )


def coarse(index: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Rows or columns of the images of normals for those of full images.

    Args:
        index: rows or columns of full images.
        size: number of them in the images of normals.
    """
    return np.minimum(index >> NORMALS_LEVEL, size - 1)


def normals_at(
    views: Views, view: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int64]
) -> Array:
    """Normals [..., 3] at pixels of views.

    Args:
        views: the views.
        view: [...], which of them.
        row: [...].
        column: [...].
    """
    height, width = views.normals.shape[1:3]
    return views.normals[view, coarse(row, height), coarse(column, width)].astype(np.float64)


def _velocities(tracked: Tracked, chosen: NDArray[np.int64]) -> Array:
    """Motion [n, 6] between the frames before and after each; held-out ones are stepped over."""
    taking_part = np.flatnonzero(~tracked.held_out)
    place = np.searchsorted(taking_part, chosen)
    before = taking_part[np.maximum(place - 1, 0)]
    after = taking_part[np.minimum(place + 1, len(taking_part) - 1)]
    T = tracked.T_map_camera
    seconds = 1e-9 * (tracked.stamps_ns[after] - tracked.stamps_ns[before])
    motion = se3.log(se3.inverse(T[before]) @ T[after]) / np.maximum(seconds, 1e-3)[:, None]
    return np.where((tracked.ok[before] & tracked.ok[after])[:, None], motion, 0.0)


def _samples(
    normals: NDArray[np.float32], depth: NDArray[np.float32], *, robot: str, index: int
) -> NDArray[np.int64] | None:
    """Columns and rows [SAMPLES, 2] of pixels with a normal; None if there are too few."""
    row, column = np.nonzero((depth > 0) & (depth < FARTHEST_SAMPLE_M))
    known = np.abs(normals[coarse(row, normals.shape[0]), coarse(column, normals.shape[1])]).sum(axis=-1) > 0
    row, column = row[known], column[known]
    if len(row) < SAMPLES:
        return None
    rng = random_streams.generator(0, "calibration.samples", robot=robot, frame=index)
    picked = np.sort(rng.choice(len(row), SAMPLES, replace=False))
    return np.stack([column[picked], row[picked]], axis=-1)


def _landmarks(
    pixels: Sequence[Array],
    descriptors: Sequence[NDArray[np.uint8]],
    depths: Sequence[Array],
    *,
    camera: PinholeCamera,
    T: Array,
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Features followed through the views: view, landmark and pixel of every observation, and the landmarks."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    offsets = np.concatenate([[0], np.cumsum([len(p) for p in pixels])])
    edges = [
        np.stack([offsets[a] + found[:, 0], offsets[b] + found[:, 1]], axis=-1)
        for a, b, found in _matched(pixels, descriptors, depths, camera=camera, T=T)
    ]
    if not edges:
        none = np.zeros(0, dtype=np.int64)
        return none, none, np.zeros((0, 2)), np.zeros((0, 3))
    ends = np.concatenate(edges)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(offsets[-1], offsets[-1]))
    _, label = connected_components(graph, directed=False)
    view = np.repeat(np.arange(len(pixels)), np.diff(offsets))
    pixel, depth = np.concatenate(pixels), np.concatenate(depths)
    # a feature that a view shows twice is ambiguous
    twice = np.unique(np.stack([label, view]), axis=1, return_inverse=True, return_counts=True)
    single = (twice[2] == 1)[twice[1]]
    kept = np.flatnonzero(single)
    views_of, depths_of = (np.bincount(label[kept], w, len(label)) for w in (None, depth[kept] > 0))
    kept = kept[(views_of >= MIN_TRACK)[label[kept]] & (depths_of > 0)[label[kept]]]
    _, landmark = np.unique(label[kept], return_inverse=True)
    count = int(landmark.max()) + 1 if len(kept) else 0
    points, seen = np.zeros((count, 3)), np.zeros(count)
    known = depth[kept] > 0
    rays = camera.rays_at(*pixel[kept].T)
    there = se3.transform(T[view[kept]], (rays * depth[kept, None])[:, None])[:, 0]
    np.add.at(points, landmark[known], there[known])
    np.add.at(seen, landmark[known], 1)
    return view[kept], landmark, pixel[kept], points / np.maximum(seen, 1)[:, None]


def _matched(
    pixels: Sequence[Array],
    descriptors: Sequence[NDArray[np.uint8]],
    depths: Sequence[Array],
    *,
    camera: PinholeCamera,
    T: Array,
) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """Pairs of views, and their matches that are roughly where the poses put them."""
    rays = [camera.rays_at(*p.T) for p in pixels]
    scale = camera.width / 640
    axes, centers = T[:, :3, 2], T[:, :3, 3]
    for a in range(len(T)):
        for b in range(a + 1, len(T)):
            if axes[a] @ axes[b] < MIN_COSINE or np.linalg.norm(centers[a] - centers[b]) > MAX_DISTANCE_M:
                continue
            found = matches(descriptors[a], descriptors[b], RATIO)
            if len(found) < MIN_MATCHES:
                continue
            i, j = found.T
            T_b_a = se3.inverse(T[b]) @ T[a]
            good = _line_distance(rays[a][i], rays[b][j], T_b_a) * camera.fx < LINE_PX * scale
            for points, T_other, other in (
                (rays[a][i] * depths[a][i, None], T_b_a, pixels[b][j]),
                (rays[b][j] * depths[b][j, None], se3.inverse(T_b_a), pixels[a][i]),
            ):
                there = se3.transform(T_other, points)
                there[:, 2] = np.maximum(there[:, 2], 0.05)
                off = np.linalg.norm(camera.project(there) - other, axis=-1)
                good &= (points[:, 2] == 0) | (off < POINT_PX * scale)
            if good.sum() >= MIN_MATCHES:
                yield a, b, found[good]


def _line_distance(rays_a: Array, rays_b: Array, T_b_a: Array) -> Array:
    """First-order distance of matches from the epipolar lines, in focal lengths (Sampson)."""
    t = T_b_a[:3, 3]
    E = np.cross(np.eye(3), t).T @ T_b_a[:3, :3]
    line_b, line_a = rays_a @ E.T, rays_b @ E
    norm = np.sqrt((line_b[:, :2] ** 2).sum(axis=-1) + (line_a[:, :2] ** 2).sum(axis=-1))
    return np.asarray(np.abs((rays_b * line_b).sum(axis=-1)) / np.maximum(norm, 1e-9))


def look_up(views: Views, view: NDArray[np.int64], u: Array, v: Array) -> Array:
    """Inverse depth of views at pixels, interpolated between neighbors on one surface; NaN where there is none.

    Args:
        views: the views.
        view: [...], which of them.
        u: columns [...].
        v: rows [...].
    """
    height, width = views.inverse_depth.shape[1:]
    inside = (u >= 1) & (u < width - 2) & (v >= 1) & (v < height - 2)
    u, v = np.where(inside, u, 1), np.where(inside, v, 1)
    i, j = v.astype(np.int64), u.astype(np.int64)
    a, b = u - j, v - i
    w = views.inverse_depth
    corners = np.stack([w[view, i, j], w[view, i, j + 1], w[view, i + 1, j], w[view, i + 1, j + 1]])
    with np.errstate(invalid="ignore"):
        whole = inside & (corners.max(axis=0) - corners.min(axis=0) < SAME_SURFACE * corners[0])
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    return np.where(whole, (weights * corners).sum(axis=0), np.nan)
