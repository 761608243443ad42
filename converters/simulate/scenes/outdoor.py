"""A block of a town under the sun: a square with trees and a fountain, a house with streets round it, cars, facades."""

from typing import Any

import cv2
import numpy as np

from duagc.converters.simulate.scenes import drawn, painting
from duagc.converters.simulate.scenes import furniture as fur
from duagc.converters.simulate.scenes import textures as tex
from duagc.converters.simulate.scenes import wood_textures as wooden
from duagc.converters.simulate.scenes.furniture import Place
from duagc.converters.simulate.scenes.scene import Flat, Scene
from duagc.pipeline.base import random_streams

SIZE_M = (44.0, 34.0, 16.0)
SUN = (0.45, -0.38, 0.62)  # toward the sun, as long as it is strong
EVEN_LIGHT = 0.62
RENDERS = ((196, 178, 148), (172, 96, 74), (206, 200, 186), (152, 164, 172), (188, 150, 104), (148, 140, 128))
HOUSE = (23.0, 11.5, 34.0, 22.5)


def outdoor(seed: int) -> Scene:
    """A block of 44 m x 34 m between facades 5 to 9 m high.

    Args:
        seed: of layout and textures.
    """
    scene = Scene("outdoor", seed, np.array(SIZE_M), even_light=EVEN_LIGHT, sun=np.array(SUN))
    rng = random_streams.generator(seed, "simulate.layout", scene="outdoor")
    w, d, _ = SIZE_M
    x, y, _ = np.eye(3)
    ground = tex.paint_onto(
        asphalt,
        [
            (tex.tiles((176, 168, 152), 0.5, (120, 114, 104)), 2.0, 2.0, 17.5, d - 4.0),
            (lawn, 5.0, 4.5, 4.0, 6.0),
            (lawn, 12.5, 23.0, 4.0, 6.5),
            (
                tex.tiles((160, 156, 150), 0.4, (116, 112, 106)),
                HOUSE[0] - 1.6,
                d - HOUSE[3] - 1.6,
                14.2,
                14.2,
            ),
            (stripes, 19.8, 15.0, 2.6, 4.0),
            (stripes, 26.0, 3.2, 4.0, 2.6),
        ],
    )
    scene.surfaces.append(Flat("floor", ground, d * y, x, -y, (w, d)))
    _facades(scene, rng)
    _house(scene, rng)
    _square(scene, rng)
    _street(scene, rng)
    return scene


def _facades(scene: Scene, rng: np.random.Generator) -> None:
    """Houses side by side along the border, each of its own width, height, depth and color."""
    w, d, _ = SIZE_M
    sides = {"south": (w, "back"), "north": (w, "front"), "west": (d, "right"), "east": (d, "left")}
    for side, (length, front) in sides.items():
        at, k = 0.0, 0
        while at < length - 0.5:
            wide = float(rng.uniform(5.5, 9.5))
            wide = length - at if length - at - wide < 5.0 else wide
            high, deep = float(rng.uniform(5.0, 9.0)), float(rng.uniform(1.2, 2.2))
            faces: dict[str, Any] = {front: facade(RENDERS[int(rng.integers(0, len(RENDERS)))])}
            low = {
                "south": (at, 0, 0),
                "north": (at, d - deep, 0),
                "west": (0, at, 0),
                "east": (w - deep, at, 0),
            }
            size = (wide, deep, high) if side in ("south", "north") else (deep, wide, high)
            plain = (
                tex.bricks()
                if rng.random() < 0.5
                else tex.plaster(painting.shaded(rng, RENDERS[2], 0.15), 0.1)
            )
            scene.box(f"{side}{k}", low[side], size, plain, **faces)
            at += wide
            k += 1


