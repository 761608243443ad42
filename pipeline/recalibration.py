"""A recording with its cameras calibrated from its own images, where views that were not used say that it is better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc.converters.calibrated_copy import Correction, why_not, write_calibrated
from duagc.pipeline.base import determinism
from duagc.pipeline.camera_calibration import report
from duagc.pipeline.camera_calibration.calibrate import Calibration, calibrate
from duagc.pipeline.camera_calibration.undetermined import UndeterminedError
from duagc.pipeline.config.calibration import CalibrationConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.recording import Recording, open_rgbd


@dataclass(frozen=True)
class CalibrationOutcome:
    """What was found about the cameras of some robots.

    Attributes:
        robots: their names; they have one kind of camera.
        found: the calibration; None: the images do not determine one.
        refused: why it is not applied; "": it is.
        delay_ns: how much earlier it makes the stamps of depth.
    """

    robots: tuple[str, ...]
    found: Calibration | None
    refused: str
    delay_ns: int = 0

    @staticmethod
    def of(found: Calibration, robots: Sequence[str], config: CalibrationConfig) -> CalibrationOutcome:
        """A calibration as it is judged.

        Args:
            found: the calibration.
            robots: whose cameras they are.
            config: what is good enough.
        """
        return CalibrationOutcome(tuple(robots), found, found.refusal(config), found.delay_ns(config))

    def lines(self) -> list[str]:
        """What changes and why, or why nothing does, in sentences."""
        names = ", ".join(self.robots)
        if not self.refused:
            assert self.found is not None
            return [f"{names}: calibrated", *report.changes(self.found, self.delay_ns)]
        lines = [f"{names}: kept as recorded: {self.refused}"]
        if self.found is not None:
            lines += [f"agreement, as recorded -> calibrated: {report.change(j)}" for j in self.found.judged]
        return lines

    def plain(self) -> dict[str, Any]:
        """As plain values, for `recording.json`."""
        values = {} if self.found is None else report.plain(self.found)
        values.pop("options", None)
        return {
            "robots": list(self.robots),
            "refused": self.refused,
            "depth_stamps_moved_ns": -self.delay_ns,
            "summary": self.lines(),
            **values,
        }


def calibrated(
    recording: Recording,
    folder: Callable[[], Path],
    name: str,
    config: RunConfig,
    *,
    workers: int = 1,
) -> tuple[list[CalibrationOutcome], bool]:
    """Calibrate a recording, robots of each camera together, and write it calibrated if that is better.

    Args:
        recording: as it is.
        folder: gives the folder to write into; called if there is something to write.
        name: of the new recording.
        config: of the calibration, and of the front end that tracks the recording.
        workers: tasks that are done at the same time; changes no bit of the result.

    Returns:
        What was found about each camera, and whether a recording was written.

    Raises:
        DuagError: a log is broken.
    """
    determinism.configure_opencv()
    outcomes = [_outcome(recording, robots, config, workers) for robots in _by_camera(recording)]
    if all(outcome.refused for outcome in outcomes):
        return outcomes, False
    write(recording, outcomes, folder(), name)
    return outcomes, True


def write(recording: Recording, outcomes: Sequence[CalibrationOutcome], folder: Path, name: str) -> None:
    """Write a recording as accepted calibrations have it.

    Args:
        recording: as it is.
        outcomes: what was found; robots of refused ones, and robots in none, are copied.
        folder: to write into; it exists.
        name: of the new recording.

    Raises:
        DuagError: a log is broken, or has no depth images.
    """
    corrections = {
        robot: _correction(outcome) for outcome in outcomes if not outcome.refused for robot in outcome.robots
    }
    entry = {"cameras": [outcome.plain() for outcome in outcomes]}
    write_calibrated(recording, corrections, folder, name, calibration=entry)


def _by_camera(recording: Recording) -> list[list[str]]:
    """Robots that have one camera, in order of their names."""
    groups: dict[PinholeCamera, list[str]] = {}
    for robot in recording.robots:
        with open_rgbd(recording.log(robot)) as log:
            groups.setdefault(log.camera, []).append(robot)
    return list(groups.values())


def _outcome(recording: Recording, robots: list[str], config: RunConfig, workers: int) -> CalibrationOutcome:
    for robot in robots:
        if why := why_not(recording.log(robot)):
            return CalibrationOutcome(tuple(robots), None, why)
    try:
        found = calibrate(recording.path, config.frontend, robots, config.calibration.views, workers=workers)
    except UndeterminedError as error:
        return CalibrationOutcome(tuple(robots), None, str(error))
    return CalibrationOutcome.of(found, robots, config.calibration)


def _correction(outcome: CalibrationOutcome) -> Correction:
    assert outcome.found is not None
    rig = outcome.found.rig
    c = rig.camera
    fx, fy, cx, cy, k1, k2, k3 = rig.lens.tolist()
    x, y, z = so3.log(rig.R_color_depth).tolist()
    source = PinholeCamera(c.width, c.height, fx, fy, cx, cy)
    lens = Lens(source, (k1, k2, 0.0, 0.0, k3), rotation_rad=(x, y, z))
    return Correction(lens, tuple(rig.depth_error.tolist()), outcome.delay_ns)
