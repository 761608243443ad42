"""S3E v1: three ground vehicles with stereo cameras and a LiDAR, all of a sequence in one bag of ROS 2.

SRC is the folder of a sequence: a `.db3` of all robots, `metadata.yaml`, `<robot>_gt.txt`, and next to it
`Calibration/<robot>.yaml`. The bags of v2 hold no camera and are refused. The calibration files are not what they look
like: `RIGHT.R` is the rotation from the left to the right camera and the last column of `RIGHT.P` its translation in
millimeters, no rectification; the cameras are rectified here, and that is tested on the images.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from duagc.converters.layouts.derived_depth import (
    MAX_RATIO_ERROR,
    RATIO_FRAMES,
    ROW_PAIRS,
    STEREO_SCALE_M,
    ImuFeed,
    LidarSource,
    ScaleCheck,
    StereoFrames,
    decoded,
    gyro,
    imu_readings,
    spread,
)
from duagc.converters.layouts.image_files import options_of
from duagc.converters.layouts.ros_images import UnusableImage
from duagc.converters.layouts.ros_points import VELODYNE, UnusableSweep
from duagc.converters.layouts.s3e_layout import Fixes, S3eCalibration, read_fixes
from duagc.converters.layouts.stereo import StereoOptions, StereoRig
from duagc.converters.logs import open_log
from duagc.converters.logs.entries import Entry, InvalidMessage
from duagc.converters.logs.files import Log
from duagc.converters.logs.gather import gathered, nearest
from duagc.converters.logs.stamps import sound_stamps
from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter, robot_names
from duagc.pipeline.base import determinism
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import encode_png
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry import se3

LEFT, RIGHT = "left_camera/compressed", "right_camera/compressed"
POINTS, IMU = "velodyne_points", "imu/data"
EYES_NS = 10_000_000  # left and right farther apart in time are no pair; they differ by 2 ms
SWEEP_NS = 55_000_000  # half a turn of the LiDAR


class Options(StereoOptions):
    """Where depth comes from, and how the stereo pair is matched."""

    depth: Literal["stereo", "lidar"] = "stereo"
    """Depth of the stereo pair, or sweeps of the LiDAR."""
    calibration: str = ""
    """Folder of the calibration files; empty: Calibration next to the sequence."""
    shrink: int = Field(default=2, ge=1, le=8)
    """Side of the blocks of rectified pixels that become one: 2 makes 612x512 of 1224x1024."""
    min_depth_m: float = Field(default=1.5, gt=0)
    """Nearest depth that the stereo pair looks for."""
    range_sigma_m: float = Field(default=0.03, gt=0)
    """Standard deviation of the LiDAR's ranges (VLP-16)."""


def convert(src: Path, out: Path, robots: int = 0, force: bool = False, **options: Any) -> None:
    """Convert a sequence, one robot for each vehicle in the bag.

    Args:
        src: folder of the sequence.
        out: folder of the recording.
        robots: how many there must be; 0: as many as are found.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names file and topic, what was found and what was expected.
    """
    determinism.configure_opencv()
    settings = options_of(Options, options, "s3e")
    bag = _bag(src)
    with open_log([bag]) as log:
        vehicles = _vehicles(log)
        if robots and robots != len(vehicles):
            raise DuagError(f"{bag}: found {len(vehicles)} robots, expected --robots {robots}")
        folder = Path(settings.calibration) if settings.calibration else src.resolve().parent / "Calibration"
        calibrations = {v: S3eCalibration.read(folder / f"{v.lower()}.yaml") for v in vehicles}
        fixes = {v: read_fixes(src / f"{v.lower()}_gt.txt") for v in vehicles}
        known = [f.positions[0] for f in fixes.values() if f is not None]
        origin = np.floor(known[0]) if known else np.zeros(3)
        parameters = {**settings.model_dump(), "calibration": folder.name, "origin_m": origin.tolist()}
        source = {"dataset": "s3e", "sequence": src.resolve().name, "vehicles": vehicles}
        with RecordingWriter(out, "", source, "s3e", parameters=parameters, force=force) as recording:
            for name, vehicle in zip(robot_names(len(vehicles)), vehicles, strict=True):
                one = _Vehicle(
                    log, vehicle, calibrations[vehicle], fixes[vehicle], origin=origin, settings=settings
                )
                with recording.robot(name, one.rig.camera, STEREO_SCALE_M, one.sensors()) as robot:
                    robot.set_valid(one.rig.valid)
                    recording.checks[name] = one.write(robot)
                recording.warnings += [f"{name} ({vehicle}): {text}" for text in one.warnings]


