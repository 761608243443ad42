"""The living room: what stands where."""

from typing import Any

import numpy as np

from duagc.converters.simulate.scenes import drawn
from duagc.converters.simulate.scenes import textures as tex
from duagc.converters.simulate.scenes import wood_textures as wooden
from duagc.converters.simulate.scenes.scene import Flat, Lamp, Scene
from duagc.pipeline.base import random_streams


def room(seed: int) -> Scene:
    """A living room, 6.4 m x 5.6 m x 2.7 m: shelf, sideboard, desk, sofa, low table, dresser, plants, boxes.

    Args:
        seed: of layout and textures.
    """
    scene = Scene("room", seed, np.array([6.4, 5.6, 2.7]))
    rng = random_streams.generator(seed, "simulate.layout", scene="room")
    _shell(scene)
    _bookshelf(scene, rng, (0.45, 5.27), width=1.9, height=2.05, depth=0.33)
    _sideboard(scene, rng)
    _desk(scene)
    _sofa(scene)
    _low_table(scene)
    _west_side(scene)
    return scene


def _shell(scene: Scene) -> None:
    """Floor with a rug, ceiling with beams, four walls with pictures, door and window, and the light."""
    w, d, h = scene.size.tolist()
    x, y, z = np.eye(3)
    north = tex.paint_onto(
        tex.plaster((198, 190, 168)),
        [
            (drawn.picture("map"), 2.75, 0.4, 0.8, 0.6),
            (drawn.picture("abstract"), 3.85, 0.32, 0.55, 0.75),
            (drawn.picture("landscape"), 5.1, 0.5, 0.85, 0.55),
            (tex.skirting, 0.0, h - 0.08, w, 0.08),
        ],
    )
    east = tex.paint_onto(
        tex.bricks(),
        [
            (drawn.window, 2.55, 0.45, 1.5, 1.25),
            (drawn.picture("abstract"), 0.5, 0.55, 0.7, 0.9),
            (drawn.picture("page"), 4.45, 0.6, 0.7, 0.55),
            (tex.skirting, 0.0, h - 0.08, d, 0.08),
        ],
    )
    south = tex.paint_onto(
        tex.wallpaper(),
        [
            (drawn.picture("page"), 1.0, 0.6, 0.6, 0.75),
            (drawn.picture("map"), 2.3, 0.4, 1.35, 0.85),
            (drawn.picture("abstract"), 4.05, 0.6, 0.5, 0.7),
            (drawn.picture("landscape"), 5.2, 0.55, 0.6, 0.8),
            (tex.skirting, 0.0, h - 0.08, w, 0.08),
        ],
    )
    west = tex.paint_onto(
        tex.plaster((146, 162, 178), 0.06),
        [
            (wooden.front((146, 108, 74), 1, 2), 1.0, 0.6, 0.9, 2.1),
            (drawn.picture("landscape"), 2.2, 0.55, 0.55, 0.75),
            (drawn.picture("abstract"), 3.05, 0.35, 1.0, 0.65),
            (drawn.picture("page"), 4.45, 0.55, 0.6, 0.75),
            (tex.skirting, 0.0, h - 0.08, 1.0, 0.08),
            (tex.skirting, 1.9, h - 0.08, d - 1.9, 0.08),
        ],
    )
    floor = tex.paint_onto(wooden.planks(), [(tex.rug, 1.9, 1.75, 2.5, 1.9)])
    ceiling = tex.paint_onto(
        tex.plaster((222, 218, 206), 0.05),
        [(tex.lamp, 1.45, 2.35, 0.9, 0.9), (tex.lamp, 4.05, 2.35, 0.9, 0.9)],
    )
    scene.surfaces += [
        Flat("floor", floor, d * y, x, -y, (w, d)),
        Flat("ceiling", ceiling, h * z, x, y, (w, d)),
        Flat("north", north, d * y + h * z, x, -z, (w, h)),
        Flat("east", east, w * x + d * y + h * z, -y, -z, (d, h)),
        Flat("south", south, w * x + h * z, -x, -z, (w, h)),
        Flat("west", west, h * z, y, -z, (d, h)),
    ]
    for k, beam in enumerate((0.8, 3.1, 5.4)):
        scene.box(
            f"beam{k}", (beam, 0.0, h - 0.14), (0.16, d, 0.14), wooden.wood((124, 84, 54)), shades=False
        )
    for cx in (1.9, 4.5):
        scene.lamps.append(Lamp(np.array([cx, 2.8, h - 0.02]), 0.4 * x, 0.4 * y, 1.0))
    scene.lamps.append(Lamp(np.array([w - 0.02, 2.3, 1.65]), 0.65 * y, 0.5 * z, 0.8))