def _house(scene: Scene, rng: np.random.Generator) -> None:
    """The house in the middle of the block, with a shop window to the square."""
    x0, y0, x1, y1 = HOUSE
    faces: dict[str, Any] = {
        side: facade(RENDERS[int(rng.integers(0, len(RENDERS)))])
        for side in ("front", "back", "left", "right")
    }
    scene.box("house", (x0, y0, 0), (x1 - x0, y1 - y0, 7.5), tex.bricks(), **faces)
    scene.box("house/step", (x0 - 0.5, y0 + 4.5, 0), (0.5, 2.0, 0.18), tex.plaster((150, 146, 138), 0.1))
    awning = tex.fabric((172, 60, 50), (226, 214, 190))
    scene.box("house/awning", (x0 - 1.1, y0 + 1.2, 2.35), (1.1, 3.0, 0.12), awning)
    for k, y in enumerate((y0 + 1.5, y0 + 3.4)):
        Place(scene, f"house/crate{k}", x0 - 0.4, y).box(
            "crate", (-0.3, -0.3, 0), (0.6, 0.6, 0.5), drawn.carton
        )


def _square(scene: Scene, rng: np.random.Generator) -> None:
    """The fountain, trees, benches, flower boxes and a column with posters."""
    stone = tex.marbled((168, 162, 150), (132, 124, 112), 0.25)
    scene.cylinder("fountain", (10.5, 17.0, 0), stone, radius=1.6, height=0.55)
    scene.cylinder("fountain/pillar", (10.5, 17.0, 0.55), stone, radius=0.3, height=1.1)
    scene.sphere("fountain/ball", (10.5, 17.0, 2.0), 0.45, tex.marbled((92, 130, 140), (180, 190, 180), 0.2))
    for k, (x, y) in enumerate(
        ((5.2, 22.0), (7.8, 28.5), (14.5, 8.0), (6.0, 7.5), (16.4, 13.2), (16.2, 21.5))
    ):
        _tree(Place(scene, f"tree{k}", x, y), rng)
    for k, (x, y, yaw) in enumerate(
        ((10.5, 13.6, 0.1), (13.8, 17.5, -1.5), (10.2, 20.6, 3.1), (7.0, 16.4, 1.6))
    ):
        fur.bench(Place(scene, f"bench{k}", x, y, yaw), rng, 1.8)
    posters = tex.paint_onto(
        tex.plaster((196, 186, 160), 0.08),
        [(drawn.picture(kind), 0.15 + 0.85 * k, 0.4, 0.7, 1.1) for k, kind in enumerate(fur.PICTURES)],
    )
    scene.cylinder("posters", (4.4, 12.6, 0), posters, radius=0.6, height=2.6)
    for k, (x, y) in enumerate(((18.6, 10.0), (18.6, 16.0), (18.6, 22.0))):
        box = Place(scene, f"flowers{k}", x, y, float(rng.uniform(-0.1, 0.1)))
        box.box("trough", (-0.3, -1.1, 0), (0.6, 2.2, 0.5), wooden.wood((150, 112, 76)), top=tex.foliage)
        box.sphere("bush", (0.0, float(rng.uniform(-0.6, 0.6)), 0.7), 0.36, tex.foliage)
    kiosk = Place(scene, "kiosk", 13.0, 27.5, 0.3)
    kiosk.box("body", (-1.2, -0.9, 0), (2.4, 1.8, 2.4), tex.plaster((66, 104, 92), 0.1), front=drawn.spines)
    kiosk.box("roof", (-1.5, -1.2, 2.4), (3.0, 2.4, 0.15), tex.plaster((96, 60, 50), 0.1))


def _street(scene: Scene, rng: np.random.Generator) -> None:
    """Parked cars, lamp posts, trees on the pavement, bins."""
    spots = (
        (25.5, 8.0, 0.0),
        (30.8, 7.9, 0.0),
        (37.0, 12.5, 1.57),
        (37.1, 18.6, 1.57),
        (27.0, 26.2, 0.0),
        (33.0, 26.1, 0.05),
    )
    for k, (x, y, yaw) in enumerate(spots):
        _car(Place(scene, f"car{k}", x, y, yaw + float(rng.uniform(-0.05, 0.05))), rng)
    for k, (x, y) in enumerate(((20.8, 5.5), (20.8, 28.5), (36.0, 5.5), (36.0, 28.8), (21.0, 17.0))):
        iron = tex.plaster((62, 70, 68), 0.15)
        scene.cylinder(f"post{k}", (x, y, 0), iron, radius=0.09, height=4.2)
        scene.sphere(f"post{k}/light", (x, y, 4.4), 0.28, tex.marbled((236, 230, 210), (206, 196, 170), 0.15))
    for k, (x, y) in enumerate(((22.2, 24.6), (35.2, 24.2), (35.0, 9.6), (40.5, 27.0))):
        _tree(Place(scene, f"street tree{k}", x, y), rng)
    for k, (x, y) in enumerate(((22.3, 9.8), (40.6, 15.0), (28.6, 30.6))):
        scene.cylinder(
            f"bin{k}", (x, y, 0), tex.marbled((70, 90, 76), (150, 150, 140), 0.15), radius=0.3, height=0.95
        )


