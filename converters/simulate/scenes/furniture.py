"""What stands in offices and corridors: pieces that are put against a wall or into the open, in any direction."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from duagc.converters.simulate.scenes import drawn, painting
from duagc.converters.simulate.scenes import textures as tex
from duagc.converters.simulate.scenes import wood_textures as wooden
from duagc.converters.simulate.scenes.scene import Scene
from duagc.pipeline.base.arrays import Array

OAK, DARK, PINE = (168, 124, 80), (92, 68, 50), (190, 152, 106)
STEEL = tex.plaster((150, 154, 158), 0.08)
CLOTHS = (
    ((84, 102, 118), (132, 122, 100)),
    ((150, 84, 62), (196, 160, 110)),
    ((70, 104, 84), (180, 170, 130)),
)
PICTURES = ("abstract", "landscape", "map", "page")


@dataclass(frozen=True)
class Place:
    """A spot on the floor with axes of its own: x to the right and y to the wall behind, turned by `yaw_rad`.

    A wall to the north has yaw 0, to the west 90 degrees, to the south 180, to the east 270.
    """

    scene: Scene
    name: str
    x: float
    y: float
    yaw_rad: float = 0.0

    def world(self, point: ArrayLike) -> Array:
        """World coordinates [3] of a point of the place.

        Args:
            point: [3], meters, in the axes of the place.
        """
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        px, py, pz = np.asarray(point, dtype=np.float64)
        return np.array([self.x + c * px - s * py, self.y + s * px + c * py, pz])

    def box(
        self,
        name: str,
        low: ArrayLike,
        size: ArrayLike,
        material: painting.Material,
        *,
        yaw_rad: float = 0.0,
        **faces: Any,
    ) -> None:
        """A box, turned about its own middle.

        Args:
            name: appended to that of the place.
            low: its low corner [3], meters, in the axes of the place.
            size: along these axes [3], meters.
            material: of all faces.
            yaw_rad: turn against the axes of the place.
            faces: materials of single faces, as in `Scene.box`.
        """
        half = np.asarray(size, dtype=np.float64) / 2
        low_world = self.world(np.asarray(low, dtype=np.float64) + half) - half
        self.scene.box(
            f"{self.name}/{name}", low_world, 2 * half, material, yaw_rad=self.yaw_rad + yaw_rad, **faces
        )

    def legs(
        self, name: str, low: ArrayLike, size: ArrayLike, material: painting.Material, *, thick: float
    ) -> None:
        """Four legs under a box.

        Args:
            name: appended to that of the place.
            low: low corner of the box [3], meters, in the axes of the place.
            size: of the box [3], meters; the legs are as high as it.
            material: of the legs.
            thick: width of a leg, meters.
        """
        low, size = np.asarray(low, dtype=np.float64), np.asarray(size, dtype=np.float64)
        for i, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            corner = low + np.array([dx, dy, 0]) * (size - thick)
            self.box(f"{name}{i}", corner, (thick, thick, size[2]), material)

    def cylinder(
        self, name: str, base: ArrayLike, material: painting.Material, *, radius: float, height: float
    ) -> None:
        """An upright cylinder.

        Args:
            name: appended to that of the place.
            base: middle of its foot [3], meters, in the axes of the place.
            material: of side and lid.
            radius: meters.
            height: meters.
        """
        self.scene.cylinder(f"{self.name}/{name}", self.world(base), material, radius=radius, height=height)

    def sphere(self, name: str, center: ArrayLike, radius: float, material: painting.Material) -> None:
        """A sphere.

        Args:
            name: appended to that of the place.
            center: [3], meters, in the axes of the place.
            radius: meters.
            material: of its surface.
        """
        self.scene.sphere(f"{self.name}/{name}", self.world(center), radius, material)


def desk(at: Place, rng: np.random.Generator) -> None:
    """A desk at the wall with a display, drawers, books, paper and a mug, and a chair before it.

    Args:
        at: where it stands.
        rng: source of colors and details.
    """
    dark = wooden.wood(DARK)
    at.box("top", (-0.75, -0.75, 0.71), (1.5, 0.75, 0.04), wooden.wood(PINE))
    at.legs("leg", (-0.72, -0.72, 0), (1.44, 0.68, 0.71), dark, thick=0.06)
    at.box(
        "drawers",
        (0.22, -0.68, 0.18),
        (0.42, 0.6, 0.52),
        wooden.wood(OAK),
        front=wooden.front((170, 126, 82), 1, 3),
    )
    left = float(rng.uniform(-0.55, -0.25))
    black = tex.plaster((38, 38, 42), 0.1)
    at.box("monitor", (left, -0.28, 0.86), (0.62, 0.05, 0.4), black, front=drawn.screen)
    at.box("monitor/foot", (left + 0.2, -0.3, 0.75), (0.22, 0.16, 0.11), black)
    cover = tex.marbled((92, 70, 60), (124, 92, 74))
    at.box("books", (0.35, -0.24, 0.75), (0.34, 0.2, 0.26), cover, front=drawn.spines)
    at.box(
        "paper", (0.05, -0.6, 0.75), (0.3, 0.22, 0.012), drawn.picture("page"), yaw_rad=rng.uniform(-0.4, 0.4)
    )
    mug = tex.marbled((176, 66, 48), (226, 212, 186), 0.05)
    at.cylinder("mug", (-0.6, -0.5, 0.75), mug, radius=0.045, height=0.1)
    x, y, _ = at.world((0.0, -0.95, 0))
    turned = Place(at.scene, f"{at.name}/chair", x, y, at.yaw_rad)
    chair(turned, rng, float(rng.uniform(-0.5, 0.5)))


def chair(at: Place, rng: np.random.Generator, yaw_rad: float = 0.0) -> None:
    """A chair that looks to the wall, its middle at the place.

    Args:
        at: where it stands.
        rng: source of colors and details.
        yaw_rad: turn against the axes of the place.
    """
    cloth = tex.fabric(*CLOTHS[int(rng.integers(0, len(CLOTHS)))])
    own = Place(at.scene, at.name, at.x, at.y, at.yaw_rad + yaw_rad)
    own.box("seat", (-0.22, -0.22, 0.42), (0.44, 0.44, 0.06), cloth)
    own.legs("leg", (-0.21, -0.21, 0), (0.42, 0.42, 0.42), wooden.wood(DARK), thick=0.045)
    own.box("back", (-0.22, -0.22, 0.54), (0.44, 0.05, 0.4), cloth)


def shelf(at: Place, rng: np.random.Generator, width: float, height: float = 2.0) -> None:
    """Boards with rows of books and boxes, open to the front.

    Args:
        at: where it stands.
        rng: source of colors and details.
        width: meters.
        height: meters.
    """
    oak, board, rows, depth = wooden.wood((150, 106, 66)), 0.03, 5, 0.32
    at.box("back", (-width / 2, -0.02, 0), (width, 0.02, height), wooden.wood((112, 78, 50)))
    for side, x in (("left", -width / 2), ("right", width / 2 - board)):
        at.box(side, (x, -depth, 0), (board, depth - 0.02, height), oak)
    step = (height - board) / rows
    paper, cover = tex.plaster((206, 198, 178), 0.1), tex.marbled((92, 70, 60), (124, 92, 74))
    for k in range(rows + 1):
        at.box(
            f"board{k}", (-width / 2 + board, -depth, k * step), (width - 2 * board, depth - 0.02, board), oak
        )
        x = -width / 2 + board + float(rng.uniform(0, 0.05))
        while k < rows and x < width / 2 - board - 0.12:
            length = min(float(rng.uniform(0.14, 0.42)), width / 2 - board - 0.005 - x)
            tall = (step - board) * float(rng.uniform(0.55, 0.92))
            low = (x, -depth + float(rng.uniform(0.01, 0.06)), k * step + board)
            if rng.random() < 0.78:
                at.box(f"books{k}.{x:.2f}", low, (length, 0.2, tall), cover, front=drawn.spines, top=paper)
            else:
                at.box(f"box{k}.{x:.2f}", low, (length, 0.2, 0.6 * tall), drawn.carton)
            x += length + float(rng.uniform(0.0, 0.1))


def cabinet(at: Place, rng: np.random.Generator, width: float = 1.2, height: float = 0.88) -> None:
    """Drawers with a few things on top.

    Args:
        at: where it stands.
        rng: source of colors and details.
        width: meters.
        height: meters.
    """
    columns = max(2, round(width / 0.45))
    tone = painting.shaded(rng, (182, 160, 126), 0.12)
    at.box(
        "body",
        (-width / 2, -0.45, 0),
        (width, 0.45, height),
        wooden.wood(tone),
        front=wooden.front(tone, columns, 3),
    )
    cover = tex.marbled((92, 70, 60), (124, 92, 74))
    at.box("books", (-width / 2 + 0.08, -0.3, height), (0.36, 0.18, 0.25), cover, front=drawn.spines)
    glaze = tex.marbled(painting.vivid(rng), (226, 206, 176), 0.08)
    at.cylinder("jar", (0.1 * width, -0.22, height), glaze, radius=0.09, height=float(rng.uniform(0.16, 0.3)))
    at.sphere(
        "ball",
        (0.36 * width, -0.22, height + 0.11),
        0.11,
        tex.marbled(painting.vivid(rng), (70, 96, 130), 0.1),
    )


def plant(at: Place, rng: np.random.Generator, high: float = 1.0) -> None:
    """A plant in a pot, its middle at the place.

    Args:
        at: where it stands.
        rng: source of colors and details.
        high: height of the middle of its leaves, meters.
    """
    at.cylinder(
        "pot",
        (0, 0, 0),
        tex.marbled(painting.shaded(rng, (168, 96, 66), 0.15), (120, 70, 52), 0.1),
        radius=0.2,
        height=0.4,
    )
    at.cylinder("stem", (0, 0, 0.4), wooden.wood((96, 74, 50)), radius=0.03, height=high - 0.6)
    at.sphere("leaves", (0, 0, high), float(rng.uniform(0.26, 0.34)), tex.foliage)


def cartons(at: Place, rng: np.random.Generator) -> None:
    """Two boxes, one on the other, at the wall.

    Args:
        at: where it stands.
        rng: source of colors and details.
    """
    at.box("low", (-0.28, -0.58, 0), (0.55, 0.55, 0.42), drawn.carton)
    at.box("high", (-0.2, -0.5, 0.42), (0.38, 0.4, 0.3), drawn.carton, yaw_rad=float(rng.uniform(-0.5, 0.5)))


def sofa(at: Place, rng: np.random.Generator, width: float = 1.7) -> None:
    """A sofa at the wall with cushions.

    Args:
        at: where it stands.
        rng: source of colors and details.
        width: of the seat, meters.
    """
    cloth = tex.fabric(*CLOTHS[int(rng.integers(0, len(CLOTHS)))])
    at.box("seat", (-width / 2, -0.85, 0.1), (width, 0.63, 0.32), cloth)
    at.box("back", (-width / 2, -0.22, 0.1), (width, 0.22, 0.72), cloth)
    for side, x in (("left", -width / 2 - 0.2), ("right", width / 2)):
        at.box(side, (x, -0.85, 0.1), (0.2, 0.85, 0.5), cloth)
    for k in range(2):
        pillow = tex.fabric(painting.vivid(rng, 0.6), (220, 206, 170))
        low = (-width / 2 + 0.15 + 0.8 * k, -0.42, 0.42)
        at.box(f"cushion{k}", low, (0.42, 0.13, 0.34), pillow, yaw_rad=float(rng.uniform(-0.2, 0.2)))


def meeting_table(at: Place, rng: np.random.Generator, length: float = 2.4) -> None:
    """A long table along x with chairs on both sides and paper on it, its middle at the place.

    Args:
        at: where it stands.
        rng: source of colors and details.
        length: meters.
    """
    at.box("top", (-length / 2, -0.5, 0.7), (length, 1.0, 0.05), wooden.wood((136, 90, 56)))
    at.legs("leg", (-length / 2 + 0.05, -0.45, 0), (length - 0.1, 0.9, 0.7), wooden.wood(DARK), thick=0.08)
    for k in range(4):
        low = (-length / 2 + 0.2 + k * (length - 0.4) / 4, float(rng.uniform(-0.35, 0.1)), 0.75)
        kind = PICTURES[int(rng.integers(0, 4))]
        at.box(
            f"paper{k}", low, (0.3, 0.22, 0.015), drawn.picture(kind), yaw_rad=float(rng.uniform(-0.6, 0.6))
        )
    for side, turn in ((-1, 0.0), (1, np.pi)):
        for k in range(3):
            x, y, _ = at.world((-length / 3 + k * length / 3, side * 0.78, 0))
            chair(
                Place(at.scene, f"{at.name}/chair{side}.{k}", x, y, at.yaw_rad + turn),
                rng,
                rng.uniform(-0.3, 0.3),
            )


def copier(at: Place, rng: np.random.Generator) -> None:
    """A copying machine at the wall.

    Args:
        at: where it stands.
        rng: source of colors and details.
    """
    gray = tex.plaster(painting.shaded(rng, (204, 204, 198), 0.05), 0.05)
    at.box(
        "body",
        (-0.35, -0.62, 0),
        (0.7, 0.6, 0.85),
        gray,
        front=wooden.front((186, 188, 190), 1, 4, (70, 72, 76)),
    )
    at.box("lid", (-0.35, -0.62, 0.87), (0.7, 0.6, 0.12), tex.plaster((84, 88, 96), 0.1))
    at.box("panel", (-0.3, -0.72, 0.9), (0.4, 0.1, 0.05), drawn.screen)
    at.box("paper", (-0.2, -0.5, 0.99), (0.3, 0.22, 0.05), drawn.picture("page"), yaw_rad=0.2)


def lockers(at: Place, rng: np.random.Generator, count: int = 4) -> None:
    """A row of lockers at the wall.

    Args:
        at: where it stands.
        rng: source of colors and details.
        count: how many, each 0.4 m wide.
    """
    width = 0.4 * count
    tone = painting.shaded(rng, (96, 122, 140), 0.15)
    at.box("body", (-width / 2, -0.45, 0), (width, 0.45, 1.85), STEEL, front=wooden.front(tone, count, 2))
    at.box("top", (-width / 2 + 0.1, -0.4, 1.85), (0.5, 0.35, 0.26), drawn.carton, yaw_rad=0.1)


def bench(at: Place, rng: np.random.Generator, length: float = 1.6) -> None:
    """A bench at the wall, with a bag on it.

    Args:
        at: where it stands.
        rng: source of colors and details.
        length: meters.
    """
    wood = wooden.wood(painting.shaded(rng, OAK, 0.1))
    for k in range(3):
        at.box(f"board{k}", (-length / 2, -0.5 + 0.15 * k, 0.42), (length, 0.12, 0.04), wood)
    at.legs("leg", (-length / 2 + 0.1, -0.48, 0), (length - 0.2, 0.4, 0.42), STEEL, thick=0.06)
    bag = tex.fabric(painting.vivid(rng, 0.7), (60, 54, 50))
    at.box("bag", (0.2, -0.42, 0.46), (0.4, 0.2, 0.3), bag, yaw_rad=float(rng.uniform(-0.3, 0.3)))


def cooler(at: Place, rng: np.random.Generator) -> None:
    """A water cooler at the wall.

    Args:
        at: where it stands.
        rng: source of colors and details.
    """
    at.box("body", (-0.17, -0.36, 0), (0.34, 0.34, 1.0), tex.plaster((216, 216, 210), 0.05))
    at.cylinder(
        "water", (0, -0.19, 1.0), tex.marbled((96, 150, 190), (150, 196, 220), 0.15), radius=0.14, height=0.38
    )
    at.box("tap", (-0.12, -0.39, 0.62), (0.24, 0.03, 0.16), drawn.screen)


def decorated(
    base: painting.Material,
    width: float,
    height: float,
    rng: np.random.Generator,
    *,
    free: tuple[float, float] = (0.0, 0.0),
) -> painting.Material:
    """A wall with a skirting board and pictures at eye height.

    Args:
        base: material of the wall.
        width: of the wall, meters.
        height: of the wall, meters.
        rng: source of the choice, size and place of the pictures.
        free: both ends of an interval along the wall, meters from its left side, that stays without pictures.
    """
    patches: list[tuple[Any, float, float, float, float]] = [(tex.skirting, 0.0, height - 0.08, width, 0.08)]
    x = float(rng.uniform(0.2, 0.6))
    while x < width - 0.8:
        w, h = float(rng.uniform(0.5, 1.1)), float(rng.uniform(0.5, 0.85))
        w = min(w, width - 0.15 - x)
        if x + w < free[0] or x > free[1]:
            top = height - float(rng.uniform(1.9, 2.1))
            patches.append((drawn.picture(PICTURES[int(rng.integers(0, 4))]), x, max(0.05, top), w, h))
        x += w + float(rng.uniform(0.35, 1.1))
    return tex.paint_onto(base, patches)
