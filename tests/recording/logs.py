"""Small logs and recordings for the tests beside this file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from duagc.converters.writer import RecordingWriter, RobotWriter, robot_names
from duagc.pipeline import messages as m
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import LogWriter, read_log
from duagc.schemas import topics

CAMERA = PinholeCamera(16, 12, 14.0, 14.0, 7.5, 5.5)
FRAME_NS = 33_333_333
COLOR, DEPTH, CALIBRATION = "/alpha/camera/color", "/alpha/camera/depth", "/alpha/camera/calibration"
LOGS = Path(__file__).parents[3] / "shared" / "data" / "logs"


def image(index: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 255, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)


def png(array: np.ndarray) -> bytes:
    return cv2.imencode(".png", array)[1].tobytes()


def depth(index: int) -> np.ndarray:
    return np.random.default_rng(1000 + index).integers(
        0, 5000, (CAMERA.height, CAMERA.width), dtype=np.uint16
    )


def write_camera(
    path: Path,
    frames: int = 4,
    skip_color: tuple[int, ...] = (),
    skip_depth: tuple[int, ...] = (),
    cameras: dict[int, PinholeCamera] | None = None,
    scale: str | None = "0.001",
    color: Callable[[int], bytes] = lambda index: png(image(index)),
    depth: Callable[[int], np.ndarray] = depth,
    masks: dict[int, Any] | None = None,
) -> Path:
    with LogWriter(path, "alpha") as log:
        log.channel(
            topics.DEPTH.of("alpha"), topics.DEPTH.schema, {} if scale is None else {"depth_scale": scale}
        )
        for index in range(frames):
            stamp = index * FRAME_NS
            for at, camera in ({0: CAMERA} if cameras is None else cameras).items():
                if at == index:
                    log.write(
                        topics.CALIBRATION.of("alpha"), m.pack_calibration(stamp, "alpha", camera), stamp
                    )
            if index not in skip_color:
                log.write(topics.COLOR.of("alpha"), m.pack_color(stamp, "alpha", color(index), "png"), stamp)
            if index not in skip_depth:
                log.write(topics.DEPTH.of("alpha"), m.pack_depth(stamp, "alpha", depth(index)), stamp)
            if masks is not None and index in masks:
                log.write(topics.MASK.of("alpha"), masks[index], stamp)
    return path


def update(robot: str, index: int) -> m.MapUpdate:
    return m.MapUpdate(index, robot, index, 1, 2, 3, 0.5, 0.25)


def write_updates(
    path: Path, robot: str, log_times: list[int], metadata: dict[str, str] | None = None
) -> str:
    with LogWriter(path, robot, metadata) as log:
        for index, time in enumerate(log_times):
            log.write(topics.MAP_UPDATE.of(robot), update(robot, index), time, max(0, time - 5))
    return log.digest


def copy_camera(source: Path, log: LogWriter, time: int) -> None:
    """The images of a camera log, all at one log time."""
    log.channel(DEPTH, topics.DEPTH.schema, {"depth_scale": "0.001"})
    for record in read_log(source):
        log.write(record.topic, record.proto(), time, record.publish_time_ns)


def write_robot(robot: RobotWriter, frames: int, exact: bool = False) -> None:
    for index in range(frames):
        T_world_camera = se3.exp([0.1 * index, 0, 0, 0, 0, 0.01 * index])
        truth = depth(50 + index) if exact else None
        robot.add_frame(index * FRAME_NS, png(image(index)), "png", depth(index), T_world_camera, truth)


def write_recording(out: Path, robots: int = 2, frames: int = 3, **arguments: Any) -> Path:
    with RecordingWriter(out, source={"dataset": "test"}, converter="test", **arguments) as recording:
        for name in robot_names(robots):
            with recording.robot(name, CAMERA, 0.001) as robot:
                write_robot(robot, frames)
    return out
