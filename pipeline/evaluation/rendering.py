"""Renders of the maps where cameras stood: own, fused, refined, and if given own trained longer, on the same pixels.

Every robot's maps are drawn at its own held-out views, at those of the robots that share its world (`peers`), and both
together are the views of the team (`team`). A map has the colors of its own robot's camera; at peers' views it is
drawn in the colors of the camera that took the view.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.component_names import same_robot
from duagc.pipeline.base.progress import track
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.evaluation import groundtruth, views
from duagc.pipeline.evaluation.results import Absent, Row
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording, RgbdLog, open_rgbd
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.peer_colors import read_peer_colors
from duagc.pipeline.splat.gaussians import Gaussians

COMPARED = ("own", "own_longer", "fused", "refined")
IN_EVERY_RUN = ("own", "fused", "refined")
CENTRAL = "central"
"""The map trained on all robots' images; it has a section where there is one (`central_map`)."""
MOST_VIEWS = 40
"""Of a set, unless more are asked for."""
TRAINING_SHARE = 4
"""Of so many views that a set may have, keyframes get one: how well a map repeats what it was trained on needs few."""
APART_PX, MOST_MOMENTS = 1.5, 15
"""Places from which a view is drawn whose camera moved: about as dense as pixels."""
COMPARED_SETS = ("held_out", "peers", "team")
OTHER_COMPONENT = "other_component"
"""Reason of a frame without a pose that has one in another component of its robot."""
NONE_MET = "no robot met another, or the settings train no final map"
NOT_ASKED = "not asked for: duagc evaluate --own-longer"
NOTHING_TO_COMPARE = "a robot that met no other has no final map to compare with"
REASONS = {
    "held_out": "there is no such view",
    "training": "there is no such view",
    "peers": "no two robots met",
    "team": "no two robots met",
}
Scores = list[views.ViewScore | Absent]


@dataclass(frozen=True)
class PosedMap:
    """A map and where the camera stood in its frame: T_frame_camera of a robot's views."""

    gaussians: Gaussians
    trajectory: Trajectory


@dataclass
class _Found:
    """Scores by robot, map and set of views; and the rows of the long table."""

    rows: list[Row]
    longer: bool
    scores: dict[tuple[str, str, str], Scores] = field(default_factory=dict)

    def add(
        self, robot: str, kind: str, view_set: str, *, index: int, score: views.ViewScore | Absent
    ) -> None:
        self.scores.setdefault((robot, kind, view_set), []).append(score)
        self.rows += _view_rows(robot, f"{kind}/{view_set}", index, score)

    def of(self, robot: str, kind: str, view_set: str) -> Scores:
        """`team`: own and peers' held-out views of a robot that has peers."""
        if view_set == "team":
            peers = self.of(robot, kind, "peers")
            return self.of(robot, kind, "held_out") + peers if peers else []
        return self.scores.get((robot, kind, view_set), [])

    def final_maps(self, robots: list[str]) -> _Found:
        """The same with each robot's final map: of one that met no other the fused map, which nothing trained again.

        Means of own and of final maps are then over the same views. Where no map was trained again, none is final.
        """
        trained = {robot for robot, kind, _ in self.scores if kind == "refined"}
        alone = [robot for robot in robots if robot not in trained] if trained else []
        final = {
            (robot, "refined", s): self.scores[robot, "fused", s]
            for robot in alone
            for s in COMPARED_SETS
            if (robot, "fused", s) in self.scores
        }
        return replace(self, scores=self.scores | final)

    def summary(self, robots: list[str], kind: str, view_set: str) -> dict[str, Any]:
        if kind == "own_unrefined":
            reason = "the front end wrote no map before its refinement"
        elif kind == "own_longer":
            reason = NOTHING_TO_COMPARE if self.longer else NOT_ASKED
        else:
            reason = NONE_MET if kind in ("own_longer", "refined", CENTRAL) else REASONS[view_set]
        return views.summary([s for r in robots for s in self.of(r, kind, view_set)], reason)


@dataclass(frozen=True)
class RenderingSections:
    """Scores of rendered views.

    Attributes:
        team: means over all robots, by map and set of views.
        robots: the same of each robot, by name.
        rows: every score of every view.
    """

    team: dict[str, Any]
    robots: dict[str, dict[str, Any]]
    rows: list[Row]


Scored = tuple[str, str, int, views.ViewScore | Absent]
"""Of a view: the map, the set of views, the index of the frame, and the score."""


