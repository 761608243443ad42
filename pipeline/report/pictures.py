"""Pictures of the report: images, renders, depths and errors as data URIs."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.files import encode_jpeg
from duagc.pipeline.base.plotting import matplotlib

Image = NDArray[Any]
NOTHING = (236, 239, 242)  # where there is no value: the light gray of the page


def svg_uri(svg: str) -> str:
    """data: URI of an SVG text.

    Args:
        svg: the text.
    """
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode("utf-8")).decode("ascii")


def jpeg_uri(rgb: Image, width: int) -> str:
    """data: URI of an 8-bit RGB image as JPEG.

    Args:
        rgb: uint8 [h, w, 3].
        width: to which the image is scaled, pixels; the shape stays.
    """
    import cv2

    height = max(1, round(rgb.shape[0] * width / rgb.shape[1]))
    shrinks = width < rgb.shape[1]
    small = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    data = encode_jpeg(small[:, :, ::-1], quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def to_uint8(color: Image) -> NDArray[np.uint8]:
    """8-bit RGB of colors in 0..1, clamped.

    Args:
        color: [...], 0..1.
    """
    return np.rint(np.clip(color, 0.0, 1.0) * 255.0).astype(np.uint8)


def colored(
    values: Image, low: float, high: float, *, valid: Image, palette: str = "viridis"
) -> NDArray[np.uint8]:
    """8-bit RGB [h, w, 3] of a scalar image: `low` to `high` over a palette, gray where not valid.

    Args:
        values: [h, w].
        low: value at the low end of the palette.
        high: value at the high end.
        valid: bool [h, w].
        palette: name of a colormap of matplotlib.
    """
    span = high - low if high > low else 1.0
    unit = np.clip((np.where(valid, values, low) - low) / span, 0.0, 1.0)
    rgb = (matplotlib().colormaps[palette](unit)[..., :3] * 255.0).round().astype(np.uint8)
    rgb[~valid] = NOTHING
    return rgb


def scale_uri(palette: str) -> str:
    """data: URI of a horizontal strip from the low to the high end of a palette.

    Args:
        palette: name of a colormap of matplotlib.
    """
    ramp = np.tile(np.linspace(0.0, 1.0, 256), (12, 1))
    return jpeg_uri(colored(ramp, 0.0, 1.0, valid=np.ones(ramp.shape, dtype=bool), palette=palette), 256)


def color_by(values: Image, low: float, high: float, palette: str = "viridis") -> NDArray[np.float32]:
    """Colors float32 [n, 3] in 0..1 of scalars [n], clamped to `low`..`high`.

    Args:
        values: [n].
        low: value at the low end of the palette.
        high: value at the high end.
        palette: name of a colormap of matplotlib.
    """
    unit = np.clip((values - low) / (high - low if high > low else 1.0), 0.0, 1.0)
    return np.asarray(matplotlib().colormaps[palette](unit)[:, :3], dtype=np.float32)
