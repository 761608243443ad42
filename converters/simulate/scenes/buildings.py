"""Scenes of several rooms: an office with doors, and a corridor with a hall in its middle."""

from typing import Any

import numpy as np

from duagc.converters.simulate.scenes import drawn, painting
from duagc.converters.simulate.scenes import furniture as fur
from duagc.converters.simulate.scenes import textures as tex
from duagc.converters.simulate.scenes import wood_textures as wooden
from duagc.converters.simulate.scenes.furniture import Place
from duagc.converters.simulate.scenes.scene import Flat, Lamp, Scene
from duagc.pipeline.base import random_streams

WALL_M = 0.12
DOOR_M, DOOR_HEIGHT_M = 1.05, 2.1
NORTH, WEST, SOUTH, EAST = 0.0, np.pi / 2, np.pi, -np.pi / 2
PAINTS = (
    (206, 198, 180),
    (176, 190, 196),
    (198, 186, 160),
    (186, 198, 176),
    (200, 178, 166),
    (178, 176, 196),
)
Rect = tuple[float, float, float, float]  # x0, y0, x1, y1


def office(seed: int) -> Scene:
    """Six rooms on both sides of a corridor, 13.6 m x 10.4 m: desks, shelves, a meeting room, a lounge.

    Args:
        seed: of layout and textures.
    """
    scene = Scene("office", seed, np.array([13.6, 10.4, 2.7]))
    rng = random_streams.generator(seed, "simulate.layout", scene="office")
    w, d, _ = scene.size.tolist()
    low, high = 4.2, 6.1  # the corridor is between them
    across = {"south": (4.4, 9.2), "north": (5.2, 9.4)}
    lamps = [(x, (low + high) / 2) for x in (1.6, 4.8, 8.0, 11.2)]
    lamps += [(x, low / 2) for x in (2.2, 6.8, 11.4)] + [(x, (high + d) / 2) for x in (1.5, 3.7, 7.3, 11.5)]
    _shell(scene, rng, lamps, tex.carpet())
    _wall_along_x(scene, rng, "south", 0.0, x1=w, y=low, doors=(3.3, 8.2, 12.2))
    _wall_along_x(scene, rng, "north", 0.0, x1=w, y=high, doors=(1.2, 8.3, 10.5))
    for k, x in enumerate(across["south"]):
        _wall_along_y(scene, rng, f"south{k}", x, y0=0.0, y1=low - WALL_M)
    for k, x in enumerate(across["north"]):
        _wall_along_y(scene, rng, f"north{k}", x, y0=high + WALL_M, y1=d)
    _study(scene, rng, "a", (0, 0, 4.4, low), window=SOUTH)
    _study(scene, rng, "b", (4.4 + WALL_M, 0, 9.2, low), window=SOUTH)
    _study(scene, rng, "c", (9.2 + WALL_M, 0, w, low), window=SOUTH)
    _meeting(scene, rng, (0, high + WALL_M, 5.2, d))
    _study(scene, rng, "d", (5.2 + WALL_M, high + WALL_M, 9.4, d), window=NORTH)
    _lounge(scene, rng, (9.4 + WALL_M, high + WALL_M, w, d))
    fur.plant(Place(scene, "corridor/plant", 0.35, (low + high) / 2), rng, 1.15)
    fur.cooler(Place(scene, "corridor/cooler", 6.9, high, NORTH), rng)
    fur.lockers(Place(scene, "corridor/lockers", 9.0, low, SOUTH), rng, 3)
    fur.plant(Place(scene, "corridor/plant2", w - 0.35, high - 0.35), rng, 1.0)
    return scene


