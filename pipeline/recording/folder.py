"""The folder of a recording and its description."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_bytes
from duagc.pipeline.recording.names import RECORDING_FILE, RECORDING_FORMAT, RECORDING_SCHEMA
from duagc.pipeline.recording.rgbd import open_rgbd
from duagc.schemas import topics


class Recording:
    """A folder with one log per robot and a `recording.json` that says what they are."""

    def __init__(self, path: str | Path) -> None:
        """Read the description of a recording; its logs are opened when they are asked for.

        Args:
            path: folder of the recording.
        Raises:
            DuagError: the folder has no sound `recording.json`.
        """
        self.path = Path(path)
        self.description = _read_description(self.path / RECORDING_FILE)
        self.name: str = self.description["name"]
        self._robots: dict[str, dict[str, Any]] = self.description["robots"]

    @property
    def robots(self) -> list[str]:
        """Names of the robots, sorted."""
        return sorted(self._robots)

    def log(self, robot: str) -> Path:
        """The log of a robot's sensors.

        Args:
            robot: name of the robot.

        Raises:
            DuagError: the recording has no such robot, or its log is missing.
        """
        path = self.path / self._robot(robot)["log"]
        if not path.is_file():
            raise DuagError(f"{path}: no such file, expected the log of {robot} that {RECORDING_FILE} names")
        return path

    def check_names(self) -> None:
        """Refuse a recording that has one robot's log as another's.

        Raises:
            DuagError: names the log, whose it is and whose it should be.
        """
        for robot in self.robots:
            with open_rgbd(self.log(robot)) as log:
                log.check_robot(robot)

    @property
    def calibration(self) -> list[str]:
        """What a calibration changed in this recording, in sentences; empty: nothing did."""
        try:
            said = [str(line) for c in self.description["calibration"]["cameras"] for line in c["summary"]]
        except (KeyError, TypeError):  # there is none, or recording.json says nonsense
            return []
        return said

    def digest(self, name: str) -> str:
        """Content digest of a log as it was written; "nothing" if recording.json has none.

        Args:
            name: file name of the log.
        """
        rows = self._robots.values()
        digest = next(
            (d[name] for r in rows if isinstance(d := r.get("digests"), dict) and name in d), "nothing"
        )
        return str(digest)

    def groundtruth(self, robot: str) -> Path | None:
        """The log of a robot's ground truth, for evaluation only; None where there is none, listed or not.

        Args:
            robot: name of the robot.

        Raises:
            DuagError: the recording has no such robot.
        """
        name = self._robot(robot).get("groundtruth")
        return self.path / name if name and (self.path / name).is_file() else None

    def geometry(self) -> Path | None:
        """The true geometry of the scene, for evaluation only; None where there is none."""
        name = self.description.get("geometry")
        return self.path / name if name and (self.path / name).is_file() else None

    def _robot(self, name: str) -> dict[str, Any]:
        robot = robot_of(name)
        if robot not in self._robots:
            raise DuagError(
                f"{self.path}: found robots {', '.join(self.robots)}, expected {robot!r} among them"
            )
        return self._robots[robot]


def _read_description(path: Path) -> dict[str, Any]:
    if not path.is_file():
        other = "; `duagc convert` makes one of logs and datasets" if path.parent.exists() else ""
        raise DuagError(f"{path}: no such file, expected a recording (a folder with {RECORDING_FILE}){other}")
    try:
        description = json.loads(read_bytes(path, "the JSON of a recording"))
    except (ValueError, RecursionError) as error:
        raise DuagError(f"{path}: {error}, expected the JSON of a recording") from error
    if not isinstance(description, dict) or description.get("format") != RECORDING_FORMAT:
        found = description.get("format") if isinstance(description, dict) else type(description).__name__
        raise DuagError(f"{path}: format is {found!r}, expected {RECORDING_FORMAT!r}")
    if description.get("schema") != RECORDING_SCHEMA:
        raise DuagError(f"{path}: schema is {description.get('schema')!r}, expected {RECORDING_SCHEMA}")
    robots = description.get("robots")
    if not isinstance(robots, dict) or not robots or not isinstance(description.get("name"), str):
        raise DuagError(f"{path}: found no name or no robots, expected both")
    for field, kind in (("source", dict), ("warnings", list), ("checks", dict), ("clocks", dict)):
        if not isinstance(description.setdefault(field, kind()), kind):
            found = type(description[field]).__name__
            raise DuagError(f"{path}: {field} is a {found}, expected a {kind.__name__}")
    _check_file_name(path, "geometry", description.get("geometry"))
    for robot, row in robots.items():
        if not re.fullmatch(
            topics.ROBOT_NAME, robot
        ):  # it becomes the name of a folder and part of every topic
            raise DuagError(
                f"{path}: found a robot {robot!r}, expected lower-case letters, digits and underscores"
            )
        if not isinstance(row, dict) or not isinstance(row.get("log"), str):
            raise DuagError(f"{path}: robot {robot!r} has no log, expected the name of one")
        if not isinstance(row.get("sensors") or {}, dict):
            found = type(row["sensors"]).__name__
            raise DuagError(f"{path}: {robot}.sensors is a {found}, expected a dict")
        _check_file_name(path, f"{robot}.log", row["log"])
        _check_file_name(path, f"{robot}.groundtruth", row.get("groundtruth"))
    return description


def _check_file_name(path: Path, field: str, name: Any) -> None:
    """Files of a recording lie in its folder: no path leads out of it."""
    if name is not None and (not isinstance(name, str) or not name or Path(name).name != name):
        raise DuagError(f"{path}: {field} is {name!r}, expected the name of a file in the same folder")