def _bookshelf(
    scene: Scene,
    rng: np.random.Generator,
    low: tuple[float, float],
    width: float,
    *,
    height: float,
    depth: float,
) -> None:
    """Sides, boards and groups of books between them, open to the south."""
    x0, y0 = low
    board, shelves = 0.03, 5
    oak = wooden.wood((150, 106, 66))
    scene.box("shelf/back", (x0, y0 + depth - 0.02, 0), (width, 0.02, height), wooden.wood((112, 78, 50)))
    for side, x in (("west", x0), ("middle", x0 + (width - board) / 2), ("east", x0 + width - board)):
        scene.box(f"shelf/{side}", (x, y0, 0), (board, depth - 0.02, height), oak)
    bay = (width - 3 * board) / 2
    step = (height - board) / shelves
    for k in range(shelves + 1):
        for column in range(2):
            x = x0 + board + column * (bay + board)
            scene.box(f"shelf/board{k}.{column}", (x, y0, k * step), (bay, depth - 0.02, board), oak)
            if k < shelves:
                _books(
                    scene,
                    rng,
                    f"shelf/books{k}.{column}",
                    (x, y0, k * step + board),
                    bay=bay,
                    clear=step - board,
                )


def _books(
    scene: Scene,
    rng: np.random.Generator,
    name: str,
    low: tuple[float, float, float],
    *,
    bay: float,
    clear: float,
) -> None:
    """Fill one bay of a shelf with groups of books, a box or a pot, with gaps between them."""
    at = rng.uniform(0.0, 0.05)
    k = 0
    paper = tex.plaster((206, 198, 178), 0.10)
    while at < bay - 0.09:
        length = min(rng.uniform(0.12, 0.36), bay - at - 0.005)
        set_back, tall = rng.uniform(0.01, 0.07), clear * rng.uniform(0.58, 0.92)
        if rng.random() < 0.8:
            size = (length, 0.2, tall)
            corner = (low[0] + at, low[1] + set_back, low[2])
            cover = tex.marbled((92, 70, 60), (124, 92, 74))
            scene.box(f"{name}.{k}", corner, size, cover, shades=False, front=drawn.spines, top=paper)
        elif rng.random() < 0.5:
            size = (length, 0.2, 0.55 * tall)
            scene.box(
                f"{name}.{k}", (low[0] + at, low[1] + set_back, low[2]), size, drawn.carton, shades=False
            )
        at += length + rng.uniform(0.0, 0.09)
        k += 1


def _sideboard(scene: Scene, rng: np.random.Generator) -> None:
    """A low cabinet at the north wall with a display, books and a vase on it."""
    scene.box(
        "sideboard",
        (3.05, 5.15, 0.08),
        (2.1, 0.45, 0.52),
        wooden.wood((176, 132, 86)),
        front=wooden.front((170, 126, 82), 4, 1),
    )
    scene.legs("sideboard", (3.1, 5.2, 0.0), (2.0, 0.35, 0.08), wooden.wood((80, 58, 42)), thick=0.06)
    scene.box(
        "display", (3.5, 5.3, 0.68), (1.1, 0.06, 0.64), tex.plaster((38, 38, 42), 0.1), front=drawn.screen
    )
    scene.box(
        "display/foot", (3.85, 5.25, 0.6), (0.4, 0.2, 0.08), tex.plaster((44, 44, 48), 0.1), shades=False
    )
    scene.box(
        "sideboard/books",
        (3.12, 5.27, 0.6),
        (0.26, 0.17, 0.24),
        tex.marbled((92, 70, 60), (124, 92, 74)),
        front=drawn.spines,
    )
    scene.cylinder(
        "vase", (4.88, 5.38, 0.6), tex.marbled((60, 92, 120), (210, 204, 190), 0.1), radius=0.085, height=0.3
    )
    scene.sphere("vase/leaves", (4.88, 5.38, 1.04), 0.17, tex.foliage)


