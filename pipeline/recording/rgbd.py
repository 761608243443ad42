"""Color and depth of one robot, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.depth_sources import check_size, constant, depth_source
from duagc.pipeline.recording.motion import MotionPrior, motion_prior
from duagc.pipeline.recording.pairing import TOLERANCE_NS, pair
from duagc.pipeline.recording.read import LogFile, Record
from duagc.schemas import topics as topic_table


@dataclass(frozen=True)
class RgbdFrame:
    """One color image with its depth.

    index: position in the log. stamp_ns: when the color was taken. color: uint8 [H, W, 3], RGB.
    depth: float32 [H, W], meters along z, 0 where nothing was measured. mask: bool [H, W], True = usable, False = a
    moving object or otherwise to be ignored; None = all usable. depth_offset_ns: how much later the depth was taken.
    depth_sigma: float32 [H, W], standard deviation of the depth in meters, 0 where there is no depth; None = unknown.
    """

    index: int
    stamp_ns: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_] | None = None
    depth_offset_ns: int = 0
    depth_sigma: NDArray[np.float32] | None = None

    @property
    def usable_depth(self) -> NDArray[np.float32]:
        """The depth, 0 also where the mask forbids the pixel."""
        return self.depth if self.mask is None else np.where(self.mask, self.depth, np.float32(0))


class RgbdLog:
    """Color and depth of one robot: a frame is a color image and the depth nearest to it, if that is near enough.

    Images without a partner are no frames; `pairing` has their times. Depth may be registered already, or of another
    camera, or a LiDAR's (`depth_sources`). Masks belong to the color image of the same publish time.

    `robot`, `camera`, `depth_scale` (meters per unit). Reads what is asked for and keeps no more than a few frames.
    """

    def __init__(self, path: Path) -> None:
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
        self.camera = self._read_camera()
        self._source = depth_source(self._log, self.robot, self.camera)
        self.depth_scale = self._source.scale
        self._mask_topic = topic_table.MASK.of(self.robot)
        topics = self._color_topic, self._source.topic, self._mask_topic
        self._color_at = self._log.entries_by_time(*topics)
        self._depth_at = self._log.entries_by_time(self._source.topic)
        self.pairing = pair(self._color_at, self._depth_at)
        if not self.pairing.pairs:
            raise DuagError(
                f"{self.path}: {self._color_topic} has {len(self._color_at)} images and {self._source.topic} "
                f"{len(self._depth_at)}, none of them within {TOLERANCE_NS / 1e6:g} ms of each other, expected pairs"
            )
        self._mask_at = self._read_mask_times()

    def _read_camera(self) -> PinholeCamera:
        topic = topic_table.CALIBRATION.of(self.robot)
        camera = constant(self._log, topic, messages.unpack_calibration)
        first, image = self._log.entries(topic)[0][0], self._log.entries(self._color_topic)[0][0]
        if first > image:
            raise DuagError(
                f"{self.path}: {topic} begins at {first} ns, expected no later than the images ({image} ns)"
            )
        return camera

    def _read_mask_times(self) -> dict[int, tuple[int, int, int]]:
        """The entry of every mask by its publish time.

        Raises:
            DuagError: a mask is of no color image.
        """
        at = self._log.entries_by_time(self._mask_topic)
        if at:
            stray = sorted(at.keys() - self._log.entries_by_time(self._color_topic).keys())
            if stray:
                raise DuagError(
                    f"{self.path}: {self._mask_topic} has a mask at {stray[0]} ns, "
                    f"expected one in {self._color_topic} at the same time"
                )
        return at

    def __len__(self) -> int:
        return len(self.pairing.pairs)

    def __enter__(self) -> RgbdLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._log.close()

    def motion_prior(self) -> MotionPrior | None:
        """How the camera moved by other sensors of the log; None if it has none."""
        return motion_prior(self._log, self.robot)

    def frames(self) -> Iterator[RgbdFrame]:
        """Every frame in order of time."""
        for index in range(len(self)):
            yield self.frame(index)

    def frame(self, index: int) -> RgbdFrame:
        """Read one frame.

        Args:
            index: position in the log, 0 <= index < len(self).

        Raises:
            DuagError: an image is damaged; the line names file, topic and time.
            IndexError: there are fewer frames.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        stamp, depth_stamp = self.pairing.pairs[index]
        color = self._log.record_at(self._color_topic, self._color_at[stamp])
        depth = self._log.record_at(self._source.topic, self._depth_at[depth_stamp])
        image = self._decode_color(color)
        offset, found = depth_stamp - stamp, self._source.read(depth)
        return RgbdFrame(
            index,
            stamp,
            image,
            found.depth_m,
            mask=self._mask_of(stamp),
            depth_offset_ns=offset,
            depth_sigma=found.sigma_m,
        )

    def _decode_color(self, record: Record) -> NDArray[np.uint8]:
        import cv2

        data = record.proto().data
        image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            where = f"{self.path}: {record.topic} at {record.publish_time_ns} ns"
            raise DuagError(f"{where} has {len(data)} bytes that no decoder reads, expected JPEG or PNG")
        check_size(record, image.shape[1], image.shape[0], self.camera)
        return np.ascontiguousarray(image[:, :, ::-1])

    def _mask_of(self, stamp_ns: int) -> NDArray[np.bool_] | None:
        entry = self._mask_at.get(stamp_ns)
        if entry is None:
            return None
        record = self._log.record_at(self._mask_topic, entry)
        mask = messages.unpack_mask(record.proto(), f"{self.path}: {record.topic} at {stamp_ns} ns")
        check_size(record, mask.shape[1], mask.shape[0], self.camera)
        return mask


def open_rgbd(path: Path) -> RgbdLog:
    """Open the log of one robot's camera.

    Args:
        path: the log, an .mcap of a recording.

    Returns:
        The log; close it, or use it in a `with` block.

    Raises:
        DuagError: the log is damaged, or has no color, depth or calibration; the line names file and topic.
    """
    return RgbdLog(path)
