"""Features of a view with known depth, and their matches between two views.

Descriptors are RootSIFT (Arandjelovic and Zisserman 2012), the square root of the L1-normalized SIFT, quantized to
one byte. Products of bytes summed over 128 dimensions stay below 2^24, so float32 matrix products of them are exact
and do not depend on the order of the sum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.registration.pyramid import RgbdPyramid

Descriptors = NDArray[np.uint8]
DIMENSIONS = 128
LEAST_PX = 50_000  # of the image that features are looked for in
DARK, DARK_PERCENT = 100, 99  # gray value that one pixel in a hundred of a well exposed image exceeds
SCALE = 512.0  # RootSIFT entries are at most 1 and mostly below 0.5; larger ones saturate at one byte


@dataclass(frozen=True)
class Features:
    """Keypoints of one keyframe with known depth, strongest response first.

    Attributes:
        descriptors: uint8 [n, 128].
        points: float32 [n, 3], meters, camera frame.
    """

    descriptors: Descriptors
    points: NDArray[np.float32]

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

    def usable(u: Array, v: Array, size: Array) -> masks.Mask:
        row, column = nearest_pixel(v, camera.height), nearest_pixel(u, camera.width)
        has_depth = depth_m[row, column] > 0
        return has_depth if mask is None else has_depth & (masks.distance_px(mask)[row, column] > size)

    found = strongest_keypoints(brightened(gray, known), most, usable)
    u, v = found.pixels.T
    z = depth_m[nearest_pixel(v, camera.height), nearest_pixel(u, camera.width)].astype(np.float64)
    return Features(found.descriptors, back_project(camera, u, v, z).astype(np.float32))


def nearest_pixel(at: Array, size: int) -> NDArray[np.int64]:
    """Row or column of the pixel nearest to a place in the image, [n].

    Args:
        at: places [n], pixels.
        size: height or width of the image.
    """
    return np.clip(np.rint(at).astype(np.int64), 0, size - 1)


@dataclass(frozen=True)
class Keypoints:
    """Where SIFT finds something in an image, strongest response first.

    Attributes:
        descriptors: RootSIFT, uint8 [n, 128].
        pixels: (u, v) [n, 2].
        responses: [n].
    """

    descriptors: Descriptors
    pixels: Array
    responses: Array


NO_KEYPOINTS = Keypoints(np.zeros((0, DIMENSIONS), np.uint8), np.zeros((0, 2)), np.zeros(0))


def strongest_keypoints(
    image: NDArray[np.uint8],
    most: int,
    usable: Callable[[Array, Array, Array], NDArray[np.bool_]],
    place: Callable[[Array], Array] = lambda pixels: pixels,
) -> Keypoints:
    """The strongest keypoints of an image that are usable.

    SIFT computes twice as many as are wanted, the strongest of the whole image; where these lie elsewhere (leaves
    beyond the range of the depth camera, the robot itself), it computes all.

    Args:
        image: uint8 [h, w].
        most: number of keypoints kept.
        usable: whether keypoints are, bool [n], by u, v and size [n] each, pixels.
        place: where keypoints [n, 2] of the image lie; by default there.
    """
    import cv2

    for limit in (2 * most, 0):
        keypoints, sift = cv2.SIFT.create(nfeatures=limit).detectAndCompute(image, None)
        if not keypoints:
            return NO_KEYPOINTS
        pixels = place(np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2))
        u, v = pixels.T
        response, angle, size = np.array([(k.response, k.angle, k.size) for k in keypoints]).T
        order = np.lexsort((angle, u, v, -response))
        order = order[usable(u, v, size)[order]][:most]
        if len(order) == most or len(keypoints) < limit:
            break
    return Keypoints(root_sift(np.asarray(sift[order], np.float32)), pixels[order], response[order])


def brightened(gray: NDArray[np.uint8], usable: masks.Mask) -> NDArray[np.uint8]:
    """The image, or two, four, ... times as bright if it is dark: features are found from a fixed contrast on.

    Args:
        gray: uint8 [h, w].
        usable: bool [h, w], where features may lie; how bright a window or a lamp is elsewhere counts nothing.
    """
    counts = np.cumsum(np.bincount(gray[usable], minlength=256))
    bright = max(int(np.searchsorted(counts, DARK_PERCENT / 100 * counts[-1])), 1)
    factor = 1
    while factor * bright <= DARK:
        factor *= 2
    return gray if factor == 1 else np.minimum(gray.astype(np.uint16) * factor, 255).astype(np.uint8)


def extract_from_pyramid(pyramid: RgbdPyramid, max_width_px: int, most: int) -> Features:
    """`extract` from the finest image of a pyramid that is not wider than a limit, or the coarsest if all are.

    An image of less than `LEAST_PX` pixels shows too little: then the next finer one is taken, if there is one.

    Args:
        pyramid: of the view.
        max_width_px: the limit.
        most: number of features kept.
    """
    levels = pyramid.levels
    at = next((k for k, of in enumerate(levels) if of.camera.width <= max_width_px), len(levels) - 1)
    small = levels[at].camera.width * levels[at].camera.height < LEAST_PX
    level = levels[at - 1 if at and small else at]
    gray = np.rint(np.clip(level.gray, 0, 1) * 255).astype(np.uint8)
    depth_m = inverse_or_zero(level.inverse_depth)
    return extract_from_gray(gray, depth_m, level.camera, most, mask=level.mask)


def root_sift(sift: NDArray[np.float32]) -> Descriptors:
    """RootSIFT, uint8 [n, 128].

    Args:
        sift: SIFT descriptors, [n, 128].
    """
    values = np.asarray(sift, dtype=np.float64)
    total = np.maximum(values.sum(axis=-1, keepdims=True), 1e-12)
    return np.minimum(np.rint(SCALE * np.sqrt(values / total)), 255).astype(np.uint8)


def matches(ours: Descriptors, theirs: Descriptors, ratio: float) -> NDArray[np.int64]:
    """Mutual nearest neighbors that pass the ratio test among ours.

    Args:
        ours: uint8 [n, 128], at least two.
        theirs: uint8 [m, 128].
        ratio: nearest distance over second-nearest, below which a match counts.

    Returns:
        Pairs (index in ours, index in theirs), int64 [k, 2], by index in theirs.
    """
    return matches_of(squared_distances(ours, theirs), ratio)


def count_matches(ours: Features, theirs: Features, most: int, ratio: float) -> int:
    """How many of the strongest features of two views match.

    Args:
        ours: of the first view.
        theirs: of the second view.
        most: number of the strongest features of each that are compared.
        ratio: as of `matches`.
    """
    return len(matches(ours.descriptors[:most], theirs.descriptors[:most], ratio))


def squared_distances(ours: Descriptors, theirs: Descriptors) -> NDArray[np.float32]:
    """Between descriptors, [n, m], exact integers.

    Args:
        ours: uint8 [n, 128].
        theirs: uint8 [m, 128].
    """
    a, b = ours.astype(np.float32), theirs.astype(np.float32)
    squared = a @ b.T
    squared *= -2
    squared += (a * a).sum(axis=1)[:, None]
    squared += (b * b).sum(axis=1)
    return squared


def matches_of(squared: NDArray[np.float32], ratio: float) -> NDArray[np.int64]:
    """`matches` by squared distances.

    Args:
        squared: [n, m], as of `squared_distances`; they are changed.
        ratio: as of `matches`.
    """
    if len(squared) < 2 or not squared.shape[1]:
        return np.zeros((0, 2), dtype=np.int64)
    columns = np.arange(squared.shape[1])
    best = squared.argmin(axis=0)
    mutual = squared.argmin(axis=1)[best] == columns
    least = squared[best, columns]
    squared[best, columns] = np.inf
    second = squared.min(axis=0)
    good = mutual & (least < np.float32(ratio) ** 2 * second)
    return np.stack([best[good], columns[good]], axis=1)
