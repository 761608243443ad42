"""Color and depth of one robot, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline import messages
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import MAX_SIDE_PX, MIN_SIDE_PX, PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.geometry.open_shutter import OpenShutter
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording.color_images import ColorImages
from duagc.pipeline.recording.depth_motion import CurveKind, DepthMotion
from duagc.pipeline.recording.depth_sources import DepthImage, Lidar, check_size, constant, depth_source
from duagc.pipeline.recording.mask_topics import mask_entries, valid_pixels
from duagc.pipeline.recording.motion import GyroPrior, MotionPrior, gyro_prior, motion_prior
from duagc.pipeline.recording.moved_depth import depth_delay_ns, move_depth, tracked_frames
from duagc.pipeline.recording.pairing import pair, pair_topics
from duagc.pipeline.recording.read import LOG_RECORD, LogFile
from duagc.pipeline.recording.rgbd_frame import RgbdFrame
from duagc.pipeline.recording.rolling_shutter import Readout, SeenPoints, Unrolling, unrollings
from duagc.pipeline.recording.shutter import found_shutter_s, stated_shutter_s
from duagc.schemas import topics as topic_table


@dataclass(frozen=True)
class _Geometry:
    """A frame without its color.

    Attributes:
        depth: in the time of the color if `depth_moved`; not yet 0 where the camera never shows the scene.
        depth_moved: as of `RgbdFrame`.
        mask: bool [H, W], pixels of the still image that may be used; None: all.
        masked: whether the image as it was read has a mask; if not, only its border may be missing from the still one.
        color_unrolling: makes the color still; None: it is.
    """

    depth: DepthImage
    depth_moved: bool
    mask: NDArray[np.bool_] | None
    masked: bool
    color_unrolling: Unrolling | None


class RgbdLog:
    """Color and depth of one robot: a frame is a color image and the depth nearest to it in time.

    Where no depth is near enough a frame has none; `pairing` has all times. Depth of another time is as it was taken
    until `move_depth` says how the camera moved. Depth may be registered already, or of another camera, or a LiDAR's
    (`depth_sources`). Masks belong to the color image of the same publish time; `valid` belongs to all of them.

    `robot`, `camera`, `lens` (with which its images were taken; None = by the camera), `depth_scale` (meters per unit),
    `valid` (bool [H, W], pixels that show the scene; None = all), `depth_delay_ns` (of `delay_depth`), `readout` (how
    long images are read, as stated or found), `stated_shutter_s` (how long the shutter is open, seconds, if it states
    that), `shutter` (of `open_shutter`). Keeps few frames.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a log; `open_rgbd` does the same.

        Args:
            path: MCAP log of one robot.
        Raises:
            DuagError: the log is damaged, or lacks color, depth or calibration.
        """
        self.path = Path(path)
        self._log = LogFile(self.path)
        try:
            self._open()
        except BaseException:
            self._log.close()
            raise

    def _open(self) -> None:
        found = [(row[1], topic) for topic in self._log.channels if (row := topic_table.find(topic))]
        robots = sorted({robot for robot, topic in found if topic == topic_table.COLOR.of(robot)})
        if len(robots) != 1:
            pattern = topic_table.COLOR.pattern
            raise DuagError(f"{self.path}: {pattern} found for robots {robots}, expected exactly one robot")
        self.robot = robots[0]
        self._color_topic = topic_table.COLOR.of(self.robot)
        if not self._log.entries(self._color_topic):
            raise DuagError(f"{self.path}: {self._color_topic} has no message, expected images")
        self.camera, self.lens = self._read_camera()
        self._images = ColorImages(self.camera, self.lens)
        self.valid = valid_pixels(self._log, self.robot, self.camera)
        self._source = depth_source(self._log, self.robot, self.camera)
        self.depth_scale = self._source.scale
        self._mask_topic = topic_table.MASK.of(self.robot)
        topics = self._color_topic, self._source.topic, self._mask_topic
        self._color_at = self._log.entries_by_time(*topics)
        self._depth_at = self._log.entries_by_time(self._source.topic)
        self.pairing = pair_topics(self._log, *topics[:2])
        self.depth_delay_ns = 0
        written = dict(self._log.metadata()).get(LOG_RECORD, {})
        self._stated_readout = Readout.stated(written, str(self.path))
        self.readout = self._stated_readout or Readout()
        self.stated_shutter_s = stated_shutter_s(written, str(self.path))
        self._motion: DepthMotion | None = None
        self._kind: CurveKind | None = None
        self._points = dict[tuple[int, int], SeenPoints]()  # of `moved_rows_px`, by delay and index
        self.shutter: OpenShutter | None = None
        if not len(self.pairing.offsets_ns):
            near = f"within {self.pairing.tolerance_ns / 1e6:g} ms of each other"
            raise DuagError(
                f"{self.path}: {self._color_topic} has {len(self._color_at)} images and {self._source.topic} "
                f"{len(self._depth_at)}, none of them {near}, expected pairs"
            )
        self._mask_at = mask_entries(self._log, self.robot)

    def _read_camera(self) -> tuple[PinholeCamera, Lens | None]:
        topic = topic_table.CALIBRATION.of(self.robot)
        camera, lens = constant(self._log, topic, messages.unpack_camera)
        if not all(MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in (camera.width, camera.height)):
            size = f"{camera.width} x {camera.height} px"
            raise DuagError(
                f"{self.path}: {topic} says {size}, expected sides of {MIN_SIDE_PX} to {MAX_SIDE_PX}"
            )
        first, image = self._log.entries(topic)[0][0], self._log.entries(self._color_topic)[0][0]
        if first > image:
            raise DuagError(
                f"{self.path}: {topic} begins at {first} ns, expected no later than the images ({image} ns)"
            )
        return camera, lens

    def check_robot(self, robot: str) -> None:
        """Refuse the log of another robot.

        Args:
            robot: whose it should be.

        Raises:
            DuagError: it is another one's.
        """
        if self.robot != robot:
            raise DuagError(f"{self.path}: is the log of {self.robot}, expected that of {robot}")

    def __len__(self) -> int:
        return len(self.pairing.pairs)

    def __enter__(self) -> RgbdLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._log.close()

    def delay_depth(self, delay_ns: int) -> None:
        """Read depth as taken earlier than its stamps say; every image gets the depth that is then nearest.

        Args:
            delay_ns: how much earlier.
        """
        moved_ns = delay_ns - self.depth_delay_ns
        self.depth_delay_ns = delay_ns
        self._depth_at = {stamp - moved_ns: entry for stamp, entry in self._depth_at.items()}
        self.pairing = pair(self._color_at, self._depth_at, self.pairing.tolerance_ns)

    def frame_offset_ns(self, index: int) -> int:
        """How much later the depth of a frame was taken; 0 if it has none.

        Args:
            index: position in the log.
        """
        color, depth = self.pairing.pairs[index]
        return 0 if depth is None else depth - color

    @property
    def swept(self) -> bool:
        """Whether depth comes from the sweeps of a LiDAR."""
        return isinstance(self._source, Lidar)

    @property
    def states_readout(self) -> bool:
        """Whether the log says how long its images are read."""
        return self._stated_readout is not None

    @property
    def needs_motion(self) -> bool:
        """Whether some depth, or some row, is of another time than its color."""
        return bool(self.pairing.largest_offset_ns) or self.readout.rolls

    def move_depth(self, *parts: Trajectory, kind: CurveKind | None = None) -> None:
        """Move depth and rows of another time than their color's into that time, in all frames read from now on.

        Args:
            parts: T_map_camera of the frames that were tracked; of every part that has a frame of its own.
            kind: of the curves that describe all motion from now on; None: by the poses of each part.
        """
        self._kind = kind
        if self.needs_motion:
            self._motion = self.motion_along(*parts)

    def open_shutter(self, shutter_s: float, *parts: Trajectory) -> None:
        """Say how the camera moves while its shutter is open, in all frames read from now on.

        Args:
            shutter_s: how long it is open; 0: images are sharp.
            parts: as of `move_depth`.
        """
        self.shutter = OpenShutter(shutter_s, self.motion_along(*parts)) if shutter_s > 0 else None

    def move_depth_by(self, frontend: str | Path, path: Trajectory | None = None) -> None:
        """`delay_depth`, `readout`, `move_depth` and `open_shutter` by what the front end found.

        Args:
            frontend: frontend.mcap of the robot.
            path: T_map_camera of the frames that it tracked; None: read if they are needed.
        """
        self.delay_depth(depth_delay_ns(frontend := Path(frontend)))
        self.readout = self._stated_readout or Readout.found(frontend) or Readout()
        shutter_s = found_shutter_s(frontend)
        if self.needs_motion or shutter_s > 0:
            path = tracked_frames(frontend) if path is None else path
            self.move_depth(path, kind=CurveKind.found(frontend))
            self.open_shutter(shutter_s, path)

    def motion_prior(self) -> MotionPrior | None:
        """How the camera moved by other sensors of the log; None if it has none."""
        return motion_prior(self._log, self.robot)

    @cached_property
    def gyro(self) -> GyroPrior | None:
        """The gyroscope of the log; None if it has none."""
        return gyro_prior(self._log, self.robot)

    def motion_along(self, *parts: Trajectory) -> DepthMotion:
        """The motion around every frame, by the poses of frames and the gyroscope if the log has one.

        Args:
            parts: as of `move_depth`.
        """
        return DepthMotion(*parts, gyro=self.gyro, kind=self._kind)

    def frames(self) -> Iterator[RgbdFrame]:
        """Every frame in order of time."""
        yield from map(self.frame, range(len(self)))

    def frame(self, index: int, *, still: bool = True, depth: bool = True) -> RgbdFrame:
        """Read one frame.

        Args:
            index: position in the log, 0 <= index < len(self).
            still: put rows that were read one after the other into one time; if not, they are as they were read.
            depth: with its depth; if not, none is known, nor where the camera was while its shutter was open.

        Raises:
            DuagError: an image is damaged; the line names file, topic and time.
            IndexError: there are fewer frames.
        """
        stamp, depth_stamp = self._stamps(index)
        image = self._images.decode(self._log.record_at(self._color_topic, self._color_at[stamp]))
        readout, shutter = self.readout if still else Readout(), self.shutter if depth else None
        geometry = self._geometry(stamp, depth_stamp, readout, with_depth=depth)
        mask, found = geometry.mask, geometry.depth
        if geometry.color_unrolling is not None:
            image = geometry.color_unrolling.color(image)
        return RgbdFrame(
            index,
            stamp,
            image if mask is None or not geometry.masked else masks.filled(image, mask),
            self._of_scene(found.depth_m),
            mask=mask,
            depth_offset_ns=self.frame_offset_ns(index),
            depth_sigma=None if found.sigma_m is None else self._of_scene(found.sigma_m),
            depth_moved=geometry.depth_moved,
            T_camera_moment=None if shutter is None else shutter.moments(stamp, found.depth_m, self.camera),
        )

    def usable_depth(self, index: int) -> NDArray[np.float32]:
        """The usable depth of one frame, whose color is not read.

        Args:
            index: position in the log, 0 <= index < len(self).

        Returns:
            `RgbdFrame.usable_depth`, float32 [H, W].

        Raises:
            DuagError: an image is damaged; the line names file, topic and time.
            IndexError: there are fewer frames.
        """
        found = self._geometry(*self._stamps(index), self.readout)
        return masks.masked_depth(self._of_scene(found.depth.depth_m), found.mask)

    def moments(self, index: int) -> Array | None:
        """Where the camera was while the shutter of one frame was open; its color is not read.

        Args:
            index: position in the log, 0 <= index < len(self).

        Returns:
            `RgbdFrame.T_camera_moment`, [k, 4, 4]; None: it stood still, or `open_shutter` was not called.
        """
        if self.shutter is None:
            return None
        stamp, depth_stamp = self._stamps(index)
        depth_m = self._geometry(stamp, depth_stamp, self.readout).depth.depth_m
        return self.shutter.moments(stamp, depth_m, self.camera)

    def _stamps(self, index: int) -> tuple[int, int | None]:
        """When color and depth of a frame were taken, nanoseconds."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return self.pairing.pairs[index]

    def _geometry(
        self, color_ns: int, depth_ns: int | None, readout: Readout, *, with_depth: bool = True
    ) -> _Geometry:
        """What a frame has besides its color; readout: by which its rows are put into one time."""
        mask = self._mask_of(color_ns)
        read = self._read_depth(depth_ns if with_depth or readout.rolls else None)
        seen = partial(SeenPoints, self.camera, read.depth_m)
        of_color, of_depth = self._unrollings(color_ns, depth_ns, readout, seen)
        if with_depth:
            depth, moved = self._in_time_of_color(read, color_ns, depth_ns, unrolling=of_depth)
        else:
            depth, moved = self._read_depth(None), False
        if of_color is None or not of_color.is_needed:
            return _Geometry(depth, moved, mask, mask is not None, None)
        return _Geometry(depth, moved, of_color.usable(mask), mask is not None, of_color)

    def _in_time_of_color(
        self, read: DepthImage, color_ns: int, depth_ns: int | None, *, unrolling: Unrolling | None
    ) -> tuple[DepthImage, bool]:
        """Depth as it would have been read with the middle of its color, and whether it was moved."""
        depth, moved = read, False
        if unrolling is not None and unrolling.is_needed:
            depth, moved = unrolling.depth(DepthImage(self._of_scene(read.depth_m), read.sigma_m)), True
        if self._motion is None or depth_ns in (None, color_ns):
            return depth, moved
        T_color_depth = self._motion.between(color_ns, depth_ns)
        if T_color_depth is None:
            return depth, False
        seen = DepthImage(self._of_scene(depth.depth_m), depth.sigma_m)
        return move_depth(seen, self.camera, T_color_depth), True

    def _read_depth(self, depth_ns: int | None) -> DepthImage:
        if depth_ns is None:
            return DepthImage(np.zeros((self.camera.height, self.camera.width), dtype=np.float32))
        return self._source.read(self._log.record_at(self._source.topic, self._depth_at[depth_ns]))

    def moved_rows_px(self, index: int) -> float:
        """How far the median pixel of a frame as read is from where a still camera has it; its depth is read once.

        Args:
            index: position in the log, 0 <= index < len(self).
        """
        key, (color_ns, depth_ns) = (self.depth_delay_ns, index), self._stamps(index)
        if key not in self._points:
            self._points[key] = SeenPoints(self.camera, self._read_depth(depth_ns).depth_m)
        found = self._unrollings(color_ns, depth_ns, self.readout, lambda: self._points[key])
        return max((unrolling.move_px for unrolling in found if unrolling is not None), default=0.0)

    def _unrollings(
        self, color_ns: int, depth_ns: int | None, readout: Readout, seen: Callable[[], SeenPoints]
    ) -> tuple[Unrolling | None, Unrolling | None]:
        """How color and depth of a frame are made still."""
        times_ns = color_ns, color_ns if depth_ns is None else depth_ns
        return unrollings(self._motion, self.camera, times_ns, readout, seen=seen)

    def _of_scene(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """An image [H, W] with 0 where the camera never shows the scene."""
        return values if self.valid is None else np.where(self.valid, values, np.float32(0))

    def _mask_of(self, stamp_ns: int) -> NDArray[np.bool_] | None:
        entry = self._mask_at.get(stamp_ns)
        if entry is None:
            return self.valid
        record = self._log.record_at(self._mask_topic, entry)
        mask = messages.unpack_mask(record.proto(), f"{self.path}: {record.topic} at {stamp_ns} ns")
        check_size(record, mask.shape[1], mask.shape[0], self.camera)
        return mask if self.valid is None else mask & self.valid


def open_rgbd(path: str | Path) -> RgbdLog:
    """Open the log of one robot's camera.

    Args:
        path: the log, an .mcap of a recording.

    Returns:
        The log; close it, or use it in a `with` block.

    Raises:
        DuagError: the log is damaged, or has no color, depth or calibration; the line names file and topic.
    """
    return RgbdLog(path)