def _tree(at: Place, rng: np.random.Generator) -> None:
    """A trunk and a crown of three balls of leaves."""
    high = float(rng.uniform(2.2, 3.0))
    at.cylinder(
        "trunk", (0, 0, 0), wooden.wood((104, 82, 60)), radius=float(rng.uniform(0.14, 0.22)), height=high
    )
    for k in range(3):
        out = rng.uniform(-0.6, 0.6, 2)
        radius = float(rng.uniform(0.9, 1.3))
        at.sphere(f"crown{k}", (out[0], out[1], high + 0.5 + 0.5 * k), radius, tex.foliage)


def _car(at: Place, rng: np.random.Generator) -> None:
    """A parked car of boxes, along x."""
    paint = painting.shaded(rng, painting.vivid(rng, 0.75), 0.1)
    body, glass = wooden.front(paint, 4, 1, (40, 40, 44)), tex.marbled((52, 62, 74), (110, 130, 146), 0.5)
    coat = tex.plaster(paint, 0.06)
    at.box("body", (-2.05, -0.85, 0.28), (4.1, 1.7, 0.62), coat, front=body, back=body)
    at.box("cabin", (-1.2, -0.76, 0.9), (2.2, 1.52, 0.52), glass, top=coat)
    plate = drawn.picture("page")
    for end, x in (("rear", -2.07), ("nose", 2.05)):
        at.box(end, (x, -0.3, 0.45), (0.02, 0.6, 0.18), plate)
    for k, (x, y) in enumerate(((-1.3, -0.86), (1.3, -0.86), (-1.3, 0.66), (1.3, 0.66))):
        tyre = tex.marbled((36, 36, 38), (96, 98, 100), 0.2)
        at.box(f"wheel{k}", (x - 0.3, y, 0.0), (0.6, 0.2, 0.6), tyre)


