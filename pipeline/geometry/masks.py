"""Masks of pixels that may be used: bool [H, W], True = usable."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
CHECKER = (170, 210)  # grays of the squares that stand for no pixel


def halved(mask: Mask) -> Mask:
    """Blocks of 2x2 pixels that may all be used, [H // 2, W // 2]; a last odd row or column is cut.

    Args:
        mask: bool [H, W].
    """
    h, w = mask.shape[0] // 2 * 2, mask.shape[1] // 2 * 2
    return mask[0:h:2, :w:2] & mask[0:h:2, 1:w:2] & mask[1:h:2, :w:2] & mask[1:h:2, 1:w:2]


def total(planes: NDArray[np.float32], mask: Mask) -> float:
    """Sum over the usable pixels, float64: the others count 0, which is faster than to take the rest out.

    Args:
        planes: [..., H, W], finite.
        mask: bool [H, W].
    """
    return float(np.sum(planes * mask, dtype=np.float64))


def masked_depth(depth_m: NDArray[np.floating], mask: Mask | None) -> NDArray[np.float32]:
    """Depth float32 [H, W], meters, 0 where a mask forbids the pixel.

    Args:
        depth_m: [H, W], 0 = unknown.
        mask: bool [H, W]; None = all may be used.
    """
    depth_m = np.asarray(depth_m, dtype=np.float32)
    return depth_m if mask is None else np.where(mask, depth_m, np.float32(0))


def whole_windows(mask: Mask, reach_px: int) -> Mask:
    """Pixels around which a square window holds usable pixels only, [H, W]; beyond the image all count as usable.

    Args:
        mask: bool [H, W].
        reach_px: of the window to either side; its side is 2 reach_px + 1.
    """
    import cv2

    window = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
    eroded = cv2.erode(mask.view(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=(1,))
    return np.asarray(eroded, dtype=np.uint8).astype(bool)


def large_regions(pixels: Mask, least_share: float) -> Mask:
    """The connected regions, corners connect too, of at least a share of the image; [H, W].

    Args:
        pixels: bool [H, W], those that belong to some region.
        least_share: of all pixels of the image.
    """
    import cv2

    _, labels, statistics, _ = cv2.connectedComponentsWithStats(pixels.view(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= least_share * pixels.size
    large[0] = False  # the pixels of none
    return np.asarray(large[labels])


def distance_px(mask: Mask) -> NDArray[np.float32]:
    """Distance of every pixel to the nearest one that may not be used, px, [H, W]; 0 there.

    Args:
        mask: bool [H, W].
    """
    import cv2

    if mask.all():
        return np.full(mask.shape, np.inf, dtype=np.float32)
    distance = cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance, dtype=np.float32)


def checkered(image: NDArray[np.uint8], mask: Mask | None, side_px: int = 8) -> NDArray[np.uint8]:
    """An image to be looked at: a checkerboard of grays where a pixel may not be used.

    Args:
        image: uint8 [H, W, 3].
        mask: bool [H, W]; None: all may be used.
        side_px: of the squares.
    """
    if mask is None:
        return image
    row, column = np.nonzero(~mask)
    out = image.copy()
    out[row, column] = np.array(CHECKER, np.uint8)[(row // side_px + column // side_px) % 2, None]
    return out


def filled(color: NDArray[np.uint8], mask: Mask) -> NDArray[np.uint8]:
    """An image in which every pixel that may not be used has the color of a usable one next to it.

    So nothing of what was there is left, and no edge is made that a filter or a feature detector would find.

    Args:
        color: uint8 [H, W, 3].
        mask: bool [H, W]; without a usable pixel the image becomes black.
    """
    import cv2

    if mask.all():
        return color
    if not mask.any():
        return np.zeros_like(color)
    # a usable pixel is a zero of the distance transform; zeros are numbered from 1, row by row
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    others = np.flatnonzero(~mask)
    nearest = np.flatnonzero(mask)[labels.ravel()[others] - 1]
    out = color.copy()
    out.reshape(-1, color.shape[-1])[others] = color.reshape(-1, color.shape[-1])[nearest]
    return out
