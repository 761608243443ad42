"""What can be simulated, behind one interface: a procedural scene, or a folder of textured meshes."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render import bake, meshes, triangles
from duagc.converters.simulate.render.raycast import Caster, MeshRenderer
from duagc.converters.simulate.render.renderer import CameraRenderer, Renderer
from duagc.converters.simulate.scenes.catalog import MESHES, SCENES, SceneSettings, build
from duagc.converters.simulate.trajectories import loops, walks
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.files import save_array
from duagc.pipeline.geometry.camera import PinholeCamera

Points = tuple[Array, Array, NDArray[np.uint8]]

ROOM = SCENES["room"][1]
ROOM_POINTS = 200_000
POINTS_PER_M2, MOST_POINTS = 2000, 2_000_000  # of meshes; the room has about as many on a square meter


class SimulatedScene(walks.Terrain, Protocol):
    """A scene that is ready to be rendered."""

    depth_scale_m: float

    def wander(self, robots: int, frames: int, overlap: float, camera: PinholeCamera) -> list[Array]:
        """Paths T_world_camera [frames, 4, 4] of every robot, of no particular figure.

        Args:
            robots: how many.
            frames: poses per robot, one step of the scene apart.
            overlap: share, 0 to 1, of what a robot sees that the one before sees as well; met as nearly as
                may be.
            camera: of all robots.

        Raises:
            DuagError: no paths are found that keep clear.
        """

    def points(self) -> Points:
        """Points spread evenly over the surfaces: positions (m, world), unit normals, colors, [n, 3] each."""

    def store(self, folder: Path) -> "SceneOnDisk":
        """Write what other processes need.

        Args:
            folder: where the files of the scene are written; exists.
        """


class SceneOnDisk(Protocol):
    """A simulated scene whose large parts lie in a folder; small enough to be sent to another process."""

    def open(self) -> SimulatedScene:
        """The scene, ready to be rendered."""


def set_up(scene: str, up: str, seed: int, cache: Path, *, as_meshes: bool) -> SimulatedScene:
    """A procedural scene or a folder of meshes, ready to be rendered.

    Args:
        scene: one of `SCENES`, or else a folder of textured meshes.
        up: of meshes, the axis that is up in the files, "y" or "z".
        seed: of the scene.
        cache: an empty folder, into which meshes are read.
        as_meshes: make triangles of the room too, whose own renderer knows rays from one point only.
    """
    if scene not in SCENES:
        meshes.read(Path(scene), up, cache)
        return SimulatedMeshes(seed, cache)
    if scene == "room" and not as_meshes:
        return SimulatedRoom(seed)
    settings = SCENES[scene][1]
    triangles.write(build(scene, seed), settings.texel_m, cache)
    return SimulatedMeshes(seed, cache, settings)


@dataclass(frozen=True)
class RoomOnDisk:
    """A procedural room whose baked texture lies in a folder; `open` gives the scene in any process."""

    seed: int
    folder: Path
    levels: int
    origin: Array

    def open(self) -> "SimulatedRoom":
        """The scene, ready to be rendered."""
        files = [self.folder / f"{k}.npy" for k in range(self.levels)]
        maps = [np.asarray(np.load(path, mmap_mode="r")) for path in files]
        return SimulatedRoom(self.seed, bake.Atlas(maps, self.origin, ROOM.texel_m))


class SimulatedRoom:
    """The procedural room, without triangles: its depth is exact in float64."""

    step_m, depth_scale_m, sky = ROOM.step_m, ROOM.depth_scale_m, ROOM.sky

    def __init__(self, seed: int, atlas: bake.Atlas | None = None) -> None:
        """Build the room; unless its colors are known, a thread bakes them meanwhile.

        Args:
            seed: of the scene.
            atlas: its colors, if they are known.
        """
        self.scene = build("room", seed)
        self._baked: Future[bake.Atlas]
        if atlas is None:
            painter = ThreadPoolExecutor(1)
            self._baked = painter.submit(bake.bake, self.scene, ROOM.texel_m)
            painter.shutdown(wait=False)
        else:
            self._baked = Future()
            self._baked.set_result(atlas)

    @property
    def atlas(self) -> bake.Atlas:
        """Colors of all surfaces."""
        return self._baked.result()

    def store(self, folder: Path) -> RoomOnDisk:
        """Write the baked texture.

        Args:
            folder: where the files of the scene are written; exists.
        """
        for k, level in enumerate(self.atlas.levels):
            save_array(folder / f"{k}.npy", level)
        return RoomOnDisk(self.scene.seed, folder, len(self.atlas.levels), self.atlas.origin)

    def renderer(self, camera: PinholeCamera) -> CameraRenderer:
        """A renderer with exact depth.

        Args:
            camera: of the views.
        """
        return Renderer(self.scene, self.atlas, camera)

    def sketch_renderer(self, camera: PinholeCamera) -> CameraRenderer:
        """A renderer for depth alone, of the room's triangles.

        Args:
            camera: of the views.
        """
        return MeshRenderer(Caster(triangles.unpainted(self.scene)), camera)

    def wander(self, robots: int, frames: int, overlap: float, camera: PinholeCamera) -> list[Array]:
        """Loops around the room, T_world_camera [frames, 4, 4] of every robot; see `loops.plan`.

        Args:
            robots: how many.
            frames: poses per robot, one step of the scene apart.
            overlap: share, 0 to 1, of what a robot sees that the one before sees as well; met as nearly as
                may be.
            camera: of all robots.

        Raises:
            DuagError: no paths are found that keep clear.
        """
        return loops.plan(self.scene, robots, frames, overlap, camera=camera)

    def free_space(self) -> walks.WalkableSpace:
        def closed(places: Array) -> NDArray[np.bool_]:
            return np.ones(len(places), dtype=np.bool_)

        return walks.space_between(np.zeros(2), self.scene.size[:2], 0.0, self.clearance, closed=closed)

    def clearance(self, points: Array) -> Array:
        """Distance (m) of points to the nearest surface, [...]; negative outside the room or in a solid.

        Args:
            points: [..., 3], meters, world frame.
        """
        return self.scene.clearance(points)

    def points(self) -> Points:
        return bake.surface_points(self.scene, self.atlas, ROOM_POINTS)


@dataclass(frozen=True)
class MeshesOnDisk:
    """Meshes that lie, read, in a folder; `open` gives the scene in any process."""

    seed: int
    folder: Path
    settings: SceneSettings

    def open(self) -> "SimulatedMeshes":
        """The scene, ready to be rendered."""
        return SimulatedMeshes(self.seed, self.folder, self.settings)


class SimulatedMeshes:
    """A scene of meshes, ready to be rendered."""

    def __init__(self, seed: int, folder: Path, settings: SceneSettings = MESHES) -> None:
        """Load the meshes for rendering; the free space is computed when it is first needed.

        Args:
            seed: of paths and points.
            folder: where `meshes.read` or `triangles.write` has written the scene.
            settings: how robots move and measure in it.
        """
        self.seed, self.folder, self.settings = seed, folder, settings
        self.step_m, self.depth_scale_m, self.sky = settings.step_m, settings.depth_scale_m, settings.sky
        self.scene = meshes.load(folder)
        self.caster = Caster(self.scene)
        self._space: walks.WalkableSpace | None = None

    def store(self, folder: Path) -> MeshesOnDisk:
        """Everything is on disk already.

        Args:
            folder: not used.
        """
        return MeshesOnDisk(self.seed, self.folder, self.settings)

    def renderer(self, camera: PinholeCamera) -> CameraRenderer:
        """A renderer of the triangles.

        Args:
            camera: of the views.
        """
        return MeshRenderer(self.caster, camera, self.sky)

    def sketch_renderer(self, camera: PinholeCamera) -> CameraRenderer:
        """The same renderer: there is no quicker one.

        Args:
            camera: of the views.
        """
        return self.renderer(camera)

    def wander(self, robots: int, frames: int, overlap: float, camera: PinholeCamera) -> list[Array]:
        """Walks T_world_camera [frames, 4, 4] of every robot; see `walks.plan`.

        Args:
            robots: how many.
            frames: poses per robot, one step of the scene apart.
            overlap: share, 0 to 1, of what a robot sees that the one before sees as well; met as nearly as
                may be.
            camera: of all robots.

        Raises:
            DuagError: no walks are found that keep clear and see something.
        """
        return walks.plan(self, robots, frames, overlap, camera=camera, seed=self.seed)

    def free_space(self) -> walks.WalkableSpace:
        if self._space is None:
            self._space = walks.free_space(self.caster, self.sky)
        return self._space

    def clearance(self, points: Array) -> Array:
        """Distance (m) of points to the nearest surface, [...].

        Args:
            points: [..., 3], meters, world frame.
        """
        return self.caster.clearance(points)

    def points(self) -> Points:
        areas = self.scene.areas()
        count = int(np.clip(POINTS_PER_M2 * areas.sum(), ROOM_POINTS, MOST_POINTS))
        rng = random_streams.generator(self.seed, "simulate.points")
        points, normals, colors = meshes.surface_points(self.scene, areas, count, rng)
        if not self.settings.solid:
            return points, normals, colors
        hit = self.caster.hits(points + 0.002 * normals, normals.astype(np.float32))
        inside = np.isfinite(hit["t"]) & (np.einsum("ij,ij->i", hit["normals"], normals) > 0)  # sees a back
        return points[~inside], normals[~inside], colors[~inside]
