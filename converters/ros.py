"""Bags of ROS 1 and ROS 2: colour and depth of RGB-D cameras, chosen by type and name of their topics.

SRC is a `.bag`, a `.db3`, a ROS 2 `.mcap` or a folder of `ros2 bag`, or a folder with one of these per robot. Images
are paired by the stamps of their headers. Colour is undistorted, and depth that another camera saw is registered to it,
with extrinsics from `/tf_static` or given ones.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from converters.base import NANOSECONDS, RecordingWriter, RobotWriter, robot_names
from converters.image_files import options_of
from converters.ros_images import RosCamera, color_bytes, depth_m, is_depth
from converters.self_check import ReprojectionCheck
from converters.tum_layout import AssociationOptions, Listed, associate
from pipeline import numeric
from pipeline.errors import DuagError
from pipeline.geometry import se3
from pipeline.progress import track
from pipeline.recording.register_depth import register_depth

Array = NDArray[np.float64]
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
BAGS = (".bag", ".db3", ".mcap")
REGISTERED = ("aligned_depth_to_color", "depth_registered", "registered", "aligned")
RECTIFIED = ("image_rect", "image_rect_color", "rect")
OUT_SCALE = 0.0005  # metres per unit of depth that was registered or came as floats


class Options(AssociationOptions):
    """Topics, times and cameras; whatever is empty is found by type and name."""

    color: str = ""
    """Topic of the colour images."""
    depth: str = ""
    """Topic of the depth images."""
    color_info: str = ""
    """Topic of the colour camera's CameraInfo."""
    depth_info: str = ""
    """Topic of the depth camera's CameraInfo."""
    truth: str = ""
    """Topic of true poses (Odometry, PoseStamped, TransformStamped), for evaluation; none if empty."""
    truth_frame: str = ""
    """Frame that the true poses are of; by default what the message says, which /tf_static must tie to the camera."""
    namespaces: str = ""
    """Namespaces of several robots in one bag, separated by commas, for example "/acl_jackal,/sparkal1"."""
    registered: Literal["auto", "yes", "no"] = "auto"
    """Whether depth is seen from the colour camera; auto: by name of the topic, frame and camera."""
    T_color_depth: str = ""
    """Extrinsics "x y z qw qx qy qz" (m) of a depth camera that /tf_static does not know; x_color = T x_depth."""
    depth_scale: float = Field(0.001, gt=0)
    """Metres per unit of 16-bit depth."""
    time_source: Literal["header", "log"] = "header"
    """Times of the headers, or those of recording."""
    undistort: bool = True
    """Take the distortion out of colour."""


def convert(src: Path, out: Path, robots: int = 0, force: bool = False, **options: Any) -> None:
    """Convert bags, one robot per bag or per namespace.

    Args:
        robots: how many there must be; 0: as many as are found.
    Raises:
        DuagError: names bag and topic, what was found and what was expected.
    """
    numeric.settle_opencv()
    settings = options_of(Options, options, "ros")
    sources = _sources(src, settings)
    if robots and robots != len(sources):
        raise DuagError(f"{src}: found {len(sources)} robots, expected --robots {len(sources)}")
    parameters = {"robots": len(sources), **settings.model_dump()}
    source = {"dataset": "ros", "folder": src.resolve().name, "parts": [s.label for s in sources]}
    with RecordingWriter(out, "", source, "ros", parameters, force) as recording:
        for name, part in zip(robot_names(len(sources)), sources, strict=True):
            with Bag(part.path, part.namespace, settings) as bag:
                sensors = {"part": part.label, **bag.sensors()}
                with recording.robot(name, bag.color_camera.camera, bag.depth_scale, sensors) as robot:
                    recording.checks[name] = _write(robot, bag)
                recording.warnings += [f"{name}: {text}" for text in bag.warnings]


@dataclass(frozen=True)
class _Source:
    path: Path
    namespace: str
    label: str


