"""Figures that the paths of a team draw on the free floor: concentric circles, one route, crossing or parallel lines.

A figure has a place and a size; every robot's curve follows from those of the robots before it by one number, its
spread, 0 to 1. Curves bend around what stands near them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from duagc.converters.simulate.trajectories.loops import HEIGHTS_M, look_at
from duagc.converters.simulate.trajectories.routes import ROUTE_STEP_M, route
from duagc.converters.simulate.trajectories.walks import MAX_TURN_RAD, MIN_CLEARANCE_M, Terrain
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3

GIVE_WAY_M, GIVE_WAY_SMOOTH = 0.4, 3.0  # what a curve may be moved by what stands there; smooth over points
KEPT_SHARE = 0.7  # of its length, at least, when a curve bends around something
SMOOTH_GAZE_M = 0.35
PITCH_RAD = np.deg2rad(-7.0)
POINT_M = 0.05  # between the points of a curve
RESERVE_M = 0.1  # of a curve at both ends: bending can make it shorter
LEAST_CLEARANCE_M = MIN_CLEARANCE_M - 0.04
APART_M = 0.4  # between robots on the floor at the same time
LINES_APART_M = 0.45
CROSSING_GAP_M = (0.45, 0.6)  # by which a robot is behind the one before, on its path through the middle
CROSSING_ONE_POINT = 4  # so many robots at most go through one point, one after the other
CROSSING_RAD = np.deg2rad((20.0, 80.0))
CIRCLE_TURN_RAD = 0.8 * MAX_TURN_RAD  # per frame; a robot on a small circle goes more slowly
FARTHEST_BEHIND_M = 5.0, 15.0  # a follower, and the last one behind the first


@dataclass(frozen=True)
class Figure:
    """Where a figure is drawn: its middle (x, y, m), direction, length of a path, and size of the whole.

    Attributes:
        frames: of a path.
        route: [n, 2], of a figure of followers, the curve that all go along.
    """

    middle: Array
    heading_rad: float
    length_m: float
    reach_m: float
    frames: int
    route: Array | None = None


# of the figure, the number of robots, and the spreads up to one robot: its curve [n, 2], and how long a path along
# the middle of it shall be
Shape = Callable[[Figure, int, Sequence[float]], tuple[Array, float]]


def circle(figure: Figure, robots: int, spreads: Sequence[float]) -> tuple[Array, float]:
    """An arc of one of the concentric circles, turned by the spread against the one before.

    Args:
        figure: middle, direction and size.
        robots: how many in the team.
        spreads: 0 to 1, of the robots up to this one.
    """
    radius = figure.reach_m * (0.5 + 0.5 * (len(spreads) - 1) / (robots - 1) if robots > 1 else 1.0)
    length = min(figure.length_m, CIRCLE_TURN_RAD * radius * (figure.frames - 1))
    half = (length / 2 + RESERVE_M) / radius
    turn = figure.heading_rad + sum(spreads) * np.deg2rad(300.0)
    angle = turn + np.linspace(-half, half, max(8, int(2 * half * radius / POINT_M)))
    return figure.middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1), length


def crossing(figure: Figure, robots: int, spreads: Sequence[float]) -> tuple[Array, float]:
    """A straight path through the middle, later than the one before, and in another direction.

    Many robots go at the same time, in evenly spread directions, and leave the middle to their left, as at a
    roundabout; the spread says how many directions on from the robot before.

    Args:
        figure: middle, direction and size.
        robots: how many in the team.
        spreads: 0 to 1, of the robots up to this one.
    """
    k = len(spreads) - 1
    if robots > CROSSING_ONE_POINT:
        between = 2 * np.pi / robots
        aside = -1.1 * APART_M / (2 * np.sin(between / 2))
        return _line(figure, between * (k + sum(round(2 * s) for s in spreads)), aside, 0.0), figure.length_m
    least, more = CROSSING_RAD
    gap = float(np.clip(figure.length_m / max(robots - 1, 1), *CROSSING_GAP_M))
    turn = k * least + sum(spreads) * (more - least)
    return _line(figure, turn, 0.0, ((robots - 1) / 2 - k) * gap), figure.length_m


def parallel(figure: Figure, robots: int, spreads: Sequence[float]) -> tuple[Array, float]:
    """A straight path next to the one before.

    The spread puts it farther from that one, and behind and ahead of it by turns.

    Args:
        figure: middle, direction and size.
        robots: how many in the team.
        spreads: 0 to 1, of the robots up to this one.
    """
    k, widest = len(spreads) - 1, max(LINES_APART_M, 2 * figure.reach_m / max(robots - 1, 1))
    aside = k * LINES_APART_M + sum(spreads) * (widest - LINES_APART_M) - figure.reach_m
    ahead = 0.8 * figure.length_m * sum((-1) ** i * spread for i, spread in enumerate(spreads))
    return _line(figure, 0.0, aside, ahead), figure.length_m


def follower(figure: Figure, robots: int, spreads: Sequence[float]) -> tuple[Array, float]:
    """A part of the route, with the spread farther behind the one before.

    Args:
        figure: middle, direction and size.
        robots: how many in the team.
        spreads: 0 to 1, of the robots up to this one.
    """
    assert figure.route is not None
    farthest = longest_lag(figure.length_m, robots)
    lag = (len(spreads) - 1) * APART_M * 1.1 + sum(spreads) * (farthest - APART_M * 1.1)
    end = len(figure.route) - round((RESERVE_M + lag) / POINT_M)
    start = end - round((figure.length_m + 2 * RESERVE_M) / POINT_M)
    return figure.route[max(start, 0) : end], figure.length_m


SHAPES: dict[str, Shape] = {
    "concentric": circle,
    "leader-follower": follower,
    "crossing": crossing,
    "parallel": parallel,
}


def longest_lag(length_m: float, robots: int) -> float:
    """How far (m) a follower may be behind the one before.

    Args:
        length_m: of a path.
        robots: how many in the team.
    """
    each, whole = FARTHEST_BEHIND_M
    return max(1.5 * APART_M, min(length_m, each, whole / max(robots - 1, 1)))


def _line(figure: Figure, turn_rad: float, aside_m: float, along_m: float) -> Array:
    """A straight path [n, 2] of the length of the figure, moved aside and along."""
    heading = figure.heading_rad + turn_rad
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    half = figure.length_m / 2 + RESERVE_M
    s = np.linspace(-half, half, max(8, int(2 * half / POINT_M))) + along_m
    return np.asarray(figure.middle + aside_m * left + s[:, None] * ahead)


@dataclass(frozen=True)
class GroundPath:
    """A robot's path on the floor: positions [frames, 3] and the direction in which it goes, rad, [frames]."""

    position: Array
    heading_rad: Array

    def poses(self, gaze_rad: float) -> Array:
        """T_world_camera [frames, 4, 4], looking to the side of the path, a little down.

        Args:
            gaze_rad: yaw of the camera from the direction of motion, counter-clockwise.
        """
        yaw = self.heading_rad + gaze_rad
        gaze = np.stack([np.cos(yaw), np.sin(yaw), np.full(len(yaw), np.tan(PITCH_RAD))], axis=1)
        return look_at(self.position, self.position + gaze)


