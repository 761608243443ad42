"""Masks in the log of one robot: of all its images, and of single ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.depth_sources import check_size
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics as topic_table


def valid_pixels(log: LogFile, robot: str, camera: PinholeCamera) -> NDArray[np.bool_] | None:
    """Pixels [h, w] that show the scene in all images, by all messages about it; None: all pixels.

    Args:
        log: of the robot.
        robot: whose topics are read.
        camera: of the images.

    Raises:
        DuagError: a mask has another size than the images, or no pixel is left.
    """
    topic = topic_table.VALID.of(robot)
    found = np.ones((camera.height, camera.width), dtype=bool)
    for entry in log.entries(topic):
        record = log.record_at(topic, entry)
        where = f"{log.path}: {topic} at {record.publish_time_ns} ns"
        valid = messages.unpack_valid(record.proto(), where)
        check_size(record, valid.shape[1], valid.shape[0], camera)
        found &= valid
        if not found.any():
            raise DuagError(f"{where} leaves no pixel that shows the scene, expected some")
    return None if found.all() else found


def mask_entries(log: LogFile, robot: str) -> dict[int, tuple[int, int, int]]:
    """The entry of every mask of a single image by its publish time.

    Args:
        log: of the robot.
        robot: whose topics are read.

    Raises:
        DuagError: a mask is of no color image.
    """
    topic, color_topic = topic_table.MASK.of(robot), topic_table.COLOR.of(robot)
    at = log.entries_by_time(topic)
    if at:
        stray = sorted(at.keys() - log.entries_by_time(color_topic).keys())
        if stray:
            raise DuagError(
                f"{log.path}: {topic} has a mask at {stray[0]} ns, expected one in {color_topic} at the same time"
            )
    return at
