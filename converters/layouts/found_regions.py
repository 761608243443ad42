"""Regions at the border of all images of a robot that do not show the scene, found while its frames are written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.own_body import OwnBody
from duagc.converters.layouts.validity import BlackBorder
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry.lens import Maps
from duagc.pipeline.geometry.masks import Mask

EVERY, EVERY_NS = 8, 250_000_000  # a frame of so many is looked at, and one in so long a time
EVERY_OF_FIRST, MANY = 3, 32  # of the first frames more are looked at, so that short recordings tell


class FoundRegions:
    """Looks at some frames of a robot."""

    def __init__(self, maps: Maps | None = None) -> None:
        """Set up.

        Args:
            maps: where in color images the pixels of the recording's camera lie; None: they are that camera's.
        """
        self._black, self._body = BlackBorder(maps), OwnBody()
        self._next_look_ns = 0

    def add(self, index: int, stamp_ns: int, color: bytes, depth: NDArray[np.uint16] | None) -> None:
        """Take the next frame, and look at it if it is its turn; never at one that is held out.

        Args:
            index: of the frame.
            stamp_ns: its time.
            color: the encoded color image.
            depth: [h, w], 0 = none; None: the frame has none.
        """
        every = EVERY if index >= MANY else EVERY_OF_FIRST
        if is_held_out(index) or (index % every and stamp_ns < self._next_look_ns):
            return
        self._next_look_ns = stamp_ns + EVERY_NS
        self._black.add(color)
        if depth is not None:
            self._body.add(depth)

    def result(self, valid: Mask | None) -> dict[str, Mask]:
        """Masks [h, w] of pixels that show the scene, by what the others show: "black", "body".

        Args:
            valid: bool [h, w], pixels that show the scene by all that is known; None: all.
        """
        found = {"black": self._black.result(valid), "body": self._body.result()}
        return {name: mask for name, mask in found.items() if mask is not None}
