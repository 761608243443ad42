"""Writes the logs of one robot: what its sensors measured, and apart from it the ground truth."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.found_regions import FoundRegions
from duagc.converters.layouts.sigma_units import SIGMA_SCALE_M, sigma_units
from duagc.converters.layouts.sound_camera import check_camera
from duagc.converters.layouts.sound_frame import check_color, check_pose, check_sigma, check_stamp
from duagc.converters.layouts.validity import mask_of_user
from duagc.converters.truth_writer import TruthWriter
from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, seen_by_source
from duagc.pipeline.recording import DEPTH_SCALE_KEY, RANGE_SIGMA_KEY, LogWriter
from duagc.pipeline.recording.copies import image_digest
from duagc.schemas import topics


class RobotWriter:
    """Writes the logs of one robot into the folder of a recording; a context manager.

    Frames and messages of other sensors are appended in the order of their times, all together. `summary` is, after a
    clean exit, what `recording.json` says about the robot: plain numbers and text.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        camera: PinholeCamera,
        depth_scale: float,
        *,
        sensors: Mapping[str, str] | None = None,
        find_regions: bool = True,
    ) -> None:
        """Check the name, camera and unit of depth; the log is opened when the context is entered.

        Args:
            folder: `RecordingWriter.folder`.
            name: of the robot: lower-case letters, digits, underscores.
            camera: of color and depth alike.
            depth_scale: meters per unit of the depth images.
            sensors: what is known about the sensors, for example {"depth_noise": "none"}; kept in the log's
                metadata. `rolling_shutter_s` and `depth_rolling_shutter_s` say how long images are read
                (`recording.rolling_shutter`).
            find_regions: leave out regions that do not show the scene: large ones at the border that are black in all
                images, as a vignette is, or the robot itself; and what is drawn over all images.
        """
        if not re.fullmatch(topics.ROBOT_NAME, name):
            raise DuagError(f"robot {name!r}: expected lower-case letters, digits and underscores")
        check_camera(camera, f"robot {name}")
        if not (math.isfinite(depth_scale) and depth_scale > 0):
            raise DuagError(f"robot {name}: a unit of depth is {depth_scale} m, expected a positive number")
        self.folder, self.name, self.camera, self.depth_scale = Path(folder), name, camera, float(depth_scale)
        self.sensors = dict(sensors or {})
        self.summary: dict[str, Any] = {}
        self._files = ExitStack()
        self._log = LogWriter(self.folder / f"{name}.mcap", name, self.sensors)
        self._truth = TruthWriter(self.folder, name, self.depth_scale, self._files)
        self._has_depth = self._has_sigma = False
        self._measures = False  # whether any depth or point says something
        self._valid = mask_of_user(name, camera.width, camera.height)
        self._regions = FoundRegions() if find_regions else None
        self._lens: Lens | None = None
        self._depth_camera: PinholeCamera | None = None  # of its own
        self._colors: set[int] = set()  # digests of the color images
        self._shares: dict[str, float] = {}  # of the pixels that were found to show something else
        # topic of a sensor's pose in the camera that is still to be written
        self._sensors: dict[str, NDArray[np.float64]] = {}
        self._stamps: list[int] = []

    def __enter__(self) -> RobotWriter:
        self._files.enter_context(self._log)
        return self

    def set_valid(self, valid: NDArray[np.bool_] | None) -> None:
        """Say which pixels of all images show the scene, before the first frame; what is said before holds too.

        Args:
            valid: bool [H, W]; None: all do.
        """
        if valid is None:
            return
        if self._stamps:
            raise ValueError(f"robot {self.name}: the mask comes after the first frame")
        self._check_size(valid)
        self._valid = valid if self._valid is None else self._valid & valid

    def set_lens(self, lens: Lens | None) -> None:
        """Say with which lens color is taken, before the first frame; pixels that it does not see are left out.

        Args:
            lens: of images that are written as they are, as large as the camera's; None: they are the camera's.
        """
        if lens is None:
            return
        maps, self._lens = lens.maps(self.camera), lens
        self.set_valid(seen_by_source(maps, lens.source.width, lens.source.height))
        if self._regions is not None:
            self._regions = FoundRegions(maps)

    def _leave_out_found(self) -> None:
        """Write another mask of all images, at the end, where a region was found that does not show the scene."""
        if self._regions is None or not self._stamps:
            return
        for name, shown in (found := self._regions.result(self._valid)).items():
            self._shares[name] = float(np.mean(~shown))
            self._valid = shown if self._valid is None else self._valid & shown
        if found:
            self._write_valid(self._stamps[-1])

    def _write_valid(self, stamp_ns: int) -> None:
        """Write the mask of all images where it leaves pixels out; readings may come after the last of them."""
        if self._valid is None or self._valid.all():
            self._valid = None
            return
        if not self._valid.any():
            raise DuagError(f"robot {self.name}: the masks leave no pixel, expected some that show the scene")
        message = messages.pack_valid(stamp_ns, self.name, self._valid)
        last_ns = max(stamp_ns, self._log.last_log_time_ns)
        self._log.write(topics.VALID.of(self.name), message, last_ns, stamp_ns)

    def add_frame(
        self,
        stamp_ns: int,
        color: bytes,
        color_format: str,
        depth: NDArray[np.uint16] | None,
        *,
        T_world_camera: NDArray[np.float64] | None = None,
        exact_depth: NDArray[np.uint16] | None = None,
        mask: NDArray[np.bool_] | None = None,
        true_mask: NDArray[np.bool_] | None = None,
        depth_sigma_m: NDArray[np.floating] | None = None,
        depth_stamp_ns: int | None = None,
    ) -> None:
        """Append one frame.

        Args:
            stamp_ns: time of the recording, increasing.
            color: the encoded color image as it is, of the lens if there is one.
            color_format: "jpeg" or "png".
            depth: uint16 [H, W] in units of depth_scale along z, registered to color, 0 = none. None: the
                depth is that of another camera or a LiDAR.
            T_world_camera: true pose [4, 4] of the color camera in the world that all robots share, where
                known.
            exact_depth: like depth, without noise, where that differs and is known.
            mask: bool [H, W], False where a pixel must not be used (a moving object); None = all may.
            true_mask: the same for the ground truth, where the log is not to have it.
            depth_sigma_m: [H, W], standard deviation of the depth in meters, where it is known pixel by
                pixel: then with every frame. It is kept to 3 %, and from 0.1 mm to 6.5 m.
            depth_stamp_ns: time of the depth, one that no other depth has; None: that of the color.
        Raises:
            ValueError: an image is none or has another size than the camera, the time is no whole number or does not
                increase, or a standard deviation is negative or not finite.
            DuagError: the true pose is no rigid motion, or 1e9 m away.
        """
        for image in (depth, mask, true_mask, depth_sigma_m, exact_depth):
            if image is not None:
                self._check_size(image)
        name, where = self.name, f"robot {self.name}: frame at {stamp_ns} ns"
        for time_ns in (stamp_ns, stamp_ns if depth_stamp_ns is None else depth_stamp_ns):
            check_stamp(time_ns, where)
        if self._stamps and stamp_ns <= self._stamps[-1]:
            raise ValueError(f"frame at {stamp_ns} ns comes after one at {self._stamps[-1]} ns")
        source = self.camera if self._lens is None else self._lens.source
        check_color(color, color_format, (source.width, source.height), where)
        if depth is not None and depth_sigma_m is not None:
            check_sigma(depth_sigma_m, depth, where)
        if T_world_camera is not None:
            T_world_camera = np.asarray(T_world_camera)
            check_pose(T_world_camera, f"robot {self.name}: the true pose at {stamp_ns} ns")
        if not self._stamps:
            calibration = messages.pack_calibration(stamp_ns, name, self.camera, self._lens)
            self._log.write(topics.CALIBRATION.of(name), calibration, stamp_ns)
            self._write_valid(stamp_ns)
        index = len(self._stamps)
        self._colors.add(image_digest(color))
        if self._regions is not None:
            self._regions.add(index, stamp_ns, color, depth)
        self._stamps.append(int(stamp_ns))
        image = messages.pack_color(stamp_ns, name, color, color_format)
        self._log.write(topics.COLOR.of(name), image, stamp_ns)
        if depth is not None:
            taken_ns = stamp_ns if depth_stamp_ns is None else max(int(depth_stamp_ns), 0)
            self._add_registered_depth(stamp_ns, taken_ns, depth, depth_sigma_m)
        if mask is not None:
            self._log.write(topics.MASK.of(name), messages.pack_mask(stamp_ns, name, mask), stamp_ns)
        self._truth.add(stamp_ns, T_world_camera, exact_depth, true_mask)

    def _add_registered_depth(
        self,
        stamp_ns: int,
        taken_ns: int,
        depth: NDArray[np.uint16],
        sigma_m: NDArray[np.floating] | None,
    ) -> None:
        """Write depth that was taken at a time and is logged with the color of another."""
        topic = topics.DEPTH.of(self.name)
        if not self._has_depth:
            self._log.channel(topic, topics.DEPTH.schema, {DEPTH_SCALE_KEY: repr(self.depth_scale)})
            self._has_depth = True
        self._measures = self._measures or bool(depth.any())
        self._log.write(topic, messages.pack_depth(taken_ns, self.name, depth), stamp_ns, taken_ns)
        if sigma_m is not None:
            self._add_sigma(stamp_ns, taken_ns, depth, sigma_m)

    def _add_sigma(
        self, stamp_ns: int, taken_ns: int, depth: NDArray[np.uint16], sigma_m: NDArray[np.floating]
    ) -> None:
        topic = topics.DEPTH_SIGMA.of(self.name)
        if not self._has_sigma:
            self._log.channel(topic, topics.DEPTH_SIGMA.schema, {DEPTH_SCALE_KEY: repr(SIGMA_SCALE_M)})
            self._has_sigma = True
        raw = sigma_units(sigma_m, depth)
        self._log.write(topic, messages.pack_depth(taken_ns, self.name, raw), stamp_ns, taken_ns)

    def set_depth_camera(
        self, camera: PinholeCamera, T_camera_depth: NDArray[np.float64], depth_scale: float
    ) -> None:
        """Announce a depth camera of its own.

        Args:
            camera: its intrinsics.
            T_camera_depth: its pose [4, 4] in the color camera.
            depth_scale: meters per unit of its images.
        """
        self._depth_camera = camera
        self._sensors[topics.RAW_DEPTH_TRANSFORM.of(self.name)] = T_camera_depth
        text = {DEPTH_SCALE_KEY: repr(float(depth_scale))}
        self._log.channel(topics.RAW_DEPTH.of(self.name), topics.RAW_DEPTH.schema, text)

    def add_depth(self, stamp_ns: int, depth: NDArray[np.uint16]) -> None:
        """Append an image of the depth camera, not registered to color.

        Args:
            stamp_ns: its time, not before that of the message before.
            depth: uint16 [h, w] along the depth camera's z, 0 = none.
        """
        camera = self._depth_camera
        if camera is None or depth.shape != (camera.height, camera.width):
            raise ValueError(f"an image is {depth.shape}, expected that of a depth camera: {camera}")
        if self._announce(topics.RAW_DEPTH_TRANSFORM, stamp_ns, "depth_camera"):
            calibration = messages.pack_calibration(stamp_ns, self.name, camera)
            self._log.write(topics.RAW_DEPTH_CALIBRATION.of(self.name), calibration, stamp_ns)
        self._measures = self._measures or bool(depth.any())
        message = messages.pack_depth(stamp_ns, self.name, depth)
        self._log.write(topics.RAW_DEPTH.of(self.name), message, stamp_ns)

    def set_lidar(self, T_camera_lidar: NDArray[np.float64], range_sigma_m: float | None) -> None:
        """Announce a LiDAR.

        Args:
            T_camera_lidar: its pose [4, 4] in the color camera.
            range_sigma_m: standard deviation of its ranges, None if not known.
        """
        self._sensors[topics.LIDAR_TRANSFORM.of(self.name)] = T_camera_lidar
        text = {} if range_sigma_m is None else {RANGE_SIGMA_KEY: repr(float(range_sigma_m))}
        self._log.channel(topics.LIDAR.of(self.name), topics.LIDAR.schema, text)

    def add_points(self, stamp_ns: int, points_lidar: NDArray[np.floating]) -> None:
        """Append a sweep of the LiDAR.

        Args:
            stamp_ns: its time, at which all points were measured.
            points_lidar: [n, 3], m, LiDAR frame.
        """
        self._measures = self._measures or len(points_lidar) > 0
        self._announce(topics.LIDAR_TRANSFORM, stamp_ns, "lidar")
        points = messages.pack_points(stamp_ns, f"{self.name}/lidar", points_lidar)
        self._log.write(topics.LIDAR.of(self.name), points, stamp_ns)

    def set_imu(self, T_camera_imu: NDArray[np.float64]) -> None:
        """Announce an IMU.

        Args:
            T_camera_imu: its pose [4, 4] in the color camera.
        """
        self._sensors[topics.IMU_TRANSFORM.of(self.name)] = T_camera_imu

    def add_imu(
        self, stamp_ns: int, rates_rad_s: NDArray[np.float64], accelerations_m_s2: NDArray[np.float64]
    ) -> None:
        """Append a reading of the IMU.

        Args:
            stamp_ns: its time.
            rates_rad_s: angular velocity [3], IMU frame.
            accelerations_m_s2: acceleration with gravity [3], IMU frame.
        """
        self._announce(topics.IMU_TRANSFORM, stamp_ns, "imu")
        reading = messages.pack_imu(stamp_ns, self.name, rates_rad_s, accelerations_m_s2)
        self._log.write(topics.IMU.of(self.name), reading, stamp_ns)

    def add_odometry(self, stamp_ns: int, T_odometry_camera: NDArray[np.float64]) -> None:
        """Append a pose of the camera by another odometry.

        Args:
            stamp_ns: its time.
            T_odometry_camera: [4, 4], in a frame of that odometry.
        """
        pose = messages.pack_pose_in_frame(stamp_ns, f"{self.name}/odometry_prior", T_odometry_camera)
        self._log.write(topics.ODOMETRY_PRIOR.of(self.name), pose, stamp_ns)

    def _announce(self, transform: topics.Topic, stamp_ns: int, sensor: str) -> bool:
        """Write the pose of a sensor in the camera before its first message; whether this was that."""
        T_camera_sensor = self._sensors.pop(transform.of(self.name), None)
        if T_camera_sensor is None:
            return False
        frames = messages.camera_frame(self.name), f"{self.name}/{sensor}"
        message = messages.pack_transform(stamp_ns, *frames, T_camera_sensor)
        self._log.write(transform.of(self.name), message, stamp_ns)
        return True

    def _check_size(self, image: NDArray[Any]) -> None:
        if image.shape != (self.camera.height, self.camera.width):
            raise ValueError(f"an image is {image.shape}, expected {(self.camera.height, self.camera.width)}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._leave_out_found()
        except BaseException:
            self._files.__exit__(*sys.exc_info())
            raise
        self._files.__exit__(kind, error, trace)
        if kind is None:
            self.summary = self._summarize()

    def _summarize(self) -> dict[str, Any]:
        if not self._stamps:
            raise DuagError(f"robot {self.name}: found no frame, expected at least one")
        gaps = np.diff(self._stamps) if len(self._stamps) > 1 else np.zeros(1, np.int64)
        summary: dict[str, Any] = {
            "robot": self.name,
            "log": self._log.path.name,
            "groundtruth": next(iter(self._truth.digests), None),
            "frames": len(self._stamps),
            "start_ns": self._stamps[0],
            "end_ns": self._stamps[-1],
            "longest_interval_ns": int(gaps.max()),
            "camera": asdict(self.camera),
            "depth_scale_m": self.depth_scale,
            "sensors": self.sensors,
            "digests": {self._log.path.name: self._log.digest, **self._truth.digests},
            "path": self._truth.path,
            "color_digests": sorted(self._colors),
            "measures": self._measures,
        }
        if self._valid is not None:
            summary["masked_share"] = float(np.mean(~self._valid))
        summary |= {f"{name}_share": share for name, share in self._shares.items()}
        return summary
