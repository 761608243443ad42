"""Paths of a team that draw a figure together: concentric circles, leader and followers, crossing or parallel lines.

A figure is put somewhere into the free floor, as large as fits; curves give way to what stands near them. Cameras look
ahead or aside, all to the same side or neighbours to opposite ones. How far the curves are apart, and where the cameras
look, follows from the share of the view that neighbours shall have in common: it is measured, and the nearest is taken.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, map_coordinates

from converters.simulate.paths import HEIGHTS_M, look_at, shared_view
from converters.simulate.render import Eye
from converters.simulate.walks import (
    LEAST_MEDIAN_M,
    MAX_HOLE_SHARE,
    MAX_NEAR_SHARE,
    MAX_SKY_SHARE,
    MAX_TURN_RAD,
    MIN_CLEARANCE_M,
    NEAR_M,
    VIEW_IMAGE,
    Terrain,
    least_shown,
    route,
)
from pipeline import streams
from pipeline.errors import DuagError
from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera

Array = NDArray[np.float64]

SIZES = (1.0, 0.8, 0.64, 0.5, 0.4, 0.3)  # of the way that frames and step would make
DRAWS = 160  # figures drawn per size
PLACES, MOST_PLACES = 4, 16  # of each size, and of all, that are looked at from the cameras
SPREADS, HALVINGS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), 3
OVERLAP_NEAR_ENOUGH = 0.04
ENOUGH = 6  # figures with that overlap: the one whose dullest view shows most is taken
GIVE_WAY_M = 0.5  # what a curve may be moved by what stands there
GAZES_RAD = [np.deg2rad((a, b)) for a in (0.0, 40.0, -40.0, 80.0, -80.0) for b in sorted({a, -a})]  # by turns
SMOOTH_GAZE_M = 0.35
CHECKED_VIEWS = 6
SKETCH = (28, 21)  # pixels of the views that a planner looks at
APART_M = 0.4  # between robots at the same time
PITCH_RAD = np.deg2rad(-7.0)
POINT_M = 0.05  # between the points of a curve


@dataclass(frozen=True)
class Figure:
    """Where a figure is drawn: its middle (x, y, m), direction, the length of a way and the size of the whole."""

    middle: Array
    heading_rad: float
    length_m: float
    reach_m: float


def _circles(figure: Figure, robots: int, spread: float) -> list[Array]:
    """Arcs of concentric circles, all with the same angular rate; `spread` turns each against the one before."""
    radii = figure.reach_m * (np.linspace(0.5, 1.0, robots) if robots > 1 else np.ones(1))
    sweep = min(figure.length_m / figure.reach_m, 1.9 * np.pi)
    shift = spread * np.pi
    curves = []
    for k, radius in enumerate(radii):
        count = max(8, int(sweep * radius / POINT_M))
        angle = figure.heading_rad + k * shift + np.linspace(-sweep / 2, sweep / 2, count)
        curves.append(figure.middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return curves


def _crossing(figure: Figure, robots: int, spread: float) -> list[Array]:
    """Straight ways through one point at different times, `spread` apart in direction."""
    angle = np.deg2rad(12) + spread * (np.pi / max(robots, 2) - np.deg2rad(12)) * (
        1.6 if robots == 2 else 1.0
    )
    gap = min(0.6, 0.8 * figure.length_m / max(robots, 1))
    turns = (np.arange(robots) - (robots - 1) / 2) * angle
    starts = (np.arange(robots) - (robots - 1) / 2) * gap
    return [
        _line(figure, turn, 0.0, start) for turn, start in zip(turns.tolist(), starts.tolist(), strict=True)
    ]


def _parallel(figure: Figure, robots: int, spread: float) -> list[Array]:
    """Straight ways side by side, with `spread` farther apart and farther behind each other."""
    apart = 0.45 + min(1.0, 1.6 * spread) * (2 * figure.reach_m / max(robots - 1, 1) - 0.45)
    behind = 0.8 * spread * figure.length_m
    sides = np.arange(robots) - (robots - 1) / 2
    return [_line(figure, 0.0, k * apart, -k * behind) for k in sides]


def _line(figure: Figure, turn_rad: float, aside_m: float, along_m: float) -> Array:
    """A straight way [n, 2] of the length of the figure, moved aside and along."""
    heading = figure.heading_rad + turn_rad
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    s = np.linspace(-0.5, 0.5, max(8, int(figure.length_m / POINT_M))) * figure.length_m + along_m
    return np.asarray(figure.middle + aside_m * left + s[:, None] * ahead)


Shape = Callable[[Figure, int, float], list[Array]]  # the robots' curves at a spread
FIGURES: dict[str, Shape] = {
    "concentric": _circles,
    "crossing": _crossing,
    "parallel": _parallel,
}
PARADIGMS = ("wander", "concentric", "leader-follower", "crossing", "parallel")


def plan(
    terrain: Terrain,
    paradigm: str,
    robots: int,
    frames: int,
    overlap: float,
    camera: PinholeCamera,
    seed: int,
) -> list[Array]:
    """Paths T_world_camera [frames, 4, 4] of every robot.

    Args:
        terrain: where they move.
        paradigm: one of PARADIGMS but the first.
        robots: how many.
        frames: poses per robot, at most a step of the terrain apart; less if the figure must be small.
        overlap: share, 0 to 1, of what a robot sees that the next one sees as well; met as nearly as may be.
        camera: of all robots.
        seed: of the figure's place.
    Raises:
        DuagError: the figure fits nowhere.
    """
    ground = _Ground(terrain, camera)
    draw = _followers if paradigm == "leader-follower" else _figures
    eye = terrain.eye(camera.scaled(*VIEW_IMAGE))
    best: tuple[float, list[Array]] | None = None
    found: list[tuple[float, list[Array]]] = []
    for place in islice(draw(ground, paradigm, robots, frames, seed), MOST_PLACES):
        for error, paths in _by_overlap(ground, place, overlap):
            if best is None or error < best[0]:
                best = error, paths
            if error < OVERLAP_NEAR_ENOUGH and (shown := _shown(eye, paths, terrain.sky)) is not None:
                found.append((shown, paths))
        if len(found) >= ENOUGH:
            break
    if found:
        return max(found, key=lambda each: each[0])[1]
    if best is None:
        area = len(ground.space.cells) * ground.space.cell_m**2
        raise DuagError(
            f"simulate: {paradigm} paths of {robots} robots fit nowhere in {area:.1f} m^2 of free floor, expected "
            "a larger scene, fewer robots, or another --paradigm"
        )
    return best[1]


# from a spread to the ways of all robots, without their gaze; None if one is not free
Place = Callable[[float], "list[_Way] | None"]


@dataclass(frozen=True)
class _Way:
    """A robot's way: positions [frames, 3] and the direction in which it goes, rad, [frames]."""

    position: Array
    heading_rad: Array

    def poses(self, gaze_rad: float) -> Array:
        """T_world_camera [frames, 4, 4], looking aside of the way by `gaze_rad`, a little down."""
        yaw = self.heading_rad + gaze_rad
        gaze = np.stack([np.cos(yaw), np.sin(yaw), np.full(len(yaw), np.tan(PITCH_RAD))], axis=1)
        return look_at(self.position, self.position + gaze)