def corridor(seed: int) -> Scene:
    """A corridor 26 m long and 2.6 m wide, with a hall of 7 m x 7 m in its middle.

    Args:
        seed: of layout and textures.
    """
    scene = Scene("corridor", seed, np.array([26.0, 7.0, 2.9]))
    rng = random_streams.generator(seed, "simulate.layout", scene="corridor")
    w, d, h = scene.size.tolist()
    south, north, hall = 2.2, 4.8, (9.5, 16.5)
    lamps = [(x, d / 2) for x in (1.5, 4.5, 7.5, 18.5, 21.5, 24.5)]
    lamps += [(x, y) for x in (11.2, 14.8) for y in (1.7, 5.3)]
    _shell(scene, rng, lamps, tex.tiles())
    for name, x0, x1 in (("west", 0.0, hall[0]), ("east", hall[1], w)):
        for side, y in (("south", 0.0), ("north", north)):
            depth = south if side == "south" else d - north
            inner = "back" if side == "south" else "front"
            end = "right" if name == "west" else "left"
            faces: dict[str, Any] = {
                inner: _with_doors(rng, x1 - x0, h),
                end: fur.decorated(tex.bricks(), depth, h, rng),
            }
            scene.box(f"{side} {name}", (x0, y, 0), (x1 - x0, depth, h), tex.plaster(PAINTS[0]), **faces)
    for k, (x, y, yaw) in enumerate(
        ((2.4, south, SOUTH), (7.2, north, NORTH), (19.3, south, SOUTH), (23.4, north, NORTH))
    ):
        place = Place(scene, f"side{k}", x, y, yaw)
        (fur.bench, fur.lockers, fur.copier, fur.bench)[k](place, rng)
    fur.plant(Place(scene, "plant west", 0.4, 3.0), rng, 1.2)
    fur.cartons(Place(scene, "cartons east", w - 0.4, north, NORTH), rng)
    fur.cooler(Place(scene, "cooler", 4.7, north, NORTH), rng)
    fur.shelf(Place(scene, "hall/shelf", 11.0, d, NORTH), rng, 1.8)
    fur.cabinet(Place(scene, "hall/cabinet", 14.8, d, NORTH), rng, 1.5)
    fur.sofa(Place(scene, "hall/sofa", 12.8, 0.0, SOUTH), rng)
    fur.shelf(Place(scene, "hall/shelf2", 15.6, 0.0, SOUTH), rng, 1.3)
    for k, (x, y) in enumerate(((9.95, 0.45), (16.1, 6.5), (9.95, 6.5))):
        fur.plant(Place(scene, f"hall/plant{k}", x, y), rng, 1.1)
    column = tex.marbled((176, 168, 150), (140, 128, 112), 0.2)
    scene.cylinder("column", (13.0, 3.5, 0.0), column, radius=0.28, height=h - 0.001)
    return scene


def _shell(
    scene: Scene, rng: np.random.Generator, lamps: list[tuple[float, float]], floor: painting.Material
) -> None:
    """Floor, ceiling with shining panels, and four outer walls with windows to the north and the south."""
    w, d, h = scene.size.tolist()
    x, y, z = np.eye(3)
    panels = [(tex.lamp, cx - 0.3, cy - 0.6, 0.6, 1.2) for cx, cy in lamps]
    ceiling = tex.paint_onto(tex.panels(), panels)
    scene.surfaces += [
        Flat("floor", floor, d * y, x, -y, (w, d)),
        Flat("ceiling", ceiling, h * z, x, y, (w, d)),
        Flat("north", _windows(rng, w, h), d * y + h * z, x, -z, (w, h)),
        Flat("east", fur.decorated(tex.bricks(), d, h, rng), w * x + d * y + h * z, -y, -z, (d, h)),
        Flat("south", _windows(rng, w, h), w * x + h * z, -x, -z, (w, h)),
        Flat("west", fur.decorated(tex.wallpaper(), d, h, rng), h * z, y, -z, (d, h)),
    ]
    for cx, cy in lamps:
        scene.lamps.append(Lamp(np.array([cx, cy, h - 0.02]), 0.3 * x, 0.6 * y, 0.75))