def asphalt(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> painting.Image:
    """Dark, with patches, cracks and stains.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = painting.shape_of(width_m, height_m, texel_m)
    image = painting.flat((h, w), (104, 104, 106))
    image *= (1 + 0.10 * painting.cloud(rng, (h, w), 0.5 / texel_m, 5, gain=0.8))[..., None]
    for _ in range(int(0.08 * width_m * height_m)):
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        size = rng.uniform(0.4, 2.2, 2) / texel_m
        tone = float(rng.uniform(0.75, 1.2))
        image[y : y + int(size[1]), x : x + int(size[0])] *= tone
    for _ in range(int(0.35 * width_m * height_m)):
        start = rng.uniform((0, 0), (w, h))
        steps = rng.normal(0, 0.22 / texel_m, (int(rng.integers(3, 8)), 2)).cumsum(axis=0)
        line = np.round(start + steps).astype(np.int32)[:, None]
        cv2.polylines(image, [line], False, (62, 62, 64), max(1, round(0.015 / texel_m)), cv2.LINE_AA)
    for _ in range(int(0.7 * width_m * height_m)):
        at = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        tone = float(rng.uniform(60, 170))
        radius = max(1, int(rng.uniform(0.015, 0.06) / texel_m))
        cv2.circle(image, at, radius, (tone, tone, 0.95 * tone), -1, cv2.LINE_AA)
    return image


def lawn(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> painting.Image:
    """Grass of uneven green with flowers, in a border of stone.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = painting.shape_of(width_m, height_m, texel_m)
    image = painting.flat((h, w), (84, 116, 58))
    image *= (1 + 0.22 * painting.cloud(rng, (h, w), 0.25 / texel_m, 4, gain=0.9))[..., None]
    for _ in range(int(9 * width_m * height_m)):
        at = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        cv2.circle(image, at, max(1, round(0.025 / texel_m)), painting.vivid(rng), -1, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (176, 170, 158), max(2, round(0.25 / texel_m)))
    return image


def stripes(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> painting.Image:
    """A crossing: white bars on asphalt, along the shorter side.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    image = asphalt(rng, width_m, height_m, texel_m)
    wear = 1 + 0.08 * painting.cloud(rng, image.shape[:2], 0.3 / texel_m, 3, gain=0.8)
    step = 1.0 / texel_m
    for k in range(int(max(image.shape[:2]) / step) + 1):
        bar = slice(round(k * step), round((k + 0.5) * step))
        some = (bar, slice(None)) if height_m > width_m else (slice(None), bar)
        image[some] = 218 * wear[some][..., None]
    return image


def facade(color: painting.Color) -> painting.Material:
    """The front of a house: rows of windows of its own kind, a door, a shop sign, stains.

    Args:
        color: RGB, 0 to 255, of the wall.
    """

    def paint(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> painting.Image:
        wall = (
            tex.bricks(color) if rng.random() < 0.35 else tex.plaster(painting.shaded(rng, color, 0.1), 0.09)
        )
        patches: list[tuple[painting.Material, float, float, float, float]] = []
        wide, high = float(rng.uniform(0.95, 1.4)), float(rng.uniform(1.2, 1.55))
        gap = float(rng.uniform(0.75, 1.3))
        count = max(1, int((width_m - 0.6) / (wide + gap)))
        left = (width_m - count * (wide + gap) + gap) / 2
        door = int(rng.integers(0, count))
        storey = 2.9
        for floor in range(int((height_m - 0.4) / storey)):
            top = height_m - floor * storey - 2.45
            for k in range(count):
                x = left + k * (wide + gap)
                if floor == 0 and k == door:
                    tone = painting.shaded(rng, (110, 76, 56), 0.3)
                    patches.append((wooden.front(tone, 2, 3), x, height_m - 2.2, min(wide, 1.1), 2.2))
                    continue
                patches.append((pane, x, top, wide, high))
                sill = tex.plaster((214, 208, 194), 0.06)
                patches.append((sill, max(0.0, x - 0.08), top + high, wide + 0.16, 0.1))
                if floor == 0 and rng.random() < 0.4:
                    kind = fur.PICTURES[int(rng.integers(0, 4))]
                    patches.append((drawn.picture(kind), x + 0.1, top + high + 0.2, wide - 0.2, 0.5))
        return tex.paint_onto(wall, patches)(rng, width_m, height_m, texel_m)

    return paint


def pane(rng: np.random.Generator, width_m: float, height_m: float, texel_m: float) -> painting.Image:
    """A window from outside: dark glass, curtains, bars.

    Args:
        rng: source of the random choices.
        width_m: width of the surface, meters.
        height_m: height of the surface, meters.
        texel_m: width of a texel, meters.
    """
    h, w = painting.shape_of(width_m, height_m, texel_m)
    image = painting.flat((h, w), painting.shaded(rng, (58, 70, 84), 0.3))
    image *= (1 + 0.2 * painting.cloud(rng, (h, w), 0.4 / texel_m, 3, gain=0.7))[..., None]
    curtain = painting.shaded(rng, painting.vivid(rng, 0.5), 0.1)
    side = round(rng.uniform(0.12, 0.38) * w)
    folds = (1 + 0.12 * np.sin(np.arange(w) * texel_m * 2 * np.pi / 0.09)).astype(np.float32)
    drape = (np.array(curtain, dtype=np.float32) * folds[:, None])[None]
    image[:, :side] = drape[:, :side]
    image[:, w - side :] = drape[:, w - side :]
    bar = max(2, round(0.06 / texel_m))
    for x in (0, w // 2, w - 1):
        cv2.line(image, (x, 0), (x, h - 1), (226, 222, 212), bar)
    for y in (0, round(0.4 * h), h - 1):
        cv2.line(image, (0, y), (w - 1, y), (226, 222, 212), bar)
    return image
