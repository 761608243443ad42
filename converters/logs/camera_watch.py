"""Watches that the cameras of a log stay as they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from duagc.converters.layouts.ros_images import RosCamera
from duagc.converters.logs.entries import Entry
from duagc.pipeline.base.errors import DuagError

SAME_CAMERA_PX = 1.0  # up to which a camera has not changed


class CameraWatch:
    """Watches that what a CameraInfo says does not change: a camera of the recording is one camera."""

    def __init__(self, first: Mapping[str, tuple[RosCamera, bool]], name: str) -> None:
        self._first, self._name = first, name
        self._seen: dict[str, bytes] = {}

    def see(self, entry: Entry) -> None:
        """Compare a message with the first one. Raises DuagError where the difference can be seen in images."""
        rest = entry.data[16:]  # in ROS what follows the times of the header, most often the same bytes
        if self._seen.get(entry.topic) == rest:
            return
        self._seen[entry.topic] = rest
        first, rectified = self._first[entry.topic]
        where = f"{self._name}: {entry.topic}"
        now = RosCamera.of(entry.read(), rectified, where)
        a, b = (np.array([c.camera.fx, c.camera.fy, c.camera.cx, c.camera.cy]) for c in (first, now))
        if np.abs(a - b).max() > SAME_CAMERA_PX or first.distortion != now.distortion:
            raise DuagError(
                f"{where} changes at {entry.log_ns} ns from fx fy cx cy = {a.round(2).tolist()} px to "
                f"{b.round(2).tolist()}, expected one camera (a zoom or autofocus has to be fixed while recording)"
            )
