"""Things that move through a scene: figures as tall as people that walk where robots could."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render import meshes, triangles
from duagc.converters.simulate.render.raycast import Caster, MeshRenderer
from duagc.converters.simulate.scenes import painting
from duagc.converters.simulate.scenes import textures as tex
from duagc.converters.simulate.scenes.scene import Scene
from duagc.converters.simulate.trajectories.routes import ROUTE_STEP_M, length_of, route
from duagc.converters.simulate.trajectories.walks import WalkableSpace
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera

STEP_M = 0.025  # per frame
START_M = 0.5  # of a route, before the first frame
TALL_M, REACH_M = 1.75, 1.0  # a ball of that radius about its middle holds a figure
APART_M = 1.2  # from every robot, if a walk allows it
TRIES = 24


@dataclass(frozen=True)
class Mover:
    """A figure.

    Attributes:
        folder: where its triangles lie.
        poses: T_world_mover [frames, 4, 4], between its feet.
    """

    folder: Path
    poses: Array

    def renderer(self, camera: PinholeCamera) -> MeshRenderer:
        """A renderer of the figure alone.

        Args:
            camera: of the views.
        """
        return MeshRenderer(Caster(meshes.load(self.folder)), camera)

    def near(
        self, T_world_mover: Array, origins: Array, directions: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Which rays pass its middle so near that they may meet it.

        Args:
            T_world_mover: pose of the figure, [4, 4].
            origins: [n, 3], meters, world frame.
            directions: [n, 3], world frame, of any length.

        Returns:
            Boolean [n].
        """
        to = T_world_mover[:3, 3] + np.array([0, 0, TALL_M / 2]) - origins
        along = np.einsum("ij,ij->i", to, directions)
        length2 = np.einsum("ij,ij->i", directions, directions)
        return np.asarray(np.einsum("ij,ij->i", to, to) - along * np.abs(along) / length2 < REACH_M**2)


def walk(
    count: int, space: WalkableSpace, caster: Caster, trajectories: list[Array], *, seed: int, cache: Path
) -> list[Mover]:
    """Figures that walk through the free space, clear of the robots and in their view as long as can be found.

    Args:
        count: how many.
        space: where they can stand.
        caster: of the scene.
        trajectories: of the robots, T_world_camera [frames, 4, 4].
        seed: of their paths and colors.
        cache: an existing folder, gets their triangles.

    Raises:
        DuagError: no walk is long enough for the frames.
    """
    cameras, movers = np.stack(trajectories), []
    for k in range(count):
        floor = _walked(k, space, caster, cameras, seed=seed)
        folder = cache / f"mover-{k}"
        folder.mkdir()
        triangles.write(_figure(k, seed), 0.006, folder)
        movers.append(Mover(folder, _upright(floor, space.floor_m)))
    return movers


def _walked(k: int, space: WalkableSpace, caster: Caster, cameras: Array, *, seed: int) -> Array:
    """Where figure k walks [frames, 2]; on longer routes if no route is long enough."""
    from scipy.interpolate import CubicSpline

    graph, frames = space.graph.tocsr(), cameras.shape[1]
    length_m, least_m = frames * STEP_M + 1.0, START_M + STEP_M * (frames - 1)
    for asked_m in (0.0, least_m):
        best: tuple[float, Array] | None = None
        for attempt in range(TRIES):
            rng = random_streams.generator(seed, "simulate.mover", mover=k, attempt=attempt)
            path = route(space, graph, length_m, rng, least_m=asked_m)
            if length_of(path) < least_m:
                continue
            spline = CubicSpline(ROUTE_STEP_M * np.arange(len(path)), path)
            floor = spline(START_M + STEP_M * np.arange(frames))
            middle = np.column_stack([floor, np.full(frames, space.floor_m + 1.1)])
            gap = np.linalg.norm(cameras[:, :, :2, 3] - floor, axis=2).min()
            score = _seen(caster, cameras, middle) + min(0.0, gap - APART_M)
            if best is None or score > best[0]:
                best = score, floor
        if best is not None:
            return best[1]
    raise DuagError(
        f"simulate: found no walk of {least_m:.1f} m for a figure in {len(space.cells) * space.cell_m**2:.1f} m^2 of "
        "free floor, expected one; give fewer frames"
    )


def _seen(caster: Caster, cameras: Array, middle: Array) -> float:
    """Share of all frames of all robots [robots, frames, 4, 4] in whose view points [frames, 3] lie."""
    to = middle - cameras[:, :, :3, 3]
    away = np.linalg.norm(to, axis=2)
    ahead = np.einsum("rfi,rfi->rf", to, cameras[:, :, :3, 2]) / away
    shown = (ahead > np.cos(np.deg2rad(28))) & (away < 6.0)
    hidden = caster.blocked(cameras[:, :, :3, 3].reshape(-1, 3), 0.95 * to.reshape(-1, 3))
    return float(np.mean(shown & ~hidden.reshape(shown.shape)))


def _upright(floor: Array, height: float) -> Array:
    """Poses [n, 4, 4] at places [n, 2] that face where they go."""
    from scipy.ndimage import gaussian_filter1d

    ahead = np.gradient(gaussian_filter1d(floor, 8.0, axis=0, mode="nearest"), axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    poses = np.tile(np.eye(4), (len(floor), 1, 1))
    poses[:, 0, 0], poses[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    poses[:, 1, 0], poses[:, 1, 1] = np.sin(yaw), np.cos(yaw)
    poses[:, :2, 3], poses[:, 2, 3] = floor, height
    return poses


def _figure(k: int, seed: int) -> Scene:
    """Legs, a coat, arms and a head, in the axes of the mover."""
    scene = Scene(f"mover{k}", seed, np.full(3, 1e6), even_light=0.9)
    rng = random_streams.generator(seed, "simulate.figure-colors", mover=k)
    coat = tex.fabric(painting.vivid(rng, 0.8), painting.vivid(rng, 0.5))
    for side, y in (("left", 0.1), ("right", -0.1)):
        scene.cylinder(
            f"leg {side}", (0.0, y, 0.02), tex.fabric((62, 70, 92), (90, 86, 80)), radius=0.085, height=0.8
        )
        scene.cylinder(f"arm {side}", (0.0, 2.7 * y, 0.8), coat, radius=0.06, height=0.58)
    scene.cylinder("coat", (0.0, 0.0, 0.78), coat, radius=0.2, height=0.66)
    scene.sphere("head", (0.0, 0.0, 1.58), 0.14, tex.marbled((206, 164, 136), (96, 64, 44), 0.2))
    return scene
