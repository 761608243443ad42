"""Exposures of a robot's frames: how the colors of an image differ from those of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array

SATURATED = 254
"""From this value of 8 bits on, a channel may have been brighter than it shows."""


@dataclass(frozen=True)
class Exposure:
    """Gain and offset of a frame, by channel: what the map shows in color c is gain * c + offset in the image.

    Attributes:
        gain: [3], RGB.
        offset: [3], colors 0..1.
        white: [3], color of the map that a saturated channel is taken for.
    """

    gain: Array
    offset: Array
    white: Array

    def in_map(self, color: NDArray[np.uint8]) -> NDArray[np.float32]:
        """An image in the colors of the map; bright ones may be above 1.

        Args:
            color: RGB [h, w, 3], as taken.
        """
        return by_table(color, self.table)

    @cached_property
    def table(self) -> NDArray[np.float32]:
        """Color [256, 3] of the map by value in the image."""
        values = np.arange(256)[:, None]
        scale = (1 / (255 * self.gain)).astype(np.float32)
        shown = values.astype(np.float32) * scale - (self.offset / self.gain).astype(np.float32)
        return np.where(values >= SATURATED, self.white.astype(np.float32), shown)

    def in_image(self, color: NDArray[np.floating], alpha: NDArray[np.floating]) -> NDArray[np.float32]:
        """A render of the map, on black, in the colors of the image.

        Args:
            color: [h, w, 3], 0..1.
            alpha: [h, w]; the background stays black.
        """
        out = np.empty(color.shape, np.float32)
        # by channel: a product with three numbers over the last axis would take five times as long
        for k, (gain, offset) in enumerate(zip(self.gain, self.offset, strict=True)):
            np.multiply(color[..., k], np.float32(gain), out=out[..., k])
            out[..., k] += np.float32(offset) * alpha
        return out


def unit_color(color: NDArray[np.uint8], exposure: Exposure | None) -> NDArray[np.float32]:
    """An image [h, w, 3] in the colors of the map, 0..1 and above.

    Args:
        color: RGB [h, w, 3], as taken.
        exposure: of the image; None: as the map.
    """
    return color * np.float32(1 / 255) if exposure is None else exposure.in_map(color)


def by_table(color: NDArray[np.uint8], table: NDArray[np.float32]) -> NDArray[np.float32]:
    """An image [h, w, 3] of what its values stand for.

    Args:
        color: RGB [h, w, 3], as taken.
        table: [256, 3], by value of a channel.
    """
    return np.asarray(cv2.LUT(color, table[None]), dtype=np.float32)


def unit_table(exposure: Exposure | None) -> NDArray[np.float32]:
    """Color [256, 3] of the map by value of an image's channel: `unit_color` without the image.

    Args:
        exposure: of the image; None: as the map.
    """
    return _UNIT_TABLE if exposure is None else exposure.table


_UNIT_TABLE: NDArray[np.float32] = np.repeat(
    np.arange(256, dtype=np.float32)[:, None], 3, axis=1
) * np.float32(1 / 255)


@dataclass(frozen=True)
class ExposureTrack:
    """The exposures of one robot's log.

    Attributes:
        frame_index: [n], ascending; empty: all frames are exposed as the map.
        gain: [n, 3].
        offset: [n, 3].
    """

    frame_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    gain: Array = field(default_factory=lambda: np.ones((0, 3)))
    offset: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @staticmethod
    def of(frame_index: Sequence[int], gain: Array, offset: Array) -> ExposureTrack:
        """Of frames in any order.

        Args:
            frame_index: of each frame.
            gain: [n, 3].
            offset: [n, 3].
        """
        order = np.argsort(np.asarray(frame_index, dtype=np.int64), kind="stable")
        if not len(order):
            return ExposureTrack()
        return ExposureTrack(
            np.asarray(frame_index, dtype=np.int64)[order],
            np.asarray(gain)[order],
            np.asarray(offset)[order],
        )

    def at(self, frame_index: int) -> Exposure | None:
        """The exposure of a frame, between those of its neighbors in time if it has none; None: as the map.

        Args:
            frame_index: in the log.
        """
        if not len(self.frame_index):
            return None
        log_gain, offset = (
            np.array([np.interp(frame_index, self.frame_index, values[:, k]) for k in range(3)])
            for values in (np.log(self.gain), self.offset)
        )
        return Exposure(np.exp(log_gain), offset, self.white)

    @cached_property
    def white(self) -> Array:
        """Color [3] of the map from which on every frame is saturated."""
        return np.asarray(np.max((1 - self.offset) / self.gain, axis=0))
