"""Frames that a converter gives to a writer: refused where they are none."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.image_files import JPEG, PNG, rigid
from duagc.converters.layouts.ros_images import encoded_size
from duagc.pipeline.base.files import decode_image

FIRST_BYTES = {"png": PNG, "jpeg": JPEG}


def check_stamp(stamp_ns: Any, where: str) -> None:
    """Refuse a time that is no whole number.

    Args:
        stamp_ns: of a frame.
        where: begins the line of an error.
    """
    try:
        operator.index(stamp_ns)
    except TypeError:
        raise ValueError(f"{where}: time {stamp_ns!r}, expected a whole number of nanoseconds") from None


def check_color(data: bytes, color_format: str, size: tuple[int, int], where: str) -> None:
    """Refuse color that is no image of its format, or has another size; by its header, if that says all.

    Args:
        data: the encoded image.
        color_format: "jpeg" or "png".
        size: width and height.
        where: begins the line of an error.
    """
    if color_format not in FIRST_BYTES:
        raise ValueError(f"{where}: color format {color_format!r}, expected 'jpeg' or 'png'")
    is_so = data.startswith(FIRST_BYTES[color_format])
    found = (encoded_size(data) or _decoded_size(data)) if is_so else None
    if found is None:
        raise ValueError(f"{where}: color is {len(data)} bytes that are no {color_format}, expected an image")
    if found != size:
        raise ValueError(f"{where}: color is {found[0]}x{found[1]}, expected {size[0]}x{size[1]}")


def _decoded_size(data: bytes) -> tuple[int, int] | None:
    import cv2

    image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else (int(image.shape[1]), int(image.shape[0]))


def check_sigma(sigma_m: NDArray[np.floating], depth: NDArray[np.uint16], where: str) -> None:
    """Refuse a standard deviation of depth that is no number, infinite or negative; 0 says that none is known.

    Args:
        sigma_m: [H, W], meters.
        depth: [H, W], 0 = none: there the standard deviation says nothing.
        where: begins the line of an error.
    """
    sigma_m = np.asarray(sigma_m)
    is_wrong = ~((sigma_m >= 0) & np.isfinite(sigma_m)) & (depth > 0)
    if is_wrong.any():
        found = float(sigma_m[is_wrong][0])
        raise ValueError(f"{where}: a standard deviation of depth is {found:g} m, expected 0 or more")


def check_pose(T: NDArray[np.float64], where: str) -> None:
    """Refuse a pose that is no rigid motion, or too far away.

    Args:
        T: of a camera [4, 4].
        where: begins the line of an error.
    Raises:
        DuagError: it is.
    """
    rigid(T, where)