def _desk(scene: Scene) -> None:
    """A desk at the east wall with a display, books and a lamp, and a chair turned away from it."""
    top = wooden.wood((190, 152, 106))
    dark = wooden.wood((92, 68, 50))
    scene.box("desk", (5.65, 1.2, 0.71), (0.75, 1.7, 0.04), top)
    scene.legs("desk", (5.67, 1.24, 0.0), (0.70, 1.62, 0.71), dark, thick=0.06)
    scene.box(
        "desk/drawers",
        (5.75, 1.35, 0.2),
        (0.6, 0.42, 0.50),
        wooden.wood((176, 132, 86)),
        left=wooden.front((170, 126, 82), 1, 3),
    )
    scene.box(
        "monitor", (6.1, 1.85, 0.86), (0.05, 0.78, 0.46), tex.plaster((38, 38, 42), 0.1), left=drawn.screen
    )
    scene.box(
        "monitor/foot", (6.08, 2.12, 0.75), (0.14, 0.24, 0.11), tex.plaster((52, 52, 58), 0.1), shades=False
    )
    scene.box(
        "desk/books",
        (6.02, 1.3, 0.75),
        (0.2, 0.34, 0.26),
        tex.marbled((92, 70, 60), (124, 92, 74)),
        left=drawn.spines,
    )
    scene.box("desk/paper", (5.76, 2.25, 0.75), (0.3, 0.22, 0.012), drawn.picture("page"), shades=False)
    scene.cylinder(
        "desk/mug",
        (5.85, 1.75, 0.75),
        tex.marbled((176, 66, 48), (226, 212, 186), 0.05),
        radius=0.045,
        height=0.1,
    )
    turn: dict[str, Any] = {"yaw_rad": 0.45, "about": (5.35, 2.15)}
    scene.box(
        "chair", (5.13, 1.93, 0.42), (0.44, 0.44, 0.06), tex.fabric((150, 84, 62), (196, 160, 110)), **turn
    )
    scene.legs("chair", (5.14, 1.94, 0.0), (0.42, 0.42, 0.42), dark, thick=0.045, **turn)
    back = tex.fabric((150, 84, 62), (196, 160, 110))
    scene.box("chair/back", (5.13, 1.93, 0.56), (0.05, 0.44, 0.4), back, **turn)
    for k, y in enumerate((1.95, 2.31)):
        scene.box(f"chair/post{k}", (5.135, y, 0.48), (0.04, 0.04, 0.08), dark, shades=False, **turn)
    scene.cylinder(
        "bin", (6.1, 3.25, 0.0), tex.marbled((66, 84, 92), (140, 150, 150), 0.1), radius=0.16, height=0.36
    )
    scene.box("cartons/low", (5.7, 4.55, 0.0), (0.55, 0.6, 0.42), drawn.carton)
    scene.box("cartons/high", (5.82, 4.65, 0.42), (0.38, 0.42, 0.3), drawn.carton, yaw_rad=-0.3)


