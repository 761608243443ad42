"""Kimera-Multi-Data: six or eight Jackals with a RealSense D455 on a campus, one or more bags of ROS 1 per robot.

SRC is a bag, or the folder of a sequence (`10_14_<robot>.bag`, ...). Robots are known by the namespace of their
topics: in some bags `frame_id` names another robot. The bags hold no /tf: the factory's extrinsics of the cameras, as
the dataset's repository publishes them, are in this file. Depth is seen from the left infrared camera and is registered
to color as it looks without distortion. The true poses are of the robot's body, from LiDAR SLAM.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from duagc.converters.datasets.ros import settle_clocks, write_robot
from duagc.converters.layouts.image_files import options_of
from duagc.converters.layouts.tum_layout import LAST_NS, AssociationOptions, Poses
from duagc.converters.logs import Log, open_log
from duagc.converters.logs.motion import CameraPoses
from duagc.converters.logs.options import LogOptions
from duagc.converters.logs.robot_log import RobotLog
from duagc.converters.logs.sources import logs_in
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base import determinism
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry import se3, so3

COLOR, DEPTH = "forward/color/image_raw/compressed", "forward/depth/image_rect_raw"
COLOR_INFO, DEPTH_INFO = "forward/color/camera_info", "forward/depth/camera_info"
IMU = "forward/imu"
# T_infra1_color of the optical frames, by the factory: translation (m) and rotation vector (rad); depth is infra1.
# The source gives thoth and sobek the very numbers of hathor, and none for apis.
EXTRINSICS = {
    "acl_jackal": ((0.0589082, -0.0000343, -0.0001886), (-0.0017935, -0.0015863, -0.0016356)),
    "acl_jackal2": ((0.0591941, 0.0000361, -0.0003506), (0.0064717, -0.0025333, 0.0007272)),
    "hathor": ((0.0592388, -0.0000397, -0.0001651), (-0.0001842, 0.0009490, 0.0029021)),
    "sparkal1": ((0.0592342, -0.0000108, -0.0003561), (-0.0002291, -0.0043654, -0.0005452)),
    "sparkal2": ((0.0593315, -0.0000593, -0.0004557), (0.0037171, -0.0039940, -0.0007121)),
}
NOMINAL = ((0.0591, 0.0, 0.0), (0.0, 0.0, 0.0))
T_INFRA1_IMU = se3.from_rotation_translation(np.eye(3), [0.03022, -0.0074, -0.01602])
T_BODY_INFRA1 = se3.from_rotation_translation(
    [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.0, 0.0, 0.0]
)  # FLU, optical
TRUTH_COLUMNS = ["#timestamp_kf", "x", "y", "z", "qw", "qx", "qy", "qz"]
TRUTH_GAP = 30  # frames between the two of the self-check: about a second
# share of the depth: LiDAR SLAM, a body whose place on the robot is unknown, poses interpolated over seconds
TRUTH_RATIO = 0.05


class Options(AssociationOptions):
    """Robots, ground truth and time."""

    robots_used: str = ""
    """Names of the robots to convert, separated by commas; all that are found if empty."""
    ground_truth: str = ""
    """Folder of `<robot>_gt_odom.csv`, or "none"; by default `ground_truth/<sequence>` in SRC or next to it."""
    max_pose_gap_s: float = Field(2.0, gt=0.0)
    """Poses are interpolated between two true ones that are no further apart; never beyond the ends."""
    imu: bool = True
    """Keep the readings of the D455's IMU, which help tracking."""
    time_source: Literal["header", "log"] = "header"
    """Times of the headers, or those of recording, which differ by an offset that changes."""


def convert(src: Path, out: Path, robots: int = 0, force: bool = False, **options: Any) -> None:
    """Convert a sequence; robots keep the names that the dataset gives them.

    Args:
        src: a bag, or the folder of a sequence.
        out: folder of the recording.
        robots: how many there must be; 0: as many as are found.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names file and topic, what was found and what was expected.
    """
    determinism.configure_opencv()
    settings = options_of(Options, options, "kimera-multi")
    with ExitStack() as opened:
        found = _robots(src, settings, opened)
        if robots and robots != len(found):
            raise DuagError(f"{src}: found {len(found)} robots, expected --robots {len(found)}")
        source = {
            "dataset": "Kimera-Multi-Data",
            "folder": src.resolve().name,
            "parts": [r.files for r in found],
        }
        parameters = {"robots": len(found), **settings.model_dump()}
        with RecordingWriter(
            out, "", source, "kimera-multi", parameters=parameters, force=force
        ) as recording:
            logs = {robot.name: _robot_log(robot, settings, src) for robot in found}
            settle_clocks(recording, logs)
            for robot in found:
                write_robot(
                    recording, robot.name, logs[robot.name], robot.name, max_ratio=TRUTH_RATIO, gap=TRUTH_GAP
                )


@dataclass
class _Robot:
    """A robot: its name in the topics, and its bags as one log."""

    name: str
    paths: list[Path] = field(default_factory=list)
    log: Log | None = None

    @property
    def files(self) -> str:
        return " ".join(path.name for path in self.paths)


