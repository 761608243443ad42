"""Procedural materials: what the surfaces of a simulated scene are painted with; those of wood are `wood_textures`.

Nothing repeats: every brick, leaf and tile is drawn anew, so that no two places look alike.
"""

from collections.abc import Sequence

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
    smooth_noise,
)


def bricks(color: Color = (158, 84, 62), mortar: Color = (186, 178, 166)) -> Material:
    """A wall of bricks in running bond, each with its own tint.

    Args:
        color: of the bricks, RGB, 0..255; every brick has its own tint.
        mortar: color of the joints.
    """

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
    """Rough paint: soft clouds at every scale and a few marks.

    Args:
        color: of the paint, RGB, 0..255.
        contrast: standard deviation of the brightness, as a share of it.
    """

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
    """Paper with leaves strewn over it, each of its own size, turn and tint.

    Args:
        color: of the paper, RGB, 0..255.
        motif: color of the leaves.
    """

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
                ellipse(image, center, axes, tint, turn_deg=turn + spread)
        return image

    return paint


def fabric(color: Color = (96, 110, 136), stripe: Color = (146, 128, 96)) -> Material:
    """Woven cloth: checks of uneven width over clouds.

    Args:
        color: of the cloth, RGB, 0..255.
        stripe: color of the checks.
    """

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
    """A woven rug: bands of triangles, diamonds and bars, no two alike.

    Args:
        rng: source of the pattern.
        width_m: of the surface.
        height_m: of the surface.
        texel_m: side of a texel.
    """
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


def paint_onto(base: Material, patches: Sequence[tuple[Material, float, float, float, float]]) -> Material:
    """`base` with patches `(material, left, top, width, height)` in meters laid over it, in their order.

    Args:
        base: material of the whole surface.
        patches: left and top are of the patch's corner, from that of the surface; what does not fit is cut.
    """

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
    """A shining panel with a frame.

    Args:
        rng: not used.
        width_m: of the surface.
        height_m: of the surface.
        texel_m: side of a texel.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = flat((h, w), (500, 490, 465))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (160, 160, 156), 2 * max(2, round(0.03 / texel_m)))
    return image


def skirting(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """A painted board along the foot of a wall.

    Args:
        rng: source of the shades.
        width_m: of the surface.
        height_m: of the surface.
        texel_m: side of a texel.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = (
        flat((h, w), (214, 208, 196))
        * (1 + 0.04 * cloud(rng, (h, w), 0.08 / texel_m, 3, gain=0.8))[..., None]
    )
    image[: max(2, round(0.008 / texel_m))] = (120, 112, 100)
    return image


def foliage(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """Leaves over leaves.

    Args:
        rng: source of the leaves.
        width_m: of the surface.
        height_m: of the surface.
        texel_m: side of a texel.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = flat((h, w), (40, 62, 34))
    for _ in range(int(900 * width_m * height_m)):
        center = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        axes = (
            max(2, round(rng.uniform(0.02, 0.05) / texel_m)),
            max(1, round(rng.uniform(0.008, 0.016) / texel_m)),
        )
        tint = shaded(rng, (72, 118, 58), 0.28)
        ellipse(image, center, axes, tint, turn_deg=float(rng.uniform(0, 180)))
    return image


def marbled(color: Color, vein: Color, wave_m: float = 0.12) -> Material:
    """Glazed clay or a globe: two colors in large soft shapes with sharper borders.

    Args:
        color: one of the two, RGB, 0..255.
        vein: the other color.
        wave_m: size of the largest shapes.
    """

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        mix = np.clip(0.5 + 2.2 * cloud(rng, (h, w), wave_m / texel_m, 4, gain=0.6), 0, 1)[..., None]
        image = (1 - mix) * flat((h, w), color) + mix * flat((h, w), vein)
        return image * (1 + 0.06 * cloud(rng, (h, w), 0.05 / texel_m, 3, gain=0.8))[..., None]

    return paint


def carpet(color: Color = (146, 146, 150), tile_m: float = 0.5) -> Material:
    """Carpet tiles of different tints, each with its own flecks.

    Args:
        color: of the carpet, RGB, 0..255; every tile has its own tint.
        tile_m: side of a tile.
    """

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
    """Stone tiles with joints, no two alike; one in eight is dark.

    Args:
        color: of the stone, RGB, 0..255; every tile has its own tint.
        tile_m: side of a tile and its joint.
        joint: color of the joints.
    """

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
    """A suspended ceiling: square panels with dark joints and specks.

    Args:
        color: of the panels, RGB, 0..255.
        panel_m: side of a panel.
    """

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        image = tiles(color, panel_m, (150, 148, 142))(rng, width_m, height_m, texel_m)
        h, w = image.shape[:2]
        for _ in range(int(30 * width_m * height_m)):
            at = (int(rng.integers(0, w)), int(rng.integers(0, h)))
            cv2.circle(image, at, max(1, round(0.008 / texel_m)), (130, 128, 122), -1, cv2.LINE_AA)
        return image

    return paint
