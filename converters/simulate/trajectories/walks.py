"""Smooth walks through the free space of a scene of meshes, looking ahead, overlapping in what the cameras see.

Free is where a robot can stand: the scene closes round it, and from 0.6 m above the floor up to its head nothing is
nearer than MIN_CLEARANCE_M. A walk visits places drawn by the seed, along the middle of rooms and doors (shortest path
on a grid, costly near obstacles), and is then smoothed. The camera looks along the path,
wavers, and turns slowly.
Walks that come too near to something, or look at a hole or a bare wall from close by, are drawn again. Of the walks
that pass, the first robot takes the one whose dullest view shows most; each other robot the one that shares the asked
part of its view with the robot before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render.raycast import Caster
from duagc.converters.simulate.render.renderer import CameraRenderer
from duagc.converters.simulate.trajectories.loops import HEIGHTS_M, OVERLAP_IMAGE, look, look_at, shared
from duagc.converters.simulate.trajectories.routes import ROUTE_STEP_M, length_of, route
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends

if TYPE_CHECKING:
    from scipy.sparse import coo_array

STEP_M = 0.028
MAX_TURN_RAD = np.deg2rad(1.5)
MIN_CLEARANCE_M = 0.3
CELL_M, LARGE_M2 = 0.1, 600.0  # scenes larger than that have cells twice as wide
BODY_HEIGHTS_M = (0.6, 1.75, 0.23)  # above the floor, from, to, step: where a robot takes up space
FLOOR_BIN_M = 0.05
FLOOR_COSINE = 0.95
FLOOR_SHARE = 0.25  # of the largest level; the lowest of the levels so large is the floor
CLOSED_SHARE = 0.85  # of the directions around a place inside the scene meet a surface
DIRECTIONS = 48
LEAST_FREE_M2 = 1.0
AHEAD_M = 1.3
GAZE_SMOOTH_FRAMES = (14, 22, 32, 45, 60)
TRIES, ENOUGH = 400, 16
VIEWS = 12
VIEW_IMAGE = (80, 60)
NEAR_M, MAX_NEAR_SHARE = 0.6, 0.25
MAX_HOLE_SHARE, MAX_SKY_SHARE = 0.05, 0.5
LEAST_MEDIAN_M = 1.0
EDGE_GRAY = 6.0  # of 255, between neighboring pixels of VIEW_IMAGE
NEAREST_M = MIN_CLEARANCE_M - 0.05  # of a smoothed walk
TOO_SHORT, HOLES = "too short", "sees holes or a near wall"


@dataclass(frozen=True)
class WalkableSpace:
    """Where a robot can stand.

    Attributes:
        floor_m: height of the floor.
        cells: [n, 2], x and y (m) of the middles of free cells, all connected.
        clearance: [n], m.
        graph: cost of the path between neighboring cells.
        inside: [nx, ny], whether a cell of the whole grid is free.
        low: [2], middle (m) of its first cell.
        cell_m: its width.
    """

    floor_m: float
    cells: Array
    clearance: Array
    graph: coo_array
    inside: NDArray[np.bool_]
    low: Array
    cell_m: float


class Terrain(Protocol):
    """What a planner must know of a scene."""

    step_m: float  # translation of a robot per frame
    sky: bool  # there is no ceiling

    def renderer(self, camera: PinholeCamera) -> CameraRenderer:
        """A renderer.

        Args:
            camera: of the views.
        """

    def sketch_renderer(self, camera: PinholeCamera) -> CameraRenderer:
        """A renderer for depth alone, the quickest there is.

        Args:
            camera: of the views.
        """

    def clearance(self, points: Array) -> Array:
        """Distance (m) of points to the nearest surface, [...].

        Args:
            points: [..., 3], meters, world frame.
        """

    def free_space(self) -> WalkableSpace:
        """Where a robot can stand."""


def plan(
    terrain: Terrain, robots: int, frames: int, overlap: float, *, camera: PinholeCamera, seed: int
) -> list[Array]:
    """Walks T_world_camera [frames, 4, 4] of every robot.

    Args:
        terrain: where they move.
        robots: how many.
        frames: poses per robot, a step of the terrain apart.
        overlap: share, 0 to 1, of what a robot sees that the one before sees as well; met as nearly as may
            be.
        camera: of all robots.
        seed: of the walks.
    Raises:
        DuagError: there is no free space, or no walk in it that keeps clear and sees something.
    """
    space = terrain.free_space()
    small = terrain.renderer(camera.scaled(*OVERLAP_IMAGE))
    walks: list[Array] = []
    for robot in track(range(robots), "plan walks"):
        found = _candidates(terrain, space, robot, frames, camera=camera, seed=seed)
        if robot == 0:
            walks += most_shown(terrain.renderer(camera.scaled(*VIEW_IMAGE)), [[walk] for walk in found])
        else:
            before = look(small, walks[-1])
            shares = [shared(small.camera, before, look(small, walk)) for walk in found]
            walks.append(found[int(np.argmin(np.abs(np.array(shares) - overlap)))])
    return walks


def floor_height(caster: Caster) -> float:
    """Height (m) of the floor: the lowest of the levels that hold much horizontal surface.

    Args:
        caster: of the scene.

    Raises:
        DuagError: the scene has no horizontal surface.
    """
    a, b, c = np.moveaxis(caster.scene.corners, 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    level = np.abs(normals[:, 2]) > FLOOR_COSINE * lengths
    heights, areas = ((a + b + c) / 3)[level, 2], 0.5 * lengths[level]
    if not areas.sum() > 0:
        raise DuagError("the scene has no horizontal surface, expected a floor; is the right axis up (--up)?")
    bins = np.floor((heights - heights.min()) / FLOOR_BIN_M).astype(np.int64)
    area = np.bincount(bins, weights=areas)
    smooth = np.convolve(area, np.ones(3), mode="same")
    lowest = int(np.argmax(smooth > FLOOR_SHARE * smooth.max()))
    around = np.abs(bins - lowest - 1) <= 1
    return float(np.average(heights[around], weights=areas[around]))


def free_space(caster: Caster, sky: bool = False) -> WalkableSpace:
    """The largest connected free space of a scene.

    Args:
        caster: of the scene.
        sky: whether there is a sky above; then only the floor below matters.

    Raises:
        DuagError: it is smaller than LEAST_FREE_M2.
    """
    floor = floor_height(caster)
    low, high = caster.scene.vertices[:, :2].min(axis=0), caster.scene.vertices[:, :2].max(axis=0)

    def closed(places: Array) -> NDArray[np.bool_]:
        return _closed_in(caster, places, floor, 0.0 if sky else CLOSED_SHARE)

    return space_between(low, high, floor, caster.clearance, closed=closed)


def space_between(
    low: Array,
    high: Array,
    floor: float,
    distance: Callable[[Array], Array],
    *,
    closed: Callable[[Array], NDArray[np.bool_]],
) -> WalkableSpace:
    """The largest connected free space on a grid from `low` to `high` (x, y).

    Args:
        low: lower corner (x, y, m) of the floor.
        high: upper corner.
        floor: its height.
        distance: of points [..., 3] to the nearest surface.
        closed: whether places [n, 2] are inside the scene.
    """
    from scipy.ndimage import label

    cell_m = CELL_M if np.prod(high - low) < LARGE_M2 else 2 * CELL_M
    nx, ny = np.maximum(np.ceil((high - low) / cell_m).astype(np.int64), 1)
    x, y = low[0] + (np.arange(nx) + 0.5) * cell_m, low[1] + (np.arange(ny) + 0.5) * cell_m
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    clearance = _body_clearance(distance, places, floor)
    free = clearance >= MIN_CLEARANCE_M
    free[free] = closed(places[free])
    parts, count = label(free, structure=np.ones((3, 3)))
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    area = sizes.max(initial=0) * cell_m**2
    if area < LEAST_FREE_M2:
        raise DuagError(
            f"found {area:.1f} m^2 of free floor {floor:.2f} m high in the scene, expected at least "
            f"{LEAST_FREE_M2} m^2; is it a room in meters, and the right axis up (--up)?"
        )
    inside = parts == 1 + int(np.argmax(sizes))
    graph = _graph(inside, clearance, cell_m)
    return WalkableSpace(
        floor, places[inside], clearance[inside], graph, inside=inside, low=places[0, 0], cell_m=cell_m
    )


def _body_clearance(distance: Callable[[Array], Array], places: Array, floor: float) -> Array:
    """Least distance (m) from a robot that stands at places [..., 2] to anything."""
    heights = floor + np.arange(*BODY_HEIGHTS_M)
    clearance = np.full(places.shape[:-1], np.inf)
    for z in heights:
        points = np.concatenate([places, np.full((*places.shape[:-1], 1), z)], axis=-1)
        clearance = np.minimum(clearance, distance(points))
    return clearance


def _closed_in(caster: Caster, places: Array, floor: float, share: float) -> NDArray[np.bool_]:
    """Whether places [n, 2] have a floor below and a surface in that share of all directions from eye height."""
    k = np.arange(DIRECTIONS) + 0.5
    polar, turn = np.arccos(1 - 2 * k / DIRECTIONS), np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=1)
    eyes = np.concatenate([places, np.full((len(places), 1), floor + HEIGHTS_M[0])], axis=1)
    hit = np.zeros(len(places))
    for direction in sphere:
        hit += np.isfinite(caster.hits(eyes, np.broadcast_to(direction, eyes.shape))["t"])
    below = caster.hits(eyes, np.broadcast_to([0.0, 0.0, -1.0], eyes.shape))["t"]
    return (hit >= share * DIRECTIONS) & (below < 1.5 * HEIGHTS_M[0])


def _graph(inside: NDArray[np.bool_], clearance: Array, cell_m: float) -> coo_array:
    """Costs of steps between neighboring cells of a grid; dear near obstacles."""
    from scipy.sparse import coo_array

    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    price = 1 + (0.45 / np.maximum(clearance, 0.1)) ** 4
    rows, columns, costs = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        here = (slice(0, -dx or None), slice(max(-dy, 0), -max(dy, 0) or None))
        there = (slice(dx, None), slice(max(dy, 0), -max(-dy, 0) or None))
        both = inside[here] & inside[there]
        rows.append(number[here][both])
        columns.append(number[there][both])
        costs.append(cell_m * np.hypot(dx, dy) * 0.5 * (price[here] + price[there])[both])
    n = int(inside.sum())
    return coo_array((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))


def _candidates(
    terrain: Terrain, space: WalkableSpace, robot: int, frames: int, *, camera: PinholeCamera, seed: int
) -> list[Array]:
    """Walks of a robot that keep clear and see something; those of longer routes if no route is long enough."""
    graph = space.graph.tocsr()
    renderer = terrain.renderer(camera.scaled(*VIEW_IMAGE))
    length_m = frames * terrain.step_m + 2 * AHEAD_M + 1.0
    found: list[Array] = []
    for least_m in (0.0, length_m):
        reasons = dict.fromkeys((TOO_SHORT, "turns too fast", "too near to something", HOLES), 0)
        for attempt in range(TRIES):
            rng = random_streams.generator(seed, "simulate.walk", robot=robot, attempt=attempt)
            way = route(space, graph, length_m, rng, least_m=least_m)
            if length_of(way) < 2 * AHEAD_M + (frames - 1) * terrain.step_m:
                reasons[TOO_SHORT] += 1
                continue
            poses = _look_ahead(way, space.floor_m, robot, frames, step_m=terrain.step_m, rng=rng)
            if poses is None:
                reasons["turns too fast"] += 1
            elif _body_clearance(terrain.clearance, poses[:, :2, 3], space.floor_m).min() < NEAREST_M:
                reasons["too near to something"] += 1
            elif not sees_enough(renderer, poses, terrain.sky):
                reasons[HOLES] += 1
            else:
                found.append(poses)
            if len(found) == ENOUGH:
                break
        if found or not reasons[TOO_SHORT]:
            break
    if not found:
        why = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        area = len(space.cells) * space.cell_m**2
        raise DuagError(
            f"no walk for robot {robot} in {TRIES} tries ({why}) in {area:.1f} m^2 of free floor, "
            "expected one; give another --seed, or fewer frames"
        )
    return found


def _look_ahead(
    path: Array, floor: float, robot: int, frames: int, *, step_m: float, rng: np.random.Generator
) -> Array | None:
    """Poses [frames, 4, 4] along a path that is long enough, step_m apart, or None if they turn too fast."""
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d

    along = ROUTE_STEP_M * np.arange(len(path))
    spline = CubicSpline(along, path)
    start = AHEAD_M
    margin = max(GAZE_SMOOTH_FRAMES)
    index = np.arange(-margin, frames + margin)
    s = np.clip(start + index * step_m, 0.0, along[-1] - AHEAD_M)
    waver = rng.uniform((0.02, 0.15, 0.02), (0.05, 0.4, 0.1))  # height m, yaw rad, pitch rad
    periods = rng.uniform((2.0, 3.0, 2.5), (3.5, 6.0, 5.0))
    phases = rng.uniform(0, 2 * np.pi, 3)
    swing = waver[:, None] * np.sin(2 * np.pi * s / periods[:, None] + phases[:, None])
    height = floor + HEIGHTS_M[robot % len(HEIGHTS_M)] + rng.uniform(-0.05, 0.05) + swing[0]
    position = np.concatenate([spline(s), height[:, None]], axis=1)
    ahead = spline(s + AHEAD_M) - position[:, :2]
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) + swing[1]
    pitch = np.deg2rad(-9) + swing[2]
    middle = slice(margin, margin + frames)
    for sigma in GAZE_SMOOTH_FRAMES:
        smooth = gaussian_filter1d(yaw, sigma, mode="nearest")
        gaze = np.stack(
            [np.cos(smooth) * np.cos(pitch), np.sin(smooth) * np.cos(pitch), np.sin(pitch)], axis=1
        )
        poses = look_at(position[middle], position[middle] + gaze[middle])
        _, turn = se3.distance(poses[:-1], poses[1:])
        if turn.max() < MAX_TURN_RAD:
            return poses
    return None


def sees_enough(renderer: CameraRenderer, poses: Array, sky: bool) -> bool:
    """Whether no view of a walk shows holes or a near wall.

    Args:
        renderer: of the views.
        poses: of the walk, T_world_camera [frames, 4, 4].
        sky: whether there is a sky, which fills more of a view than holes may.
    """
    for T in _some_views(poses):
        depth, _ = renderer.depth(T)
        seen = depth > 0
        if (
            1 - seen.mean() > (MAX_SKY_SHARE if sky else MAX_HOLE_SHARE)
            or np.mean(seen & (depth < NEAR_M)) > MAX_NEAR_SHARE
        ):
            return False
        if np.median(depth[seen]) < LEAST_MEDIAN_M:
            return False
    return True


def most_shown(renderer: CameraRenderer, teams: list[list[Array]]) -> list[Array]:
    """The first of the teams of paths whose dullest view, the one with fewest edges, shows most.

    Args:
        renderer: of the views.
        teams: paths T_world_camera [frames, 4, 4] of every robot, per team.
    """
    most, best = -1.0, teams[0]
    for paths in teams:
        least = 1.0
        for T in chain.from_iterable(map(_some_views, paths)):
            gray = renderer.render(T).color.astype(np.float64).mean(axis=2)
            edges = np.hypot(*np.gradient(gray)) > EDGE_GRAY / 2
            least = min(least, float(edges.mean()))
            if least <= most:  # it cannot become the best
                break
        else:
            most, best = least, paths
    return best


def _some_views(poses: Array) -> Array:
    """Poses [n, 4, 4] evenly spread over a walk."""
    return poses[evenly_spaced_to_ends(len(poses), VIEWS)]