class _Ground:
    """The free floor, and what cameras see from it."""

    def __init__(self, terrain: Terrain, camera: PinholeCamera) -> None:
        self.terrain, self.space = terrain, terrain.free_space()
        self.eye = terrain.sketch(camera.scaled(*SKETCH))
        inside = np.pad(self.space.inside, 1)
        out, into = distance_transform_edt(~inside), distance_transform_edt(inside)
        self._margin = ((into - out) * self.space.cell_m).astype(np.float64)
        self._slope = np.stack(np.gradient(self._margin, self.space.cell_m))

    def _at(self, field: Array, points: Array) -> Array:
        place = (points - self.space.low) / self.space.cell_m + 1
        return np.asarray(map_coordinates(field, place.T, order=1, mode="nearest"))

    def margin(self, points: Array) -> Array:
        """How far (m) points [n, 2] are inside the free floor; negative outside."""
        return self._at(self._margin, points)

    def bent(self, curve: Array) -> Array | None:
        """A curve [n, 2] moved aside until it is free, or None."""
        way = curve
        for _ in range(40):
            lack = np.clip(0.15 - self.margin(way), 0.0, 0.1)
            if lack.max() == 0:
                break
            push = np.stack([self._at(slope, way) for slope in self._slope], axis=1)
            way = gaussian_filter1d(way + lack[:, None] * push, 3.0, axis=0, mode="nearest")
        moved = np.linalg.norm(way - curve, axis=1).max()
        shrunk = _length(way) < 0.7 * _length(curve)  # smoothing draws a short one together
        return way if self.margin(way).min() > 0.0 and moved < GIVE_WAY_M and not shrunk else None

    def way(
        self, curve: Array, start_m: float, length_m: float, robot: int, frames: int, seed: int
    ) -> _Way | None:
        """Even steps along a part of a curve [n, 2] at the robot's height; None if too sharp or not clear."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        if start_m < 0 or start_m + length_m > along[-1] + 1e-6:
            return None
        spline = CubicSpline(along, curve)
        s = start_m + np.linspace(0.0, length_m, frames)
        ahead = spline(s, 1)
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        heading = gaussian_filter1d(heading, SMOOTH_GAZE_M * frames / length_m, mode="nearest")
        rng = streams.generator(seed, "simulate.waver", robot=robot)
        waves = (
            rng.uniform((0.02, 0.03), (0.05, 0.08)),
            rng.uniform(1.5, 3.0, 2),
            rng.uniform(0, 2 * np.pi, 2),
        )
        bob, swing = (a * np.sin(2 * np.pi * s / p + f) for a, p, f in zip(*waves, strict=True))
        height = HEIGHTS_M[robot % len(HEIGHTS_M)] + 0.06 * (robot // len(HEIGHTS_M)) + bob
        position = np.column_stack([spline(s), self.space.floor_m + height])
        way = _Way(position, heading + swing)
        turns = se3.distance(*(way.poses(0.0)[k] for k in (slice(None, -1), slice(1, None))))[1]
        if turns.max() > MAX_TURN_RAD or self.terrain.clearance(position).min() < MIN_CLEARANCE_M - 0.05:
            return None
        return way

    def shows(self, paths: list[Array]) -> bool:
        """Whether no camera faces holes or something near."""
        most = MAX_SKY_SHARE if self.terrain.sky else MAX_HOLE_SHARE
        for path in paths:
            for pose in path[np.linspace(0, len(path) - 1, CHECKED_VIEWS).round().astype(np.int64)]:
                depth, _ = self.eye.depth(pose)
                seen = depth > 0
                if 1 - seen.mean() > most or np.mean(seen & (depth < NEAR_M)) > MAX_NEAR_SHARE:
                    return False
                if np.median(depth[seen]) < LEAST_MEDIAN_M:
                    return False
        return True


def _poses(ways: list[_Way], gaze_rad: Array) -> list[Array]:
    """Paths of all robots, which look aside by the two directions by turns."""
    return [way.poses(float(gaze_rad[k % 2])) for k, way in enumerate(ways)]


def _length(curve: Array) -> float:
    """Length (m) of a curve [n, 2]."""
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def _free(places: Iterator[Place]) -> Iterator[Place]:
    """The first places whose ways are free at a middling spread."""
    return islice((place for place in places if place(SPREADS[1]) is not None), PLACES)


def _figures(ground: _Ground, paradigm: str, robots: int, frames: int, seed: int) -> Iterator[Place]:
    """Places where a figure is free, the largest first."""
    space = ground.space
    extent = float(np.ptp(space.cells, axis=0).max())
    share = space.clearance / space.clearance.sum()

    def drawn(size: float, attempt: int) -> Place:
        length = size * (frames - 1) * ground.terrain.step_m
        rng = streams.generator(seed, "simulate.figure", paradigm=paradigm, size=str(size), attempt=attempt)
        middle = space.cells[rng.choice(len(share), p=share)]
        if paradigm == "concentric":
            middle = middle + rng.normal(0, 0.1 * extent, 2)
            reach = float(rng.uniform(0.8, max(1.0, 0.4 * extent))) * size
        else:
            reach = float(rng.uniform(0.3, 1.2)) * max(1.0, 0.35 * length) * size
        figure = Figure(middle, float(rng.uniform(0, 2 * np.pi)), length, reach)
        return partial(_ways_of_figure, ground, FIGURES[paradigm], figure, robots, frames, seed)

    for size in SIZES:
        yield from _free(drawn(size, attempt) for attempt in range(DRAWS))


def _ways_of_figure(
    ground: _Ground, shape: Shape, figure: Figure, robots: int, frames: int, seed: int, spread: float
) -> list[_Way] | None:
    """The robots' ways along the curves of a figure, bent aside where they must; None if one is not free."""
    curves = shape(figure, robots, spread)
    if ground.margin(np.concatenate(curves)).min() < GIVE_WAY_M - 0.95:
        return None
    ways = []
    for robot, curve in enumerate(curves):
        bent = ground.bent(curve)
        way = None if bent is None else ground.way(bent, 0.0, _length(bent), robot, frames, seed)
        if way is None:
            return None
        ways.append(way)
    return ways


