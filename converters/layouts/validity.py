"""Which pixels of a camera's images show the scene: what is black in all images, and what users say.

A camera may show pixels that are none of the scene in every image: the rim that undistortion and rectification leave,
a vignette that is black, the robot itself. The masks of this module are bool [H, W], True = shows the scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image, read_bytes
from duagc.pipeline.geometry.masks import Mask

ALL_ROBOTS = ""
BLACK = 8  # of 255: a pixel that is never brighter sees nothing
BRIGHT = 40  # of 255: an image whose percentile is no brighter cannot tell black pixels from a dark scene
BRIGHT_PERCENT = 75
LEAST_IMAGES = 8  # that must tell
LEAST_BLACK = 0.002  # of the pixels, in pieces that touch the border
GROW_PX = 4  # a vignette does not end from one pixel to the next
# side and number of the small images by which it is seen whether the camera moved
SMALL_PX, MOST_SMALL = 24, 256
MOST = 0.5  # of a pixel of these: then it counts as one of some that are asked for
MOVED = 0.25
"""Change of the median pixel that is not black, in standard deviations of the image, from which on the camera moved.

Still cameras have at most 0.05, 0.11 with an exposure that changes by 30 %, 0.21 while somebody walks through; half a
second of fr1_desk has 0.47, all of it 1.35.
"""


def shrunk(mask: Mask, factor: int) -> Mask:
    """Blocks of factor x factor pixels that all show the scene.

    Args:
        mask: bool [H, W], sides that are multiples of the factor.
        factor: side of a block, pixels.
    """
    h, w = mask.shape
    return np.asarray(mask.reshape(h // factor, factor, w // factor, factor).all(axis=(1, 3)))


class BlackBorder:
    """Finds pixels that are black in all images, in large pieces at the border: a vignette or the rim of a lens.

    Before a camera that stands still what is dark stays dark: then nothing is found.
    """

    def __init__(self) -> None:
        """No image yet."""
        self._brightest: NDArray[np.uint8] | None = None
        self._images, self._every = 0, 1
        self._small: list[NDArray[np.float32]] = []

    def add(self, value: NDArray[np.uint8]) -> None:
        """Take an image of the recording; a few of every second do.

        Args:
            value: [h, w], brightest of the three colors.
        """
        import cv2

        if np.percentile(value, BRIGHT_PERCENT) > BRIGHT and (
            self._brightest is None or value.shape == self._brightest.shape
        ):
            self._brightest = value if self._brightest is None else np.maximum(self._brightest, value)
            if self._images % self._every == 0:
                small = cv2.resize(value, (SMALL_PX, SMALL_PX), interpolation=cv2.INTER_AREA)
                self._small.append(np.asarray(small, dtype=np.float32))
            self._images += 1
            if len(self._small) == MOST_SMALL:
                self._small, self._every = self._small[::2], 2 * self._every

    def result(self, valid: Mask | None) -> Mask | None:
        """Pixels that show something, bool [h, w]; None where nothing is black, or too few images could tell.

        Args:
            valid: bool [h, w], pixels that show the scene by all that is known; None: all.
        """
        from scipy import ndimage

        if self._brightest is None or self._images < LEAST_IMAGES or not self.moved():
            return None
        black = self._brightest <= BLACK
        outside = np.zeros_like(black) if valid is None else ~valid
        labels, pieces = ndimage.label(black | outside, np.ones((3, 3)))
        touches = np.zeros(pieces + 1, dtype=bool)
        touches[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
        touches[0] = False  # what is not black
        found = touches[labels] & ~outside
        if np.count_nonzero(found) < LEAST_BLACK * found.size:
            return None
        return ~np.asarray(ndimage.binary_dilation(found, np.ones((3, 3)), GROW_PX))

    def moved(self) -> bool:
        """Whether what is not black changed, by more than exposure."""
        return self.change_of(np.ones((SMALL_PX, SMALL_PX), dtype=bool)) > MOVED

    def change_of(self, pixels: Mask) -> float:
        """By how much those of some pixels that are not black changed, as a rule, in standard deviations of the image.

        Args:
            pixels: bool [h, w], some of those of the images.
        """
        import cv2

        if not self._small:
            return 0.0
        images = np.stack(self._small)
        is_lit = images.max(axis=0) > 2 * BLACK
        size, share = (SMALL_PX, SMALL_PX), pixels.astype(np.float32)
        chosen = (np.asarray(cv2.resize(share, size, interpolation=cv2.INTER_AREA)) > MOST)[is_lit]
        if not chosen.any():
            return 0.0
        lit = images[:, is_lit]
        lit = lit - lit.mean(axis=1, keepdims=True)
        lit /= np.maximum(lit.std(axis=1, keepdims=True), 1)
        low, high = np.percentile(lit, (25, 75), axis=0)  # who walks through is seen in few images
        return float(np.median((high - low)[chosen]))


# --- what users say -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class UserMask:
    """A mask that a user gives.

    Attributes:
        where: begins the line of an error.
        image: bool [H, W], as the file has it; None: there is a polygon.
        polygon: corners (column, row) of what does not show the scene, pixels.
    """

    where: str
    image: Mask | None = None
    polygon: tuple[tuple[float, float], ...] = ()

    def of_size(self, width: int, height: int) -> Mask:
        """The mask of the images of a recording.

        Args:
            width: of the images.
            height: of the images.
        Raises:
            DuagError: the mask has another size.
        """
        import cv2

        if self.image is not None:
            if self.image.shape != (height, width):
                found = f"{self.image.shape[1]}x{self.image.shape[0]}"
                raise DuagError(
                    f"{self.where}: is {found}, expected {width}x{height} as the images of the recording"
                )
            return self.image
        inside = np.zeros((height, width), dtype=np.uint8)
        corners = np.rint(np.array(self.polygon)).astype(np.int32)
        cv2.fillPoly(inside, [corners], (1,))
        if not inside.any():
            raise DuagError(
                f"{self.where}: its polygon covers no pixel of {width}x{height} images, expected corners in them"
            )
        return inside == 0


USER_MASKS: ContextVar[Mapping[str, Sequence[UserMask]] | None] = ContextVar("user_masks", default=None)
"""Masks by robot, `ALL_ROBOTS` for those of every robot; recordings that are written meanwhile apply them."""


def read_mask(path: Path) -> UserMask:
    """A mask image: PNG of 8 bits; 0 = does not show the scene, anything else = shows it.

    Args:
        path: of the PNG.

    Raises:
        DuagError: it is no such image, or leaves no pixel.
    """
    import cv2

    image = decode_image(read_bytes(path, "a mask as PNG"), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 2:
        found = "no decoder reads it" if image is None else f"is {image.dtype} with {image.ndim} axes"
        raise DuagError(f"{path}: {found}, expected a mask: PNG of 8 bits, one channel")
    if not image.any():
        raise DuagError(f"{path}: is 0 everywhere, expected a pixel that shows the scene")
    return UserMask(str(path), np.asarray(image > 0))


def user_masks(
    said: Sequence[str], filed: Sequence[Any] = (), file: Path | None = None
) -> dict[str, list[UserMask]]:
    """Masks by robot.

    Args:
        said: FILE of every robot, or ROBOT=FILE.
        filed: tables of an options file: `file` or `polygon`, and `robot` unless for all.
        file: that options file; files are relative to it.
    Raises:
        DuagError: names what is wrong.
    """
    masks: dict[str, list[UserMask]] = {}
    for text in said:
        robot, separator, name = text.partition("=")
        if not separator:
            robot, name = ALL_ROBOTS, text
        masks.setdefault(robot, []).append(read_mask(Path(name)))
    if not isinstance(filed, Sequence) or isinstance(filed, str):
        raise DuagError(f"{file}: masks = {filed!r}, expected tables [[masks]]")
    for number, table in enumerate(filed):
        where = f"{file}: masks[{number}]"
        if not isinstance(table, Mapping) or not set(table) <= {"robot", "file", "polygon"}:
            raise DuagError(f"{where}: {table!r}, expected robot, file, polygon")
        robot = table.get("robot", ALL_ROBOTS)
        if not isinstance(robot, str) or ("file" in table) == ("polygon" in table):
            raise DuagError(
                f"{where}: {dict(table)!r}, expected either file or polygon, and the name of a robot"
            )
        if "file" in table:
            base = file.parent if file is not None else Path()
            mask = read_mask(base / str(table["file"]))
        else:
            mask = UserMask(where, None, _polygon(table["polygon"], where))
        masks.setdefault(robot, []).append(mask)
    return masks


def _polygon(value: Any, where: str) -> tuple[tuple[float, float], ...]:
    """Corners of a polygon."""
    try:
        corners = tuple((float(u), float(v)) for u, v in value)
    except (TypeError, ValueError):
        corners = ()
    if len(corners) < 3 or not all(math.isfinite(x) and abs(x) < 1e6 for corner in corners for x in corner):
        raise DuagError(
            f"{where}: polygon = {value!r}, expected at least three corners [column, row] in pixels"
        )
    return corners


def mask_of_user(robot: str, width: int, height: int) -> Mask | None:
    """What users say of the images of a robot; None: nothing.

    Args:
        robot: its name.
        width: of its images.
        height: of its images.
    Raises:
        DuagError: a mask has another size.
    """
    masks = USER_MASKS.get() or {}
    found = [mask.of_size(width, height) for name in (ALL_ROBOTS, robot) for mask in masks.get(name, ())]
    return np.logical_and.reduce(found) if found else None
