"""Logs of ROS 1, ROS 2 and Foxglove: color and depth of RGB-D cameras, chosen by type and name of their topics.

SRC is a `.bag`, a `.db3`, an `.mcap` or a folder of `ros2 bag`; a folder with one of these per robot, or with a folder
of them per robot; or a TOML file that says which logs and topics each robot has (`duagc info LOG --toml`). Images are
paired by the stamps of their headers; messages that hold both (RealSense's RGBD, RTAB-Map's RGBDImage) are read as
topics below their own. Color keeps its distortion, and depth that another camera saw is registered to it as it looks
without, with extrinsics from the log's constant transforms or given ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from duagc.converters.layouts.ros_images import UnusableImage
from duagc.converters.layouts.self_check import GAP, MAX_RATIO, ReprojectionCheck
from duagc.converters.logs import Log, open_log
from duagc.converters.logs.clocks import LEAST_OFFSET_S, angular_speed, compare, lag, overlap_warnings
from duagc.converters.logs.derived import Picture, Sweeps
from duagc.converters.logs.describe import namespaces
from duagc.converters.logs.measured_frames import FARTHEST, measured, rules_of_depth
from duagc.converters.logs.options import LogOptions
from duagc.converters.logs.robot_log import RobotLog
from duagc.converters.logs.sources import (
    Source,
    overlap_words,
    piece_before,
    pieces_words,
    sources_of,
    unread,
)
from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base import determinism
from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.atomic_folder import check_apart
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry import se3
from duagc.pipeline.messages.parts import NANOSECONDS

Options = LogOptions
TRUTH_REMEDY = "--set truth_offset_s=SECONDS to add to the poses' times, or --set time_source=log"


def convert(src: Path, out: Path, robots: int = 0, force: bool = False, **options: Any) -> None:
    """Convert logs, one robot per log, per folder of logs, or per namespace.

    Args:
        src: a log, a folder of logs, or a TOML file that names them.
        out: folder of the recording.
        robots: how many there must be; 0: as many as are found.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names log and topic, what was found and what was expected.
    """
    determinism.configure_opencv()
    sources = sources_of(src, options)
    check_apart(out, [path for source in sources for path in source.paths])
    if robots and robots != len(sources):
        raise DuagError(f"{src}: found {len(sources)} robots, expected --robots {len(sources)}")
    said = {s.robot: s.settings.model_dump() for s in sources}
    for row in said.values():
        row["truth_file"] = Path(row["truth_file"]).name  # no paths of this machine
    parameters = {"robots": said}
    source = {"dataset": "ros", "folder": src.resolve().name, "parts": [s.label for s in sources]}
    with (
        RecordingWriter(out, "", source, "ros", parameters=parameters, force=force) as recording,
        ExitStack() as opened,
    ):
        recording.warnings += unread(src)
        robot_logs = {}
        for part in sources:
            log = opened.enter_context(open_log(part.paths, part.name))
            if src.suffix != ".toml" and (words := overlap_words(part, log)):
                raise DuagError(words)
            robot_logs[part.robot] = _robot_log(log, part, sources)
        spans = {robot: (min(found.pairs), max(found.pairs)) for robot, found in robot_logs.items()}
        if src.suffix != ".toml" and (words := pieces_words(sources, spans)):
            raise DuagError(f"{src}: {words}")
        recording.warnings += _world_warnings(robot_logs)
        settle_clocks(recording, robot_logs)
        for part in sources:
            write_robot(recording, part.robot, robot_logs[part.robot], part.part)


def _robot_log(log: Log, part: Source, sources: Sequence[Source]) -> RobotLog:
    """The log of one robot; where it is not that of one, the error says what to do."""
    if not (part.namespace or part.settings.color) and (spaces := namespaces(log)):
        raise DuagError(
            f"{log.name}: found color and depth below {', '.join(spaces)}, expected --set "
            f"namespaces={','.join(spaces)} if each is a robot, namespaces={spaces[0]} for one, or color=TOPIC"
        )
    try:
        return RobotLog(log, part.namespace, part.settings)
    except DuagError as error:
        if piece_before(part, sources) is None:
            raise
        raise DuagError(f"{error}, or --set pieces=true if these are pieces of one log") from error


def _world_warnings(robot_logs: Mapping[str, RobotLog]) -> list[str]:
    """What to warn of where true poses of robots are in frames of their own."""
    worlds = {robot: robot_log.truth_world for robot, robot_log in robot_logs.items()}
    if len(set(filter(None, worlds.values()))) < 2:
        return []
    named = ", ".join(f"{robot} in {world!r}" for robot, world in worlds.items() if world)
    return [
        f"true poses are in different frames ({named}); expected one, or maps of the team cannot be judged"
    ]


def settle_clocks(recording: RecordingWriter, robot_logs: Mapping[str, RobotLog]) -> None:
    """Say how the robots' clocks differ, and shift their times as the options ask.

    Args:
        recording: gets the differences and warnings.
        robot_logs: by the robots' names, the reference first; their `shift_ns` is changed.

    Raises:
        DuagError: a robot's recording would begin before time 0.
    """
    for robot_log in robot_logs.values():
        robot_log.settle_drift()
    clocks = [robot_log.clock(robot) for robot, robot_log in robot_logs.items()]
    offsets = compare(clocks)
    for robot, robot_log in robot_logs.items():
        kind, offset = robot_log.settings.clocks, offsets[robot]
        if kind == "from_zero":
            robot_log.shift_ns -= robot_log.begin_ns
        elif kind == "estimated" and offset.seconds is not None and offset.matters:
            robot_log.shift_ns += round(offset.seconds * NANOSECONDS)
        elif kind == "estimated" and offset.seconds is None:
            robot_log.warnings.append(f"its clock is kept: {offset.how}")
    for robot_log in robot_logs.values():
        if (begin_ns := robot_log.written_ns(min(robot_log.pairs))) < 0:
            raise DuagError(
                f"{robot_log.name}: begins at {begin_ns / NANOSECONDS:.1f} s by the settled clocks, expected 0 s; "
                "--set clock_offset_s=SECONDS, the same for every robot, moves all of them"
            )
    if len(robot_logs) > 1:
        recording.clocks = {
            robot: {**offsets[robot].row(), "added_s": robot_log.shift_ns / NANOSECONDS}
            for robot, robot_log in robot_logs.items()
        }
        recording.warnings += overlap_warnings(clocks)


def write_robot(
    recording: RecordingWriter,
    name: str,
    source: RobotLog,
    label: str,
    *,
    max_ratio: float = MAX_RATIO,
    gap: int = GAP,
) -> None:
    """Write all frames of a robot, what the self-check measured, and warnings.

    Args:
        recording: gets the logs.
        name: of the robot.
        source: its log.
        label: which part of the source it was; kept in the log, whose digest it changes.
        max_ratio: largest residual of the self-check, as a share of the depth.
        gap: frames between those that the self-check compares.
    """
    sensors = {"part": label, **source.sensors()}
    with recording.robot(name, source.camera, source.depth_scale, sensors) as robot:
        robot.set_lens(source.lens)
        robot.set_valid(source.valid)
        recording.checks[name] = _write_frames(robot, source, max_ratio, gap)
    recording.warnings += [f"{name}: {text}" for text in source.warnings]


def _write_frames(robot: RobotWriter, source: RobotLog, max_ratio: float, gap: int) -> dict[str, Any]:
    pairs, derived = source.pairs, source.derived
    readings, rows = _Readings(robot, source), source.check_rows()
    if isinstance(derived, Sweeps):
        robot.set_lidar(derived.T_camera_lidar, derived.range_sigma_m)
    check, left_out = ReprojectionCheck(source.camera, len(pairs), gap), _LeftOut()
    written: set[int] = set()
    for index, (stamp_ns, picture, beyond) in enumerate(
        track(_pictures(source), f"convert {robot.name}", len(pairs))
    ):
        if isinstance(picture, UnusableImage):
            left_out.cut.append(picture)
            continue
        T = source.true_pose(stamp_ns)
        readings.write_until(stamp_ns)
        at_ns, encoded = source.written_ns(stamp_ns), (picture.color, picture.color_format)
        if picture.points_lidar is not None:
            robot.add_points(at_ns, picture.points_lidar)
        depth_ns = source.depth_stamp_ns(stamp_ns)
        lost = not derived and picture.depth is None and pairs[stamp_ns] is not None
        if lost:
            depth_ns = None
        left_out.add(picture, beyond=beyond, lost=lost, has_pose=T is not None)
        robot.add_frame(
            at_ns,
            *encoded,
            None if depth_ns in written else picture.depth,
            T_world_camera=T,
            depth_sigma_m=picture.depth_sigma_m,
            depth_stamp_ns=depth_ns,
        )
        if depth_ns is not None:
            written.add(depth_ns)
        if check.needs(index, T) and (picture.depth is not None or derived):
            at_depth = None if depth_ns is None else source.true_pose(pairs[stamp_ns])
            T_depth = T if at_depth is None else at_depth
            check.add(index, source.depth_m(picture), T_depth, picture.depth_sigma_m)
    source.warnings += source.invalid_words()
    left_out.warn(source)
    readings.write_until(np.iinfo(np.int64).max)
    if not isinstance(derived, Sweeps):
        rows["without_depth"] = left_out.share_without_depth(source)
    drift = {} if source.drift is None else {"clock_drift_ppm": 1e6 * source.drift.rate}
    return {**rows, **check.result(source.name, max_ratio), **_truth_lag(source), **drift}


def _pictures(source: RobotLog) -> Iterator[tuple[int, Picture | UnusableImage, int]]:
    """Time of every frame, what is written of it or why nothing is, and how many pixels are too far away."""
    derived, rules = source.derived, rules_of_depth(source)

    def pictured(frame: tuple[int, Any, Any]) -> tuple[int, Picture | UnusableImage, int]:
        stamp_ns, color, depth = frame
        try:
            if isinstance(color, UnusableImage):
                raise color
            if isinstance(depth, UnusableImage):
                if not source.settings.keeps_depth_time:
                    raise depth
                depth = None
            if derived:
                partner_ns = source.pairs[stamp_ns]
                assert partner_ns is not None  # or there would be nothing to derive depth from
                return stamp_ns, derived.picture(color, depth, stamp_ns, partner_ns), 0
            return stamp_ns, *measured(source, stamp_ns, color, depth, rules=rules)
        except UnusableImage as error:
            return stamp_ns, error, 0

    # what is derived may depend on the frames before
    return in_order(pictured, source.frames(), threads=1 if derived else None)


@dataclass
class _LeftOut:
    """What of the frames of a robot is not written.

    Attributes:
        cut: why frames are left out.
        lost: frames whose depth is left out.
        far: pixels that are farther away than depth can hold.
        without: frames without a true pose.
        empty: pixels without depth, of the images of depth.
    """

    cut: list[UnusableImage] = field(default_factory=list)
    lost: int = 0
    far: int = 0
    without: int = 0
    empty: int = 0

    def add(self, picture: Picture, *, beyond: int, lost: bool, has_pose: bool) -> None:
        self.far, self.lost, self.without = self.far + beyond, self.lost + lost, self.without + (not has_pose)
        if picture.depth is not None:
            self.empty += picture.depth.size - int(np.count_nonzero(picture.depth))

    def warn(self, source: RobotLog) -> None:
        """Say so; nothing may be all that is left."""
        pairs, warnings = source.pairs, source.warnings
        if len(self.cut) == len(pairs):
            raise self.cut[0]
        if self.cut:
            warnings.append(
                f"{len(self.cut)} frames have color or depth that is cut short or broken; left out"
            )
        if self.lost and self.lost + len(self.cut) >= sum(
            depth_ns is not None for depth_ns in pairs.values()
        ):
            raise DuagError(
                f"{source.name}: {source.depth}: {self.lost} images are cut short or broken, expected depth in some"
            )
        if self.lost:
            warnings.append(f"{self.lost} frames have depth that is cut short or broken; their color is kept")
        if self.far:
            limit = FARTHEST * source.depth_scale
            warnings.append(
                f"{self.far} pixels are farther away than {limit:.1f} m, which depth can hold; left out"
            )
        if source.truth is not None and self.without:
            why = source.truth.body.missing_words(list(pairs), source.settings.max_pose_gap_s, TRUTH_REMEDY)
            warnings.append(f"{self.without} of {len(pairs)} frames have no true pose: {why}")

    def share_without_depth(self, source: RobotLog) -> float:
        """Of the pixels of all images of depth that were written."""
        with_depth = (
            sum(depth_ns is not None for depth_ns in source.pairs.values()) - len(self.cut) - self.lost
        )
        return self.empty / max(1, with_depth * source.camera.width * source.camera.height)


def _truth_lag(source: RobotLog) -> dict[str, float]:
    """How much later the true poses turn than what the robot itself measured; nothing where that is not known."""
    if source.truth is None or (source.imu is None and source.odometry is None):
        return {}
    true = angular_speed(source.truth.body.stamps_ns, source.truth.body.T_world_body)
    if source.imu is not None:
        own = source.imu.stamps_ns, np.linalg.norm(source.imu.values[:, :3], axis=1)
    elif source.odometry is not None:
        own = angular_speed(source.odometry.body.stamps_ns, source.odometry.body.T_world_body)
    found = lag(*own, *true)
    if found is None:
        return {}
    if abs(found[0]) > LEAST_OFFSET_S:
        source.warnings.append(
            f"true poses are {found[0]:.3f} s late by the robot's own clock (they turn so much later)"
        )
    return {"truth_lag_s": found[0], "truth_lag_correlation": found[1]}


class _Readings:
    """Writes IMU and odometry in order of time, between the frames."""

    def __init__(self, robot: RobotWriter, source: RobotLog) -> None:
        self._robot, self._imu, self._odometry = robot, source.imu, source.odometry
        imu = self._imu.stamps_ns if self._imu else np.zeros(0, np.int64)
        odometry = self._odometry.body.stamps_ns if self._odometry else np.zeros(0, np.int64)
        self._stamps = np.concatenate([imu, odometry])
        self._order = np.argsort(self._stamps, kind="stable")
        self._imu_count, self._source = len(imu), source
        for topic, stamps in ((source.settings.imu, imu), (source.settings.odometry, odometry)):
            if len(stamps) and (stamps.max() < min(source.pairs) or stamps.min() > max(source.pairs)):
                begin, end = (float(t) / NANOSECONDS for t in (stamps.min(), stamps.max()))
                source.warnings.append(
                    f"{topic}: its times ({begin:.3f} to {end:.3f} s) have none in common with the images; expected "
                    "one clock, or --set time_source=log"
                )
        self._next = int((self._stamps < -source.shift_ns).sum())
        self._T_color_camera = source.T_color_camera
        if self._imu:
            robot.set_imu(se3.inverse(self._T_color_camera) @ self._imu.T_color_imu)

    def write_until(self, stamp_ns: int) -> None:
        """Write what was measured before a time; what comes before time 0 of the recording is left out."""
        while self._next < len(self._order) and self._stamps[k := self._order[self._next]] < stamp_ns:
            stamp = self._source.written_ns(int(self._stamps[k]))
            if k < self._imu_count and self._imu:
                values = self._imu.values[k]
                self._robot.add_imu(stamp, values[:3], values[3:])
            elif self._odometry:
                T_odometry_body = self._odometry.body.T_world_body[k - self._imu_count]
                T_odometry_color = T_odometry_body @ self._odometry.T_body_color
                self._robot.add_odometry(stamp, T_odometry_color @ self._T_color_camera)
            self._next += 1
