"""Features of a view: keypoints with known depth, and bearings of others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.registration.descriptors import DIMENSIONS, Descriptors, matches
from duagc.pipeline.registration.keypoints import (
    AllKeypoints,
    KeptKeypoints,
    Keypoints,
    Usable,
    brightened,
    enough_keypoints,
    nearest_pixel,
    strongest_keypoints,
)
from duagc.pipeline.registration.pyramid import RgbdPyramid

LEAST_PX = 50_000  # of the image that features are looked for in
FEW_DEPTHS = 0.5  # share of the usable pixels with depth below which features without depth are kept, too


@dataclass(frozen=True)
class Bearings:
    """Keypoints without depth, strongest response first.

    Attributes:
        descriptors: uint8 [n, 128].
        rays: float32 [n, 3], camera frame, their z is 1.
        pixel_width: width of a pixel at a depth of 1; 0: they were not looked for.
        few_depths: whether most of the image has no depth.
        inverse_depth_sigma: standard deviation of the inverse depth of what is far and has depth, 1/m.
    """

    descriptors: Descriptors
    rays: NDArray[np.float32]
    pixel_width: float = 0.0
    few_depths: bool = False
    inverse_depth_sigma: float = 0.0


NO_BEARINGS = Bearings(np.zeros((0, DIMENSIONS), np.uint8), np.zeros((0, 3), np.float32))


@dataclass(frozen=True)
class Features:
    """Keypoints of one keyframe with known depth, strongest response first.

    Attributes:
        descriptors: uint8 [n, 128].
        points: float32 [n, 3], meters, camera frame.
        bearings: keypoints without depth, where they were looked for.
    """

    descriptors: Descriptors
    points: NDArray[np.float32]
    bearings: Bearings = NO_BEARINGS

    def __len__(self) -> int:
        return len(self.points)


def extract(
    color: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    most: int,
    *,
    mask: masks.Mask | None = None,
) -> Features:
    """The strongest SIFT features of a frame that have a depth.

    A feature that is nearer to a pixel that may not be used than its size, the diameter of its blob, is left out.

    Args:
        color: uint8 RGB [h, w, 3].
        depth_m: float32 [h, w], meters, 0 = unknown.
        camera: of both.
        most: number of features kept.
        mask: bool [h, w], pixels that may be used; None: all.
    """
    return extract_from_gray(gray_of(color), depth_m, camera, most, mask=mask)


def gray_of(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The gray image [h, w] that features are found in.

    Args:
        color: uint8 RGB [h, w, 3].
    """
    import cv2

    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def extract_from_gray(
    gray: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    most: int,
    *,
    mask: masks.Mask | None = None,
) -> Features:
    """`extract` from a gray image.

    Args:
        gray: uint8 [h, w].
        depth_m: float32 [h, w], meters, 0 = unknown.
        camera: of both.
        most: number of features kept.
        mask: bool [h, w], pixels that may be used; None: all.
    """
    known = depth_m > 0 if mask is None else (depth_m > 0) & mask
    usable = _usable(depth_m > 0, None if mask is None else masks.distance_px(mask))
    return _with_depth(strongest_keypoints(brightened(gray, known), most, usable), depth_m, camera)


def _usable(where: masks.Mask, from_masked_px: NDArray[np.float32] | None) -> Usable:
    """Whether keypoints, by u, v and size [n] each, pixels, lie somewhere, and far enough from masked pixels."""
    height, width = where.shape

    def usable(u: Array, v: Array, size: Array) -> masks.Mask:
        row, column = nearest_pixel(v, height), nearest_pixel(u, width)
        there = where[row, column]
        return there if from_masked_px is None else there & (from_masked_px[row, column] > size)

    return usable


def _with_depth(found: Keypoints, depth_m: NDArray[np.float32], camera: PinholeCamera) -> Features:
    """Features of keypoints that have a depth."""
    u, v = found.pixels.T
    z = depth_m[nearest_pixel(v, camera.height), nearest_pixel(u, camera.width)].astype(np.float64)
    return Features(found.descriptors, back_project(camera, u, v, z).astype(np.float32))


def _rays(found: Keypoints, camera: PinholeCamera) -> NDArray[np.float32]:
    """Places [n, 3] of keypoints at a depth of 1."""
    u, v = found.pixels.T
    return back_project(camera, u, v, np.ones(len(u))).astype(np.float32)


def extract_from_pyramid(
    pyramid: RgbdPyramid, max_width_px: int, most: int, *, before: KeptKeypoints | None = None
) -> Features:
    """`extract` from the finest image of a pyramid that is not wider than a limit, or the coarsest if all are.

    Features without depth are kept, too: where less than half of the image has depth, of all that there are. An image
    of less than `LEAST_PX` pixels shows too little: then the next finer one is taken, if there is one.

    Args:
        pyramid: of the view.
        max_width_px: the limit.
        most: number of features kept.
        before: what was found in the frame; None: nothing. What is found now is added.
    """
    levels = pyramid.levels
    at = next((k for k, of in enumerate(levels) if of.camera.width <= max_width_px), len(levels) - 1)
    level = levels[at - 1 if at and levels[at].gray.size < LEAST_PX else at]
    gray = np.rint(np.clip(level.gray, 0, 1) * 255).astype(np.uint8)
    depth_m = inverse_or_zero(level.inverse_depth)
    known = depth_m > 0 if level.mask is None else (depth_m > 0) & level.mask
    few, image = has_few_depths(pyramid), brightened(gray, known)
    from_masked_px = None if level.mask is None else masks.distance_px(level.mask)
    with_depth, without = (_usable(where, from_masked_px) for where in (depth_m > 0, depth_m == 0))
    find = AllKeypoints.of if before is None else before.of
    found = find(image, 0) if few else enough_keypoints(image, most, with_depth, find)
    features = _with_depth(found.strongest(most, with_depth), depth_m, level.camera)
    others = found.strongest(most, without)
    bearings = Bearings(
        others.descriptors,
        _rays(others, level.camera),
        pixel_width=1 / level.camera.fx,
        few_depths=few,
        inverse_depth_sigma=levels[-1].inverse_depth_sigma,
    )
    return replace(features, bearings=bearings)


def has_few_depths(pyramid: RgbdPyramid) -> bool:
    """Whether less than half of the pixels that may be used have depth, but some have.

    Args:
        pyramid: of the view.
    """
    coarsest = pyramid.levels[-1]
    known = coarsest.inverse_depth > 0
    count = known.size if coarsest.mask is None else int(np.count_nonzero(coarsest.mask))
    if coarsest.mask is not None:
        known &= coarsest.mask
    return 0 < int(np.count_nonzero(known)) < FEW_DEPTHS * count


def count_matches(ours: Features, theirs: Features, most: int, ratio: float) -> int:
    """How many of the strongest features of two views match.

    Args:
        ours: of the first view.
        theirs: of the second view.
        most: number of the strongest features of each that are compared.
        ratio: as of `matches`.
    """
    return len(matches(ours.descriptors[:most], theirs.descriptors[:most], ratio))
