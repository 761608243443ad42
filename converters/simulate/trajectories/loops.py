"""Smooth paths of a team through a room: clear of every surface, and overlapping in what the cameras see.

A robot goes round the middle of the room on a slowly wavering loop and looks across it. Neighboring robots go in
opposite directions, at different heights, and their paths are shifted along the loop until the asked share of
what one sees is seen by the other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render.renderer import CameraRenderer, Renderer
from duagc.converters.simulate.scenes.scene import UP, Scene
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends

STEP_M = 0.022
MIN_CLEARANCE_M = 0.5
MAX_TURN_RAD = np.deg2rad(1.25)
TRIES = 200
OVERLAP_IMAGE = (48, 36)
OVERLAP_VIEWS = 14
OVERLAP_TOLERANCE = 0.05  # relative difference of depth up to which two views see the same point
HEIGHTS_M = (1.48, 1.22, 1.62, 1.34)


@dataclass(frozen=True)
class Loop:
    """One robot's path around the room; angles count from east, in radians.

    Attributes:
        radii: half axes of the loop.
        waver: size and phase of its deviations (radius, height, gaze).
        phases: size and phase of its deviations (radius, height, gaze).
        direction: +1 counter-clockwise.
        gaze_m: half axes of the curve, across the room, on which the gaze rests.
    """

    middle: Array
    radii: Array
    height_m: float
    direction: int
    waver: Array
    phases: Array
    gaze_m: Array

    def positions(self, angle: Array) -> Array:
        """Positions [n, 3], meters, world frame.

        Args:
            angle: along the loop, rad, [n].
        """
        stretch = 1 + self.waver[0] * np.sin(2 * angle + self.phases[0])
        x = self.middle[0] + self.radii[0] * stretch * np.cos(angle)
        y = self.middle[1] + self.radii[1] * stretch * np.sin(angle)
        z = self.height_m + self.waver[1] * np.sin(3 * angle + self.phases[1])
        return np.stack([x, y, z], axis=1)

    def targets(self, angle: Array) -> Array:
        """Points [n, 3] that the camera looks at, meters, world frame.

        Args:
            angle: of its position along the loop, rad, [n].
        """
        across = angle + np.pi + self.waver[2] * np.sin(2 * angle + self.phases[2])
        x = self.middle[0] + self.gaze_m[0] * np.cos(across)
        y = self.middle[1] + self.gaze_m[1] * np.sin(across)
        z = 0.95 + self.waver[3] * np.sin(2 * angle + self.phases[3])
        return np.stack([x, y, z], axis=1)

    def poses(self, frames: int, middle_angle: float) -> Array:
        """T_world_camera [frames, 4, 4], STEP_M apart along the loop.

        Args:
            frames: how many.
            middle_angle: of the middle frame, rad.
        """
        from scipy.interpolate import CubicSpline

        half = (frames - 1) / 2 * STEP_M
        reach = 1.3 * half / self.radii.min() + 0.2
        offset = np.linspace(-reach, reach, max(64, int(2 * reach * 100)))
        along = self.positions(middle_angle + self.direction * offset)
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(along, axis=0), axis=1))])
        length -= np.interp(0.0, offset, length)
        wanted = (np.arange(frames) - (frames - 1) / 2) * STEP_M
        angle = middle_angle + self.direction * CubicSpline(length, offset)(wanted)
        return look_at(self.positions(angle), self.targets(angle))


def look_at(positions: Array, targets: Array) -> Array:
    """T_world_camera [n, 4, 4] of upright cameras.

    Args:
        positions: of the cameras, [n, 3], meters, world frame.
        targets: points that they look at, [n, 3], meters, world frame.
    """
    forward = targets - positions
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, UP)
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    return se3.from_rotation_translation(np.stack([right, down, forward], axis=-1), positions)


def plan(scene: Scene, robots: int, frames: int, overlap: float, *, camera: PinholeCamera) -> list[Array]:
    """Paths T_world_camera [frames, 4, 4] of every robot.

    Args:
        scene: where they move.
        robots: how many.
        frames: poses per robot.
        overlap: share, 0 to 1, of what a robot sees that the next one sees as well; met as nearly as the room
            allows.
        camera: of all robots.
    Raises:
        DuagError: no path was found that keeps clear of the furniture.
    """
    small = Renderer(scene, None, camera.scaled(*OVERLAP_IMAGE))
    start = random_streams.generator(scene.seed, "simulate.start", scene=scene.name).uniform(0, 2 * np.pi)
    loops = [_loop(scene, robot) for robot in range(robots)]
    paths = [loops[0].poses(frames, start)]
    angle = start
    for loop in loops[1:]:
        low, high = 0.0, np.pi
        before = look(small, paths[-1])
        for _ in range(8):
            shift = (low + high) / 2
            after = look(small, loop.poses(frames, angle + shift))
            if shared(small.camera, before, after) > overlap:
                low = shift
            else:
                high = shift
        angle += (low + high) / 2
        paths.append(loop.poses(frames, angle))
    return paths


def _loop(scene: Scene, robot: int) -> Loop:
    """Draw loops of one robot until one keeps clear all around and never turns too fast."""
    rng = random_streams.generator(scene.seed, "simulate.path", scene=scene.name, robot=robot)
    middle = scene.size[:2] / 2
    around = int(np.ceil(2 * np.pi * middle.max() / STEP_M))
    for _ in range(TRIES):
        loop = Loop(
            middle=middle + rng.uniform(-0.1, 0.1, 2),
            radii=np.array([0.5, 0.47]) * middle * rng.uniform(0.82, 1.02),
            height_m=HEIGHTS_M[robot % len(HEIGHTS_M)] + rng.uniform(-0.05, 0.05),
            direction=1 if robot % 2 == 0 else -1,
            waver=rng.uniform((0.02, 0.04, 0.05, 0.1), (0.06, 0.1, 0.12, 0.2)),
            phases=rng.uniform(0, 2 * np.pi, 4),
            gaze_m=np.array([0.72, 0.66]) * middle * rng.uniform(0.9, 1.1),
        )
        poses = loop.poses(around, 0.0)
        _, turn = se3.distance(poses[:-1], poses[1:])
        if scene.clearance(poses[:, :3, 3]).min() > MIN_CLEARANCE_M and turn.max() < MAX_TURN_RAD:
            return loop
    raise DuagError(
        f"scene {scene.name!r}, seed {scene.seed}: no path for robot {robot} in {TRIES} tries, expected one that "
        f"stays {MIN_CLEARANCE_M} m clear of everything"
    )


@dataclass(frozen=True)
class PathViews:
    """What a camera sees on its path: poses T_world_camera [n, 4, 4], depths [n, h, w], world points [n * h * w, 3]."""

    poses: Array
    depths: Array
    points: Array


def look(renderer: CameraRenderer, path: Array) -> PathViews:
    """Some views, evenly spread, along a path.

    Args:
        renderer: of the views.
        path: T_world_camera [frames, 4, 4].
    """
    poses = path[evenly_spaced_to_ends(len(path), OVERLAP_VIEWS)]
    depths = np.stack([renderer.depth(T)[0] for T in poses])
    rays = renderer.camera.rays()
    points = [
        se3.transform(T, (rays * d[..., None]).reshape(-1, 3)) for T, d in zip(poses, depths, strict=True)
    ]
    return PathViews(poses, depths, np.concatenate(points))


def shared(camera: PinholeCamera, a: PathViews, b: PathViews) -> float:
    """Share of the pixels of views a whose points views b see too, and vice versa, averaged.

    Args:
        camera: of the views.
        a: views along a path.
        b: views along another one.
    """
    shares = []
    for one, other in ((a, b), (b, a)):
        seen = np.zeros(len(one.points), dtype=bool)
        for T, depth in zip(other.poses, other.depths, strict=True):
            seen |= sees(camera, depth, se3.transform(se3.inverse(T), one.points))
        shares.append(seen.mean())
    return float(np.mean(shares))


def shared_view(renderer: CameraRenderer, path_a: Array, path_b: Array) -> float:
    """Share of the pixels along path a whose points path b sees too, and vice versa, averaged.

    Args:
        renderer: of the views.
        path_a: T_world_camera [n, 4, 4].
        path_b: T_world_camera [m, 4, 4].
    """
    return shared(renderer.camera, look(renderer, path_a), look(renderer, path_b))


def sees(camera: PinholeCamera, depth: Array, points_camera: Array) -> NDArray[np.bool_]:
    """Whether a view sees points, nothing in front of them, [n].

    Args:
        camera: of the view.
        depth: of the view, [h, w], meters, 0 = nothing.
        points_camera: [n, 3], meters, camera frame.
    """
    index, u, v = visible(camera, points_camera, near_m=0.1)
    z, seen = points_camera[index, 2], np.zeros(len(points_camera), dtype=bool)
    seen[index] = np.abs(depth[v, u] - z) < OVERLAP_TOLERANCE * z
    return seen
