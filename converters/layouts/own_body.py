"""Where a camera sees the robot that carries it: a bumper, a gripper, the frame that it is mounted on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.masks import Mask

WIDTH = 160  # columns that are looked at, or up to twice as many
MOST_IMAGES, LEAST_IMAGES = 64, 8  # that are compared
STILL, MOVED = (
    0.03,
    0.10,
)  # spread of a pixel's depth over its median: of what moves with the camera, and of the scene
KNOWN = 0.8  # share of the images in which a pixel of the body has a depth
STEP = 1.15  # how many times as far what is next to the body is, or it may be a floor that the camera moves along
NEXT_TO = 5  # pixels of the reduced image
LEAST_MOVED = 0.25  # share of what is no body whose depth must change
LEAST_SHARE = 0.005  # of the pixels, in pieces that touch the border
GROW = 2  # pixels of the reduced image: the outline of what is near is blurred
Stack = NDArray[np.floating]


class OwnBody:
    """Finds large pieces at the border whose depth stays as it is while that of most pixels changes.

    A floor keeps its depth too, where the camera moves along it. But it goes on, as its plane does, where the body has
    an edge, with the scene some way behind it.

    A body that fills most of the view leaves little that could change, and a floor next to it keeps its depth as well.
    `pieces` are what may be such a body, or something long that the camera moves along: color shows which.
    """

    def __init__(self) -> None:
        self._images: list[NDArray[np.uint16]] = []
        self._shape = (0, 0)
        self._every = self._seen = 0
        self._found: tuple[Stack, Stack, Stack] | None = None  # of `_measured`

    def add(self, depth: NDArray[np.uint16]) -> None:
        """Take a depth image of the recording; of many, some evenly spread ones are kept.

        Args:
            depth: [h, w], 0 = none; all in one unit.
        """
        if not self._images:
            self._shape, self._every = depth.shape, 1
        if depth.shape != self._shape:
            return
        self._seen += 1
        if (self._seen - 1) % self._every:
            return
        step = self._step()
        self._found = None
        self._images.append(depth[step // 2 :: step, step // 2 :: step].copy())
        if len(self._images) == MOST_IMAGES:
            self._images, self._every = self._images[::2], 2 * self._every

    def _step(self) -> int:
        return max(1, self._shape[1] // WIDTH)

    def spread(self) -> Stack | None:
        """Spread of every pixel's depth over its median, [h, w], NaN where it never has one.

        None where the camera stood still, or too few images can tell.
        """
        found = self._measured()
        return None if found is None or not _most_moves(*found) else self._enlarged(found[2])

    def _measured(self) -> tuple[Stack, Stack, Stack] | None:
        """Share of the images in which a pixel has a depth, its median, and its spread over that.

        None where too few images can tell.
        """
        if len(self._images) < LEAST_IMAGES:
            return None
        if self._found is None:
            depth = np.stack(self._images).astype(np.float32)
            known = (depth > 0).mean(axis=0)
            low, middle, high = percentiles(np.where(depth > 0, depth, np.float32(np.nan)))
            self._found = known, middle, (high - low) / middle
        return self._found

    def _enlarged(self, reduced: NDArray[Any]) -> NDArray[Any]:
        """What is of the reduced images, of the whole ones."""
        step = self._step()
        rows, columns = (
            np.minimum(np.arange(n) // step, m - 1) for n, m in zip(self._shape, reduced.shape, strict=True)
        )
        return np.asarray(reduced[np.ix_(rows, columns)])

    def result(self) -> Mask | None:
        """Pixels that show no body, bool [h, w]; None where none is seen, or the images cannot tell."""
        from scipy import ndimage

        if (measured := self._measured()) is None or not _most_moves(*measured):
            return None
        known, middle, spread = measured
        still = (known >= KNOWN) & (spread < STILL)
        # the rim that undistortion leaves has no depth
        labels, _ = ndimage.label(still | (known == 0), np.ones((3, 3)))
        found = np.zeros_like(still)
        for label in np.unique(_at_border(labels)):
            piece = still & (labels == label)
            if np.count_nonzero(piece) >= LEAST_SHARE * still.size:
                found |= _with_edge(piece, middle)
        if not found.any():
            return None
        return ~self._enlarged(ndimage.binary_dilation(found, np.ones((3, 3)), GROW))

    def pieces(self) -> tuple[list[Mask], Mask | None]:
        """Large pieces at the border, bool [h, w] each, that keep their depth and end at an edge.

        What is behind the edge may keep its depth, too, as a floor does. Besides, where depth changes; None: nowhere.
        """
        from scipy import ndimage

        if (measured := self._measured()) is None:
            return [], None
        known, middle, spread = measured
        still, square = (known >= KNOWN) & (spread < STILL), np.ones((3, 3))
        others = (known > 0.5) & ~still
        changes = others & (spread >= MOVED)
        if np.count_nonzero(changes) <= LEAST_MOVED * np.count_nonzero(others):
            return [], None
        unknown, _ = ndimage.label(known == 0, square)
        outside = np.pad(np.isin(unknown, np.setdiff1d(_at_border(unknown), 0)), 1, constant_values=True)
        outside = ndimage.binary_dilation(outside, square, GROW)[1:-1, 1:-1]
        labels, _ = ndimage.label(still & ~_steps(middle), square)
        sizes, out = np.bincount(labels.ravel()), []
        for label in np.setdiff1d(np.unique(labels[outside]), 0):
            piece = labels == label
            if sizes[label] >= LEAST_SHARE * still.size and _with_edge(piece, middle).any():
                out.append(self._enlarged(ndimage.binary_dilation(piece, square, GROW)))
        return out, self._enlarged(changes)


def _most_moves(known: Stack, _: Stack, spread: Stack) -> bool:
    """Whether the depth of most pixels changes; shares of the images with a depth, medians, spreads."""
    often = known > 0.5
    return bool(often.any() and np.median(spread[often]) >= MOVED)


def _at_border(image: NDArray[Any]) -> NDArray[Any]:
    """The values along the border of an image."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def _steps(middle: Stack) -> Mask:
    """Pixels next to which depth is `STEP` times as large or as small."""
    out = np.zeros(middle.shape, bool)
    for here, there in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        one, other = middle[here], middle[there]
        step = np.maximum(one, other) >= STEP * np.minimum(one, other)  # False where one is not known
        out[here] |= step
        out[there] |= step
    return out