def robot_scores(
    run: RunFolder,
    source: Recording,
    name: str,
    *,
    threads: int,
    progress: bool,
    further: Mapping[str, Gaussians],
    most_views: int = MOST_VIEWS,
    save: Checkpoints = NO_CHECKPOINTS,
) -> list[Scored]:
    """Scores of the maps of one robot at its views, and at those of its peers.

    Args:
        run: the run.
        source: its recording.
        name: of the robot.
        threads: views rendered at the same time; changes no bit of the result.
        progress: show it on standard error.
        further: maps besides those of the run: own_longer, in its map frame, and central, in the world.
        most_views: of a set, evenly spread; of peers' views all peers have the same share, of keyframes a few suffice.
        save: of every set of views, when it is done.
    """
    found: list[Scored] = []
    robot = run.robots[name]
    maps = {**_maps(robot), **further}
    own = {kind: PosedMap(g, _own_trajectory(robot, kind)) for kind, g in maps.items()}

    def score(task: RenderTask, view_set: str, title: str) -> None:
        name, total = f"{view_set} of {task.camera_robot.robot}", len(task.chosen())

        def scored() -> list[Scored]:
            views_done: list[dict[str, Scored]] = (save.resume(name) or (0, []))[1]
            rest = task.scores(source, threads, title if progress else None, skip=len(views_done))
            for index, scores in rest:
                views_done.append({kind: (kind, view_set, index, score) for kind, score in scores.items()})
                save.at(name, len(views_done), total, lambda: views_done)
            return [row for view in views_done for row in view.values()]

        found.extend(save.done(name, scored))

    task = RenderTask(own, robot, "held_out", robot.own_map.depth, most_views)
    score(task, "held_out", f"render maps of {name}")
    mapped = {kind: own[kind] for kind in ("own", "fused")}
    task = RenderTask(mapped, robot, "keyframes", robot.own_map.depth, -(-most_views // TRAINING_SHARE))
    score(task, "training", f"render keyframes of {name}")
    world = {kind: in_world(robot, kind, g) for kind, g in maps.items() if kind in (*COMPARED, CENTRAL)}
    colors = read_peer_colors(robot.folder / "fused.mcap", name)
    peers = mates(run, robot)
    for peer in peers:
        here = colors.get(peer.robot)
        seen = {kind: in_colors_of(None if kind == CENTRAL else here, g) for kind, g in world.items()}
        there = {kind: PosedMap(g, peer.trajectory) for kind, g in seen.items()}
        task = RenderTask(there, peer, "held_out", robot.own_map.depth, -(-most_views // len(peers)))
        score(task, "peers", f"render maps of {name} from {peer.robot}")
    return found


def rendering_sections(of_robots: Mapping[str, Sequence[Scored]], *, longer: bool) -> RenderingSections:
    """Scores of all maps over all sets of views: of all robots together, and of each.

    Args:
        of_robots: scores of every robot, by name.
        longer: whether own maps that were trained longer are among them.
    """
    found = _Found([], longer)
    for name, scored in of_robots.items():
        for kind, view_set, index, score in scored:
            found.add(name, kind, view_set, index=index, score=score)
    robots_of_run = list(of_robots)
    sets: dict[str, tuple[str, ...]] = dict.fromkeys(COMPARED, COMPARED_SETS)
    if any(kind == CENTRAL for scored in of_robots.values() for kind, *_ in scored):
        sets[CENTRAL] = COMPARED_SETS
    sets |= {"own_unrefined": ("held_out",)} | dict.fromkeys(("own", "fused"), (*COMPARED_SETS, "training"))
    compared = [kind for kind in sets if kind in (*COMPARED, CENTRAL)]
    final = found.final_maps(robots_of_run)
    team = {
        kind: {s: (final if kind == "refined" else found).summary(robots_of_run, kind, s) for s in sets[kind]}
        for kind in sets
    }
    robots = {
        name: {kind: {s: found.summary([name], kind, s) for s in COMPARED_SETS} for kind in compared}
        for name in of_robots
    }
    return RenderingSections(team, robots, found.rows)


def mates(run: RunFolder, robot: RobotRun) -> list[RobotRun]:
    """The other robots that agree with this one on who shares their world; its own other components are none.

    Args:
        run: with all robots.
        robot: one of them.
    """
    others = [run.robots[r] for r in robot.component if not same_robot(r, robot.robot)]
    return [other for other in others if other.component == robot.component]


def _maps(robot: RobotRun) -> dict[str, Gaussians]:
    """The own maps in the robot's map frame, the others in the world; those that exist."""
    maps = {"own": robot.own_map.gaussians, "fused": robot.fused_map.gaussians}
    if robot.unrefined_map is not None:
        maps["own_unrefined"] = robot.unrefined_map.gaussians
    if robot.refined_map is not None:
        maps["refined"] = robot.refined_map.gaussians
    return maps


def _own_trajectory(robot: RobotRun, kind: str) -> Trajectory:
    """The robot's own poses in the frame of `_maps`."""
    return robot.odometry if kind.startswith("own") else robot.trajectory


def in_world(robot: RobotRun, kind: str, gaussians: Gaussians) -> Gaussians:
    """A map of `_maps` in the world: Gaussians of the own maps move with their keyframes.

    Args:
        robot: whose map it is; its corrected keyframes move it.
        kind: name of the map ("own", "own_longer", "fused", ...); a name that begins with "own" is in the map
            frame.
        gaussians: of that map, meters, in the map frame or already in the world.
    """
    if not kind.startswith("own"):
        return gaussians
    T_map_keyframe = np.array([k.T_map_camera for k in robot.keyframes])
    return gaussians.moved(T_map_keyframe, robot.corrected.T_world_keyframe)


def in_colors_of(colors: ColorMap | None, gaussians: Gaussians) -> Gaussians:
    """A map of a robot in a peer's colors, by how those look to the robot.

    Args:
        colors: from the peer's colors to the robot's; None: as if both cameras were alike.
        gaussians: of the robot's map, colors 0..1.
    """
    if colors is None or colors.is_identity:
        return gaussians
    return gaussians.replace(colors=colors.from_other(gaussians.colors).astype(np.float32))


@dataclass(frozen=True)
class RenderTask:
    """Maps to be rendered where one robot's camera stood: at held-out frames, or at keyframes, evenly spread."""

    maps: Mapping[str, PosedMap]
    camera_robot: RobotRun
    view_set: Literal["held_out", "keyframes"]
    depth: DepthKind
    most: int = MOST_VIEWS

    def chosen(self) -> list[int]:
        """Frames of the set, evenly spread, in order."""
        keyframes = {k.frame_index for k in self.camera_robot.keyframes}
        return spread(held_out_of(self.camera_robot) if self.view_set == "held_out" else keyframes, self.most)

    def scores(
        self, source: Recording, threads: int, title: str | None, *, skip: int = 0
    ) -> Iterator[tuple[int, dict[str, views.ViewScore | Absent]]]:
        """Frame index and the maps' scores of every view, in order.

        Args:
            source: the recording.
            threads: views rendered at the same time; changes no bit of the result.
            title: of the progress on standard error; None: no progress.
            skip: number of views at the start that are left out.
        """
        name, robot = self.camera_robot.robot, self.camera_robot
        chosen = self.chosen()[skip:]
        with open_rgbd(source.log(name)) as log:
            log.move_depth_by(robot.folder / "frontend.mcap")
            frames = scored_frames(log, chosen, source, robot)
            maps = {kind: (m.gaussians, poses_by_stamp(m.trajectory)) for kind, m in self.maps.items()}
            found = views.score_maps(
                maps, log.camera, frames, threads=threads, depth=self.depth, compared=IN_EVERY_RUN
            )
            yield from track(found, title, total=len(chosen)) if title else found


def held_out_of(robot: RobotRun) -> frozenset[int]:
    """Held-out frames of a robot, lost ones too, but none of its other components: those are theirs to score.

    Args:
        robot: with its frames and held-out frames.
    """
    return robot.held_out - {f.frame_index for f in robot.frames if f.reason == OTHER_COMPONENT}


def spread(frames: Collection[int], most: int) -> list[int]:
    """At most so many of the frames, evenly spread, in order.

    Args:
        frames: indices, in any order.
        most: largest number of frames returned.
    """
    in_order = sorted(frames)
    return [in_order[k] for k in evenly_spaced(len(in_order), min(most, len(in_order)))]


def scored_frames(
    log: RgbdLog, indices: Sequence[int], source: Recording, robot: RobotRun
) -> Iterator[views.ScoredFrame]:
    """Frames of a robot with their exact depth, where there is some.

    Args:
        log: of the robot.
        indices: of the frames.
        source: the recording.
        robot: whose frames they are.
    """
    recorded_is_exact = groundtruth.recorded_depth_is_exact(source, robot.robot)
    stamps = {f.stamp_ns for f in robot.frames if f.frame_index in indices}
    exact = groundtruth.exact_depths(source, robot.robot, stamps)
    still = groundtruth.static_masks(source, robot.robot, stamps)
    for index in indices:
        frame = log.frame(index)
        if (static := still.get(frame.stamp_ns)) is not None:
            frame = replace(frame, mask=static if frame.mask is None else static & frame.mask)
        depth_m: Any = exact
        if recorded_is_exact:
            depth_m = frame.depth
        elif not isinstance(exact, Absent):
            depth_m = exact.get(frame.stamp_ns, Absent("the frame has no exact depth"))
        moments = (
            None
            if log.shutter is None
            else log.shutter.moments(
                frame.stamp_ns, frame.usable_depth, log.camera, apart_px=APART_PX, most=MOST_MOMENTS
            )
        )
        yield views.ScoredFrame(frame, depth_m, robot.exposures.at(index), moments)


def poses_by_stamp(trajectory: Trajectory) -> dict[int, NDArray[np.float64]]:
    """Poses [4, 4] by time stamp in ns.

    Args:
        trajectory: poses [n, 4, 4] and stamps in ns.
    """
    return dict(zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True))


def _view_rows(robot: str, view_set: str, frame_index: int, score: views.ViewScore | Absent) -> list[Row]:
    return [
        Row(
            "view",
            robot,
            view_set,
            frame_index,
            f.name,
            score if isinstance(score, Absent) else getattr(score, f.name),
        )
        for f in fields(views.ViewScore)
    ]
