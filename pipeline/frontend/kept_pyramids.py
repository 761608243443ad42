"""Image pyramids of keyframes, kept in memory between the passes over them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from duagc.pipeline.registration import RgbdPyramid

MAX_BYTES = 128 << 20  # 40 pyramids of 640x480


class KeptPyramids:
    """Reads pyramids, and keeps those that were asked for first, as many as fit into a number of bytes.

    The joint optimization asks for the keyframes in order, again and again: to keep the last ones instead would be of
    no use as soon as not all fit. Images that change must not be read through one object.
    """

    def __init__(self, read: Callable[[int, int], RgbdPyramid], max_bytes: int = MAX_BYTES) -> None:
        """Begin with none.

        Args:
            read: reads the pyramid of a frame, by its index and the number of levels.
            max_bytes: of what is kept.
        """
        self._read, self._free_bytes = read, max_bytes
        self._kept: dict[int, RgbdPyramid] = {}

    def __call__(self, index: int, levels: int) -> RgbdPyramid:
        """The pyramid of a frame.

        Args:
            index: of the frame.
            levels: number of resolutions.
        """
        kept = self._kept.get(index)
        if kept is None:
            pyramid = self._read(index, levels)
            if size_bytes(pyramid) <= self._free_bytes:
                self._keep(index, pyramid)
            return pyramid
        if len(kept.levels) < levels:
            self._free_bytes += size_bytes(kept)
            built = list(kept.levels)
            while len(built) < levels:
                built.append(built[-1].halved())
            kept = RgbdPyramid(tuple(built))
            self._keep(index, kept)
        return RgbdPyramid(kept.levels[:levels])

    def _keep(self, index: int, pyramid: RgbdPyramid) -> None:
        self._kept[index] = pyramid
        self._free_bytes -= size_bytes(pyramid)


def size_bytes(pyramid: RgbdPyramid) -> int:
    """Memory of the images of a pyramid.

    Args:
        pyramid: of a frame.
    """
    images = (
        image
        for level in pyramid.levels
        for image in (level.gray, level.inverse_depth, level.depth_sigma_m, level.mask)
    )
    return sum(np.asarray(image).nbytes for image in images if image is not None)
