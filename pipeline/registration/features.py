"""Features of a view with known depth, and their matches between two views.

Descriptors are RootSIFT (Arandjelovic and Zisserman 2012), the square root of the L1-normalized SIFT, quantized to
one byte. Products of bytes summed over 128 dimensions stay below 2^24, so float32 matrix products of them are exact
and do not depend on the order of the sum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.registration.pyramid import RgbdPyramid

Descriptors = NDArray[np.uint8]
Usable = Callable[[Array, Array, Array], NDArray[np.bool_]]
Placed = Callable[[Array], Array]
DIMENSIONS = 128
LEAST_PX = 50_000  # of the image that features are looked for in
DARK, DARK_PERCENT = 100, 99  # gray value that one pixel in a hundred of a well exposed image exceeds
FEW_DEPTHS = 0.5  # share of the usable pixels with depth below which features without depth are kept, too
SCALE = 512.0  # RootSIFT entries are at most 1 and mostly below 0.5; larger ones saturate at one byte


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


def _usable(
    where: masks.Mask, from_masked_px: NDArray[np.float32] | None
) -> Callable[[Array, Array, Array], NDArray[np.bool_]]:
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
    image: NDArray[np.uint8], most: int, usable: Usable, place: Placed = lambda pixels: pixels
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
    return _detected(image, most, usable, place).strongest(most, usable)


def _detected(
    image: NDArray[np.uint8],
    most: int,
    usable: Usable,
    place: Placed = lambda pixels: pixels,
    *,
    all_of_them: bool = False,
    before: Detections | None = None,
) -> _Detected:
    """Twice as many keypoints as are wanted, or all, if there are too few usable ones among those."""
    for limit in (0,) if all_of_them else (2 * most, 0):
        found = _Detected.of(image, limit, place) if before is None else before.of(image, limit)
        u, v = found.pixels.T
        if np.count_nonzero(usable(u, v, found.sizes)) >= most or len(found.sizes) < limit:
            break
    return found


@dataclass(frozen=True)
class _Detected:
    """All that SIFT finds in an image.

    Attributes:
        sift: [n, 128].
        pixels: (u, v) [n, 2].
        responses: [n].
        angles: [n].
        sizes: [n], diameters of the blobs, pixels.
    """

    sift: NDArray[np.float32]
    pixels: Array
    responses: Array
    angles: Array
    sizes: Array

    @staticmethod
    def of(image: NDArray[np.uint8], limit: int, place: Placed = lambda pixels: pixels) -> _Detected:
        """The strongest, about so many; 0: all."""
        import cv2

        keypoints, sift = cv2.SIFT.create(nfeatures=limit).detectAndCompute(image, None)
        if not keypoints:
            none = np.zeros(0)
            return _Detected(np.zeros((0, DIMENSIONS), np.float32), np.zeros((0, 2)), none, none, none)
        pixels = place(np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2))
        responses, angles, sizes = np.array([(k.response, k.angle, k.size) for k in keypoints]).T
        return _Detected(np.asarray(sift, np.float32), pixels, responses, angles, sizes)

    def strongest(self, most: int, usable: Usable) -> Keypoints:
        """The strongest that are usable, as of `strongest_keypoints`."""
        if not len(self.sizes):
            return NO_KEYPOINTS
        u, v = self.pixels.T
        order = np.lexsort((self.angles, u, v, -self.responses))
        order = order[usable(u, v, self.sizes)[order]][:most]
        return Keypoints(root_sift(self.sift[order]), self.pixels[order], self.responses[order])


class Detections:
    """What SIFT found in the images of a frame: where pixels are left out of it, its image stays the same."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, bytes], _Detected] = {}

    def of(self, image: NDArray[np.uint8], limit: int) -> _Detected:
        """`_Detected.of`, or what it returned before.

        Args:
            image: uint8 [h, w].
            limit: how many, about; 0: all.
        """
        key = limit, image.tobytes()
        if key not in self._found:
            self._found[key] = _Detected.of(image, limit)
        return self._found[key]


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


def extract_from_pyramid(
    pyramid: RgbdPyramid, max_width_px: int, most: int, *, before: Detections | None = None
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
    found = _detected(image, most, with_depth, all_of_them=few, before=before)
    features = _with_depth(found.strongest(most, with_depth), depth_m, level.camera)
    others = found.strongest(most, without)
    rays = _with_depth(others, np.ones_like(depth_m), level.camera).points
    sigma = levels[-1].inverse_depth_sigma
    return replace(features, bearings=Bearings(others.descriptors, rays, 1 / level.camera.fx, few, sigma))


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