def _windows(rng: np.random.Generator, width: float, height: float) -> painting.Material:
    """An outer wall with a window every few meters and pictures between."""
    patches: list[tuple[painting.Material, float, float, float, float]] = []
    at = float(rng.uniform(0.5, 1.0))
    while at < width - 1.7:
        patches.append((drawn.window, at, 0.45, 1.4, 1.2))
        kind = fur.PICTURES[int(rng.integers(0, 4))]
        if at + 2.4 < width:
            patches.append((drawn.picture(kind), at + 1.65, 0.5, 0.6, 0.75))
        at += 2.6
    patches.append((tex.skirting, 0.0, height - 0.08, width, 0.08))
    return tex.paint_onto(tex.plaster(PAINTS[int(rng.integers(0, len(PAINTS)))]), patches)


def _with_doors(rng: np.random.Generator, width: float, height: float) -> painting.Material:
    """A wall with painted doors and boards of notices between them."""
    patches: list[tuple[painting.Material, float, float, float, float]] = []
    at = float(rng.uniform(0.4, 0.9))
    while at < width - 1.1:
        tone = painting.shaded(rng, (146, 108, 74), 0.2)
        patches.append((wooden.front(tone, 1, 2), at, height - 2.08, 0.95, 2.08))
        kind = fur.PICTURES[int(rng.integers(0, 4))]
        if at + 2.3 < width:
            patches.append((drawn.picture(kind), at + 1.25, height - 2.1, float(rng.uniform(0.6, 1.0)), 0.8))
        at += float(rng.uniform(2.5, 2.9))
    return tex.paint_onto(tex.plaster(PAINTS[int(rng.integers(0, len(PAINTS)))]), patches)


def _wall_along_x(
    scene: Scene,
    rng: np.random.Generator,
    name: str,
    x0: float,
    *,
    x1: float,
    y: float,
    doors: tuple[float, ...],
) -> None:
    """A wall whose nearer face is at `y` (south wall: its north face), with open doors around the given x."""
    h = float(scene.size[2])
    low = y - WALL_M if name == "south" else y
    edges = [x0, *(e for x in doors for e in (x - DOOR_M / 2, x + DOOR_M / 2)), x1]
    trim = wooden.wood((150, 118, 84))
    paints = [tex.plaster(PAINTS[int(k)]) for k in rng.integers(0, len(PAINTS), 2)]
    for k, (a, b) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        faces: dict[str, Any] = {
            side: fur.decorated(p, b - a, h, rng) for side, p in zip(("front", "back"), paints, strict=True)
        }
        scene.box(f"{name}/wall{k}", (a, low, 0), (b - a, WALL_M, h), trim, **faces)
    for k, x in enumerate(doors):
        size = (DOOR_M, WALL_M, h - DOOR_HEIGHT_M)
        scene.box(f"{name}/lintel{k}", (x - DOOR_M / 2, low, DOOR_HEIGHT_M), size, paints[0], under=trim)
        leaf = wooden.front(painting.shaded(rng, (146, 108, 74), 0.2), 1, 2)
        inside = -1.0 if name == "south" else 1.0
        hinge = (x - DOOR_M / 2 + 0.02, low if inside < 0 else low + WALL_M)
        corner = (hinge[0], hinge[1] - 0.95 if inside < 0 else hinge[1], 0.01)
        scene.box(f"{name}/door{k}", corner, (0.04, 0.95, DOOR_HEIGHT_M - 0.02), trim, left=leaf, right=leaf)


def _wall_along_y(
    scene: Scene, rng: np.random.Generator, name: str, x: float, *, y0: float, y1: float
) -> None:
    """A wall without doors between two rooms, from `x` to the east."""
    h = float(scene.size[2])
    paints = [tex.plaster(PAINTS[int(k)]) for k in rng.integers(0, len(PAINTS), 2)]
    faces: dict[str, Any] = {
        side: fur.decorated(p, y1 - y0, h, rng) for side, p in zip(("left", "right"), paints, strict=True)
    }
    scene.box(f"{name}/partition", (x, y0, 0), (WALL_M, y1 - y0, h), paints[0], **faces)