def _sources(src: Path, settings: Options) -> list[_Source]:
    """Bag and namespace of every robot."""
    if not src.exists():
        raise DuagError(f"{src}: no such file or folder, expected a bag")
    if src.is_file() and src.suffix not in BAGS:
        raise DuagError(f"{src}: is no bag, expected one of {', '.join(BAGS)}")
    bags = [src]
    if src.is_dir() and not (src / "metadata.yaml").is_file():
        bags = [p for p in sorted(src.iterdir()) if p.suffix in BAGS or (p / "metadata.yaml").is_file()]
        if not bags:
            raise DuagError(f"{src}: found no bag, expected one for each robot")
    spaces = [text.strip() for text in settings.namespaces.split(",") if text.strip()]
    if spaces and len(bags) > 1:
        raise DuagError(f"{src}: namespaces and {len(bags)} bags, expected namespaces of one bag")
    if spaces:
        return [_Source(bags[0], space, space) for space in spaces]
    return [_Source(bag, "", bag.name if len(bags) > 1 else "") for bag in bags]


class Bag:
    """One robot's camera in a bag: which topics, which cameras, and which messages belong together."""

    def __init__(self, path: Path, namespace: str, settings: Options) -> None:
        self.path, self.namespace, self.settings = path, namespace.rstrip("/"), settings
        self.warnings: list[str] = []
        self._open = ExitStack()

    def __enter__(self) -> Bag:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        try:
            reader = AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self.reader = self._open.enter_context(reader)
        except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
            raise DuagError(
                f"{self.path}: {type(error).__name__} {error}, expected a bag of ROS 1 or ROS 2"
            ) from error
        try:
            self._choose()
        except BaseException:
            self._open.close()
            raise
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)

    # --- which topics

    def _topics(self, types: Sequence[str]) -> list[str]:
        """Topics of these types in the robot's namespace that have messages."""
        return sorted(
            {
                c.topic
                for c in self.reader.connections
                if c.msgtype in types and c.msgcount and c.topic.startswith(f"{self.namespace}/")
            }
        )

    def _messages(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording and message, in order of recording."""
        connections = [c for c in self.reader.connections if c.topic in topics]
        for connection, log_ns, raw in self.reader.messages(connections=connections) if connections else ():
            yield connection.topic, log_ns, self._read(connection, raw)

    def _read(self, connection: Any, raw: bytes) -> Any:
        try:
            return self.reader.deserialize(raw, connection.msgtype)
        except (AssertionError, ValueError, IndexError, KeyError, struct.error, UnicodeDecodeError) as error:
            raise DuagError(
                f"{self.path}: {connection.topic} holds {len(raw)} bytes that are no {connection.msgtype} "
                f"({type(error).__name__})"
            ) from error

    def _first(self, topic: str) -> Any:
        return next(self._messages(topic))[2]

    def _choose(self) -> None:
        s = self.settings
        images = {topic: self._first(topic) for topic in self._topics(IMAGE_TYPES)}
        if not images:
            where = f" below {self.namespace}" if self.namespace else ""
            raise DuagError(f"{self.path}: found no topic of images{where}, expected colour and depth")
        depths = [t for t, m in images.items() if is_depth(m)]
        colors = [t for t, m in images.items() if not is_depth(m) and "depth" not in t.lower()]
        self.depth = self._one("depth", s.depth, depths, REGISTERED)
        self.color = self._one("color", s.color, colors, ("color", "rgb"))
        self.color_camera = self._camera(self.color, s.color_info, "color_info", images[self.color])
        self.depth_camera = self._camera(self.depth, s.depth_info, "depth_info", images[self.depth])
        self._T_static = self._static()
        self.T_color_depth = self._extrinsics()
        raw16 = not hasattr(images[self.depth], "encoding") or images[self.depth].encoding != "32FC1"
        kept = raw16 and self.T_color_depth is None and self.color_maps is None
        self.depth_scale = s.depth_scale if kept else OUT_SCALE
        self.truth = self._truth() if s.truth else None

    def _one(self, kind: str, wanted: str, found: list[str], hints: tuple[str, ...]) -> str:
        """The topic to use: the wanted one, the only one, or the only one with the first hint that decides."""
        if wanted:
            if wanted not in self._topics(IMAGE_TYPES):
                names = ", ".join(self._topics(IMAGE_TYPES)) or "none"
                raise DuagError(f"{self.path}: {kind} topic {wanted} not found, expected one of {names}")
            return wanted
        for hint in ("", *hints):
            some = [topic for topic in found if hint in topic.lower()]
            if len(some) == 1:
                return some[0]
        names = ", ".join(found) or "none"
        raise DuagError(
            f"{self.path}: {kind} images on {names}; expected --set {kind}=TOPIC with one of them"
        )

    def _camera(self, topic: str, wanted: str, option: str, image: Any) -> RosCamera:
        """Camera of an image topic, from the CameraInfo whose name shares most with it."""
        infos = self._topics((INFO_TYPE,))
        if wanted:
            if wanted not in infos:
                raise DuagError(
                    f"{self.path}: {option} {wanted} not found, expected one of {', '.join(infos) or 'none'}"
                )
            chosen = wanted
        else:
            shared = {info: _shared_parts(topic, info) for info in infos}
            best = [info for info in infos if shared[info] == max(shared.values())]
            if len(best) != 1 or shared[best[0]] == 0:
                raise DuagError(
                    f"{self.path}: {topic} has CameraInfo on {', '.join(infos) or 'no topic'}; expected "
                    f"--set {option}=TOPIC"
                )
            chosen = best[0]
        name = PurePosixPath(topic.removesuffix("/compressedDepth").removesuffix("/compressed")).name
        rectified = name.startswith(RECTIFIED)
        camera = RosCamera.of(self._first(chosen), rectified, f"{self.path}: {chosen}")
        if hasattr(image, "width") and (image.width, image.height) != (
            camera.camera.width,
            camera.camera.height,
        ):
            raise DuagError(
                f"{self.path}: {topic} is {image.width}x{image.height}, expected {camera.camera.width}x"
                f"{camera.camera.height} as in {chosen}"
            )
        return camera

    @property
    def color_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Where in the colour images every pixel of the recording's camera lies."""
        return self.color_camera.maps() if self.settings.undistort else None

    # --- where the cameras are

    def _static(self) -> dict[tuple[str, str], Array]:
        """(parent, child) -> T_parent_child of every static transform."""
        topics = [t for t in self._topics_anywhere(TF_TYPES) if t.endswith("tf_static")]
        found = {}
        for _, _, message in self._messages(*topics):
            for t in message.transforms:
                found[_frame(t.header.frame_id), _frame(t.child_frame_id)] = _transform(
                    t.transform.translation, t.transform.rotation
                )
        return found

    def _topics_anywhere(self, types: Sequence[str]) -> list[str]:
        return sorted({c.topic for c in self.reader.connections if c.msgtype in types and c.msgcount})

    def _lookup(self, target: str, source: str) -> Array | None:
        """T_target_source [4, 4] along static transforms; None if they are not tied together."""
        target, source = _frame(target), _frame(source)
        reached = {target: np.eye(4)}
        queue = [target]
        while queue:
            at = queue.pop(0)
            for (parent, child), T in self._T_static.items():
                for other, step in ((child, T), (parent, se3.inverse(T))):
                    if at == (parent if other == child else child) and other not in reached:
                        reached[other] = reached[at] @ step
                        queue.append(other)
        return reached.get(source)

    def _extrinsics(self) -> Array | None:
        """T_color_depth [4, 4]; None if depth is registered already."""
        s, color, depth = self.settings, self.color_camera, self.depth_camera
        same = color.camera == depth.camera and color.frame_id == depth.frame_id != ""
        named = any(hint in self.depth.lower() for hint in REGISTERED)
        if s.registered == "yes" or (s.registered == "auto" and not s.T_color_depth and (same or named)):
            if (color.camera.width, color.camera.height) != (depth.camera.width, depth.camera.height):
                raise DuagError(
                    f"{self.path}: {self.depth} is {depth.camera.width}x{depth.camera.height}, expected "
                    f"{color.camera.width}x{color.camera.height} of colour that it is registered to"
                )
            return None
        if s.T_color_depth:
            try:
                numbers = np.array(s.T_color_depth.split(), dtype=np.float64)
                x, y, z, *q = numbers.tolist()
                return np.asarray(se3.from_quat_translation(np.array(q), np.array([x, y, z])))
            except ValueError as error:
                raise DuagError(
                    f"ros: T_color_depth = {s.T_color_depth!r}, expected 'x y z qw qx qy qz'"
                ) from error
        named_frames = bool(color.frame_id and depth.frame_id)
        T = self._lookup(color.frame_id, depth.frame_id) if named_frames else None
        if T is None:
            raise DuagError(
                f"{self.path}: {self.depth} is seen from {depth.frame_id!r}, colour from {color.frame_id!r}, and "
                "/tf_static does not tie them; expected --set T_color_depth='x y z qw qx qy qz' or registered=yes"
            )
        return T

    def _truth(self) -> tuple[list[int], Array]:
        """Times and T_world_camera [n, 4, 4] of the topic of true poses."""
        topic = self.settings.truth
        if topic not in self._topics_anywhere(POSE_TYPES):
            names = ", ".join(self._topics_anywhere(POSE_TYPES)) or "none"
            raise DuagError(f"{self.path}: truth topic {topic} not found, expected one of {names}")
        poses: dict[int, Array] = {}
        body = ""
        for _, log_ns, m in self._messages(topic):
            stamp = self._stamp(m, log_ns)
            if hasattr(m, "transform"):
                T = _transform(m.transform.translation, m.transform.rotation)
            else:
                pose = m.pose.pose if hasattr(m.pose, "pose") else m.pose
                T = _transform(pose.position, pose.orientation)
            body = getattr(m, "child_frame_id", "")
            if np.isfinite(T).all():
                poses[stamp] = T
        frame = self.settings.truth_frame or body or self.color_camera.frame_id
        T_body_camera = (
            np.eye(4)
            if _frame(frame) in ("camera", _frame(self.color_camera.frame_id))
            else self._lookup(frame, self.color_camera.frame_id)
        )
        if T_body_camera is None:
            raise DuagError(
                f"{self.path}: {topic} is of {frame!r}, and /tf_static does not tie it to "
                f"{self.color_camera.frame_id!r}; expected --set truth_frame=camera if that is where it is"
            )
        stamps = sorted(poses)
        return stamps, np.array([poses[s] for s in stamps]).reshape(-1, 4, 4) @ T_body_camera

    # --- which messages

    def _stamp(self, message: Any, log_ns: int) -> int:
        if self.settings.time_source == "log":
            return log_ns
        stamp = message.header.stamp
        return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)

    def pairs(self) -> dict[int, int]:
        """Time of a colour image -> time of its depth image."""
        stamps: dict[str, list[int]] = {self.color: [], self.depth: []}
        connections = [c for c in self.reader.connections if c.topic in stamps]
        for connection, log_ns, raw in self.reader.messages(connections=connections):
            stamps[connection.topic].append(
                log_ns if self.settings.time_source == "log" else self._header_ns(connection, raw)
            )
        for topic, times in stamps.items():
            if times != sorted(times):
                self.warnings.append(f"{topic}: times go backwards; images are taken in order of time")
            if len(set(times)) < len(times):
                self.warnings.append(
                    f"{topic}: {len(times) - len(set(times))} images repeat a time; left out"
                )
            if not any(times):
                raise DuagError(
                    f"{self.path}: {topic}: all times are zero, expected times, or --set time_source=log"
                )
        listed = {topic: [Listed(t, Path()) for t in sorted(set(times))] for topic, times in stamps.items()}
        found = associate(listed[self.color], listed[self.depth], self.settings)
        if not found:
            raise DuagError(
                f"{self.path}: no image on {self.depth} within {self.settings.limit_ns / NANOSECONDS:g} s of one on "
                f"{self.color}, expected pairs"
            )
        alone = len(listed[self.color]) - len(found)
        if alone:
            self.warnings.append(
                f"{alone} of {len(listed[self.color])} colour images have no depth near in time"
            )
        return {c.stamp_ns: d.stamp_ns for c, d in found}

    def _header_ns(self, connection: Any, raw: bytes) -> int:
        """Stamp of a message that begins with a header, without reading the rest."""
        if self.reader.is2:
            order = "<" if raw[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, 4)
        else:
            seconds, nanoseconds = struct.unpack_from("<II", raw, 4)
        return int(seconds) * NANOSECONDS + int(nanoseconds)

    def frames(self, pairs: Mapping[int, int]) -> Iterator[tuple[int, Any, Any]]:
        """Time, colour and depth message of every pair, in order of time; holds no more than it must."""
        used_by: dict[int, list[int]] = {}
        for color_ns, depth_ns in pairs.items():
            used_by.setdefault(depth_ns, []).append(color_ns)
        colors: dict[int, Any] = {}
        depths: dict[int, Any] = {}
        order = sorted(pairs)
        at = 0
        for topic, log_ns, message in self._messages(self.color, self.depth):
            stamp = self._stamp(message, log_ns)
            if topic == self.color and stamp in pairs:
                colors.setdefault(stamp, message)
            elif topic == self.depth and stamp in used_by:
                depths.setdefault(stamp, message)
            while at < len(order) and order[at] in colors and pairs[order[at]] in depths:
                color_ns, depth_ns = order[at], pairs[order[at]]
                yield color_ns, colors.pop(color_ns), depths[depth_ns]
                used_by[depth_ns].remove(color_ns)
                if not used_by[depth_ns]:
                    del depths[depth_ns]
                at += 1

    def sensors(self) -> dict[str, str]:
        """What the log says about its source."""
        moved = "registered to colour by the converter" if self.T_color_depth is not None else "registered"
        return {"color_topic": self.color, "depth_topic": self.depth, "depth": moved}


