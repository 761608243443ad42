"""Procedural materials: what the surfaces of a simulated scene are painted with.

A material is a function `(rng, width_m, height_m, texel_m) -> albedo`, float32 [h, w, 3] in RGB, 0..255 (more where it
shines), h = ceil(height_m / texel_m). The first row is the top of the surface and the first column its left side as
seen from the front. Nothing repeats: every plank, brick and book is drawn anew, so that no two places look alike.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Color = Sequence[float]
Material = Callable[[np.random.Generator, float, float, float], Image]


def shape_of(width_m: float, height_m: float, texel_m: float) -> tuple[int, int]:
    """Rows and columns of texels that cover a surface."""
    return max(1, int(np.ceil(height_m / texel_m - 1e-6))), max(1, int(np.ceil(width_m / texel_m - 1e-6)))


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], wave_x: float, wave_y: float) -> Image:
    """Smooth random field [h, w] of about unit variance; `wave_x`, `wave_y` in texels between its random nodes."""
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
    """One color everywhere."""
    return np.broadcast_to(np.array(color, dtype=np.float32), (*shape, 3)).copy()


def shaded(rng: np.random.Generator, color: Color, spread: float) -> tuple[float, float, float]:
    """A color near `color`: brightness and, less, hue changed at random."""
    c = np.array(color, dtype=np.float64) * (1 + spread * rng.standard_normal())
    c = np.clip(c * (1 + 0.2 * spread * rng.standard_normal(3)), 4, 250)
    return float(c[0]), float(c[1]), float(c[2])


def vivid(rng: np.random.Generator, saturation: float = 0.8) -> tuple[float, float, float]:
    """A random color, neither black nor white, at most that saturated (0 to 1)."""
    hue, value = rng.random(), rng.uniform(90, 235)
    dull = value * (1 - saturation * rng.uniform(0.4, 1.0))
    r, g, b = (value - (value - dull) * min(1.0, max(0.0, abs((hue * 6 + k) % 6 - 3) - 1)) for k in (0, 4, 2))
    return float(r), float(g), float(b)


def _ellipse(
    image: Image, center: tuple[int, int], axes: tuple[int, int], color: Color, *, turn_deg: float
) -> None:
    """Fill an ellipse; center and half axes in pixels."""
    cv2.ellipse(image, center, axes, turn_deg, 0, 360, color=color, thickness=-1, lineType=cv2.LINE_AA)


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
        _ellipse(image, (x, y), size, (62, 40, 24), turn_deg=float(rng.uniform(-20, 20)))


def wood(color: Color = (168, 120, 78), knots_per_m2: float = 9.0) -> Material:
    """One board, grain along its longer side."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        along_x = w >= h
        shape = (h, w) if along_x else (w, h)
        image = flat(shape, shaded(rng, color, 0.06)) * (1 + 0.11 * _grain(rng, shape, texel_m))[..., None]
        _knots(rng, image, texel_m, knots_per_m2)
        return image if along_x else np.ascontiguousarray(image.transpose(1, 0, 2))

    return paint


def planks(color: Color = (164, 116, 74), plank_m: float = 0.15) -> Material:
    """A floor of boards of different lengths and tints, along x."""

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


def bricks(color: Color = (158, 84, 62), mortar: Color = (186, 178, 166)) -> Material:
    """A wall of bricks in running bond, each with its own tint."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = flat((h, w), mortar)
        joint = max(2, round(0.012 / texel_m))
        pitch_y, pitch_x = 0.085 / texel_m, 0.25 / texel_m
        for row in range(int(h / pitch_y) + 1):
            x = -pitch_x * (0.5 * (row % 2) + 0.1 * rng.random())
            y0, y1 = round(row * pitch_y), min(h, round((row + 1) * pitch_y) - joint)
            while x < w and y1 > y0:
                length = pitch_x * rng.uniform(0.9, 1.1)
                x0, x1 = max(0, round(x)), min(w, round(x + length) - joint)
                if x1 > x0:
                    image[y0:y1, x0:x1] = shaded(rng, color, 0.2)
                x += length
        image *= (1 + 0.10 * cloud(rng, (h, w), 0.05 / texel_m, 3, gain=0.8))[..., None]
        return image * (1 + 0.08 * smooth_noise(rng, (h, w), 0.7 / texel_m, 0.5 / texel_m))[..., None]

    return paint


def plaster(color: Color = (206, 198, 180), contrast: float = 0.06) -> Material:
    """Rough paint: soft clouds at every scale and a few marks."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        tone = contrast * cloud(rng, (h, w), 0.16 / texel_m, 4, gain=0.85)
        hue = 0.2 * contrast * smooth_noise(rng, (h, w), 0.5 / texel_m, 0.5 / texel_m)
        image = flat((h, w), color) * (1 + tone)[..., None]
        image[..., 0] *= 1 + hue
        image[..., 2] *= 1 - hue
        mark = [0.72 * c for c in color]
        for _ in range(rng.poisson(5 * width_m * height_m)):
            center = (int(rng.integers(0, w)), int(rng.integers(0, h)))
            radius = max(1, int(rng.uniform(0.006, 0.016) / texel_m))
            cv2.circle(image, center, radius, shaded(rng, mark, 0.08), -1, cv2.LINE_AA)
        return image

    return paint


