"""What can be simulated, behind one interface: a procedural room, or a folder of textured meshes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from converters.simulate import bake, meshes, paths, walks
from converters.simulate.raycast import Caster, MeshRenderer
from converters.simulate.render import Eye, Renderer
from converters.simulate.scene import build
from pipeline import streams
from pipeline.geometry.camera import PinholeCamera

Array = NDArray[np.float64]
Points = tuple[Array, Array, NDArray[np.uint8]]

TEXEL_M = 0.004
ROOM_POINTS = 200_000
POINTS_PER_M2, MOST_POINTS = 2000, 2_000_000  # of meshes; the room has about as many on a square metre


class Stage(Protocol):
    """A scene that is ready to be rendered."""

    def eye(self, camera: PinholeCamera) -> Eye:
        """A renderer."""

    def plan(self, robots: int, frames: int, overlap: float, camera: PinholeCamera) -> list[Array]:
        """Paths T_world_camera [frames, 4, 4] of every robot."""

    def clearance(self, points: Array) -> Array:
        """Distance (m) of world points [n, 3] to the nearest surface."""

    def points(self) -> Points:
        """Points spread evenly over the surfaces: positions (m, world), unit normals, colours, [n, 3] each."""


@dataclass(frozen=True)
class RoomOnDisk:
    """A procedural room whose baked texture lies in a folder; `open` gives the stage in any process."""

    name: str
    seed: int
    folder: Path
    levels: int
    origin: Array

    def open(self) -> "RoomStage":
        """The stage."""
        files = [self.folder / f"{k}.npy" for k in range(self.levels)]
        maps = [np.asarray(np.load(path, mmap_mode="r")) for path in files]
        return RoomStage(self.name, self.seed, bake.Atlas(maps, self.origin, TEXEL_M))


class RoomStage:
    """A procedural room."""

    def __init__(self, name: str, seed: int, atlas: bake.Atlas | None = None) -> None:
        self.scene = build(name, seed)
        self.atlas = bake.bake(self.scene, TEXEL_M) if atlas is None else atlas

    def store(self, folder: Path) -> RoomOnDisk:
        """Write what other processes need."""
        for k, level in enumerate(self.atlas.levels):
            np.save(folder / f"{k}.npy", level)
        return RoomOnDisk(self.scene.name, self.scene.seed, folder, len(self.atlas.levels), self.atlas.origin)

    def eye(self, camera: PinholeCamera) -> Eye:
        return Renderer(self.scene, self.atlas, camera)

    def plan(self, robots: int, frames: int, overlap: float, camera: PinholeCamera) -> list[Array]:
        return paths.plan(self.scene, robots, frames, overlap, camera)

    def clearance(self, points: Array) -> Array:
        return self.scene.clearance(points)

    def points(self) -> Points:
        return bake.surface_points(self.scene, self.atlas, ROOM_POINTS)


@dataclass(frozen=True)
class MeshesOnDisk:
    """Meshes that lie, read, in a folder; `open` gives the stage in any process."""

    seed: int
    folder: Path

    def open(self) -> "MeshStage":
        """The stage."""
        return MeshStage(self.seed, self.folder)


class MeshStage:
    """A scene of meshes."""

    def __init__(self, seed: int, folder: Path) -> None:
        """Args:
        seed: of walks and points. folder: where `meshes.read` has written the scene.
        """
        self.seed, self.folder = seed, folder
        self.scene = meshes.load(folder)
        self.caster = Caster(self.scene)

    def store(self, folder: Path) -> MeshesOnDisk:
        """All is on disk already."""
        return MeshesOnDisk(self.seed, self.folder)

    def eye(self, camera: PinholeCamera) -> Eye:
        return MeshRenderer(self.caster, camera)

    def plan(self, robots: int, frames: int, overlap: float, camera: PinholeCamera) -> list[Array]:
        return walks.plan(self.caster, robots, frames, overlap, camera, self.seed)

    def clearance(self, points: Array) -> Array:
        return self.caster.clearance(points)

    def points(self) -> Points:
        areas = self.scene.areas()
        count = int(np.clip(POINTS_PER_M2 * areas.sum(), ROOM_POINTS, MOST_POINTS))
        rng = streams.generator(self.seed, "simulate.points")
        return meshes.surface_points(self.scene, areas, count, rng)
