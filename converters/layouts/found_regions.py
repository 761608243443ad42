"""Regions of all images of a robot that do not show the scene, found while its frames are written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.constant_edges import ConstantEdges
from duagc.converters.layouts.own_body import OwnBody
from duagc.converters.layouts.validity import MOVED, BlackBorder
from duagc.pipeline.base.files import decode_image
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry.lens import Maps, rectified
from duagc.pipeline.geometry.masks import Mask

EVERY, EVERY_NS = 8, 250_000_000  # a frame of so many is looked at, and one in so long a time
LESS = 0.5  # of the change of color of the scene: what a body that is reflecting, or shakes, may have
EVERY_OF_FIRST, MANY = 3, 32  # of the first frames more are looked at, so that short recordings tell


class FoundRegions:
    """Looks at some frames of a robot."""

    def __init__(self, maps: Maps | None = None) -> None:
        """Begin with no image; the first frame that is not held out will be looked at.

        Args:
            maps: where in color images the pixels of the recording's camera lie; None: they are that camera's.
        """
        self._maps = maps
        self._black, self._body, self._edges = BlackBorder(), OwnBody(), ConstantEdges()
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
        if (value := self._value(color)) is not None:  # else reading the recording will complain
            self._black.add(value)
            self._edges.add(value)
        if depth is not None:
            self._body.add(depth)

    def result(self, valid: Mask | None) -> dict[str, Mask]:
        """Masks [h, w] of pixels that show the scene, by what the others show: "black", "body", "drawn".

        Args:
            valid: bool [h, w], pixels that show the scene by all that is known; None: all.
        """
        found = {"black": self._black.result(valid), "body": self._body_mask()}
        masks = {name: mask for name, mask in found.items() if mask is not None}
        spread = self._body.spread()
        if spread is not None and self._black.moved():
            known = [mask for mask in (valid, *masks.values()) if mask is not None]
            drawn = self._edges.result(~np.logical_and.reduce(known) if known else None, spread)
            masks |= {} if drawn is None else {"drawn": drawn}
        return masks

    def _body_mask(self) -> Mask | None:
        """Pixels [h, w] that show no body: of one that leaves most of the view, or one that keeps its color, too."""
        shown, (pieces, moved) = self._body.result(), self._body.pieces()
        change = 0.0 if moved is None else self._black.change_of(moved)
        if change <= MOVED:
            return shown
        limit = max(MOVED, LESS * change)
        masks = [~piece for piece in pieces if self._black.change_of(piece) <= limit]
        masks += [] if shown is None else [shown]
        return np.logical_and.reduce(masks) if masks else None

    def _value(self, color: bytes) -> NDArray[np.uint8] | None:
        """The brightest of the three colors, [h, w], as the recording's camera sees it; None: it cannot be read."""
        import cv2

        image = decode_image(color, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            return None
        if self._maps is not None:
            image = rectified(image, self._maps)
        blue, green, red = image[..., 0], image[..., 1], image[..., 2]
        return np.maximum(np.maximum(blue, green), red)  # ten times as fast as max(axis=2)