def wallpaper(color: Color = (150, 172, 166), motif: Color = (104, 132, 126)) -> Material:
    """Paper with leaves strewn over it, each of its own size, turn and tint."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = flat((h, w), color) * (1 + 0.035 * cloud(rng, (h, w), 0.2 / texel_m, 4, gain=0.7))[..., None]
        for _ in range(int(26 * width_m * height_m)):
            x, y = float(rng.uniform(0, w)), float(rng.uniform(0, h))
            turn, length = float(rng.uniform(0, 360)), rng.uniform(0.03, 0.075) / texel_m
            tint = shaded(rng, motif, 0.16)
            for spread in (-38, 0, 38):
                a = np.deg2rad(turn + spread)
                center = (round(x + 0.8 * length * np.cos(a)), round(y + 0.8 * length * np.sin(a)))
                axes = (max(1, round(0.62 * length)), max(1, round(0.2 * length)))
                _ellipse(image, center, axes, tint, turn_deg=turn + spread)
        return image

    return paint


def fabric(color: Color = (96, 110, 136), stripe: Color = (146, 128, 96)) -> Material:
    """Woven cloth: checks of uneven width over clouds."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = flat((h, w), color)
        for axis, extent in ((0, h), (1, w)):
            at = rng.uniform(0.02, 0.1) / texel_m
            while at < extent:
                width = max(2, round(rng.uniform(0.008, 0.035) / texel_m))
                band = [slice(None), slice(None)]
                band[axis] = slice(int(at), int(at) + width)
                tint = np.array(shaded(rng, stripe, 0.18), dtype=np.float32)
                image[tuple(band)] = 0.45 * image[tuple(band)] + 0.55 * tint
                at += width + rng.uniform(0.03, 0.13) / texel_m
        return image * (1 + 0.10 * cloud(rng, (h, w), 0.06 / texel_m, 3, gain=0.8))[..., None]

    return paint


def rug(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """A woven rug: bands of triangles, diamonds and bars, no two alike."""
    h, w = shape_of(width_m, height_m, texel_m)
    ground = [(126, 44, 42), (42, 56, 88), (188, 154, 104), (78, 92, 70), (206, 192, 164)]
    image = flat((h, w), ground[0])
    y = 0.0
    while y < h:
        band = rng.uniform(0.07, 0.17) / texel_m
        y0, y1 = round(y), min(h, round(y + band))
        image[y0:y1] = shaded(rng, ground[int(rng.integers(0, 5))], 0.08)
        x = -rng.uniform(0, 0.1) / texel_m
        while x < w and y1 - y0 > 4:
            width = rng.uniform(0.05, 0.16) / texel_m
            tint = shaded(rng, ground[int(rng.integers(0, 5))], 0.14)
            mid, low, high = (y0 + y1) / 2, y0 + 0.12 * band, y1 - 0.12 * band
            shapes = (
                [(x, high), (x + width, high), (x + width / 2, low)],
                [(x, mid), (x + width / 2, low), (x + width, mid), (x + width / 2, high)],
                [(x, low), (x + 0.6 * width, low), (x + 0.6 * width, high), (x, high)],
                [(x, low), (x + width, low), (x + width / 2, high)],
            )
            polygon = np.round(np.array(shapes[int(rng.integers(0, 4))])).astype(np.int32)
            cv2.fillPoly(image, [polygon], tint, cv2.LINE_AA)
            x += width * rng.uniform(1.0, 1.25)
        y += band
    edge = max(2, round(0.05 / texel_m))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (206, 192, 164), edge)
    return image * (1 + 0.07 * cloud(rng, (h, w), 0.03 / texel_m, 2, gain=0.8))[..., None]


def front(color: Color, columns: int, rows: int, knob: Color = (206, 192, 150)) -> Material:
    """Doors or drawers of a piece of furniture, with grain, seams and knobs."""

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