def percentiles(depth: Stack) -> Stack:
    """The 10th, 50th and 90th percentile of every pixel, [3, h, w]; NaN where it never had a depth.

    Those of `np.nanpercentile`, rounded to the type of the depths. That takes pixels one by one; here those with as
    many depths go together.

    Args:
        depth: [n, h, w], NaN where a pixel has none.
    """
    ordered = np.sort(depth, axis=0)  # NaN comes last
    count = np.count_nonzero(~np.isnan(depth), axis=0)
    out = np.full((3, *count.shape), np.nan, dtype=depth.dtype)
    for n in np.unique(count[count > 0]):
        out[:, count == n] = np.percentile(ordered[:n, count == n], [10, 50, 90], axis=0)
    return out


def _with_edge(piece: Mask, middle: Stack) -> Mask:
    """The piece, with what it encloses, if most of what is next to it is farther than it goes on; else nothing.

    The inverse depth of a plane is linear in the image: toward its horizon a floor's depth grows by more than a step,
    as it did before.

    Args:
        piece: bool [h, w].
        middle: [h, w], median depth of every pixel, or NaN.
    """
    from scipy import ndimage

    square = np.ones((3, 3))
    around = ndimage.binary_dilation(piece, square, NEXT_TO) & ~ndimage.binary_dilation(piece, square)
    around &= np.isfinite(middle)
    if not around.any():
        return np.zeros_like(piece)
    rows, columns = ndimage.distance_transform_edt(~piece, return_distances=False, return_indices=True)
    edge = rows[around], columns[around]
    inside = tuple(2 * e - at for e, at in zip(edge, np.nonzero(around), strict=True))  # as far from the edge
    seen = np.all([(i >= 0) & (i < n) for i, n in zip(inside, piece.shape, strict=True)], axis=0)
    inside = tuple(np.where(seen, i, e) for i, e in zip(inside, edge, strict=True))
    inverse = 1 / middle[edge]
    slope = np.where(piece[inside], inverse - 1 / middle[inside], 0.0)
    steps = middle[around] * (inverse + np.minimum(slope, 0.0))
    return ndimage.binary_fill_holes(piece) if np.median(steps) >= STEP else np.zeros_like(piece)