class Ground:
    """The free floor of a terrain, and paths on it."""

    def __init__(self, terrain: Terrain, frames: int, seed: int) -> None:
        """Compute how far inside the free floor every cell is, and the slope of this distance.

        Args:
            terrain: whose floor it is.
            frames: of every path.
            seed: of figures, and of how cameras waver.
        """
        from scipy.ndimage import distance_transform_edt

        self.terrain, self.space, self.frames, self.seed = terrain, terrain.free_space(), frames, seed
        self.planned = 0  # worked out so far
        self._graph = self.space.graph.tocsr()
        inside = np.pad(self.space.inside, 1)
        out, into = distance_transform_edt(~inside), distance_transform_edt(inside)
        margin = ((into - out) * self.space.cell_m).astype(np.float64)
        slope = np.gradient(margin, self.space.cell_m)
        self._fields = np.stack([margin, *slope], axis=-1)

    def figure(self, paradigm: str, robots: int, size: float, attempt: int) -> Figure:
        """A figure drawn at random.

        Args:
            paradigm: a key of `SHAPES`.
            robots: how many.
            size: factor of the length of its paths, which at 1 is that of the frames' steps.
            attempt: number of the try; each has random numbers of its own.
        """
        space, length = self.space, size * (self.frames - 1) * self.terrain.step_m
        rng = random_streams.generator(
            self.seed, "simulate.figure", paradigm=paradigm, size=str(size), attempt=attempt
        )
        curve = None
        if paradigm == "leader-follower":
            whole = length + (robots - 1) * longest_lag(length, robots) + 2 * RESERVE_M
            curve = route(space, self._graph, whole, rng)[:: round(POINT_M / ROUTE_STEP_M)]
        extent = float(np.ptp(space.cells, axis=0).max())
        middle = space.cells[rng.choice(len(space.cells), p=space.clearance / space.clearance.sum())]
        if paradigm == "concentric":
            middle = middle + rng.normal(0, 0.1 * extent, 2)
            least = size * self.terrain.step_m / CIRCLE_TURN_RAD  # the outermost is as fast as is asked for
            reach = least * max(1.3, 0.45 * extent / least) ** rng.uniform()
        else:
            reach = float(rng.uniform(0.3, 1.2)) * max(1.0, 0.35 * length) * size
            reach = max(reach, 0.5 * LINES_APART_M * (robots - 1))
        return Figure(middle, float(rng.uniform(0, 2 * np.pi)), length, reach, self.frames, curve)

    def ground_path(
        self, shape: Shape, figure: Figure, robots: int, spreads: Sequence[float]
    ) -> GroundPath | None:
        """The path of the robot that has the last of the spreads; None if it is not free.

        Args:
            shape: of the figure.
            figure: middle, direction and size.
            robots: how many in the team.
            spreads: 0 to 1, of the robots up to this one.
        """
        self.planned += 1
        curve, length = shape(figure, robots, spreads)
        if len(curve) < 8 or self.margin(curve).min() < -GIVE_WAY_M:
            return None
        bent = self.bent(curve)
        return None if bent is None else self._steps(bent, length, len(spreads) - 1)

    def _at(self, points: Array) -> Array:
        """The margin at points [n, 2] and its slope, [n, 3], linear between the middles of cells."""
        place = (points - self.space.low) / self.space.cell_m + 1
        place = np.clip(place, 0.0, np.array(self._fields.shape[:2]) - 1.001)
        i, j = place.astype(np.int64).T
        u, v = (place - np.floor(place)).T[..., None]
        low = (1 - v) * self._fields[i, j] + v * self._fields[i, j + 1]
        high = (1 - v) * self._fields[i + 1, j] + v * self._fields[i + 1, j + 1]
        return np.asarray((1 - u) * low + u * high)

    def margin(self, points: Array) -> Array:
        """How far (m) points are inside the free floor, [n]; negative outside.

        Args:
            points: [n, 2], x and y, meters, world frame.
        """
        return self._at(points)[:, 0]

    def bent(self, curve: Array) -> Array | None:
        """A curve moved aside until it is free, or None.

        Args:
            curve: [n, 2], x and y, meters, world frame.
        """
        from scipy.ndimage import gaussian_filter1d

        moved = np.zeros_like(curve)
        at = self._at(curve)
        for _ in range(40):
            lack = np.clip(0.15 - at[:, :1], 0.0, 0.1)
            if lack.max() == 0 or np.abs(moved).max() > GIVE_WAY_M:
                break
            moved = gaussian_filter1d(moved + lack * at[:, 1:], GIVE_WAY_SMOOTH, axis=0, mode="nearest")
            at = self._at(curve + moved)
        ground_path = curve + moved
        free = at[:, 0].min() > 0.0 and np.linalg.norm(moved, axis=1).max() < GIVE_WAY_M
        return ground_path if free and _length(ground_path) > KEPT_SHARE * _length(curve) else None

    def _steps(self, curve: Array, length_m: float, robot: int) -> GroundPath | None:
        """Even steps along the middle of a curve [n, 2], at the robot's height; None if too sharp or not clear."""
        from scipy.interpolate import CubicSpline
        from scipy.ndimage import gaussian_filter1d

        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        length_m = min(length_m, float(along[-1]))
        spline = CubicSpline(along, curve)
        s = (along[-1] - length_m) / 2 + np.linspace(0.0, length_m, self.frames)
        ahead = spline(s, 1)
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        heading = gaussian_filter1d(heading, SMOOTH_GAZE_M * self.frames / length_m, mode="nearest")
        rng = random_streams.generator(self.seed, "simulate.waver", robot=robot)
        waves = (
            rng.uniform((0.02, 0.03), (0.05, 0.08)),
            rng.uniform(1.5, 3.0, 2),
            rng.uniform(0, 2 * np.pi, 2),
        )
        bob, swing = (a * np.sin(2 * np.pi * s / p + f) for a, p, f in zip(*waves, strict=True))
        height = HEIGHTS_M[robot % len(HEIGHTS_M)] + 0.06 * (robot // len(HEIGHTS_M)) + bob
        position = np.column_stack([spline(s), self.space.floor_m + height])
        ground_path = GroundPath(position, heading + swing)
        turns = se3.distance(*(ground_path.poses(0.0)[k] for k in (slice(None, -1), slice(1, None))))[1]
        if turns.max() > MAX_TURN_RAD:
            return None
        tight = position[
            self.margin(position[:, :2]) < 2 * self.space.cell_m
        ]  # elsewhere the floor says enough
        return (
            ground_path if not len(tight) or self.terrain.clearance(tight).min() > LEAST_CLEARANCE_M else None
        )


def _length(curve: Array) -> float:
    """Length (m) of a curve [n, 2]."""
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def apart(one: GroundPath, other: GroundPath) -> float:
    """Least distance (m) on the floor between two robots at the same time.

    Args:
        one: path of a robot.
        other: path of another one, with as many frames.
    """
    return float(np.linalg.norm(one.position[:, :2] - other.position[:, :2], axis=1).min())