def _robots(src: Path, settings: Options, opened: ExitStack) -> list[_Robot]:
    """The robots of the bags, in order of name, with their logs open."""
    robots: dict[str, _Robot] = {}
    for path in logs_in(src):
        with open_log([path]) as log:
            names = sorted(
                {t.split("/")[1] for t in log.topics if t.endswith(f"/{COLOR}") and t.count("/") == 5}
            )
        if not names:
            raise DuagError(f"{path}: no topic /<robot>/{COLOR}, expected a bag of Kimera-Multi-Data")
        for name in names:
            robots.setdefault(name, _Robot(name)).paths.append(path)
    wanted = [name.strip() for name in settings.robots_used.split(",") if name.strip()]
    for name in wanted:
        if name not in robots:
            raise DuagError(f"{src}: robot {name} not found, {closest(name, sorted(robots), 'robots')}")
    chosen = [robots[name] for name in sorted(wanted or robots)]
    for robot in chosen:
        robot.log = opened.enter_context(open_log(robot.paths, str(src) if len(robot.paths) > 1 else ""))
    return chosen


def _robot_log(robot: _Robot, settings: Options, src: Path) -> RobotLog:
    """The robot's camera, with what its bags do not tell."""
    assert robot.log is not None
    T_infra1_color, known = extrinsics(robot.name)
    T_color_infra1 = se3.inverse(T_infra1_color)
    name = f"/{robot.name}"
    imu = f"{name}/{IMU}"
    has_imu = settings.imu and imu in robot.log.of_type("sensor_msgs/msg/Imu")
    log = RobotLog(
        robot.log,
        name,
        LogOptions(
            color=f"{name}/{COLOR}",
            depth=f"{name}/{DEPTH}",
            color_info=f"{name}/{COLOR_INFO}",
            depth_info=f"{name}/{DEPTH_INFO}",
            T_color_depth=_text(T_color_infra1),
            imu=imu if has_imu else "",
            T_color_imu=_text(T_color_infra1 @ T_INFRA1_IMU),
            time_source=settings.time_source,
            association=settings.association,
            max_difference_s=settings.max_difference_s,
            max_pose_gap_s=settings.max_pose_gap_s,
        ),
    )
    if known != "published":
        log.warnings.append(f"extrinsics of depth and color are {known}")
    if settings.imu and not has_imu:
        log.warnings.append(f"no readings on {imu}")
    path = _truth_file(robot, settings, src)
    if path is None:
        log.warnings.append("no ground truth")
    else:
        log.truth = CameraPoses(read_truth(path), T_BODY_INFRA1 @ T_infra1_color)
        log.warnings.append(
            "true poses are of the body, whose place on the robot is not published: taken to be the infrared "
            "camera's, with x forward, y left, z up"
        )
    return log


def extrinsics(robot: str) -> tuple[Array, str]:
    """T_infra1_color [4, 4] of a robot's camera, and whether it is "published" or what it is.

    Args:
        robot: name that the dataset gives it.
    """
    known = "published"
    if robot in ("thoth", "sobek"):
        known = "published, and the same as those of hathor"
        translation, rotation = EXTRINSICS["hathor"]
    elif robot in EXTRINSICS:
        translation, rotation = EXTRINSICS[robot]
    else:
        known = "not published: nominal ones of a D455"
        translation, rotation = NOMINAL
    return se3.from_rotation_translation(so3.exp(rotation), translation), known


def _text(T: Array) -> str:
    return " ".join(repr(float(v)) for v in (*T[:3, 3], *so3.to_quat_wxyz(T[:3, :3])))


def _truth_file(robot: _Robot, settings: Options, src: Path) -> Path | None:
    """The robot's ground truth; None if there is none and none was asked for."""
    if settings.ground_truth == "none":
        return None
    name = f"{robot.name}_gt_odom.csv"
    if settings.ground_truth:
        path = Path(settings.ground_truth) / name
        if not path.is_file():
            raise DuagError(
                f"{path}: no such file, expected the ground truth of {robot.name}, or ground_truth=none"
            )
        return path
    folder = src if src.is_dir() else src.parent
    return next((path for path in _truth_places(folder, robot, name) if path.is_file()), None)


def _truth_places(folder: Path, robot: _Robot, name: str) -> Iterator[Path]:
    """Where the ground truth may be: `ground_truth/1014`, or `ground_truth`, with the bags or next to their folder."""
    match = re.match(r"(\d\d)_(\d\d)_", robot.paths[0].name)
    for place in (folder, folder.resolve().parent):
        if match:
            yield place / "ground_truth" / "".join(match.groups()) / name
        yield place / "ground_truth" / name


def read_truth(path: Path) -> Poses:
    """Poses of the body: integer nanoseconds, position (m), quaternion wxyz.

    Args:
        path: of the CSV file.

    Raises:
        DuagError: the columns are others, or a line is no pose.
    """
    rows = csv.reader(io.StringIO(read_text(path, "lines of time and pose")))
    columns = [name.strip() for name in next(rows, [])]
    if columns != TRUTH_COLUMNS:
        raise DuagError(f"{path}: columns {','.join(columns)[:80]}, expected {','.join(TRUTH_COLUMNS)}")
    poses: dict[int, list[float]] = {}
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        try:
            stamp, values = int(row[0]), [float(v) for v in row[1:]]
        except ValueError:
            stamp, values = 0, []
        known = -LAST_NS < stamp < LAST_NS and len(values) == 7
        if not known or not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > 0.01:
            raise DuagError(
                f"{path}:{number}: {','.join(row)[:80]}, expected integer nanoseconds and a pose, w first"
            )
        poses.setdefault(stamp, values)
    if not poses:
        raise DuagError(f"{path}: found no pose, expected lines of {','.join(TRUTH_COLUMNS)}")
    stamps = sorted(poses)
    table = np.array([poses[s] for s in stamps])
    return Poses(np.array(stamps, dtype=np.int64), se3.from_quat_translation(table[:, 3:], table[:, :3]), 0)