def _sofa(scene: Scene) -> None:
    """A sofa at the south wall with cushions, a side table with a globe, a standing lamp."""
    cloth = tex.fabric((84, 102, 118), (132, 122, 100))
    scene.box("sofa/seat", (2.05, 0.27, 0.1), (1.9, 0.63, 0.32), cloth)
    scene.box("sofa/back", (2.05, 0.05, 0.1), (1.9, 0.22, 0.72), cloth)
    for side, x in (("west", 1.85), ("east", 3.95)):
        scene.box(f"sofa/{side}", (x, 0.05, 0.1), (0.2, 0.85, 0.5), cloth)
    colors = (
        ((196, 140, 60), (90, 60, 50)),
        ((150, 60, 56), (220, 196, 160)),
        ((88, 122, 92), (212, 206, 170)),
    )
    for k, (x, yaw) in enumerate(((2.2, 0.2), (2.75, -0.15), (3.4, 0.1))):
        scene.box(
            f"cushion{k}",
            (x, 0.32, 0.42),
            (0.42, 0.13, 0.36),
            tex.fabric(*colors[k]),
            yaw_rad=yaw,
            shades=False,
        )
    scene.cylinder("side table", (4.55, 0.5, 0.0), wooden.wood((132, 92, 60)), radius=0.26, height=0.5)
    scene.sphere("globe", (4.55, 0.5, 0.66), 0.16, tex.marbled((52, 96, 142), (176, 164, 96), 0.16))
    scene.cylinder("lamp/pole", (1.35, 0.4, 0.0), tex.plaster((70, 66, 62), 0.1), radius=0.03, height=1.3)
    scene.cylinder(
        "lamp/shade", (1.35, 0.4, 1.3), tex.fabric((226, 204, 160), (196, 160, 110)), radius=0.2, height=0.3
    )


def _low_table(scene: Scene) -> None:
    """A low table on the rug, slightly turned, with books and a bowl."""
    turn: dict[str, Any] = {"yaw_rad": 0.12, "about": (3.15, 2.8)}
    scene.box("low table", (2.6, 2.5, 0.38), (1.1, 0.6, 0.045), wooden.wood((136, 90, 56)), **turn)
    scene.legs(
        "low table", (2.63, 2.53, 0.0), (1.04, 0.54, 0.38), wooden.wood((100, 66, 44)), thick=0.06, **turn
    )
    pages = tex.plaster((206, 198, 178), 0.1)
    scene.box(
        "low table/book",
        (2.75, 2.6, 0.425),
        (0.3, 0.22, 0.04),
        pages,
        yaw_rad=0.4,
        top=drawn.picture("landscape"),
        shades=False,
    )
    scene.box(
        "low table/card",
        (3.3, 2.85, 0.425),
        (0.24, 0.18, 0.02),
        pages,
        yaw_rad=-0.5,
        top=drawn.picture("abstract"),
        shades=False,
    )
    scene.cylinder(
        "low table/bowl",
        (3.2, 2.68, 0.425),
        tex.marbled((190, 120, 70), (236, 214, 178), 0.06),
        radius=0.11,
        height=0.09,
    )


def _west_side(scene: Scene) -> None:
    """A dresser with a row of things on it, and a plant."""
    scene.box(
        "dresser",
        (0.0, 3.1, 0.0),
        (0.46, 1.3, 0.88),
        wooden.wood((188, 168, 136)),
        right=wooden.front((182, 160, 126), 3, 3),
    )
    scene.box(
        "dresser/books",
        (0.1, 3.2, 0.88),
        (0.18, 0.4, 0.25),
        tex.marbled((92, 70, 60), (124, 92, 74)),
        right=drawn.spines,
    )
    scene.cylinder(
        "dresser/jar",
        (0.24, 3.85, 0.88),
        tex.marbled((150, 60, 56), (226, 206, 176), 0.08),
        radius=0.09,
        height=0.24,
    )
    scene.sphere("dresser/ball", (0.24, 4.17, 1.0), 0.12, tex.marbled((220, 180, 70), (70, 96, 130), 0.1))
    scene.cylinder(
        "plant/pot", (0.45, 2.4, 0.0), tex.marbled((168, 96, 66), (120, 70, 52), 0.1), radius=0.2, height=0.4
    )
    scene.cylinder("plant/stem", (0.45, 2.4, 0.4), wooden.wood((96, 74, 50)), radius=0.03, height=0.3)
    scene.sphere("plant/leaves", (0.45, 2.4, 0.98), 0.32, tex.foliage)
    scene.box(
        "crate",
        (0.12, 0.3, 0.0),
        (0.6, 0.45, 0.38),
        wooden.wood((160, 124, 84)),
        yaw_rad=0.25,
        back=drawn.carton,
    )
