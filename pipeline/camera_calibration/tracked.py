"""Logs with the poses of their frames, as the front end tracks them before a calibration."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.unmapped import NothingToMapError
from duagc.pipeline.camera_calibration.undetermined import UndeterminedError
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.rolling_shutter import Readout
from duagc.pipeline.runs.folder import RobotRun

READ_AT_ONCE = Readout()


@dataclass(frozen=True)
class Tracked:
    """A log with the poses of its n frames.

    Attributes:
        path: of the log.
        robot: its name.
        T_map_camera: [n, 4, 4].
        ok: whether each was tracked, [n].
        held_out: whether each is kept for evaluation, [n].
        stamps_ns: [n].
        readout: as the log states it, or the front end found it.
    """

    path: Path
    robot: str
    T_map_camera: Array
    ok: NDArray[np.bool_]
    held_out: NDArray[np.bool_]
    stamps_ns: NDArray[np.int64]
    readout: Readout = READ_AT_ONCE


def track_log(path: Path, robot: str, config: FrontendConfig) -> Tracked:
    """Poses of a log by the front end, without a map.

    That depth and color contradict each other is what is to be calibrated: no frame is lost for it.

    Args:
        path: of the log.
        robot: its name.
        config: of the front end.

    Raises:
        UndeterminedError: no frame begins a map.
    """
    failure = config.tracking.failure.model_copy(update={"color_check_gray_of_usual": math.inf})
    tracking = config.tracking.model_copy(update={"failure": failure})
    exposure = config.exposure.model_copy(update={"mode": "off"})  # only maps need it
    config = config.model_copy(update={"mapping_enabled": False, "tracking": tracking, "exposure": exposure})
    with tempfile.TemporaryDirectory(prefix="duagc-calibrate-") as folder:
        try:
            run_frontend(path, Path(folder) / "frontend.mcap", config, progress=True)
        except NothingToMapError as error:
            raise UndeterminedError(str(error)) from error
        frames = RobotRun(robot, Path(folder)).frames
        with open_rgbd(path) as log:
            readout = log.readout if log.states_readout else Readout.found(Path(folder) / "frontend.mcap")
    return Tracked(
        path=path,
        robot=robot,
        T_map_camera=np.array([frame.T_map_camera for frame in frames]),
        ok=np.array([frame.status == "ok" for frame in frames]),
        held_out=np.array([frame.held_out for frame in frames]),
        stamps_ns=np.array([frame.stamp_ns for frame in frames]),
        readout=readout or READ_AT_ONCE,
    )
