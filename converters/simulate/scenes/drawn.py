"""Materials with something drawn on them: pictures, screens, the view out of a window, books, boxes."""

import cv2
import numpy as np

from duagc.converters.simulate.scenes.painting import Image, Material, cloud, flat, shaded, shape_of, vivid


def picture(kind: str) -> Material:
    """Something framed.

    Args:
        kind: an "abstract" painting, a "landscape", a "map" or a "page" of text.

    Raises:
        KeyError: there is no such kind.
    """
    painter = {"abstract": _abstract, "landscape": _landscape, "map": _map, "page": _page}[kind]

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
        h, w = shape_of(width_m, height_m, texel_m)
        image = painter(rng, h, w, texel_m)
        frame = max(2, round(0.025 / texel_m))
        cv2.rectangle(image, (0, 0), (w - 1, h - 1), shaded(rng, (235, 232, 222), 0.02), 3 * frame)
        cv2.rectangle(image, (0, 0), (w - 1, h - 1), shaded(rng, (72, 54, 40), 0.25), 2 * frame)
        return image

    return paint


def _abstract(rng: np.random.Generator, h: int, w: int, texel_m: float) -> Image:
    image = flat((h, w), vivid(rng, 0.45))
    for _ in range(int(rng.integers(16, 28))):
        x, y, r = rng.uniform(0, w), rng.uniform(0, h), rng.uniform(0.04, 0.2) * min(h, w)
        kind = rng.integers(0, 3)
        if kind == 0:
            cv2.circle(image, (round(x), round(y)), max(2, round(r)), vivid(rng), -1, cv2.LINE_AA)
        elif kind == 1:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            polygon = np.stack([x + 1.4 * r * np.cos(angles), y + 1.4 * r * np.sin(angles)], axis=1)
            cv2.fillPoly(image, [np.round(polygon).astype(np.int32)], vivid(rng), cv2.LINE_AA)
        else:
            end = (round(x + 4 * r * rng.standard_normal()), round(y + 4 * r * rng.standard_normal()))
            cv2.line(image, (round(x), round(y)), end, vivid(rng), max(2, round(0.2 * r)), cv2.LINE_AA)
    return image * (1 + 0.05 * cloud(rng, (h, w), 0.05 / texel_m, 3))[..., None]


def _landscape(rng: np.random.Generator, h: int, w: int, texel_m: float) -> Image:
    sky = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    image = np.ascontiguousarray(
        (1 - sky) * flat((h, w), (110, 158, 208)) + sky * flat((h, w), (238, 208, 166))
    )
    image *= (1 + 0.10 * cloud(rng, (h, w), 0.14 / texel_m, 4, gain=0.6, stretch=2.0))[..., None]
    center = (int(rng.uniform(0.15, 0.85) * w), int(rng.uniform(0.1, 0.35) * h))
    cv2.circle(image, center, max(2, int(0.07 * h)), (250, 232, 170), -1, cv2.LINE_AA)
    rows = np.arange(h, dtype=np.float32)[:, None]
    for k in range(4):
        ridge = cloud(rng, (1, w), 0.28 / texel_m / (k + 1), 4, gain=0.6)[0]
        top = h * (0.42 + 0.15 * k) + 0.09 * h * ridge
        hill = np.clip(rows - top[None] + 0.5, 0, 1)[..., None]
        tint = flat((h, w), shaded(rng, (96 - 14 * k, 124 - 12 * k, 92 - 14 * k), 0.12))
        tint *= (1 + 0.16 * cloud(rng, (h, w), 0.04 / texel_m, 3, gain=0.8))[..., None]
        image = (1 - hill) * image + hill * tint
    return np.ascontiguousarray(image, dtype=np.float32)


def _map(rng: np.random.Generator, h: int, w: int, texel_m: float) -> Image:
    height = cloud(rng, (h, w), 0.32 / texel_m, 5, gain=0.6)
    steps = np.array(
        [(150, 186, 206), (172, 202, 214), (206, 206, 160), (178, 190, 128), (198, 168, 118), (150, 112, 86)]
    )
    image = steps[np.clip(np.floor(1.6 * height + 2.5), 0, 5).astype(np.int64)].astype(np.float32)
    for _ in range(14):
        at = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        cv2.circle(image, at, max(1, round(0.008 / texel_m)), (168, 40, 36), -1, cv2.LINE_AA)
        name = (at[0] + round(rng.uniform(0.03, 0.11) / texel_m), at[1])
        cv2.line(
            image, (at[0] + round(0.014 / texel_m), at[1]), name, (46, 40, 40), max(1, round(0.007 / texel_m))
        )
    return image


