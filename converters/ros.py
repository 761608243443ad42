"""Logs of ROS 1, ROS 2 and Foxglove: colour and depth of RGB-D cameras, chosen by type and name of their topics.

SRC is a `.bag`, a `.db3`, an `.mcap` or a folder of `ros2 bag`; or a folder with one of these per robot, or with a
folder of them per robot. Images are paired by the stamps of their headers. Colour is undistorted, and depth that
another camera saw is registered to it, with extrinsics from the log's constant transforms or given ones.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from converters.base import RecordingWriter, RobotWriter, robot_names
from converters.image_files import options_of
from converters.logs import open_log
from converters.logs.files import SUFFIXES
from converters.logs.options import LogOptions
from converters.logs.robot_log import RobotLog
from converters.ros_images import color_bytes, depth_m
from converters.self_check import GAP, MAX_RATIO, ReprojectionCheck
from pipeline import numeric
from pipeline.errors import DuagError
from pipeline.progress import track
from pipeline.recording.register_depth import register_depth

Options = LogOptions


def convert(src: Path, out: Path, robots: int = 0, force: bool = False, **options: Any) -> None:
    """Convert logs, one robot per log, per folder of logs, or per namespace.

    Args:
        robots: how many there must be; 0: as many as are found.
    Raises:
        DuagError: names log and topic, what was found and what was expected.
    """
    numeric.settle_opencv()
    settings = options_of(Options, options, "ros")
    sources = sources_of(src, settings)
    if robots and robots != len(sources):
        raise DuagError(f"{src}: found {len(sources)} robots, expected --robots {len(sources)}")
    parameters = {"robots": len(sources), **settings.model_dump()}
    source = {"dataset": "ros", "folder": src.resolve().name, "parts": [s.label for s in sources]}
    with RecordingWriter(out, "", source, "ros", parameters, force) as recording:
        for name, part in zip(robot_names(len(sources)), sources, strict=True):
            with open_log(part.paths, part.name) as log:
                robot_log = RobotLog(log, part.namespace, settings)
                write_robot(recording, name, robot_log, part.label)


@dataclass(frozen=True)
class Source:
    """The logs of one robot. name: how messages call them. label: how the recording calls them."""

    paths: tuple[Path, ...]
    namespace: str
    label: str

    @property
    def name(self) -> str:
        """One log, or the folder of several."""
        return str(self.paths[0] if len(self.paths) == 1 else self.paths[0].parent)


def sources_of(src: Path, settings: LogOptions) -> list[Source]:
    """Logs and namespace of every robot.

    Raises:
        DuagError: there is no log.
    """
    spaces = [text.strip() for text in settings.namespaces.split(",") if text.strip()]
    if spaces or settings.pieces:
        paths = tuple(logs_in(src))
        return [Source(paths, space, space) for space in spaces or [""]]
    groups = _groups(src)
    return [Source(paths, "", label if len(groups) > 1 else "") for label, paths in groups.items()]


def logs_in(src: Path) -> list[Path]:
    """All logs of a folder, or the log itself, in the order of the numbers in their names."""
    return [path for group in _groups(src).values() for path in group]


def _groups(src: Path) -> dict[str, tuple[Path, ...]]:
    """The logs of every robot, by the name of its log or folder."""
    if not src.exists():
        raise DuagError(f"{src}: no such file or folder, expected a log")
    if src.is_file() and src.suffix not in SUFFIXES:
        raise DuagError(f"{src}: is no log, expected one of {', '.join(SUFFIXES)}")
    if _is_log(src):
        return {src.name: (src,)}
    groups = {}
    for path in sorted(src.iterdir(), key=_natural):
        inner = (path,) if _is_log(path) else _inside(path)
        if inner:
            groups[path.name] = inner
    if not groups:
        raise DuagError(f"{src}: found no log, expected one for each robot")
    return groups


def _inside(folder: Path) -> tuple[Path, ...]:
    if not folder.is_dir() or folder.name.startswith("."):
        return ()
    return tuple(path for path in sorted(folder.iterdir(), key=_natural) if _is_log(path))


def _is_log(path: Path) -> bool:
    if path.is_file():
        return path.suffix in SUFFIXES and not path.name.startswith(".")
    return (path / "metadata.yaml").is_file()


def _natural(path: Path) -> list[Any]:
    """Order in which 9.bag comes before 10.bag."""
    return [(int(word), "") if word.isdigit() else (0, word) for word in re.split(r"(\d+)", path.name)]


def write_robot(
    recording: RecordingWriter,
    name: str,
    source: RobotLog,
    label: str,
    max_ratio: float = MAX_RATIO,
    gap: int = GAP,
) -> None:
    """Write all frames of a robot, what the self-check measured, and warnings.

    Args:
        label: which part of the source it was. max_ratio, gap: see `ReprojectionCheck`.
    """
    sensors = {"part": label, **source.sensors()}
    with recording.robot(name, source.color_camera.camera, source.depth_scale, sensors) as robot:
        recording.checks[name] = _write_frames(robot, source, max_ratio, gap)
    recording.warnings += [f"{name}: {text}" for text in source.warnings]


def _write_frames(robot: RobotWriter, source: RobotLog, max_ratio: float, gap: int) -> dict[str, Any]:
    import cv2

    settings, log = source.settings, source.name
    pairs = source.pairs()
    readings = _Readings(robot, source)
    camera, maps = source.color_camera.camera, source.color_maps
    check = ReprojectionCheck(camera, len(pairs), gap)
    without = empty = 0
    progress = track(source.frames(pairs), f"convert {robot.name}", len(pairs))
    for index, (stamp_ns, color, depth) in enumerate(progress):
        where = f"{log}: {source.color} at {stamp_ns} ns"
        data, color_format = color_bytes(color, where)
        if maps is not None:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise DuagError(f"{where}: no decoder reads it, expected a colour image")
            data = cv2.imencode(".png", cv2.remap(image, *maps, cv2.INTER_LINEAR))[1].tobytes()
            color_format = "png"
        metres = depth_m(depth, f"{log}: {source.depth} at {stamp_ns} ns", settings.depth_scale)
        size = source.depth_camera.camera.width, source.depth_camera.camera.height
        if metres.shape != (size[1], size[0]):
            raise DuagError(
                f"{log}: {source.depth} at {stamp_ns} ns is {metres.shape[1]}x{metres.shape[0]}, expected "
                f"{size[0]}x{size[1]} as in its CameraInfo"
            )
        if source.T_color_depth is not None:
            metres = register_depth(metres, source.depth_camera.camera, source.T_color_depth, camera)
        elif maps is not None:
            metres = np.asarray(cv2.remap(metres, *maps, cv2.INTER_NEAREST), dtype=np.float32)
        units = np.rint(metres / source.depth_scale)
        raw = np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
        T = source.truth.at(stamp_ns, settings.max_pose_gap_s) if source.truth else None
        without += T is None
        readings.write_until(stamp_ns)
        robot.add_frame(stamp_ns, data, color_format, raw, T)
        check.add(index, raw.astype(np.float64) * source.depth_scale, T)
        empty += int((raw == 0).sum())
    readings.write_until(np.iinfo(np.int64).max)
    if source.truth is not None and without:
        source.warnings.append(f"{without} of {len(pairs)} frames have no true pose")
    pixels = len(pairs) * camera.width * camera.height
    return {"without_depth": empty / pixels, **check.result(log, max_ratio)}


class _Readings:
    """Writes IMU and odometry in order of time, between the frames."""

    def __init__(self, robot: RobotWriter, source: RobotLog) -> None:
        self._robot, self._imu, self._odometry = robot, source.imu, source.odometry
        imu = self._imu.stamps_ns if self._imu else np.zeros(0, np.int64)
        odometry = self._odometry.body.stamps_ns if self._odometry else np.zeros(0, np.int64)
        self._stamps = np.concatenate([imu, odometry])
        self._order = np.argsort(self._stamps, kind="stable")
        self._imu_count, self._next = len(imu), 0
        if self._imu:
            robot.set_imu(self._imu.T_color_imu)

    def write_until(self, stamp_ns: int) -> None:
        """Write what was measured before a time."""
        while self._next < len(self._order) and self._stamps[k := self._order[self._next]] < stamp_ns:
            stamp = int(self._stamps[k])
            if k < self._imu_count and self._imu:
                values = self._imu.values[k]
                self._robot.add_imu(stamp, values[:3], values[3:])
            elif self._odometry:
                T_odometry_body = self._odometry.body.T_world_body[k - self._imu_count]
                self._robot.add_odometry(stamp, T_odometry_body @ self._odometry.T_body_color)
            self._next += 1