def _followers(ground: _Ground, paradigm: str, robots: int, frames: int, seed: int) -> Iterator[Place]:
    """Routes along which one robot leads and the others follow, each behind the one before by the spread."""
    graph = ground.space.graph.tocsr()

    def drawn(size: float, attempt: int) -> Place:
        length = size * (frames - 1) * ground.terrain.step_m
        longest = min(length, 5.0, 15.0 / max(robots - 1, 1))
        rng = streams.generator(seed, "simulate.lead", size=str(size), attempt=attempt)
        curve = route(ground.space, graph, length + (robots - 1) * longest + 1.5, rng)
        return partial(_ways_behind, ground, curve, length, longest, robots, frames, seed)

    for size in SIZES:
        yield from _free(drawn(size, attempt) for attempt in range(DRAWS // 8))


def _ways_behind(
    ground: _Ground,
    curve: Array,
    length: float,
    longest: float,
    robots: int,
    frames: int,
    seed: int,
    spread: float,
) -> list[_Way] | None:
    """The robots' ways along one curve, each behind the one before, at most by `longest` m; None if one is not free."""
    lag = min(APART_M, longest) + spread * (longest - min(APART_M, longest))
    ways = []
    for robot in range(robots):
        way = ground.way(curve, 0.5 + (robots - 1 - robot) * lag, length, robot, frames, seed)
        if way is None:
            return None
        ways.append(way)
    return ways


def _by_overlap(ground: _Ground, place: Place, overlap: float) -> Iterator[tuple[float, list[Array]]]:
    """For every direction to look in: the paths whose overlap is nearest to the one asked for, and their distance.

    A few spreads are tried; where the overlap passes the one asked for between two of them, the interval is halved.
    """
    ways_of = {spread: ways for spread in SPREADS if (ways := place(spread)) is not None}
    for gaze in GAZES_RAD:
        seen: dict[float, tuple[float, list[Array]]] = {}
        for spread, ways in ways_of.items():
            paths = _poses(ways, gaze)
            if ground.shows(paths):
                seen[spread] = _shared(ground.eye, paths), paths
        for low, high in pairwise(sorted(seen)):
            if (seen[low][0] - overlap) * (seen[high][0] - overlap) < 0:
                _halve(ground, place, gaze, overlap, seen, low, high)
                break
        errors = [(_error(shared, paths, overlap), spread) for spread, (shared, paths) in seen.items()]
        if errors:
            error, spread = min(errors)
            yield error, seen[spread][1]


def _halve(
    ground: _Ground,
    place: Place,
    gaze_rad: Array,
    overlap: float,
    seen: dict[float, tuple[float, list[Array]]],
    low: float,
    high: float,
) -> None:
    """Add spreads between `low` and `high` to what was `seen`, nearer and nearer to the overlap asked for."""
    for _ in range(HALVINGS):
        spread = (low + high) / 2
        paths = _poses(place(spread) or [], gaze_rad)
        if not paths or not ground.shows(paths):
            return
        seen[spread] = _shared(ground.eye, paths), paths
        same_side = (seen[spread][0] > overlap) == (seen[low][0] > overlap)
        low, high = (spread, high) if same_side else (low, spread)


def _shown(eye: Eye, paths: list[Array], sky: bool) -> float | None:
    """Share of edges in the dullest view of all paths; None if one shows holes or something near."""
    shares = [least_shown(eye, path, sky) for path in paths]
    return None if None in shares else min(share for share in shares if share is not None)


def _error(shared: float, paths: list[Array], overlap: float) -> float:
    """How far an overlap is from the one asked for; robots that come too near to each other count as well."""
    return abs(shared - overlap) + 0.2 * max(0.0, 1 - least_apart(paths) / APART_M)


def _shared(eye: Eye, paths: list[Array]) -> float:
    """Mean share of the view that neighbours have in common; 1 for a robot alone."""
    return float(np.mean([shared_view(eye, *pair) for pair in pairwise(paths)])) if len(paths) > 1 else 1.0


def least_apart(paths: list[Array]) -> float:
    """Least distance (m) between two robots at the same time; of one robot, infinity."""
    at = np.stack([path[:, :3, 3] for path in paths])
    gaps = [np.linalg.norm(at[i] - at[j], axis=1).min() for i in range(len(at)) for j in range(i)]
    return float(min(gaps, default=np.inf))
