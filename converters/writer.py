"""Writes a recording: a folder with one log per robot, its ground truth apart, and `recording.json`.

A recording has its final name only when it is complete. One process may write it all, or each robot's logs may be
written by a process of its own:

    with RecordingWriter(out, name, source, converter) as recording:
        with recording.robot("alpha", camera, depth_scale) as robot:
            robot.add_frame(...)

    with RecordingWriter(out, name, source, converter) as recording:
        folder = recording.folder            # give it to the workers; each one does:
        #     with RobotWriter(folder, "alpha", camera, depth_scale) as robot:
        #         robot.add_frame(...)
        #     return robot.summary
        for summary in pool.map(work, names):
            recording.add(summary)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from contextvars import ContextVar
from pathlib import Path
from types import TracebackType
from typing import Any

from duagc import __version__
from duagc.converters.layouts.validity import ALL_ROBOTS, USER_MASKS
from duagc.converters.robot_writer import RobotWriter
from duagc.pipeline.base.atomic_folder import RECORDING, new_folder, resolved
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import (
    RECORDING_FILE,
    RECORDING_FORMAT,
    RECORDING_SCHEMA,
)
from duagc.pipeline.recording.copies import copies

OPTIONS_FILE: ContextVar[dict[str, str] | None] = ContextVar("options_file", default=None)
"""Name and text of the file that the converter's options came from; recordings keep it."""

SPELLING_ALPHABET = """
    alpha bravo charlie delta echo foxtrot golf hotel india juliett kilo lima mike november oscar papa quebec romeo
    sierra tango uniform victor whiskey xray yankee zulu
"""
ROBOT_NAMES = tuple(SPELLING_ALPHABET.split())
FOUND = {
    "black": ", at the border, are black in all images",
    "drawn": " have edges that stay where they are while the camera moves, as text drawn over the images has",
    "body": ", at the border, keep their depth while the camera moves, as what carries it does",
}
"""Regions that do not show the scene, by the name that `RobotWriter` gives them."""
UNITS = {"time": "ns", "length": "m", "depth": "depth_scale_m per unit, along z, 0 = none", "angle": "rad"}


def robot_names(count: int) -> list[str]:
    """The first names of the spelling alphabet: alpha, bravo, charlie, ...

    Args:
        count: how many.

    Raises:
        DuagError: there are fewer than one, or more than names.
    """
    if not 1 <= count <= len(ROBOT_NAMES):
        raise DuagError(f"{count} robots, expected 1 to {len(ROBOT_NAMES)}")
    return list(ROBOT_NAMES[:count])


class RecordingWriter:
    """Writes the folder of a recording; a context manager. See the top of this file."""

    def __init__(
        self,
        out: str | Path,
        name: str = "",
        source: Mapping[str, Any] | None = None,
        converter: str = "",
        *,
        parameters: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> None:
        """Begin without a robot; the folder is made when the context is entered.

        Args:
            out: the folder; must not exist, unless `force` and it is a recording.
            name: of the recording; the name of the folder if empty.
            source: what it was made from; no absolute paths.
            converter: what made it.
            parameters: the settings it was made with.
            force: replace a recording that is there.
        """
        self.out = Path(out)
        self.name = name or resolved(self.out).name
        self.warnings: list[str] = []
        self.parameters = dict(parameters or {})
        self.checks: dict[str, Any] = {}
        # by robot: how its clock differs from the first robot's, where that was asked
        self.clocks: dict[str, Any] = {}
        self._source, self._converter, self._force = dict(source or {}), converter, force
        self._robots: dict[str, dict[str, Any]] = {}
        self._colors: dict[str, set[int]] = {}  # digests of the color images, by robot
        self._open: list[RobotWriter] = []
        self._geometry: str | None = None
        self._place = ExitStack()

    def __enter__(self) -> RecordingWriter:
        self.folder = self._place.enter_context(new_folder(self.out, self._force, RECORDING))
        return self

    def robot(
        self,
        name: str,
        camera: PinholeCamera,
        depth_scale: float,
        sensors: Mapping[str, str] | None = None,
        *,
        find_regions: bool = True,
    ) -> RobotWriter:
        """The writer of one robot's logs, to be used as a context manager within this one.

        Args:
            name: of the robot.
            camera: of color and depth alike.
            depth_scale: meters per unit of the depth images.
            sensors: as of `RobotWriter`.
            find_regions: as of `RobotWriter`.
        """
        writer = RobotWriter(
            self.folder, name, camera, depth_scale, sensors=sensors, find_regions=find_regions
        )
        self._open.append(writer)
        return writer

    def add(self, summary: Mapping[str, Any]) -> None:
        """Add a robot whose logs another `RobotWriter` has written into `folder`.

        Args:
            summary: that writer's summary.
        """
        row = dict(summary)
        robot = row.pop("robot")
        self._colors[robot] = set(row.pop("color_digests"))
        if not row.pop("measures"):
            self.warnings.append(
                f"{robot}: none of {row['frames']} frames has any depth (0, and the largest number, are none); "
                "expected some, or no map can be made"
            )
        if robot in self._robots:
            raise ValueError(f"robot {robot} is in the recording already")
        for name, words in FOUND.items():
            if row.get(f"{name}_share"):
                self.warnings.append(f"{robot}: {row[f'{name}_share']:.1%} of the pixels{words}; left out")
        self._robots[robot] = row

    def add_geometry(self, write: Callable[[Path], None]) -> None:
        """Add the true geometry of the scene.

        Args:
            write: is called with the path of a .ply file to write.
        """
        self._geometry = "groundtruth.ply"
        write(self.folder / self._geometry)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._place.__exit__(kind, error, trace)
            return
        with self._place:
            for writer in self._open:
                self.add(writer.summary)
            self._finish()

    def _finish(self) -> None:
        if not self._robots:
            raise DuagError(f"{self.out}: found no robot, expected at least one")
        for robot, row in self.checks.items():
            if not isinstance(row, Mapping):
                continue
            if row.get("rough"):
                self.warnings.append(
                    f"{robot}: depth moved by its true poses differs by {row['reprojection_median_m']:.3f} m at "
                    f"{row['median_depth_m']:.2f} m (medians), far less than without a motion: poses or depth are rough"
                )
            if "apart_m" in row:
                self.warnings.append(
                    f"{robot}: by its true poses, images that were compared are {row['apart_m']:.3g} m apart and show "
                    "too little of each other: whether poses (meters?), depth and intrinsics fit is not known"
                )
        self.warnings += [
            f"{other}: {same} of its color images are those of {robot}, byte for byte: what one camera saw once would "
            "count twice"
            for robot, other, same in copies(self._colors)
        ]
        unknown = sorted(set(USER_MASKS.get() or {}) - {ALL_ROBOTS} - set(self._robots))
        if unknown:
            names = ", ".join(sorted(self._robots))
            raise DuagError(f"{self.out}: a mask is of robot {unknown[0]!r}, expected one of {names}")
        description = {
            "format": RECORDING_FORMAT,
            "schema": RECORDING_SCHEMA,
            "name": self.name,
            "source": self._source,
            "converter": {"name": self._converter, "version": __version__},
            "parameters": self.parameters,
            "options_file": OPTIONS_FILE.get(),
            "units": UNITS,
            "geometry": self._geometry,
            "robots": {robot: self._robots[robot] for robot in sorted(self._robots)},
            "checks": self.checks,
            "clocks": self.clocks,
            "warnings": self.warnings,
        }
        text = json.dumps(description, indent=2, allow_nan=False) + "\n"
        with new_file(self.folder / RECORDING_FILE) as part:
            part.write_text(text)