def paint_onto(base: Material, patches: Sequence[tuple[Material, float, float, float, float]]) -> Material:
    """`base` with patches `(material, left, top, width, height)` in meters laid over it, in their order."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        image = base(rng, width_m, height_m, texel_m)
        for material, left, top, patch_w, patch_h in patches:
            patch = material(rng, patch_w, patch_h, texel_m)
            x, y = round(left / texel_m), round(top / texel_m)
            patch = patch[
                : max(0, image.shape[0] - y), : max(0, image.shape[1] - x)
            ]  # what does not fit is cut
            image[y : y + patch.shape[0], x : x + patch.shape[1]] = patch
        return image

    return paint


def lamp(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """A shining panel with a frame."""
    h, w = shape_of(width_m, height_m, texel_m)
    image = flat((h, w), (500, 490, 465))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (160, 160, 156), 2 * max(2, round(0.03 / texel_m)))
    return image


def skirting(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """A painted board along the foot of a wall."""
    h, w = shape_of(width_m, height_m, texel_m)
    image = (
        flat((h, w), (214, 208, 196))
        * (1 + 0.04 * cloud(rng, (h, w), 0.08 / texel_m, 3, gain=0.8))[..., None]
    )
    image[: max(2, round(0.008 / texel_m))] = (120, 112, 100)
    return image


def foliage(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """Leaves over leaves."""
    h, w = shape_of(width_m, height_m, texel_m)
    image = flat((h, w), (40, 62, 34))
    for _ in range(int(900 * width_m * height_m)):
        center = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        axes = (
            max(2, round(rng.uniform(0.02, 0.05) / texel_m)),
            max(1, round(rng.uniform(0.008, 0.016) / texel_m)),
        )
        tint = shaded(rng, (72, 118, 58), 0.28)
        _ellipse(image, center, axes, tint, turn_deg=float(rng.uniform(0, 180)))
    return image


def marbled(color: Color, vein: Color, wave_m: float = 0.12) -> Material:
    """Glazed clay or a globe: two colors in large soft shapes with sharper borders."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        mix = np.clip(0.5 + 2.2 * cloud(rng, (h, w), wave_m / texel_m, 4, gain=0.6), 0, 1)[..., None]
        image = (1 - mix) * flat((h, w), color) + mix * flat((h, w), vein)
        return image * (1 + 0.06 * cloud(rng, (h, w), 0.05 / texel_m, 3, gain=0.8))[..., None]

    return paint


def carpet(color: Color = (146, 146, 150), tile_m: float = 0.5) -> Material:
    """Carpet tiles of different tints, each with its own flecks."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = flat((h, w), color)
        flecks = cloud(rng, (h, w), 0.06 / texel_m, 3, gain=0.85)
        for y in np.arange(0, h, tile_m / texel_m):
            for x in np.arange(0, w, tile_m / texel_m):
                some = (
                    slice(round(y), round(y + tile_m / texel_m)),
                    slice(round(x), round(x + tile_m / texel_m)),
                )
                tint = np.array(shaded(rng, color, 0.12), dtype=np.float32)
                image[some] = tint * (1 + 0.16 * flecks[some])[..., None]
        return image

    return paint


def tiles(color: Color = (188, 180, 164), tile_m: float = 0.3, joint: Color = (110, 104, 96)) -> Material:
    """Stone tiles with joints, no two alike; one in eight is dark."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = flat((h, w), joint)
        veins = cloud(rng, (h, w), 0.1 / texel_m, 4, gain=0.75)
        gap, step = max(1, round(0.008 / texel_m)), tile_m / texel_m
        for y in np.arange(0, h, step):
            for x in np.arange(0, w, step):
                some = (slice(round(y), round(y + step) - gap), slice(round(x), round(x + step) - gap))
                dark = 0.55 if rng.random() < 0.125 else 1.0
                tint = dark * np.array(shaded(rng, color, 0.08), dtype=np.float32)
                image[some] = tint * (1 + 0.09 * veins[some])[..., None]
        return image

    return paint


def panels(color: Color = (214, 212, 204), panel_m: float = 0.6) -> Material:
    """A suspended ceiling: square panels with dark joints and specks."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        image = tiles(color, panel_m, (150, 148, 142))(rng, width_m, height_m, texel_m)
        h, w = image.shape[:2]
        for _ in range(int(30 * width_m * height_m)):
            at = (int(rng.integers(0, w)), int(rng.integers(0, h)))
            cv2.circle(image, at, max(1, round(0.008 / texel_m)), (130, 128, 122), -1, cv2.LINE_AA)
        return image

    return paint
