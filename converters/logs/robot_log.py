"""One robot's RGB-D camera in a log: which topics, which cameras, and which messages belong together."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, partial
from typing import Any

import numpy as np

from duagc.converters.layouts.ros_camera import RosCamera
from duagc.converters.layouts.ros_images import UnusableImage, is_integer_depth, size_of
from duagc.converters.logs.cameras import (
    CameraWatch,
    as_stated,
    is_own_depth,
    is_rectified,
    stated,
    stated_camera,
)
from duagc.converters.logs.choice import Chooser
from duagc.converters.logs.clocks import Drift, RobotClock, drift
from duagc.converters.logs.derived import Derived, Picture, Stereo, some_pairs, stereo_of, sweeps_of
from duagc.converters.logs.entries import Entry, InvalidMessage, time_of
from duagc.converters.logs.files import Log, is_own_log
from duagc.converters.logs.frames import Transforms, frame_name
from duagc.converters.logs.gather import gathered
from duagc.converters.logs.image_times import ImageTimes, look_through
from duagc.converters.logs.motion import CameraPoses, Imu, MotionReader
from duagc.converters.logs.options import LogOptions
from duagc.converters.logs.registration import ImageTopic, check_infos, check_samples, extrinsics
from duagc.converters.logs.stamps import clock_words, paired
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.lens import Lens, Maps
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.messages.parts import NANOSECONDS

HALF_TURN_S = 0.055  # of a LiDAR with 10 turns a second
OUT_SCALE = 0.0005  # meters per unit of depth that was registered or came as floats


class RobotLog:
    """Color, depth, cameras and true poses of one robot.

    Raises (on construction):
        DuagError: a topic is missing or more than one could be meant; a camera or an extrinsic is unknown.
    """

    def __init__(self, log: Log, namespace: str, settings: LogOptions) -> None:
        """Choose the robot's topics, and read its cameras and extrinsics.

        Args:
            log: open; it must stay so.
            namespace: of the robot's topics; empty: the whole log.
            settings: options of the conversion.
        """
        self.log, self.namespace, self.settings = log, namespace.rstrip("/"), settings
        self.name = log.name
        self.warnings: list[str] = []
        # added to all times when they are written
        self.shift_ns = round(settings.clock_offset_s * NANOSECONDS)
        self._rate, self._origin_ns = 0.0, 0  # of the clock, see `settle_drift`
        # by topic of a CameraInfo: the camera of its first message, and whether its images are rectified
        self._cameras: dict[str, tuple[RosCamera, bool]] = {}
        self._own = any(is_own_log(part.path) for part in log.parts)
        self._is_rectified = partial(is_rectified, own=self._own)
        self.transforms = Transforms(log, self.namespace, self.warnings)
        self._choose()

    def _choose(self) -> None:
        s = self.settings
        chooser = Chooser(self.log, self.namespace, s.model_dump())
        if not chooser.images:
            where = f" below {self.namespace}" if self.namespace else ""
            raise DuagError(
                f"{self.name}: found no topic of images{where}, expected color and depth{chooser.unread}"
            )
        self.depth = chooser.depth().required(self.log, "depth")
        self.color = chooser.color().required(self.log, "color")
        self.settings = s = as_stated(self.log, self.depth, s, own=self._own)
        color = self._view(self.color, "color_info", chooser)
        self.color_camera = color.camera
        self._motion = MotionReader(
            self.log, s, self.transforms, self.color_camera.frame_id, time_ns=self.time_ns
        )
        self.T_color_depth: Array | None = None
        self._has_own_info = False  # depth has, not that of color
        self.derived = self._derived(chooser, color) if s.depth_from != "image" else None
        if self.derived:
            self.camera, self.depth_scale = self.derived.camera, self.derived.scale
            return
        self.camera = self.color_camera.camera
        depth = self._view(self.depth, "depth_info", chooser)
        check_infos(color, depth, s, self.name)
        self.depth_camera, self._has_own_info = depth.camera, depth.info not in ("", color.info)
        self.T_color_depth = extrinsics(self.log, color, depth, self.transforms, settings=s)
        sensor = self.depth_camera.camera
        if self._is_depth_rectified:
            self.camera = sensor
        if self.T_color_depth is not None:
            check_samples(self.camera, sensor, f"{self.name}: pixels of {self.color}", self.depth)
        self.keeps_depth = is_integer_depth(chooser.images[self.depth]) and self.T_color_depth is None
        self.depth_scale = s.depth_scale if self.keeps_depth else OUT_SCALE

    def _derived(self, chooser: Chooser, color: ImageTopic) -> Derived:
        """Depth of a stereo pair or of a LiDAR."""
        s = self.settings
        if s.depth_from == "stereo":
            right = self._view(self.depth, "depth_info", chooser)
            check_infos(color, right, s, self.name)
            eyes = [(view.topic, view.info, view.camera) for view in (color, right)]
            return stereo_of(
                self.log,
                eyes[0],
                eyes[1],
                self._is_rectified(self.color),
                transforms=self.transforms,
                settings=s,
            )
        if s.max_difference_s == 0:
            self.settings = s.model_copy(update={"max_difference_s": HALF_TURN_S})
        motion = self.odometry.prior() if self.odometry else self.imu.prior() if self.imu else None
        camera = self.color, self.color_camera
        sweeps = sweeps_of(self.log, camera, self.depth, self.transforms, motion=motion, settings=s)
        self.warnings += sweeps.warnings
        return sweeps

    @cached_property
    def T_color_camera(self) -> Array:  # noqa: N802 (a transform)
        """Where the camera of the recording is in the frame of color: turned, if that is rectified, here or before."""
        T_frame_images = se3.inverse(self.color_camera.T_images_frame(f"{self.name}: camera of {self.color}"))
        if self.derived:
            return T_frame_images @ self.derived.T_color_camera
        turn = np.eye(3) if self.lens is None else self.lens.rotation()
        return T_frame_images @ se3.from_rotation_translation(turn, np.zeros(3))

    def depth_m(self, picture: Picture) -> Array:
        """Depth [h, w] of a picture in meters, 0 = none.

        Args:
            picture: of which the depth is wanted.
        """
        if self.derived:
            return self.derived.depth_m(picture)
        assert picture.depth is not None
        return np.asarray(picture.depth, dtype=np.float64) * self.depth_scale

    def check_rows(self) -> dict[str, Any]:
        """The test of the rectification of a stereo pair; nothing for other sources of depth."""
        if not isinstance(self.derived, Stereo):
            return {}
        pairs = {c: d for c, d in self.pairs.items() if d is not None}
        groups = [{self.color: c, self.depth: d} for c, d in some_pairs(pairs)]
        found = gathered(self.log, groups, self.time_ns)
        read = [(self._read(g[self.color]), self._read(g[self.depth])) for g in found]
        return self.derived.check([p for p in read if not any(isinstance(m, UnusableImage) for m in p)])

    def _view(self, topic: str, option: str, chooser: Chooser) -> ImageTopic:
        """An image topic with its camera: as the options state it, else by its CameraInfo."""
        image, where = chooser.images[topic], f"{self.name}: {topic}"
        frame = frame_name(image.header.frame_id)
        if text := stated(self.settings, option, bool(chooser.infos)):
            return ImageTopic(topic, frame, "", stated_camera(text, image, where))
        chosen = chooser.info(option, topic).required(self.log, option)
        remedy = f"or --set {option.removesuffix('_info')}_camera='fx fy cx cy'"
        try:
            camera = RosCamera.of(self.log.first(chosen), self._is_rectified(topic), f"{self.name}: {chosen}")
        except DuagError as error:
            raise DuagError(f"{error}, {remedy}") from error
        self._cameras[chosen] = (camera, self._is_rectified(topic))
        found = size_of(image, where)
        expected = camera.camera.width, camera.camera.height
        if found != expected:
            raise DuagError(
                f"{where} is {found[0]}x{found[1]}, expected {expected[0]}x{expected[1]} as in {chosen}, {remedy}"
            )
        return ImageTopic(topic, frame, chosen, camera)

    @cached_property
    def lens(self) -> Lens | None:
        """With which the color images were taken that the recording keeps; None: by its camera."""
        if not self.settings.undistort or isinstance(self.derived, Stereo):
            return None
        if self._is_depth_rectified:
            return self.color_camera.lens_of_rectified(f"{self.name}: camera of {self.color}")
        return self.color_camera.lens

    @cached_property
    def _is_depth_rectified(self) -> bool:
        """Whether depth is registered to color as it looks without distortion, while color is recorded with it."""
        if self.derived is not None or self.T_color_depth is not None or not self.settings.undistort:
            return False
        if is_own_depth(self.depth, self._own):
            return True
        stated_so = self._has_own_info and self.depth_camera.is_straight
        return (is_rectified(self.depth) or stated_so) and bool(self.color_camera.distortion)

    @property
    def valid(self) -> Mask | None:
        """Pixels of images that were resampled here that show the scene; None: all."""
        return None if self.derived is None else self.derived.valid

    @cached_property
    def depth_maps(self) -> Maps | None:
        """Where in the depth images every pixel of their pinhole lies; None if they need not be undistorted.

        Depth that is registered has the distortion of color, unless it is rectified or color is; that of another camera
        its own.
        """
        if self._is_depth_rectified:
            return None
        if self.T_color_depth is None and self._has_own_info and not self.color_camera.distortion:
            return self.depth_camera.maps(self.camera)
        if self.T_color_depth is not None:
            return self.depth_camera.maps()
        return None if self.lens is None else self.lens.maps(self.camera)

    # --- what moved

    @cached_property
    def imu(self) -> Imu | None:
        """What the IMU measured, in order of time."""
        self._seen  # noqa: B018 (looks through the log)
        return self._motion.imu()

    @cached_property
    def odometry(self) -> CameraPoses | None:
        """Poses of the color camera by another odometry."""
        self._seen  # noqa: B018
        return self._motion.odometry()

    @cached_property
    def truth(self) -> CameraPoses | None:
        """True poses of the color camera, for evaluation only."""
        self._seen  # noqa: B018
        return self._motion.truth()

    @property
    def truth_world(self) -> str:
        """Frame in which a topic states the true poses; empty: nothing does."""
        self._seen  # noqa: B018
        return self._motion.truth_world

    @cached_property
    def begin_ns(self) -> int:
        """Time of the log of the first image, of color or of depth that keeps its time."""
        depths = [depth for color, depth in self.pairs.items() if self.depth_stamp_ns(color) is not None]
        return min([*self.pairs, *(depth for depth in depths if depth is not None)])

    def true_pose(self, stamp_ns: int | None) -> Array | None:
        """T_world_camera [4, 4] of the camera of the recording at a time of the log; None where it is not known.

        Args:
            stamp_ns: time of the log; None: not known.
        """
        if self.truth is None or stamp_ns is None:
            return None
        T = self.truth.at(stamp_ns, self.settings.max_pose_gap_s)
        return None if T is None else T @ self.T_color_camera

    # --- which messages

    def time_ns(self, entry: Entry) -> int:
        """The time of a message by the clock that the options choose.

        Args:
            entry: the message.
        """
        return time_of(entry, self.settings.time_source, self.name)

    @cached_property
    def _seen(self) -> ImageTimes:
        """Times of the images. Looks through the log once, for all that is to be known before the images."""
        cameras = CameraWatch(self._cameras, self.name)
        infos = [(topic, cameras.see) for topic in self._cameras]
        images = self.color, self.depth
        seen = look_through(self.log, images, self._motion.take, infos, time_ns=self.time_ns)
        self.log.invalid.check(self._used)
        for topic, times in seen.by_topic.items():  # messages of one time of recording were counted as one
            if not times and (error := self.log.invalid.first(topic)):
                raise error
        if self.settings.time_source == "header":
            least_ns = dict(seen.least_delay_ns)
            if self.settings.truth in least_ns:
                least_ns[self.settings.truth] -= round(self.settings.truth_offset_s * NANOSECONDS)
            self.warnings += clock_words(least_ns, self.color)
        return seen

    @cached_property
    def drift(self) -> Drift | None:
        """How the clocks of headers and recorder differ in rate; None if that is not known, or was not asked for."""
        if self.settings.time_source != "header":
            return None
        return drift(self._seen.stamps_ns, self._seen.delays_ns)

    def settle_drift(self) -> None:
        """Bring the times of the headers to the rate of the recorder's clock, if that matters and was asked for."""
        if self.drift is None or not self.drift.matters:
            return
        if self.settings.clocks != "estimated":
            self.warnings.append(f"{self.drift.words()}; expected one rate, or --set clocks=estimated")
            return
        self.warnings.append(f"{self.drift.words()}; taken out")
        self._rate, self._origin_ns = self.drift.rate, int(self._seen.stamps_ns.min())

    def written_ns(self, stamp_ns: int) -> int:
        """The time of the recording for a time of the log: by the robot's clock as it was settled.

        Args:
            stamp_ns: time of the log.
        """
        return stamp_ns + self.shift_ns + round(self._rate * (stamp_ns - self._origin_ns))

    @cached_property
    def pairs(self) -> dict[int, int | None]:
        """Time of a color image -> time of its depth image; None: none is near, and the camera is followed by color."""
        topics, options = (self.color, self.depth), self.settings
        pairs = paired(self.name, topics, self._seen.by_topic, options, warnings=self.warnings)
        if min(pairs) + self.shift_ns < 0:
            raise DuagError(f"{self.name}: clock_offset_s = {self.settings.clock_offset_s} leads before 1970")
        return pairs

    def depth_stamp_ns(self, stamp_ns: int) -> int | None:
        """The time of the recording for the depth of a color image; None: there is none, or it is that of the color.

        Args:
            stamp_ns: time of the color image in the log.
        """
        depth_ns = self.pairs[stamp_ns]
        if depth_ns is None or not self.settings.keeps_depth_time:
            return None
        return self.written_ns(depth_ns)

    def clock(self, robot: str) -> RobotClock:
        """What the times of the images say about the robot's clock.

        Args:
            robot: its name in the recording.
        """
        first, last, seen = min(self.pairs), max(self.pairs), self._seen
        gained_ns = np.rint(self._rate * (seen.stamps_ns - self._origin_ns)).astype(np.int64)
        header = self.settings.time_source == "header"
        files = frozenset(part.path for part in self.log.parts if self.color in part.topics)
        return RobotClock(
            robot,
            self.log,
            files,
            self.namespace,
            delays_ns=seen.delays_ns - gained_ns,
            start_ns=first,
            end_ns=last,
            header=header,
        )

    def frames(self) -> Iterator[tuple[int, Any, Any]]:
        """Time, color and depth message (if any) of every frame, in order of time; holds no more than it must.

        An `UnusableImage` stands for a message that is none.
        """
        order = sorted(self.pairs)
        wanted = [{self.color: time, self.depth: self.pairs[time]} for time in order]
        groups = [{topic: time for topic, time in group.items() if time is not None} for group in wanted]
        # to the end of the log, so that all its checksums are compared
        for index, found in enumerate(gathered(self.log, groups, self.time_ns)):
            depth = found.get(self.depth)
            yield order[index], self._read(found[self.color]), None if depth is None else self._read(depth)

    def _read(self, entry: Entry) -> Any:
        """A message; why it is not usable, if it is none."""
        try:
            return entry.read()
        except InvalidMessage as error:
            self.log.invalid.add(entry, error)
            return UnusableImage(str(error))

    def invalid_words(self) -> list[str]:
        """What to warn of: messages of the robot's topics that are none.

        Raises:
            DuagError: most messages of a topic are such.
        """
        self.log.invalid.check(self._used)
        return self.log.invalid.words(self._used)

    @property
    def _used(self) -> set[str]:
        """Topics that are converted, those of transforms apart."""
        return {self.color, self.depth, *self._cameras, *(topic for topic, _ in self._motion.take)}

    def sensors(self) -> dict[str, str]:
        """What the log says about its source."""
        moved = "registered to color by the converter" if self.T_color_depth is not None else "registered"
        moved = self.derived.words if self.derived else moved
        return {"color_topic": self.color, "depth_topic": self.depth, "depth": moved} | self.settings.notes
