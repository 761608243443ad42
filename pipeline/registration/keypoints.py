"""Keypoints of an image: where SIFT finds something, and which of them are the strongest that can be used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import masks
from duagc.pipeline.registration.descriptors import DIMENSIONS, Descriptors, root_sift

Usable = Callable[[Array, Array, Array], NDArray[np.bool_]]
Placed = Callable[[Array], Array]
Find = Callable[[NDArray[np.uint8], int], "AllKeypoints"]
DARK, DARK_PERCENT = 100, 99  # gray value that one pixel in a hundred of a well exposed image exceeds


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
    return enough_keypoints(image, most, usable, partial(AllKeypoints.of, place=place)).strongest(
        most, usable
    )


def enough_keypoints(image: NDArray[np.uint8], most: int, usable: Usable, find: Find) -> AllKeypoints:
    """Twice as many keypoints as are wanted, or all, if there are too few usable ones among those.

    Args:
        image: uint8 [h, w].
        most: number of keypoints that are wanted.
        usable: as of `strongest_keypoints`.
        find: finds keypoints in an image, about so many, the strongest; 0: all.
    """
    for limit in (2 * most, 0):
        found = find(image, limit)
        u, v = found.pixels.T
        if np.count_nonzero(usable(u, v, found.sizes)) >= most or len(found.sizes) < limit:
            break
    return found


@dataclass(frozen=True)
class AllKeypoints:
    """What SIFT finds in an image, usable or not, in its own order.

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
    def of(image: NDArray[np.uint8], limit: int, place: Placed = lambda pixels: pixels) -> AllKeypoints:
        """The strongest of an image.

        Args:
            image: uint8 [h, w].
            limit: how many, about; 0: all.
            place: as of `strongest_keypoints`.
        """
        import cv2

        keypoints, sift = cv2.SIFT.create(nfeatures=limit).detectAndCompute(image, None)
        if not keypoints:
            none = np.zeros(0)
            return AllKeypoints(np.zeros((0, DIMENSIONS), np.float32), np.zeros((0, 2)), none, none, none)
        pixels = place(np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2))
        responses, angles, sizes = np.array([(k.response, k.angle, k.size) for k in keypoints]).T
        return AllKeypoints(np.asarray(sift, np.float32), pixels, responses, angles, sizes)

    def strongest(self, most: int, usable: Usable) -> Keypoints:
        """The strongest that are usable.

        Args:
            most: number of keypoints kept.
            usable: as of `strongest_keypoints`.
        """
        if not len(self.sizes):
            return NO_KEYPOINTS
        u, v = self.pixels.T
        order = np.lexsort((self.angles, u, v, -self.responses))
        order = order[usable(u, v, self.sizes)[order]][:most]
        return Keypoints(root_sift(self.sift[order]), self.pixels[order], self.responses[order])


class KeptKeypoints:
    """What SIFT found in the images of a frame: where pixels are left out of it, its image stays the same."""

    def __init__(self) -> None:
        """Begin with none."""
        self._found: dict[tuple[int, bytes], AllKeypoints] = {}

    def of(self, image: NDArray[np.uint8], limit: int) -> AllKeypoints:
        """`AllKeypoints.of`, or what it returned before.

        Args:
            image: uint8 [h, w].
            limit: how many, about; 0: all.
        """
        key = limit, image.tobytes()
        if key not in self._found:
            self._found[key] = AllKeypoints.of(image, limit)
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


def nearest_pixel(at: Array, size: int) -> NDArray[np.int64]:
    """Row or column of the pixel nearest to a place in the image, [n].

    Args:
        at: places [n], pixels.
        size: height or width of the image.
    """
    return np.clip(np.rint(at).astype(np.int64), 0, size - 1)
