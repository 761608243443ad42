"""Pixels of a view that show an object in front of the camera: what stands in space that earlier views saw to be free.

A part of the object may be where no earlier view measured anything. So a connected surface is the object's as a whole
if enough of it is in free space. It ends at steps of depth, and where earlier views saw the same surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.inverse_depth import chance_difference
from duagc.pipeline.geometry.masks import Mask, large_regions
from duagc.pipeline.geometry.projection import SAME_SURFACE
from duagc.pipeline.kernels.free_space import free_space
from duagc.pipeline.kernels.free_space_definition import FREE, ON_SURFACE, UNKNOWN
from duagc.pipeline.registration import Level

Image = NDArray[np.floating]

COLUMNS = 80
"""Columns of an image, or up to twice as many, that are looked at."""
REACH = 1 / 16
"""Of the width of an image, by which an object moves from one to the next."""


@dataclass(frozen=True)
class HiddenPixels:
    """What an object hides of a view.

    Attributes:
        mask: bool [h, w] of the view's image: True where it shows the object, or touches it.
        share: of the pixels of known depth, those that show it.
        visible: of the pixels of known depth, the share whose place some earlier view measured.
    """

    mask: Mask
    share: float
    visible: float


def hidden_pixels(
    view: Level,
    T_map_camera: Array,
    seen: Iterable[tuple[Level, Array]],
    config: FrontendConfig,
) -> HiddenPixels:
    """Find the object in a view.

    Args:
        view: its coarsest image.
        T_map_camera: [4, 4], of the view.
        seen: earlier views: their coarsest images, and T_map_camera [4, 4] of each.
        config: of the front end. What registration takes for the same surface is not in free space; number of views
            and smallest region are those of moving objects.
    """
    import cv2

    step = max(1, view.inverse_depth.shape[1] // COLUMNS)
    inverse_depth = view.inverse_depth[::step, ::step]
    v, u = np.nonzero(view.inverse_depth)
    kept = (v % step == 0) & (u % step == 0)
    v, u, points_map = v[kept] // step, u[kept] // step, se3.transform(T_map_camera, view.points[kept])
    seen, least = tuple(seen), config.moving.min_region * inverse_depth.size
    T_views_map = se3.inverse(np.reshape([T_map_view for _, T_map_view in seen], (-1, 4, 4)))
    views = [(level, T_view_map) for (level, _), T_view_map in zip(seen, T_views_map, strict=True)]
    some = (v % 2 == 0) & (u % 2 == 0)
    votes = _votes(points_map[some], view.inverse_depth_sigma, views, config)
    if np.count_nonzero(votes.is_free) >= least / 8:  # half as many as of a region that is large enough
        votes = _votes(points_map, view.inverse_depth_sigma, views, config)
    if np.count_nonzero(votes.is_free) < least:
        return HiddenPixels(np.zeros(view.inverse_depth.shape, bool), 0.0, votes.visible)
    is_free, is_surface = np.zeros(inverse_depth.shape, bool), np.zeros(inverse_depth.shape, bool)
    is_free[v, u], is_surface[v, u] = votes.is_free, votes.is_surface
    labels = _surfaces(inverse_depth, (inverse_depth > 0) & ~is_surface)
    sizes, in_free_space = (
        np.bincount(labels.ravel()),
        np.bincount(labels[is_free], minlength=labels.max() + 1),
    )
    of_object = in_free_space > config.tracking.failure.max_free_space_violations * sizes
    of_object[0] = False
    found = large_regions(of_object[labels] | is_free, config.moving.min_region)
    mask = cv2.dilate(found.view(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    height, width = view.inverse_depth.shape
    whole = mask.repeat(step, axis=0).repeat(step, axis=1)[:height, :width]
    return HiddenPixels(whole, float(np.count_nonzero(found) / max(len(v), 1)), votes.visible)


@dataclass(frozen=True)
class _Votes:
    """What earlier views say of points [n].

    Attributes:
        is_free: bool [n], whether enough of them, and most, saw free space there.
        is_surface: bool [n], whether they saw a surface there.
        visible: share of the points whose place some of them measured.
    """

    is_free: NDArray[np.bool_]
    is_surface: NDArray[np.bool_]
    visible: float


def _votes(
    points_map: Array,
    inverse_depth_sigma: float,
    views: Sequence[tuple[Level, Array]],
    config: FrontendConfig,
) -> _Votes:
    """What earlier views, each with T_view_map [4, 4], say of points [n, 3] in the map, meters; sigma as of `Level`."""
    n = len(points_map)
    free, there, judged = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, bool)
    for level, T_view_map in views:
        where = free_space(
            points_map,
            T_view_map,
            level.nearest,
            level.camera,
            gate_m=config.tracking.registration.depth_gate_m,
            gate_relative=config.tracking.registration.depth_gate_relative,
            gate_inverse=chance_difference(inverse_depth_sigma, level.inverse_depth_sigma),
        )
        free += where == FREE
        there += where == ON_SURFACE
        judged |= where != UNKNOWN
    is_free = (free >= config.moving.min_views) & (free > there)
    return _Votes(is_free, (there > 0) & (free <= there), float(np.count_nonzero(judged) / max(n, 1)))


def carried(before: Mask, inverse_depth_before: Image, view: Level, *, min_region: float) -> Mask:
    """Where an object is in the view after one in which it was found, as far as depth follows it; [h, w].

    Where the camera is does not matter: the object is what is at the same depth at the same pixels, and the surface
    that is connected with it nearby.

    Args:
        before: bool [h, w], where it was.
        inverse_depth_before: [h, w], 1/m, of that view, 0 = unknown.
        view: the coarsest image of the next view.
        min_region: smallest connected region, as a share of the image.
    """
    import cv2

    now = view.inverse_depth
    reach = 2 * max(1, round(REACH * now.shape[1])) + 1
    near = cv2.dilate(before.view(np.uint8), np.ones((reach, reach), np.uint8)).astype(bool) & (now > 0)
    same = before & near & (np.abs(now - inverse_depth_before) < SAME_SURFACE * now)
    labels = _surfaces(now, near)
    followed = np.zeros(labels.max() + 1, bool)
    followed[labels[same]] = True
    followed[0] = False
    return large_regions(followed[labels], min_region)


def _surfaces(inverse_depth: Image, among: Mask) -> NDArray[np.int32]:
    """Labels [h, w] of connected pixels between which depth makes no step; 0: not among those asked for."""
    import cv2

    # between every two neighbors there is a pixel more: set if they are connected
    height, width = among.shape
    connected = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    connected[::2, ::2] = among
    for here, there, at in (
        (np.s_[:, :-1], np.s_[:, 1:], np.s_[::2, 1::2]),
        (np.s_[:-1], np.s_[1:], np.s_[1::2, ::2]),
    ):
        one, other = inverse_depth[here], inverse_depth[there]
        same = np.abs(one - other) < SAME_SURFACE * np.maximum(one, other)
        connected[at] = among[here] & among[there] & same
    _, labels = cv2.connectedComponents(connected, connectivity=4, ltype=cv2.CV_32S)
    return np.asarray(labels[::2, ::2], dtype=np.int32)