def _bag(src: Path) -> Path:
    """The bag of a sequence: its only .db3."""
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected the folder of a sequence with a .db3 in it")
    found = sorted(src.glob("*.db3"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise DuagError(f"{src}: .db3 files: {names}; expected one with all robots of the sequence")
    return found[0]


def _vehicles(log: Log) -> list[str]:
    """Names of the vehicles with cameras.

    Raises:
        DuagError: no vehicle has cameras: S3E v2, or another bag.
    """
    names = {
        topic.name.split("/")[1] for topic in log.topics.values() if topic.count and topic.name.count("/") > 1
    }
    seeing = sorted(v for v in names if all(_count(log, f"/{v}/{t}") for t in (LEFT, RIGHT)))
    if seeing:
        return seeing
    others = ", ".join(sorted(t.name for t in log.topics.values() if t.count)) or "no topic"
    if any(_count(log, f"/{v}/{POINTS}") for v in names):
        raise DuagError(
            f"{log.name}: no camera in this bag (found {others}); S3E v2 has none, and a map is made of images: "
            "expected a sequence of S3E v1. Its LiDAR, IMU and GNSS serve other programs (LiDAR odometry)"
        )
    raise DuagError(f"{log.name}: found {others}, expected /<robot>/{LEFT} and /<robot>/{RIGHT} of S3E v1")


def _count(log: Log, topic: str) -> int:
    return log.topics[topic].count if topic in log.topics else 0


class _Vehicle:
    """One vehicle of the bag and its part of the recording."""

    def __init__(
        self,
        log: Log,
        vehicle: str,
        calibration: S3eCalibration,
        fixes: Fixes | None,
        *,
        origin: Array,
        settings: Options,
    ) -> None:
        self.log, self.settings, self.warnings = log, settings, list[str]()
        self.left, self.right, self.points, self.imu = (f"/{vehicle}/{t}" for t in (LEFT, RIGHT, POINTS, IMU))
        self.where = f"{log.name}: {self.left}"
        c = calibration
        self.rig = StereoRig.of(c.left, c.right, c.T_right_left, c.where, options=settings)
        self.frames = StereoFrames(self.rig, (c.left.width, c.left.height))
        T_camera_left = se3.from_rotation_translation(self.rig.R_rectified_left, np.zeros(3))
        self.T_camera_imu = T_camera_left @ c.T_left_imu
        self.readings = imu_readings(log.entries(self.imu), log.invalid.left_out)
        motion = gyro(self.readings, self.T_camera_imu)
        self.lidar = LidarSource(T_camera_left @ c.T_left_lidar, settings.range_sigma_m, motion, VELODYNE)
        self.groups = self._groups()
        self.truth = self._truth(fixes, origin)
        images = [group[self.left] for group in self.groups]
        if self.readings and (self.readings[-1][0] < images[0] or self.readings[0][0] > images[-1]):
            self.warnings.append(
                f"{self.imu}: its times have none in common with the images; expected one clock"
            )

    def sensors(self) -> dict[str, str]:
        """What the log says about its source."""
        depth = "stereo" if self.settings.depth == "stereo" else "lidar, drawn on reading"
        return {"part": self.left.split("/")[1], "depth": depth, "truth": "position", "imu": self.imu}

    @property
    def _used(self) -> set[str]:
        """Topics that are converted."""
        return {self.left, self.imu, self.right if self.settings.depth == "stereo" else self.points}

    def _groups(self) -> list[dict[str, int]]:
        """Topic -> time of what belongs together, for every frame in order."""
        left, right, points = self._times()
        eyes, sweeps = nearest(left, right, EYES_NS), nearest(left, points, SWEEP_NS)
        stereo = self.settings.depth == "stereo"
        used = [stamp for stamp in left if stamp in (eyes if stereo else sweeps)]
        if len(used) < len(left):
            other = (
                f"right image within {EYES_NS // 10**6} ms"
                if stereo
                else f"sweep within {SWEEP_NS // 10**6} ms"
            )
            self.warnings.append(
                f"{len(left) - len(used)} of {len(left)} left images have no {other}; left out"
            )
        if not used:
            raise DuagError(
                f"{self.where}: none of {len(left)} images has a partner near in time, expected pairs"
            )
        compared = spread(len(used), RATIO_FRAMES)
        groups = []
        for k, stamp in enumerate(used):
            group = {self.left: stamp}
            if stereo or k in spread(len(used), ROW_PAIRS):
                group |= {self.right: eyes[stamp]} if stamp in eyes else {}
            if (not stereo or k in compared) and stamp in sweeps:
                group |= {self.points: sweeps[stamp]}
            groups.append(group)
        return groups

    def _times(self) -> list[list[int]]:
        """Times of the left and right images and of the sweeps, increasing."""
        times: dict[str, list[int]] = {topic: [] for topic in (self.left, self.right, self.points)}
        for entry in self.log.entries(*times):
            with self.log.invalid.left_out(entry):
                times[entry.topic].append(entry.header_ns())
        self.log.invalid.check(self._used)
        return [
            sound_stamps(self.log.name, topic, stamps, self.warnings, remedy="") if stamps else []
            for topic, stamps in times.items()
        ]

    def _truth(self, fixes: Fixes | None, origin: Array) -> dict[int, Array]:
        """Poses [4, 4] of the images next to a fix; rotations mean nothing and are the identity."""
        if fixes is None:
            self.warnings.append("no positions with times (indoors there are only two): no ground truth")
            return {}
        found = fixes.near([group[self.left] for group in self.groups])
        self.warnings.append(
            f"ground truth: {len(found)} positions of the satellite antenna, whose place on the vehicle is not known; "
            "no rotations"
        )
        return {
            stamp: se3.from_rotation_translation(np.eye(3), position - origin)
            for stamp, position in found.items()
        }

    def write(self, robot: RobotWriter) -> dict[str, Any]:
        """Write all frames; returns what the checks measured."""
        rows = self._check_rows()
        robot.set_imu(self.T_camera_imu)
        if self.settings.depth == "lidar":
            robot.set_lidar(self.lidar.T_camera_lidar, self.lidar.range_sigma_m)
        feed, scale, empty = ImuFeed(robot, self.readings), ScaleCheck(self.lidar, self.rig), 0
        broken, swept = list[UnusableImage](), list[UnusableSweep]()  # images and sweeps that are none
        found = gathered(self.log, self.groups, lambda entry: entry.header_ns())
        for parts in track(found, f"convert {robot.name}", len(self.groups)):
            stamp = parts[self.left].header_ns()
            feed.until(stamp)
            points = np.zeros((0, 3))
            try:
                image, depth, sigma_m = self._images(parts)
                points = self._sweep(parts, stamp)
            except UnusableSweep as error:
                swept.append(error)
                if self.settings.depth == "lidar":
                    continue
            except UnusableImage as error:
                broken.append(error)
                continue
            if depth is None:
                robot.add_points(stamp, points)
            robot.add_frame(
                stamp, image, "png", depth, T_world_camera=self.truth.get(stamp), depth_sigma_m=sigma_m
            )
            if depth is not None:
                empty += int((depth == 0).sum())
                if len(points):
                    scale.add(points, depth)
        self.log.invalid.check(self._used)
        self.warnings += self.log.invalid.words({self.left, self.right, self.points, self.imu})
        left_out = [*broken, *swept] if self.settings.depth == "lidar" else broken
        if len(left_out) == len(self.groups):
            raise left_out[0]
        if broken:
            self.warnings.append(f"{len(broken)} frames have images that are cut short or broken; left out")
        if swept:
            lost = "frames" if self.settings.depth == "lidar" else "frames that test the scale of stereo"
            self.warnings.append(f"{len(swept)} {lost} have a sweep that is cut short; left out")
        if self.settings.depth == "lidar":
            return rows
        pixels = (len(self.groups) - len(broken)) * self.rig.camera.width * self.rig.camera.height
        ratio = scale.result()
        if ratio is not None and abs(ratio - 1) > MAX_RATIO_ERROR:
            self.warnings.append(f"stereo depth is {ratio:.3f} times that of the LiDAR, expected 1 to 2 %")
        return {**rows, "without_depth": empty / pixels, "stereo_over_lidar": ratio}

    def _images(
        self, parts: Mapping[str, Entry]
    ) -> tuple[bytes, NDArray[np.uint16] | None, NDArray[np.float32] | None]:
        """PNG of the left image, and depth with its standard deviation (m), [h, w]; none of a LiDAR."""
        left = self._read(parts[self.left])
        if self.settings.depth == "stereo":
            return self.frames.frame(left, self._read(parts[self.right]), self.where)
        color = self.rig.rectify_left(self.frames.sized(decoded(left, self.where), self.where))
        return encode_png(color), None, None

    def _sweep(self, parts: Mapping[str, Entry], at_ns: int) -> Array:
        """The points of a frame as of its time; none where it has no sweep."""
        entry = parts.get(self.points)
        if entry is None:
            return np.zeros((0, 3))
        sweep = self._read(entry, UnusableSweep)
        return self.lidar.points(sweep, entry.header_ns(), at_ns, f"{self.log.name}: {self.points}")

    def _read(self, entry: Entry, kind: type[UnusableImage] = UnusableImage) -> Any:
        """A message; an error of this kind if it is none."""
        try:
            return entry.read()
        except InvalidMessage as error:
            self.log.invalid.add(entry, error)
            raise kind(str(error)) from error

    def _check_rows(self) -> dict[str, Any]:
        """The test of the rectification on some pairs."""
        eyes = [{t: g[t] for t in (self.left, self.right)} for g in self.groups if self.right in g]
        chosen = [eyes[k] for k in sorted(spread(len(eyes), ROW_PAIRS))] if eyes else []
        found = gathered(self.log, chosen, lambda entry: entry.header_ns())
        return self.frames.check_rows(self._pairs(found), self.where)

    def _pairs(self, groups: Iterable[Mapping[str, Entry]]) -> Iterator[tuple[Any, Any]]:
        """Left and right images of groups without those that are none; an error if all are."""
        errors, sound = list[UnusableImage](), False
        for parts in groups:
            try:
                pair = self._read(parts[self.left]), self._read(parts[self.right])
            except UnusableImage as error:
                errors.append(error)
                continue
            sound = True
            yield pair
        if errors and not sound:
            self.log.invalid.check(self._used)
            raise errors[0]