def _page(rng: np.random.Generator, h: int, w: int, texel_m: float) -> Image:
    image = flat((h, w), shaded(rng, (226, 218, 196), 0.03))
    x0, y = round(0.18 * w), 0.16 * h
    cv2.rectangle(
        image, (x0, round(y)), (round(rng.uniform(0.5, 0.8) * w), round(y + 0.09 * h)), vivid(rng), -1
    )
    y += 0.15 * h
    while y < 0.84 * h:
        line = max(2, round(rng.uniform(0.010, 0.016) / texel_m))
        x = float(x0)
        while x < rng.uniform(0.72, 0.84) * w:
            word = rng.uniform(0.02, 0.07) / texel_m
            ink = shaded(rng, (62, 58, 62), 0.25)
            cv2.rectangle(image, (round(x), round(y)), (round(x + word), round(y) + line), ink, -1)
            x += word + 0.016 / texel_m
        y += line + rng.uniform(0.016, 0.024) / texel_m
    return image


def screen(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """A display with windows of text and a chart.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = _landscape(rng, h, w, texel_m) * np.float32(0.7)
    for _ in range(3):
        x, y = round(rng.uniform(0.05, 0.5) * w), round(rng.uniform(0.08, 0.45) * h)
        x1, y1 = x + round(rng.uniform(0.3, 0.45) * w), y + round(rng.uniform(0.3, 0.45) * h)
        cv2.rectangle(image, (x, y), (x1, y1), shaded(rng, (40, 44, 54), 0.2), -1)
        line = y + 0.02 / texel_m
        while line < y1 - 0.012 / texel_m:
            start = x + round(rng.uniform(0.01, 0.05) / texel_m)
            end = max(start + 2, round(x + rng.uniform(0.3, 0.9) * (x1 - x)))
            cv2.line(
                image, (start, round(line)), (end, round(line)), vivid(rng), max(1, round(0.006 / texel_m))
            )
            line += 0.018 / texel_m
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (22, 22, 24), 2 * max(2, round(0.014 / texel_m)))
    return image


def window(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """A bright view outside behind the bars of a window.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = 1.1 * _landscape(rng, h, w, texel_m) + 60
    bar = max(3, round(0.05 / texel_m))
    for x in (0, w // 2, w - 1):
        cv2.line(image, (x, 0), (x, h - 1), (232, 230, 224), bar if x == w // 2 else 2 * bar)
    for y in (0, round(0.35 * h), h - 1):
        cv2.line(image, (0, y), (w - 1, y), (232, 230, 224), bar if 0 < y < h - 1 else 2 * bar)
    return image


BINDINGS = (
    *((138, 42, 40), (36, 62, 100), (54, 86, 62), (194, 148, 82), (40, 40, 46), (220, 210, 186)),
    *((116, 70, 104), (182, 92, 52), (96, 128, 150), (206, 196, 170), (86, 56, 40)),
)


def spines(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """Books side by side, seen from their backs.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = flat((h, w), (24, 20, 18))
    x = 0.0
    while x < w:
        width = rng.uniform(0.018, 0.052) / texel_m
        x0, x1 = round(x), min(w, max(round(x) + 2, round(x + width) - 1))
        top = round(rng.uniform(0.0, 0.16) * h)
        tint = shaded(rng, BINDINGS[int(rng.integers(0, len(BINDINGS)))], 0.15)
        image[top:, x0:x1] = tint
        for _ in range(int(rng.integers(1, 4))):
            y, tall = rng.uniform(0.1, 0.85) * h, rng.uniform(0.03, 0.18) * h
            inset = 0 if rng.random() < 0.5 else max(1, (x1 - x0) // 4)
            ink = shaded(rng, (222, 204, 150), 0.1) if sum(tint) < 380 else shaded(rng, (60, 46, 44), 0.2)
            image[max(top, round(y)) : round(y + tall), x0 + inset : x1 - inset] = ink
        x += width
    return image


def carton(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> Image:
    """Cardboard with tape, a label and print.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = shape_of(width_m, height_m, texel_m)
    image = flat((h, w), shaded(rng, (178, 140, 98), 0.05))
    image *= (1 + 0.06 * cloud(rng, (h, w), 0.08 / texel_m, 4, gain=0.8))[..., None]
    tape = max(3, round(0.05 / texel_m))
    image[:, w // 2 - tape // 2 : w // 2 + tape // 2] = shaded(rng, (206, 184, 140), 0.04)
    x, y = round(rng.uniform(0.05, 0.5) * w), round(rng.uniform(0.1, 0.5) * h)
    lw, lh = max(6, round(0.34 * w)), max(6, round(0.32 * h))
    cv2.rectangle(image, (x, y), (x + lw, y + lh), (232, 230, 222), -1)
    for k in range(4):
        end = x + round(rng.uniform(0.4, 0.9) * lw)
        cv2.line(
            image,
            (x + 3, y + round((k + 0.7) * lh / 4.4)),
            (end, y + round((k + 0.7) * lh / 4.4)),
            (40, 40, 44),
            2,
        )
    cv2.circle(
        image, (round(0.8 * w), round(0.8 * h)), max(2, round(0.08 * min(h, w))), vivid(rng), -1, cv2.LINE_AA
    )
    return image
