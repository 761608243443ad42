"""A recording as a calibration of its cameras has it, made from its logs: no converter, no file of the dataset.

Depth stays on the pixels of the recording, its values are corrected. Color is seen as by a pinhole camera that is where
depth was registered to: its images stay as they are, and the log states their lens; where it stated one before they are
resampled. So the camera of the recording stays as it is, and what it does not see goes into the mask of pixels that
show no scene. Other topics and ground truth are copied.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from duagc.converters.layouts.calibrated import correct
from duagc.pipeline import messages
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import encode_png, new_file
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry import depth_error
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, Maps, rectified, seen_by_source
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.recording import DEPTH_SCALE_KEY, RECORDING_FILE, LogWriter, Record, Recording, open_rgbd
from duagc.pipeline.recording.color_images import ColorImages
from duagc.pipeline.recording.depth_sources import OtherCamera, depth_source
from duagc.pipeline.recording.read import LogFile, log_metadata
from duagc.schemas import topics

MOST_UNITS = np.iinfo(np.uint16).max


@dataclass(frozen=True)
class Correction:
    """How the cameras of a robot differ from those that its log says.

    Attributes:
        lens: the color camera, and how it is turned against the registered depth.
        depth_error: c0 .. c5 of `geometry.depth_error`, 1/m, at the rays of the recording's camera.
        delay_ns: how much later color was taken than its stamps say; stamps of depth become that much earlier.
    """

    lens: Lens
    depth_error: tuple[float, ...]
    delay_ns: int = 0


def why_not(log: Path) -> str:
    """Why no correction applies to the depth of a log; "" if one does.

    Args:
        log: of one robot.
    Raises:
        DuagError: the log is broken.
    """
    with open_rgbd(log) as rgbd:
        if rgbd.swept:
            topic = topics.LIDAR.of(rgbd.robot)
            return f"{log}: depth comes from {topic}, expected images of a depth camera to calibrate"
    return ""


def write_calibrated(
    recording: Recording,
    corrections: Mapping[str, Correction],
    folder: Path,
    name: str,
    *,
    calibration: Mapping[str, Any],
) -> None:
    """Write a recording with corrected cameras; every frame keeps its index, held-out ones are treated like all.

    Args:
        recording: as it is.
        corrections: by robot; the logs of other robots are copied.
        folder: to write into; it exists.
        name: of the new recording.
        calibration: what its `recording.json` says about the calibration.
    Raises:
        DuagError: a log is broken, or has no depth images.
    """
    description = deepcopy(recording.description)
    for robot in recording.robots:
        row, log = description["robots"][robot], recording.log(robot)
        if robot in corrections:
            written = _write_log(log, folder / log.name, corrections[robot])
            row["digests"] = {**row.get("digests", {}), log.name: written["digest"]}
            row["masked_share"] = written["masked_share"]
        else:
            shutil.copyfile(log, folder / log.name)
        if (truth := recording.groundtruth(robot)) is not None:
            shutil.copyfile(truth, folder / truth.name)
    if (geometry := recording.geometry()) is not None:
        shutil.copyfile(geometry, folder / geometry.name)
    description["name"] = name
    description["calibration"] = {
        "recording": recording.name,
        "digests": {robot: recording.digest(recording.log(robot).name) for robot in recording.robots},
        **calibration,
    }
    text = json.dumps(description, indent=2, allow_nan=False) + "\n"
    with new_file(folder / RECORDING_FILE) as part:
        part.write_text(text)


def _write_log(path: Path, out: Path, correction: Correction) -> dict[str, Any]:
    """The corrected log of a robot; returns what `recording.json` says differently about the robot."""
    if why := why_not(path):
        raise DuagError(why)
    with open_rgbd(path) as rgbd:
        robot, camera, valid, lens = rgbd.robot, rgbd.camera, rgbd.valid, rgbd.lens
    with LogFile(path) as log, LogWriter(out, robot, log_metadata(path)) as writer:
        cameras = camera, lens
        copy = _Copy(log, robot, cameras, valid, correction=correction, writer=writer)
        statistics = log.summary.statistics
        for record in track(
            log.records(None), f"calibrate {robot}", statistics.message_count if statistics else None
        ):
            copy.add(record)
    return {"digest": writer.digest, "masked_share": float(np.mean(~copy.valid))}


class _Copy:
    """Writes the messages of a log, those of the cameras as they should have been."""

    def __init__(
        self,
        log: LogFile,
        robot: str,
        cameras: tuple[PinholeCamera, Lens | None],
        valid: Mask | None,
        *,
        correction: Correction,
        writer: LogWriter,
    ) -> None:
        camera, lens = cameras
        self._log, self._robot, self._camera, self._lens = log, robot, camera, lens
        self._correction, self._writer = correction, writer
        self._maps: Maps = correction.lens.maps(camera)
        self._source = depth_source(log, robot, camera)
        whole = seen_by_source(self._maps, camera.width, camera.height)
        # depth is not moved: what was no scene before is none either
        self.valid = whole if valid is None else whole & valid & self._moved(valid)
        if not self.valid.any():
            raise DuagError(
                f"{log.path}: its calibration leaves no pixel that shows the scene, expected some"
            )
        handlers: dict[topics.Topic, Callable[[Record], None]] = {
            topics.CALIBRATION: self._calibration,
            topics.COLOR: self._color,
            topics.MASK: self._mask,
            topics.DEPTH: self._depth,
            topics.DEPTH_SIGMA: self._sigma,
            topics.VALID: lambda record: None,  # in that which is written with the first image
        }
        if isinstance(self._source, OtherCamera):
            handlers[topics.RAW_DEPTH] = self._depth
            handlers[topics.RAW_DEPTH_CALIBRATION] = handlers[topics.RAW_DEPTH_TRANSFORM] = handlers[
                topics.VALID
            ]
        self._handlers = {topic.of(robot): handler for topic, handler in handlers.items()}
        self._has_color, self._images = False, ColorImages(camera, lens)
        self._opened: set[topics.Topic] = set()

    def add(self, record: Record) -> None:
        """Take in the next message of the log."""
        handler = self._handlers.get(record.topic)
        if handler is None:
            self._writer.copy(self._log, record)
        else:
            handler(record)

    def _moved(self, mask: Mask) -> Mask:
        """Pixels of the new image that are of usable pixels of the old one alone."""
        image = np.where(mask, np.uint8(255), np.uint8(0))
        return np.asarray(
            cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) == 255
        )

    def _calibration(self, record: Record) -> None:
        """Images of a pinhole camera are kept, and their lens is stated; those of a lens are resampled."""
        lens = self._correction.lens if self._lens is None else None
        message = messages.pack_calibration(record.publish_time_ns, self._robot, self._camera, lens)
        self._writer.write(record.topic, message, record.log_time_ns, record.publish_time_ns)

    def _color(self, record: Record) -> None:
        if not self._has_color and not self.valid.all():
            shown = messages.pack_valid(record.publish_time_ns, self._robot, self.valid)
            self._writer.write(
                topics.VALID.of(self._robot), shown, record.log_time_ns, record.publish_time_ns
            )
        self._has_color = True
        if self._lens is None:
            self._writer.copy(self._log, record)
            return
        message, image = record.proto(), self._images.decode(record)
        message.data, message.format = encode_png(rectified(image, self._maps)[:, :, ::-1]), "png"
        self._writer.write(record.topic, message, record.log_time_ns, record.publish_time_ns)

    def _mask(self, record: Record) -> None:
        where = f"{record.path}: {record.topic} at {record.publish_time_ns} ns"
        usable = self._moved(messages.unpack_mask(record.proto(), where))
        message = messages.pack_mask(record.publish_time_ns, self._robot, usable)
        self._writer.write(record.topic, message, record.log_time_ns, record.publish_time_ns)

    def _depth(self, record: Record) -> None:
        """The corrected depth, registered to color, whichever camera took it."""
        topic, scale = topics.DEPTH.of(self._robot), self._source.scale
        self._open(topics.DEPTH, {DEPTH_SCALE_KEY: repr(scale)})
        self._write_depth(topic, record, self._corrected(record) / scale)

    def _sigma(self, record: Record) -> None:
        """Its standard deviation: depth as recorded and as corrected differ by a smooth function."""
        topic = topics.DEPTH.of(self._robot)
        entry = self._log.entries_by_time(topic).get(record.publish_time_ns)
        if entry is None:
            self._writer.copy(self._log, record)  # of no depth image: never read
            return
        depth = self._log.record_at(topic, entry)
        before, after = self._source.read(depth).depth_m.astype(np.float64), self._corrected(depth)
        slope = 1 - depth_error.NO_ERROR_M * (self._correction.depth_error or (0.0,))[0]
        factor = slope * (after / np.where(before > 0, before, 1)) ** 2
        where = f"{record.path}: {record.topic} at {record.publish_time_ns} ns"
        sigma = messages.unpack_depth(record.proto(), where)
        self._open(topics.DEPTH_SIGMA, self._log.channels[record.topic].metadata)
        known = (sigma > 0) & (after > 0)
        self._write_depth(record.topic, record, np.where(known, np.clip(sigma * factor, 1, MOST_UNITS), 0))

    def _open(self, topic: topics.Topic, metadata: Mapping[str, str]) -> None:
        """Open a topic whose channel has metadata, before its first message."""
        if topic not in self._opened:
            self._writer.channel(topic.of(self._robot), topic.schema, metadata)
            self._opened.add(topic)

    def _corrected(self, record: Record) -> Array:
        depth_m = self._source.read(record).depth_m.astype(np.float64)
        return np.asarray(correct(depth_m, self._camera, self._correction.depth_error), dtype=np.float64)

    def _write_depth(self, topic: str, record: Record, units: Array) -> None:
        """An image in units of its channel, at the time that the delay puts it to."""
        raw = np.rint(units)
        raw = np.where(raw <= MOST_UNITS, raw, 0).astype(np.uint16)
        stamp_ns = max(0, record.publish_time_ns - self._correction.delay_ns)  # logs know no time before 0
        message = messages.pack_depth(stamp_ns, self._robot, raw)
        self._writer.write(topic, message, record.log_time_ns, stamp_ns)
