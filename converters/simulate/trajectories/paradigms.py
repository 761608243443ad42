"""Paths of a team that draw a figure together: concentric circles, leader and followers, crossing or parallel lines.

A figure (`figures.py`) is put where it is free, the longest paths first. Then robot after robot gets the spread and
the direction of gaze, ahead or to the side of its path, with which it shares as much of the view with the robot before
as was asked for. What two robots share is measured. Of a few figures that come near enough, the one whose dullest view
shows most is taken; if there is none, the nearest.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from duagc.converters.simulate.trajectories.figures import APART_M, SHAPES, Figure, Ground, GroundPath, apart
from duagc.converters.simulate.trajectories.loops import PathViews, look, shared
from duagc.converters.simulate.trajectories.walks import (
    LEAST_MEDIAN_M,
    MAX_HOLE_SHARE,
    MAX_NEAR_SHARE,
    MAX_SKY_SHARE,
    NEAR_M,
    VIEW_IMAGE,
    Terrain,
    most_shown,
    sees_enough,
)
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera

PARADIGMS = ("wander", *SHAPES)
SIZES = (1.0, 0.8, 0.64, 0.5, 0.4, 0.3, 0.2, 0.14, 0.1)  # of the length that frames and step would make
LEAST_LENGTH_M = 1.0  # paths become no shorter than that by going more slowly
DRAWS = 160  # figures per size
PLACES = 4  # figures with room for all that are looked at from the cameras
SPREADS, HALVINGS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), 4
FIRST_SPREADS = (0.4, 0.6, 0.2, 0.8, 0.0, 1.0)  # to see whether there is room
GAZE_STEP_RAD, GAZES = np.deg2rad(40.0), (0, 1, -1, 2, -2)  # from the path's direction, to the left
CLOSE, NEAR_ENOUGH = 0.015, 0.03  # to the overlap asked for: of two robots, to search no more; of every two
SHOWN = 12  # paths near enough of which the one with most to see is taken: robots times figures
EFFORT = 250  # per size and robot: planning a path counts one, rendering along it LOOK_EFFORT
LOOK_EFFORT = 5
SKETCH = (28, 21)  # pixels of the views that a planner looks at


@dataclass(frozen=True)
class _Member:
    """A robot of a team: its spread, path on the floor and direction of gaze, its T_world_camera, and what it sees."""

    spread: float
    on_floor: GroundPath
    gaze_rad: float
    path: Array
    views: PathViews
    surplus: float  # of the overlap with the robot before, over what was asked for

    @property
    def error(self) -> float:
        return abs(self.surplus)


def plan(
    terrain: Terrain,
    paradigm: str,
    *,
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
        frames: poses per robot, evenly spaced, at most a step of the terrain apart; less where there is no
            room.
        overlap: share, 0 to 1, of what a robot sees that the next one sees as well; met as nearly as may be.
        camera: of all robots.
        seed: of the figure's place.
    Raises:
        DuagError: there is no room for so many.
    """
    search = _Search(terrain, paradigm, frames, overlap, camera=camera, seed=seed)
    paths = search.best(robots)
    if paths is not None:
        return paths
    fit, too_many = 0, robots
    while too_many - fit > 1:
        middle = (fit + too_many) // 2
        fit, too_many = (fit, middle) if search.best(middle) is None else (middle, too_many)
    area = len(search.ground.space.cells) * search.ground.space.cell_m**2
    what = f"expected at most {fit}" if fit else "expected a larger scene, or another --paradigm or --seed"
    raise DuagError(
        f"simulate: found no room for {paradigm} paths of {robots} robots, {APART_M} m apart, in {area:.1f} m^2 "
        f"of free floor, {what}"
    )