def _write(robot: RobotWriter, bag: Bag) -> dict[str, Any]:
    """Write all frames of a robot; returns what the self-check measured."""
    import cv2

    pairs = bag.pairs()
    camera, maps = bag.color_camera.camera, bag.color_maps
    check = ReprojectionCheck(camera, len(pairs))
    without = empty = 0
    progress = track(bag.frames(pairs), f"convert {robot.name}", len(pairs))
    for index, (stamp_ns, color, depth) in enumerate(progress):
        where = f"{bag.path}: {bag.color} at {stamp_ns} ns"
        data, color_format = color_bytes(color, where)
        if maps is not None:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise DuagError(f"{where}: no decoder reads it, expected a colour image")
            data = cv2.imencode(".png", cv2.remap(image, *maps, cv2.INTER_LINEAR))[1].tobytes()
            color_format = "png"
        metres = depth_m(depth, f"{bag.path}: {bag.depth} at {stamp_ns} ns", bag.settings.depth_scale)
        if metres.shape != (bag.depth_camera.camera.height, bag.depth_camera.camera.width):
            raise DuagError(
                f"{bag.path}: {bag.depth} at {stamp_ns} ns is {metres.shape[1]}x{metres.shape[0]}, expected "
                f"{bag.depth_camera.camera.width}x{bag.depth_camera.camera.height} as in its CameraInfo"
            )
        if bag.T_color_depth is not None:
            metres = register_depth(metres, bag.depth_camera.camera, bag.T_color_depth, camera)
        elif maps is not None:
            metres = np.asarray(cv2.remap(metres, *maps, cv2.INTER_NEAREST), dtype=np.float32)
        units = np.rint(metres / bag.depth_scale)
        raw = np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
        T = _pose_at(bag.truth, stamp_ns, bag.settings.max_pose_gap_s)
        without += T is None
        robot.add_frame(stamp_ns, data, color_format, raw, T)
        check.add(index, raw.astype(np.float64) * bag.depth_scale, T)
        empty += int((raw == 0).sum())
    if bag.truth is not None and without:
        bag.warnings.append(f"{without} of {len(pairs)} frames have no true pose")
    pixels = len(pairs) * camera.width * camera.height
    return {"without_depth": empty / pixels, **check.result(str(bag.path))}


def _pose_at(truth: tuple[list[int], Array] | None, stamp_ns: int, max_gap_s: float) -> Array | None:
    from converters.tum_layout import Poses

    if truth is None or not truth[0]:
        return None
    return Poses(np.array(truth[0], dtype=np.int64), truth[1], 0).at(stamp_ns, max_gap_s)


def _shared_parts(a: str, b: str) -> int:
    """How many parts two topics have in common from the left."""
    count = 0
    for x, y in zip(PurePosixPath(a).parts[1:], PurePosixPath(b).parts[1:], strict=False):
        if x != y:
            break
        count += 1
    return count


def _frame(name: str) -> str:
    return name.removeprefix("/")


def _transform(t: Any, q: Any) -> Array:
    return np.asarray(se3.from_quat_translation(np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z])))
