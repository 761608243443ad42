"""Paths of a team that draw a figure together: concentric circles, leader and followers, crossing or parallel lines.

A figure is put somewhere into the free floor, as large as fits; curves give way to what stands near them. All robots
of a figure look to the same side of their way, to where there is most to see. How far the curves are apart follows
from the share of the view that neighbours shall have in common: it is measured, and the nearest is taken.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, map_coordinates

from converters.simulate.paths import HEIGHTS_M, OVERLAP_IMAGE, look_at, shared_view
from converters.simulate.render import Eye
from converters.simulate.walks import (
    MAX_HOLE_SHARE,
    MAX_NEAR_SHARE,
    MAX_SKY_SHARE,
    MAX_TURN_RAD,
    MIN_CLEARANCE_M,
    NEAR_M,
    FreeSpace,
    Terrain,
    route,
)
from pipeline import streams
from pipeline.errors import DuagError
from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera

Array = NDArray[np.float64]

SIZES = (1.0, 0.8, 0.64, 0.5, 0.4, 0.3)  # of the way that frames and step would make
DRAWS = 160  # figures drawn per size
PLACES = 10  # figures looked at from the cameras, of all sizes
SPREADS = 6  # halvings of the interval of spreads
OVERLAP_NEAR_ENOUGH = 0.03
GIVE_WAY_M = 0.5  # what a curve may be moved by what stands there
GAZES_RAD = tuple(np.deg2rad((0.0, 40.0, -40.0, 80.0, -80.0)))
CHECKED_VIEWS = 8
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
    shift = (0.1 + 0.9 * spread) * np.pi
    curves = []
    for k, radius in enumerate(radii):
        count = max(8, int(sweep * radius / POINT_M))
        angle = figure.heading_rad + k * shift + np.linspace(-sweep / 2, sweep / 2, count)
        curves.append(figure.middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return curves


def _crossing(figure: Figure, robots: int, spread: float) -> list[Array]:
    """Straight ways through one point at different times, `spread` apart in direction."""
    angle = np.deg2rad(12) + spread * (np.pi / max(robots, 2) - np.deg2rad(12)) * (1.6 if robots == 2 else 1.0)
    gap = min(0.6, 0.8 * figure.length_m / max(robots, 1))
    turns = (np.arange(robots) - (robots - 1) / 2) * angle
    starts = [(k - (robots - 1) / 2) * gap * (-1) ** k for k in range(robots)]
    return [_line(figure, turn, 0.0, start) for turn, start in zip(turns, starts, strict=True)]


def _parallel(figure: Figure, robots: int, spread: float) -> list[Array]:
    """Straight ways side by side, at first farther apart with `spread`, then behind each other too."""
    apart = 0.45 + min(1.0, 1.6 * spread) * (2 * figure.reach_m / max(robots - 1, 1) - 0.45)
    behind = max(0.0, spread - 0.4) * 0.7 * figure.length_m
    sides = np.arange(robots) - (robots - 1) / 2
    return [_line(figure, 0.0, k * apart, -k * behind) for k in sides]


def _line(figure: Figure, turn_rad: float, aside_m: float, along_m: float) -> Array:
    """A straight way [n, 2] of the length of the figure, moved aside and along."""
    heading = figure.heading_rad + turn_rad
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    s = np.linspace(-0.5, 0.5, max(8, int(figure.length_m / POINT_M))) * figure.length_m + along_m
    return figure.middle + aside_m * left + s[:, None] * ahead


FIGURES: dict[str, Callable[[Figure, int, float], list[Array]]] = {
    "concentric": _circles,
    "crossing": _crossing,
    "parallel": _parallel,
}
PARADIGMS = ("wander", "concentric", "leader-follower", "crossing", "parallel")


def plan(
    terrain: Terrain, paradigm: str, robots: int, frames: int, overlap: float, camera: PinholeCamera, seed: int
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
    best: tuple[float, list[Array]] | None = None
    for place in draw(ground, paradigm, robots, frames, seed):
        for gaze in ground.gazes(place(0.5)):
            error, ways = _nearest(ground, place, gaze, overlap)
            if best is None or error < best[0]:
                best = error, ways
            if best[0] < OVERLAP_NEAR_ENOUGH:
                return best[1]
    if best is None:
        raise DuagError(
            f"simulate: {paradigm} paths of {robots} robots fit nowhere in {len(ground.space.cells) * ground.space.cell_m**2:.1f} m^2 "
            "of free floor, expected a larger scene, fewer robots, or another --paradigm"
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
        self.eye = terrain.eye(camera.scaled(*OVERLAP_IMAGE))
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
        return way if self.margin(way).min() > 0.0 and moved < GIVE_WAY_M else None

    def way(self, curve: Array, start_m: float, length_m: float, robot: int, frames: int, seed: int) -> _Way | None:
        """Even steps along a part of a curve [n, 2], at the robot's height, or None if they turn too fast or hit something."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        if start_m < 0 or start_m + length_m > along[-1] + 1e-6:
            return None
        spline = CubicSpline(along, curve)
        s = start_m + np.linspace(0.0, length_m, frames)
        ahead = spline(s, 1)
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        rng = streams.generator(seed, "simulate.waver", robot=robot)
        waves = rng.uniform((0.02, 0.03), (0.05, 0.08)), rng.uniform(1.5, 3.0, 2), rng.uniform(0, 2 * np.pi, 2)
        bob, swing = (a * np.sin(2 * np.pi * s / p + f) for a, p, f in zip(*waves, strict=True))
        height = HEIGHTS_M[robot % len(HEIGHTS_M)] + 0.06 * (robot // len(HEIGHTS_M)) + bob
        position = np.column_stack([spline(s), self.space.floor_m + height])
        way = _Way(position, heading + swing)
        turns = se3.distance(*(way.poses(0.0)[k] for k in (slice(None, -1), slice(1, None))))[1]
        if turns.max() > MAX_TURN_RAD or self.terrain.clearance(position).min() < MIN_CLEARANCE_M - 0.05:
            return None
        return way

    def gazes(self, ways: list[_Way] | None) -> list[float]:
        """Directions to look in, beside the way, in which cameras see enough; the most open first."""
        shown = [(self.shows(ways, gaze), gaze) for gaze in GAZES_RAD] if ways else []
        return [gaze for _, gaze in sorted((-least, gaze) for least, gaze in shown if least is not None)]

    def shows(self, ways: list[_Way], gaze_rad: float) -> float | None:
        """Least median depth (m) of a view from the ways; None if one faces holes or a near wall."""
        least = np.inf
        for way in ways:
            for pose in _some(way.poses(gaze_rad)):
                depth = self._openness(pose)
                if depth is None:
                    return None
                least = min(least, depth)
        return float(least)

    def _openness(self, pose: Array) -> float | None:
        """Median depth (m) of a view, at most 3; None if it shows too much of nothing or of something near."""
        depth, _ = self.eye.depth(pose)
        seen = depth > 0
        most = MAX_SKY_SHARE if self.terrain.sky else MAX_HOLE_SHARE
        if 1 - seen.mean() > most or np.mean(seen & (depth < NEAR_M)) > MAX_NEAR_SHARE:
            return None
        return min(3.0, float(np.median(depth[seen])))


def _some(poses: Array) -> Array:
    """A few of the poses of a path, evenly."""
    return np.asarray(poses[np.linspace(0, len(poses) - 1, CHECKED_VIEWS).round().astype(np.int64)])


def _figures(ground: _Ground, paradigm: str, robots: int, frames: int, seed: int) -> Iterator[Place]:
    """Places where a figure is free, the largest first."""
    space, shape = ground.space, FIGURES[paradigm]
    extent = float(np.ptp(space.cells, axis=0).max())
    share = space.clearance / space.clearance.sum()
    found = 0
    for size in SIZES:
        length = size * (frames - 1) * ground.terrain.step_m
        for attempt in range(DRAWS):
            rng = streams.generator(seed, "simulate.figure", paradigm=paradigm, size=str(size), attempt=attempt)
            middle = space.cells[rng.choice(len(share), p=share)]
            if paradigm == "concentric":
                middle = middle + rng.normal(0, 0.1 * extent, 2)
                reach = float(rng.uniform(0.8, max(1.0, 0.4 * extent))) * size
            else:
                reach = float(rng.uniform(0.3, 1.2)) * max(1.0, 0.35 * length) * size
            figure = Figure(middle, float(rng.uniform(0, 2 * np.pi)), length, reach)

            def place(spread: float, figure: Figure = figure) -> list[_Way] | None:
                ways = []
                for robot, curve in enumerate(shape(figure, robots, spread)):
                    if ground.margin(curve).min() < -0.35:
                        return None
                    bent = ground.bent(curve)
                    if bent is None:
                        return None
                    reached = np.linalg.norm(np.diff(bent, axis=0), axis=1).sum()
                    way = ground.way(bent, 0.0, float(reached), robot, frames, seed)
                    if way is None:
                        return None
                    ways.append(way)
                return ways

            if place(0.5) is not None:
                yield place
                found += 1
                if found == PLACES:
                    return


def _followers(ground: _Ground, paradigm: str, robots: int, frames: int, seed: int) -> Iterator[Place]:
    """Routes along which one robot leads and the others follow, each behind the one before by the spread."""
    graph = ground.space.graph.tocsr()
    found = 0
    for size in SIZES:
        length = size * (frames - 1) * ground.terrain.step_m
        longest = min(1.0 * length, 6.0) if robots > 1 else 0.0
        for attempt in range(DRAWS // 8):
            rng = streams.generator(seed, "simulate.lead", size=str(size), attempt=attempt)
            total = length + (robots - 1) * longest
            curve = route(ground.space, graph, total + 1.5, rng)

            def place(spread: float, curve: Array = curve, length: float = length, longest: float = longest) -> list[_Way] | None:
                lag = min(APART_M, longest) + spread * (longest - min(APART_M, longest))
                ways = []
                for robot in range(robots):
                    start = 0.5 + (robots - 1 - robot) * lag
                    way = ground.way(curve, start, length, robot, frames, seed)
                    if way is None:
                        return None
                    ways.append(way)
                return ways

            if place(0.5) is not None:
                yield place
                found += 1
                if found == PLACES:
                    return


def _nearest(ground: _Ground, place: Place, gaze_rad: float, overlap: float) -> tuple[float, list[Array]]:
    """The ways of a place whose overlap is nearest to the one asked for, and how far it is from it.

    A larger spread shares less, by and large: the interval is halved, and the best of all that were seen is taken.
    """
    low, high, spread = 0.0, 1.0, 0.5
    best: tuple[float, list[Array]] = (np.inf, [])
    for _ in range(SPREADS):
        ways = place(spread)
        poses = [way.poses(gaze_rad) for way in ways or []]
        shared = _shared(ground.eye, poses) if poses else 0.0  # what is not free is too wide
        error = abs(shared - overlap)
        if ways and ground.shows(ways, gaze_rad) is not None:
            crowded = max(0.0, 1 - least_apart(poses) / APART_M)
            if error + 0.2 * crowded < best[0]:
                best = (error + 0.2 * crowded, poses)
        if len(poses) == 1 or error < OVERLAP_NEAR_ENOUGH / 2:
            break
        low, high = (spread, high) if shared > overlap else (low, spread)
        spread = (low + high) / 2
    return best


def _shared(eye: Eye, paths: list[Array]) -> float:
    """Mean share of the view that neighbours have in common; 1 for a robot alone."""
    pairs = zip(paths[:-1], paths[1:], strict=True)
    return float(np.mean([shared_view(eye, a, b) for a, b in pairs])) if len(paths) > 1 else 1.0


def least_apart(paths: list[Array]) -> float:
    """Least distance (m) between two robots at the same time; of one robot, infinity."""
    at = np.stack([path[:, :3, 3] for path in paths])
    gaps = [np.linalg.norm(at[i] - at[j], axis=1).min() for i in range(len(at)) for j in range(i)]
    return float(min(gaps, default=np.inf))
