"""Materials of wood: boards, floors, fronts of furniture.

Nothing repeats: every plank is drawn anew.
"""

import cv2
import numpy as np

from duagc.converters.simulate.scenes.painting import (
    Color,
    Image,
    Material,
    cloud,
    ellipse,
    flat,
    shaded,
    shape_of,
)


def _grain(rng: np.random.Generator, shape: tuple[int, int], texel_m: float) -> Image:
    """Streaks of wood along the columns' direction (x), [h, w]."""
    broad = cloud(rng, shape, 0.045 / texel_m, 3, gain=0.7, stretch=9.0)
    bend = cloud(rng, shape, 0.25 / texel_m, 2, gain=0.5, stretch=3.0)
    y = np.arange(shape[0], dtype=np.float32)[:, None] * np.float32(texel_m)
    rings = np.sin(y * np.float32(2 * np.pi / 0.055) + 2.5 * bend)
    return np.asarray(0.55 * broad + 0.6 * rings, dtype=np.float32)


def _knots(rng: np.random.Generator, image: Image, texel_m: float, per_m2: float) -> None:
    """Dark eyes in wood, drawn in place."""
    h, w = image.shape[:2]
    for _ in range(rng.poisson(per_m2 * h * w * texel_m**2)):
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        size = (
            max(2, int(rng.uniform(0.010, 0.028) / texel_m)),
            max(2, int(rng.uniform(0.006, 0.014) / texel_m)),
        )
        ellipse(image, (x, y), size, (62, 40, 24), turn_deg=float(rng.uniform(-20, 20)))


def wood(color: Color = (168, 120, 78), knots_per_m2: float = 9.0) -> Material:
    """One board, grain along its longer side.

    Args:
        color: of the wood, RGB, 0..255.
        knots_per_m2: expected number of knots in a square meter.
    """

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        along_x = w >= h
        shape = (h, w) if along_x else (w, h)
        image = flat(shape, shaded(rng, color, 0.06)) * (1 + 0.11 * _grain(rng, shape, texel_m))[..., None]
        _knots(rng, image, texel_m, knots_per_m2)
        return image if along_x else np.ascontiguousarray(image.transpose(1, 0, 2))

    return paint


def planks(color: Color = (164, 116, 74), plank_m: float = 0.15) -> Material:
    """A floor of boards of different lengths and tints, along x.

    Args:
        color: of the wood, RGB, 0..255; every board has its own tint.
        plank_m: width of a board.
    """

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = flat((h, w), (60, 40, 26))
        grain = _grain(rng, (h, w), texel_m)
        rows = np.arange(0, h, plank_m / texel_m)
        gap = max(1, round(0.004 / texel_m))
        for top in rows:
            y0, y1 = round(top), min(h, round(top + plank_m / texel_m) - gap)
            x = -rng.uniform(0, 1.2) / texel_m
            while x < w and y1 > y0:
                length = rng.uniform(0.55, 1.7) / texel_m
                x0, x1 = max(0, round(x)), min(w, round(x + length) - gap)
                if x1 > x0:
                    tone = (1 + 0.12 * np.roll(grain[y0:y1, x0:x1], int(rng.integers(0, 40)), axis=0))[
                        ..., None
                    ]
                    image[y0:y1, x0:x1] = np.array(shaded(rng, color, 0.13), dtype=np.float32) * tone
                x += length
        _knots(rng, image, texel_m, 7.0)
        return image

    return paint


def front(color: Color, columns: int, rows: int, knob: Color = (206, 192, 150)) -> Material:
    """Doors or drawers of a piece of furniture, with grain, seams and knobs.

    Args:
        color: of the wood, RGB, 0..255.
        columns: doors or drawers side by side.
        rows: doors or drawers above each other.
        knob: color of the knobs.
    """

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        image = wood(color, 5.0)(rng, width_m, height_m, texel_m)
        h, w = image.shape[:2]
        seam = max(2, round(0.007 / texel_m))
        for i in range(columns):
            for j in range(rows):
                x0, x1 = round(i * w / columns) + 2 * seam, round((i + 1) * w / columns) - 2 * seam
                y0, y1 = round(j * h / rows) + 2 * seam, round((j + 1) * h / rows) - 2 * seam
                image[y0:y1, x0:x1] *= rng.uniform(0.84, 1.16)
                cv2.rectangle(image, (x0, y0), (x1, y1), (50, 36, 26), seam)
                at = (round((x0 + x1) / 2 + 0.3 * (x1 - x0) * (rows < columns)), round(y0 + 0.35 * (y1 - y0)))
                cv2.circle(image, at, max(2, round(0.016 / texel_m)), tuple(knob), -1, cv2.LINE_AA)
        return image

    return paint
