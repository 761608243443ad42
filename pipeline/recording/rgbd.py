"""Colour and depth of one robot, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline import messages
from pipeline.errors import DuagError
from pipeline.geometry.camera import PinholeCamera
from pipeline.recording.names import DEPTH_SCALE_KEY
from pipeline.recording.read import LogFile, Record
from schemas import topics as topic_table


@dataclass(frozen=True)
class RgbdFrame:
    """One colour image with its depth.

    index: position in the log. stamp_ns: when both were taken. color: uint8 [H, W, 3], RGB.
    depth: float32 [H, W], metres along z, 0 where nothing was measured. mask: bool [H, W], True = usable, False = a
    moving object or otherwise to be ignored; None = all usable.
    """

    index: int
    stamp_ns: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_] | None = None

    @property
    def usable_depth(self) -> NDArray[np.float32]:
        """The depth, 0 also where the mask forbids the pixel."""
        return self.depth if self.mask is None else np.where(self.mask, self.depth, np.float32(0))


class RgbdLog:
    """Registered colour and depth of one robot; frames are paired by equal publish time, masks too where there are any.

    `robot`, `camera`, `depth_scale` (metres per unit). Reads what is asked for and keeps no more than a few frames.
    """

    def __init__(self, path: Path) -> None:
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
        self._depth_topic = topic_table.DEPTH.of(self.robot)
        self._color = self._log.entries(self._color_topic)
        self._depth = self._log.entries(self._depth_topic)
        if not self._color and not self._depth:
            raise DuagError(f"{self.path}: {self._color_topic} has no message, expected images")
        if len(self._color) != len(self._depth):
            raise DuagError(self._unpaired())
        self.camera = self._read_camera()
        self.depth_scale = self._read_depth_scale()
        self._mask_topic = topic_table.MASK.of(self.robot)
        self._mask_at = self._read_mask_times()

    def _unpaired(self) -> str:
        """The line that names the first image without a partner."""
        stamps = {
            topic: {r.publish_time_ns for r in self._log.records([topic])}
            for topic in (self._color_topic, self._depth_topic)
        }
        color, depth = stamps[self._color_topic], stamps[self._depth_topic]
        for stamp in sorted(color ^ depth):
            here, there = self._color_topic, self._depth_topic
            if stamp in depth:
                here, there = there, here
            return f"{self.path}: {here} has an image at {stamp} ns, expected one in {there} at the same time"
        counts = f"{len(self._color)} and {len(self._depth)}"
        return (
            f"{self.path}: {self._color_topic} and {self._depth_topic} have {counts} images, expected as many"
        )

    def _read_camera(self) -> PinholeCamera:
        topic = topic_table.CALIBRATION.of(self.robot)
        cameras = []
        for entry in self._log.entries(topic):
            record = self._log.record_at(topic, entry)
            calibration = record.proto()
            try:
                cameras.append((record.log_time_ns, messages.unpack_calibration(calibration)))
            except DuagError as error:
                raise DuagError(f"{self.path}: {topic}: {error}") from error
        if not cameras:
            raise DuagError(f"{self.path}: {topic} has no message, expected the calibration of the camera")
        if cameras[0][0] > self._color[0][0]:
            first, image = cameras[0][0], self._color[0][0]
            raise DuagError(
                f"{self.path}: {topic} begins at {first} ns, expected no later than the images ({image} ns)"
            )
        for time, camera in cameras:
            if camera != cameras[0][1]:
                raise DuagError(
                    f"{self.path}: {topic} changes at {time} ns to {camera}, expected {cameras[0][1]}"
                )
        return cameras[0][1]

    def _read_depth_scale(self) -> float:
        text = self._log.channels[self._depth_topic].metadata.get(DEPTH_SCALE_KEY)
        try:
            scale = float(text or "missing")
        except ValueError:
            scale = math.nan
        if not (math.isfinite(scale) and scale > 0):
            where = f"{self.path}: {self._depth_topic}: channel metadata {DEPTH_SCALE_KEY}"
            raise DuagError(f"{where} is {text!r}, expected metres per unit, for example '0.001'")
        return scale

    def _read_mask_times(self) -> dict[int, tuple[int, int, int]]:
        """The entry of every mask by its publish time.

        Raises:
            DuagError: a mask is of no colour image.
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
        return len(self._color)

    def __enter__(self) -> RgbdLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._log.close()

    def frames(self) -> Iterator[RgbdFrame]:
        """Every frame in order of time."""
        for index in range(len(self)):
            yield self.frame(index)

    def frame(self, index: int) -> RgbdFrame:
        """Frame `index`, 0 <= index < len(self)."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        color = self._log.record_at(self._color_topic, self._color[index])
        depth = self._log.record_at(self._depth_topic, self._depth[index])
        if color.publish_time_ns != depth.publish_time_ns:
            raise DuagError(
                f"{self.path}: {depth.topic} number {index} is of {depth.publish_time_ns} ns, "
                f"expected {color.publish_time_ns} ns as in {color.topic}"
            )
        stamp = color.publish_time_ns
        return RgbdFrame(
            index, stamp, self._decode_color(color), self._decode_depth(depth), self._mask_of(stamp)
        )

    def _decode_color(self, record: Record) -> NDArray[np.uint8]:
        import cv2

        data = np.frombuffer(record.proto().data, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
        if image is None:
            where = f"{self.path}: {record.topic} at {record.publish_time_ns} ns"
            raise DuagError(f"{where} has {len(data)} bytes that no decoder reads, expected JPEG or PNG")
        self._check_size(record, image.shape[1], image.shape[0])
        return np.ascontiguousarray(image[:, :, ::-1])

    def _decode_depth(self, record: Record) -> NDArray[np.float32]:
        raw = messages.unpack_depth(
            record.proto(), f"{self.path}: {record.topic} at {record.publish_time_ns} ns"
        )
        self._check_size(record, raw.shape[1], raw.shape[0])
        return raw.astype(np.float32) * np.float32(self.depth_scale)

    def _mask_of(self, stamp_ns: int) -> NDArray[np.bool_] | None:
        entry = self._mask_at.get(stamp_ns)
        if entry is None:
            return None
        record = self._log.record_at(self._mask_topic, entry)
        mask = messages.unpack_mask(record.proto(), f"{self.path}: {record.topic} at {stamp_ns} ns")
        self._check_size(record, mask.shape[1], mask.shape[0])
        return mask

    def _check_size(self, record: Record, width: int, height: int) -> None:
        if (width, height) != (self.camera.width, self.camera.height):
            raise DuagError(
                f"{self.path}: {record.topic} at {record.publish_time_ns} ns is {width}x{height}, "
                f"expected {self.camera.width}x{self.camera.height} as in the calibration"
            )


def open_rgbd(path: Path) -> RgbdLog:
    """Open the log of one robot's camera; see `RgbdLog`."""
    return RgbdLog(path)
