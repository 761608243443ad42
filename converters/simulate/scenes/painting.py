"""What materials are painted with: noise, colors, shapes.

A material is a function `(rng, width_m, height_m, texel_m) -> albedo`, float32 [h, w, 3] in RGB, 0..255 (more where it
shines), h = ceil(height_m / texel_m). The first row is the top of the surface and the first column its left side as
seen from the front.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Color = Sequence[float]
Material = Callable[[np.random.Generator, float, float, float], Image]


def shape_of(width_m: float, height_m: float, texel_m: float) -> tuple[int, int]:
    """Rows and columns of texels that cover a surface.

    Args:
        width_m: of the surface.
        height_m: of the surface.
        texel_m: side of a texel.
    """
    return max(1, int(np.ceil(height_m / texel_m - 1e-6))), max(1, int(np.ceil(width_m / texel_m - 1e-6)))


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], wave_x: float, wave_y: float) -> Image:
    """Smooth random field [h, w] of about unit variance.

    Args:
        rng: source of the nodes.
        shape: (rows, columns) of texels.
        wave_x: texels between the random nodes along a row.
        wave_y: the same along a column.
    """
    h, w = shape
    nodes = rng.standard_normal((int(np.ceil(h / wave_y)) + 2, int(np.ceil(w / wave_x)) + 2)).astype(
        np.float32
    )
    size = (max(w, round(nodes.shape[1] * wave_x)), max(h, round(nodes.shape[0] * wave_y)))
    return 1.3 * cv2.resize(nodes, size, interpolation=cv2.INTER_CUBIC)[:h, :w]


def cloud(
    rng: np.random.Generator,
    shape: tuple[int, int],
    wave: float,
    octaves: int = 4,
    *,
    gain: float = 0.6,
    stretch: float = 1.0,
) -> Image:
    """Sum of smooth noises, each with half the wave length and `gain` times the height of the one before.

    Args:
        rng: source of the nodes.
        shape: (rows, columns) of texels.
        wave: texels between the random nodes of the first noise.
        octaves: how many noises.
        gain: height of a noise as a share of that of the one before.
        stretch: factor of the wave length along the rows (x).
    """
    field = np.zeros(shape, dtype=np.float32)
    height = norm = 1.0
    for _ in range(octaves):
        field += height * smooth_noise(rng, shape, max(1.0, wave * stretch), max(1.0, wave))
        norm += height**2
        wave, height = wave / 2, height * gain
    return field / np.float32(np.sqrt(norm - 1.0))


def flat(shape: tuple[int, int], color: Color) -> Image:
    """One color everywhere.

    Args:
        shape: (rows, columns) of texels.
        color: RGB, 0..255.
    """
    return np.broadcast_to(np.array(color, dtype=np.float32), (*shape, 3)).copy()


def shaded(rng: np.random.Generator, color: Color, spread: float) -> tuple[float, float, float]:
    """A color near `color`: brightness and, less, hue changed at random.

    Args:
        rng: source of the change.
        color: RGB, 0..255.
        spread: standard deviation of the brightness, as a share of it.
    """
    c = np.array(color, dtype=np.float64) * (1 + spread * rng.standard_normal())
    c = np.clip(c * (1 + 0.2 * spread * rng.standard_normal(3)), 4, 250)
    return float(c[0]), float(c[1]), float(c[2])


def vivid(rng: np.random.Generator, saturation: float = 0.8) -> tuple[float, float, float]:
    """A random color, neither black nor white.

    Args:
        rng: source of the color.
        saturation: 0 to 1; the most that the color may have.
    """
    hue, value = rng.random(), rng.uniform(90, 235)
    dull = value * (1 - saturation * rng.uniform(0.4, 1.0))
    r, g, b = (value - (value - dull) * min(1.0, max(0.0, abs((hue * 6 + k) % 6 - 3) - 1)) for k in (0, 4, 2))
    return float(r), float(g), float(b)


def ellipse(
    image: Image, center: tuple[int, int], axes: tuple[int, int], color: Color, *, turn_deg: float
) -> None:
    """Fill an ellipse.

    Args:
        image: drawn upon in place.
        center: (x, y), pixels.
        axes: half axes, pixels.
        color: RGB, 0..255.
        turn_deg: by which the first axis is turned from x to y.
    """
    cv2.ellipse(image, center, axes, turn_deg, 0, 360, color=color, thickness=-1, lineType=cv2.LINE_AA)