def _study(scene: Scene, rng: np.random.Generator, name: str, room: Rect, *, window: float) -> None:
    """Two desks at the side walls, a shelf or a cabinet at the outer wall, something in the corners."""
    x0, y0, x1, y1 = room
    outer = y0 if window == SOUTH else y1
    desk_y = y0 + 1.35 if window == SOUTH else y1 - 1.35
    fur.desk(Place(scene, f"{name}/desk0", x0, desk_y, WEST), rng)
    fur.desk(Place(scene, f"{name}/desk1", x1, desk_y, EAST), rng)
    middle = (x0 + x1) / 2
    if rng.random() < 0.5:
        fur.shelf(Place(scene, f"{name}/shelf", middle, outer, window), rng, float(rng.uniform(1.0, 1.5)))
    else:
        fur.cabinet(Place(scene, f"{name}/cabinet", middle, outer, window), rng)
    inner = y1 - WALL_M if window == SOUTH else y0
    inward = -0.35 if window == SOUTH else 0.35
    fur.cartons(Place(scene, f"{name}/cartons", x0 + 0.4, inner, NORTH if window == SOUTH else SOUTH), rng)
    fur.plant(
        Place(scene, f"{name}/plant", x1 - 0.35, outer - inward, 0.0), rng, float(rng.uniform(0.9, 1.2))
    )


def _meeting(scene: Scene, rng: np.random.Generator, room: Rect) -> None:
    """A long table with chairs, a screen on the west wall, a cabinet."""
    x0, y0, x1, y1 = room
    fur.meeting_table(Place(scene, "meeting/table", (x0 + x1) / 2, (y0 + y1) / 2 + 0.25), rng)
    screen = Place(scene, "meeting/screen", x0, (y0 + y1) / 2 + 0.25, WEST)
    screen.box(
        "display", (-0.8, -0.06, 0.95), (1.6, 0.06, 0.95), tex.plaster((38, 38, 42), 0.1), front=drawn.screen
    )
    fur.cabinet(Place(scene, "meeting/cabinet", x1, (y0 + y1) / 2 + 0.4, EAST), rng, 1.5)
    fur.plant(Place(scene, "meeting/plant", x0 + 0.4, y1 - 0.4), rng, 1.1)


def _lounge(scene: Scene, rng: np.random.Generator, room: Rect) -> None:
    """A sofa, a low table on a rug, a copier, a shelf."""
    x0, y0, x1, y1 = room
    fur.sofa(Place(scene, "lounge/sofa", (x0 + x1) / 2 + 0.4, y1, NORTH), rng)
    table = Place(scene, "lounge/table", (x0 + x1) / 2 + 0.3, y1 - 1.6, 0.15)
    table.box("top", (-0.5, -0.3, 0.38), (1.0, 0.6, 0.05), wooden.wood((136, 90, 56)))
    table.legs("leg", (-0.47, -0.27, 0), (0.94, 0.54, 0.38), wooden.wood((100, 66, 44)), thick=0.06)
    table.box("paper", (-0.2, -0.1, 0.43), (0.3, 0.22, 0.02), drawn.picture("landscape"), yaw_rad=0.4)
    rug_at = Place(scene, "lounge/rug", (x0 + x1) / 2 + 0.3, y1 - 1.6)
    rug_at.box("rug", (-1.1, -0.75, 0.0), (2.2, 1.5, 0.012), tex.plaster((120, 90, 70)), top=tex.rug)
    fur.copier(Place(scene, "lounge/copier", x0, y1 - 1.2, WEST), rng)
    fur.shelf(Place(scene, "lounge/shelf", x1, y1 - 1.9, EAST), rng, 1.4)
    fur.cartons(Place(scene, "lounge/cartons", x1 - 0.5, y0, SOUTH), rng)
