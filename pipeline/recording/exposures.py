"""The exposures of a robot's frames, as its front end found them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.messages import FrameExposure
from duagc.pipeline.recording.read import read_log
from duagc.schemas import topics


def read_exposures(frontend: Path, robot: str) -> ExposureTrack:
    """The exposures of a log; none where its frames are exposed alike.

    Args:
        frontend: the robot's frontend.mcap.
        robot: its name.
    """
    found: list[FrameExposure] = [
        record.message() for record in read_log(frontend, (topics.EXPOSURE.of(robot),))
    ]
    return ExposureTrack.of(
        [m.frame_index for m in found], np.array([m.gain for m in found]), np.array([m.offset for m in found])
    )