class _Search:
    """Looks for a place for a figure, and for each robot's part in it."""

    def __init__(
        self,
        terrain: Terrain,
        paradigm: str,
        frames: int,
        overlap: float,
        *,
        camera: PinholeCamera,
        seed: int,
    ) -> None:
        self.ground = Ground(terrain, frames, seed)
        self.paradigm, self.shape, self.overlap = paradigm, SHAPES[paradigm], overlap
        self.sky, self.full_m = terrain.sky, (frames - 1) * terrain.step_m
        self.sketch_renderer = terrain.sketch_renderer(camera.scaled(*SKETCH))
        self.renderer = terrain.renderer(camera.scaled(*VIEW_IMAGE))
        self.looks = 0  # along paths, so far

    def best(self, robots: int) -> list[Array] | None:
        """The best paths for a team of so many; None if there is no room."""
        near: list[tuple[float, list[Array]]] = []
        for size in SIZES:
            if size < 1 and size * self.full_m < LEAST_LENGTH_M:
                break
            good = []
            for error, paths in self._teams(robots, size):
                if error > NEAR_ENOUGH:
                    near.append((error, paths))
                elif self._sees_enough(paths):
                    good.append(paths)
                if len(good) * robots >= SHOWN:
                    break
            if good:
                return most_shown(self.renderer, good)
        near.sort(key=lambda each: each[0])
        return next((paths for _, paths in near if self._sees_enough(paths)), None)

    def _sees_enough(self, paths: list[Array]) -> bool:
        return all(sees_enough(self.renderer, path, self.sky) for path in paths)

    def _teams(self, robots: int, size: float) -> Iterator[tuple[float, list[Array]]]:
        """Teams of figures of one size, each with its error; they stop when enough effort was spent."""
        spent = self._effort()
        least, places = np.inf, 0
        for attempt in range(DRAWS):
            figure = self.ground.figure(self.paradigm, robots, size, attempt)
            if not self._has_room(figure, robots):
                continue
            places += 1
            for gaze in GAZES:
                team = self._team(figure, robots, gaze * GAZE_STEP_RAD, least)
                if team:
                    least = _error(team, robots)
                    yield least, [member.path for member in team]
                if least <= NEAR_ENOUGH:
                    break
            least = least if least > NEAR_ENOUGH else np.inf
            if places == PLACES or self._effort() - spent > EFFORT * robots:
                return

    def _effort(self) -> int:
        return self.ground.planned + LOOK_EFFORT * self.looks

    def _has_room(self, figure: Figure, robots: int) -> bool:
        """Whether all robots find a path in a figure, at some spreads."""
        spreads: list[float] = []
        floor_paths: list[GroundPath] = []
        for robot in range(robots):
            for spread in FIRST_SPREADS if robot else (0.0,):
                on_floor = self.ground.ground_path(self.shape, figure, robots, [*spreads, spread])
                if on_floor is not None and all(apart(on_floor, other) >= APART_M for other in floor_paths):
                    spreads.append(spread)
                    floor_paths.append(on_floor)
                    break
            else:
                return False
        return True

    def _team(self, figure: Figure, robots: int, gaze_rad: float, worst: float) -> list[_Member]:
        """A team whose first robot looks in that direction; empty if there is none whose error is below `worst`."""
        on_floor = self.ground.ground_path(self.shape, figure, robots, [0.0])
        first = None if on_floor is None else self._member(0.0, on_floor, gaze_rad, None)
        team = [] if first is None else [first]
        while team and len(team) < robots:
            after = self._next(figure, robots, team)
            if after is None or _error([*team, after], robots) >= worst:
                return []
            team.append(after)
        return team

    def _member(
        self, spread: float, on_floor: GroundPath, gaze_rad: float, before: _Member | None
    ) -> _Member | None:
        """A robot that looks to the side of its path by an angle; None if it faces holes or something near."""
        path = on_floor.poses(gaze_rad)
        self.looks += 1
        views = look(self.sketch_renderer, path)
        if not _open(views, self.sky):
            return None
        surplus = 0.0
        if before is not None:
            surplus = shared(self.sketch_renderer.camera, before.views, views) - self.overlap
        return _Member(spread, on_floor, gaze_rad, path, views, surplus)

    def _next(self, figure: Figure, robots: int, team: list[_Member]) -> _Member | None:
        """The robot after a team: of those that keep apart from it, the one nearest to the overlap asked for."""
        before, spreads = team[-1], [member.spread for member in team]

        def free(spread: float) -> GroundPath | None:
            on_floor = self.ground.ground_path(self.shape, figure, robots, [*spreads, spread])
            clear = on_floor is not None and all(
                apart(on_floor, member.on_floor) >= APART_M for member in team
            )
            return on_floor if clear else None

        def halved(one: _Member, other: _Member) -> Iterator[_Member]:
            for _ in range(HALVINGS):
                spread = (one.spread + other.spread) / 2
                on_floor = one.on_floor if one.spread == other.spread else free(spread)
                middle = on_floor and self._member(
                    spread, on_floor, (one.gaze_rad + other.gaze_rad) / 2, before
                )
                if not middle:
                    return
                yield middle
                one, other = (middle, other) if middle.surplus * one.surplus > 0 else (one, middle)

        floor_paths = {spread: on_floor for spread in SPREADS if (on_floor := free(spread)) is not None}
        tried = sorted({*floor_paths}, key=list(floor_paths).index)
        tried = [tried[k] for k in sorted({0, len(tried) // 2, len(tried) - 1})] if tried else []
        seen: dict[tuple[float, int], _Member] = {}
        best: _Member | None = None
        own = round(before.gaze_rad / GAZE_STEP_RAD)
        for gaze in sorted(GAZES, key=lambda g: abs(g - own)):
            for k, spread in enumerate(tried):
                member = self._member(spread, floor_paths[spread], gaze * GAZE_STEP_RAD, before)
                if member is None:
                    continue
                seen[spread, gaze] = member
                neighbors = [(spread, gaze - 1), (spread, gaze + 1)] + [(tried[k - 1], gaze)] * (k > 0)
                across = [
                    seen[key] for key in neighbors if key in seen and seen[key].surplus * member.surplus < 0
                ]
                for found in chain([member], *(halved(member, other) for other in across)):
                    if best is None or found.error < best.error:
                        best = found
                    if best.error < CLOSE:
                        return best
        return best


def _open(views: PathViews, sky: bool) -> bool:
    """Whether no view faces holes or something near."""
    for depth in views.depths:
        seen = depth > 0
        if 1 - seen.mean() > (MAX_SKY_SHARE if sky else MAX_HOLE_SHARE):
            return False
        if np.mean(seen & (depth < NEAR_M)) > MAX_NEAR_SHARE or np.median(depth[seen]) < LEAST_MEDIAN_M:
            return False
    return True


def _error(team: list[_Member], robots: int) -> float:
    """How far the overlaps of neighbors are from the one asked for, on average over the whole team."""
    return float(sum(member.error for member in team) / max(robots - 1, 1))


def least_apart(paths: list[Array]) -> float:
    """Least distance (m) on the floor between two robots at the same time; of one robot, infinity.

    Args:
        paths: T_world_camera [frames, 4, 4] of every robot.
    """
    at = np.stack([path[:, :2, 3] for path in paths])
    gaps = [np.linalg.norm(at[i] - at[j], axis=1).min() for i in range(len(at)) for j in range(i)]
    return float(min(gaps, default=np.inf))
