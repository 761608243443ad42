"""Scenes made of boxes, upright cylinders and spheres, and the surfaces that a camera sees of them.

World frame: x east, y north, z up, meters; the floor is z = 0. A solid is what paths keep clear of and what casts
shadows; its surfaces carry the texture. Surface coordinates (s, t) are meters, s to the right and t downwards for
somebody who looks at the surface from its front.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from duagc.converters.simulate.scenes import painting
from duagc.pipeline.base.arrays import Array

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Flat:
    """A rectangle p0 + s axis_s + t axis_t with 0 <= s <= size[0], 0 <= t <= size[1]; or the disc that fits in it."""

    name: str
    material: painting.Material
    corner: Array
    axis_s: Array
    axis_t: Array
    size: tuple[float, float]
    round: bool = False

    @property
    def normal(self) -> Array:
        """Unit normal, toward the side from which the surface is seen."""
        return np.cross(self.axis_t, self.axis_s)

    def points(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        """World points [..., 3] and normals [..., 3] at surface coordinates.

        Args:
            s: meters to the right, [...].
            t: meters downwards, [...]; broadcasts with s.
        """
        s, t = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(t, dtype=np.float64))
        points = self.corner + s[..., None] * self.axis_s + t[..., None] * self.axis_t
        return points, np.broadcast_to(self.normal, points.shape)


@dataclass(frozen=True)
class Side:
    """The mantle of an upright cylinder; s runs around it, t down from its top."""

    name: str
    material: painting.Material
    base: Array
    radius: float
    height: float

    @property
    def size(self) -> tuple[float, float]:
        """Circumference and height, meters."""
        return 2 * np.pi * self.radius, self.height

    def points(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        """World points [..., 3] and normals [..., 3] at surface coordinates.

        Args:
            s: meters around, [...].
            t: meters down from the top, [...]; broadcasts with s.
        """
        s, t = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(t, dtype=np.float64))
        angle = s / self.radius
        normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        offset = self.radius * normals + (self.height - t)[..., None] * UP
        return self.base + offset, normals


@dataclass(frozen=True)
class Ball:
    """A sphere; s is longitude times radius, t is angle from the top times radius."""

    name: str
    material: painting.Material
    center: Array
    radius: float

    @property
    def size(self) -> tuple[float, float]:
        """Length of the equator and of a meridian, meters."""
        return 2 * np.pi * self.radius, np.pi * self.radius

    def points(self, s: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        """World points [..., 3] and normals [..., 3] at surface coordinates.

        Args:
            s: longitude times radius, meters, [...].
            t: angle from the top times radius, meters, [...]; broadcasts with s.
        """
        lon = np.asarray(s, dtype=np.float64) / self.radius
        polar = np.asarray(t, dtype=np.float64) / self.radius
        normals = np.stack([np.sin(polar) * np.cos(lon), np.sin(polar) * np.sin(lon), np.cos(polar)], axis=-1)
        return self.center + self.radius * normals, normals


Surface = Flat | Side | Ball


@dataclass(frozen=True)
class Box:
    """A box turned by `yaw_rad` about the vertical through its center; `half` are its half extents."""

    center: Array
    half: Array
    yaw_rad: float = 0.0
    shades: bool = True

    def local(self, points: ArrayLike) -> Array:
        """World points in the frame of the box, [..., 3].

        Args:
            points: [..., 3], meters, world frame.
        """
        return self.turned(np.asarray(points, dtype=np.float64) - self.center)

    def turned(self, vectors: ArrayLike) -> Array:
        """World vectors in the frame of the box, [..., 3].

        Args:
            vectors: [..., 3], world frame.
        """
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.asarray(vectors) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (m) of points to the box, negative inside, [...].

        Args:
            points: [..., 3], meters, world frame.
        """
        q = np.abs(self.local(points)) - self.half
        return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder that stands on `base`."""

    base: Array
    radius: float
    height: float
    shades: bool = True

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (m) of points to the cylinder, negative inside, [...].

        Args:
            points: [..., 3], meters, world frame.
        """
        p = np.asarray(points, dtype=np.float64) - self.base
        radial = np.hypot(p[..., 0], p[..., 1]) - self.radius
        along = np.abs(p[..., 2] - self.height / 2) - self.height / 2
        outside = np.hypot(np.maximum(radial, 0.0), np.maximum(along, 0.0))
        return outside + np.minimum(np.maximum(radial, along), 0.0)


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    center: Array
    radius: float
    shades: bool = True

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (m) of points to the sphere, negative inside, [...].

        Args:
            points: [..., 3], meters, world frame.
        """
        return np.linalg.norm(np.asarray(points, dtype=np.float64) - self.center, axis=-1) - self.radius


Solid = Box | Cylinder | Sphere


@dataclass(frozen=True)
class Lamp:
    """A shining rectangle: its center, two half extents (world vectors) and its strength (1 lights a near wall)."""

    center: Array
    half_a: Array
    half_b: Array
    strength: float


@dataclass
class Scene:
    """A room [0, size] with what stands in it.

    Attributes:
        even_light: strength of the light from everywhere.
        sun: vector toward the sun, as long as it is strong; a scene with a sun has a sky instead of a
            ceiling.
    """

    name: str
    seed: int
    size: Array
    solids: list[Solid] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    even_light: float = 0.5
    sun: Array | None = None

    def clearance(self, points: ArrayLike) -> Array:
        """Distance (m) of points to the nearest surface, [...]; negative outside the room or in a solid.

        Args:
            points: [..., 3], meters, world frame.
        """
        p = np.asarray(points, dtype=np.float64)
        nearest = np.minimum(p, self.size - p).min(axis=-1)
        for solid in self.solids:
            nearest = np.minimum(nearest, solid.distance(p))
        return nearest

    def box(
        self,
        name: str,
        low: ArrayLike,
        size: ArrayLike,
        material: painting.Material,
        *,
        yaw_rad: float = 0.0,
        about: ArrayLike | None = None,
        shades: bool = True,
        **faces: painting.Material,
    ) -> None:
        """Put a box.

        Front looks south (-y). Faces that lie on a wall or on the floor are left out.

        Args:
            name: of the box; its surfaces are called name/face.
            low: its low corner before the turn [3], meters, world frame.
            size: [3], meters.
            material: of the faces that `faces` does not name.
            yaw_rad: turn about the vertical through `about`.
            about: (x, y) or a point of the axis of the turn, meters, world frame; None: the box's own center.
            shades: whether it casts shadows.
            faces: materials by face: front, back, left, right, top, under.
        """
        low, size = np.asarray(low, dtype=np.float64), np.asarray(size, dtype=np.float64)
        center = low + size / 2
        if about is not None:
            pivot = np.array([*np.asarray(about, dtype=np.float64)[:2], 0.0])
            center = pivot + _turn(yaw_rad) @ (center - pivot)
        self.solids.append(Box(center, size / 2, yaw_rad, shades))
        x, y, z = np.eye(3)
        axes = {"front": (x, -z, -y), "back": (-x, -z, y), "left": (-y, -z, -x), "right": (y, -z, x)}
        axes |= {"top": (x, -y, z), "under": (x, y, -z)}
        for face, (s, t, n) in axes.items():
            extent = (float(np.abs(s) @ size), float(np.abs(t) @ size))
            corner = center + _turn(yaw_rad) @ ((np.abs(n) @ size * n - extent[0] * s - extent[1] * t) / 2)
            flat = Flat(
                f"{name}/{face}",
                faces.get(face, material),
                corner,
                _turn(yaw_rad) @ s,
                _turn(yaw_rad) @ t,
                extent,
            )
            middle, _ = flat.points(extent[0] / 2, extent[1] / 2)
            if np.minimum(middle, self.size - middle).min() > 1e-3:
                self.surfaces.append(flat)

    def cylinder(
        self, name: str, base: ArrayLike, material: painting.Material, *, radius: float, height: float
    ) -> None:
        """Put an upright cylinder with its lid.

        Args:
            name: of the cylinder.
            base: middle of its foot [3], meters, world frame.
            material: of side and lid.
            radius: meters.
            height: meters.
        """
        base = np.asarray(base, dtype=np.float64)
        self.solids.append(Cylinder(base, radius, height))
        self.surfaces.append(Side(f"{name}/side", material, base, radius, height))
        x, y, _ = np.eye(3)
        lid = base + height * UP - radius * x + radius * y
        self.surfaces.append(Flat(f"{name}/lid", material, lid, x, -y, (2 * radius, 2 * radius), round=True))

    def sphere(self, name: str, center: ArrayLike, radius: float, material: painting.Material) -> None:
        """Put a sphere.

        Args:
            name: of the sphere.
            center: [3], meters, world frame.
            radius: meters.
            material: of its surface.
        """
        center = np.asarray(center, dtype=np.float64)
        self.solids.append(Sphere(center, radius))
        self.surfaces.append(Ball(name, material, center, radius))

    def legs(
        self,
        name: str,
        low: ArrayLike,
        size: ArrayLike,
        material: painting.Material,
        *,
        thick: float,
        **turn: Any,
    ) -> None:
        """Put four legs under a box; they cast no shadows.

        Args:
            name: of the piece of furniture.
            low: low corner of the box [3], meters, world frame.
            size: of the box [3], meters; the legs are as high as it.
            material: of the legs.
            thick: width of a leg, meters.
            turn: `yaw_rad` and `about` of `box`.
        """
        low, size = np.asarray(low, dtype=np.float64), np.asarray(size, dtype=np.float64)
        for i, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            corner = low + np.array([dx, dy, 0]) * (size - thick)
            self.box(f"{name}/leg{i}", corner, (thick, thick, size[2]), material, shades=False, **turn)


def _turn(yaw_rad: float) -> Array:
    """Rotation about the vertical [3, 3]."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
