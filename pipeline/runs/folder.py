"""A finished run as arrays: what evaluation, report and viewer read. Nothing here opens ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_json
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.base.unmapped import Unmapped
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.geometry.trajectory import Trajectory, read_tum
from duagc.pipeline.messages import (
    CorrectedKeyframes,
    GaussianInformation,
    GaussianMap,
    Keyframe,
    Odometry,
    Submap,
)
from duagc.pipeline.recording import Recording, read_exposures, read_log, stated_digest
from duagc.pipeline.runs.digest import digest_file
from duagc.pipeline.runs.metrics import sound_metrics
from duagc.pipeline.splat.ply import gaussians_in_ply
from duagc.schemas import topics

SCHEMA = 1  # of manifest.json
TYPES = {
    "recording": str,
    "config": str,
    "inputs": dict,
    "outputs": dict,
    "stages": dict,
    "calibration": dict,
    "unmapped": dict,
}
"""What the manifest holds."""
TIMES = ("wall_s", "cpu_s", "peak_rss_mb")
"""What timing.json holds of every stage."""
METRICS_SCHEMA = 2  # of metrics.json; 1 had a reason for every name, and other names of loop closures


def written(path: Path) -> Path:
    """A result of a run, which may have been stopped before the stage that writes it.

    Args:
        path: of the file, in the folder of the run.

    Raises:
        DuagError: it is not there.
    """
    if not path.is_file():
        raise DuagError(f"{path}: not found; `duagc run` without --until writes it")
    return path


@dataclass(frozen=True)
class RobotRun:
    """The results of one robot; files are read when they are asked for, and once.

    Attributes:
        robot: its name.
        folder: robots/<robot> of the run.
        digests: digest of every result file by its name, as the manifest has it; empty while the run is being made.
    """

    robot: str
    folder: Path
    digests: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def odometry(self) -> Trajectory:
        """T_map_camera of all frames that are not lost, before consensus, in the robot's own map frame."""
        return self._trajectory("odometry.tum")

    @cached_property
    def trajectory(self) -> Trajectory:
        """T_world_camera of all frames that are not lost, after consensus, by the robot's own estimate."""
        return self._trajectory("trajectory.tum")

    @cached_property
    def frames(self) -> list[Odometry]:
        """Every frame of the log, in order, as the front end tracked it."""
        return self._all("frontend.mcap", topics.ODOMETRY)

    @cached_property
    def held_out(self) -> frozenset[int]:
        """Indices of the frames that the front end kept for evaluation."""
        return frozenset(f.frame_index for f in self.frames if f.held_out)

    @cached_property
    def keyframes(self) -> list[Keyframe]:
        """Every keyframe, in order of its index."""
        return self._all("frontend.mcap", topics.KEYFRAME)

    @cached_property
    def submaps(self) -> list[Submap]:
        """The submaps of this component, in the order in which they began; none if the robot has a single one."""
        return self._all("frontend.mcap", topics.SUBMAP)

    @cached_property
    def exposures(self) -> ExposureTrack:
        """Exposures of the frames; none where all are exposed as the map."""
        return read_exposures(self.folder / "frontend.mcap", self.robot)

    @cached_property
    def own_map(self) -> GaussianMap:
        """The robot's own map, in its own map frame, as it was at the end of its log."""
        return self._last("frontend.mcap", topics.MAP)

    @cached_property
    def unrefined_map(self) -> GaussianMap | None:
        """The own map before its final refinement; None if the front end wrote none."""
        maps = self._all("frontend.mcap", topics.UNREFINED_MAP)
        return maps[-1] if maps else None

    @cached_property
    def information(self) -> GaussianInformation:
        """Fisher information of the own map."""
        return self._last("information.mcap", topics.INFORMATION)

    @cached_property
    def fused_map(self) -> GaussianMap:
        """The map after fusion, world frame, with the information of its Gaussians."""
        return self._last("fused.mcap", topics.FUSED_MAP)

    @cached_property
    def refined_map(self) -> GaussianMap | None:
        """The robot's final map: the fused one after training, world frame; None if it met no other robot."""
        maps = self._all("fused.mcap", topics.REFINED_MAP)
        return maps[-1] if maps else None

    @cached_property
    def corrected(self) -> CorrectedKeyframes:
        """Keyframe poses after consensus, and the component that the robot counts itself in."""
        return self._last("fused.mcap", topics.CORRECTED_KEYFRAMES)

    @cached_property
    def rejected_matches(self) -> dict[tuple[str, str], NDArray[np.int64]]:
        """Ids [n, 2] of matched Gaussians that it did not use, by the two robots, lower name first."""
        found = self._all("fused.mcap", topics.REJECTED_MATCHES)
        return {(m.lower, m.higher): m.ids for m in found}

    @property
    def component(self) -> tuple[str, ...]:
        """Names of the robots that share this robot's world frame, itself among them."""
        return tuple(sorted({*self.corrected.component, self.robot}))

    def _trajectory(self, file: str) -> Trajectory:
        """A log has checksums of its own; of a text file only the manifest knows what was written."""
        path = written(self.folder / file)
        trajectory = read_tum(path)
        if file in self.digests and (found := digest_file(path)) != self.digests[file]:
            raise DuagError(
                f"{path}: has digest {found[:12]}, expected {self.digests[file][:12]} as in manifest.json"
            )
        return trajectory

    def _all(self, file: str, topic: topics.Topic) -> list[Any]:
        path = written(self.folder / file)
        return [SHELF.put(r.message()) for r in read_log(path, topics=[topic.of(self.robot)])]

    def _last(self, file: str, topic: topics.Topic) -> Any:
        found = self._all(file, topic)
        if not found:
            raise DuagError(
                f"{self.folder / file}: found no message on {topic.of(self.robot)}, expected at least one"
            )
        return found[-1]


@dataclass(frozen=True)
class RunFolder:
    """A run: its robots in order of their names, its settings and timings.

    A component of a robot that did not join its largest one is among them, as "alpha-2" after "alpha".

    Attributes:
        path: the folder.
    """

    path: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))  # a text will do

    @cached_property
    def robots(self) -> dict[str, RobotRun]:
        """Robots by name, in order of the names."""
        folder = self.path / "robots"
        names = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
        if not names:
            raise DuagError(f"{self.path}: found no folder robots/<robot>, expected a run")
        for name in self._json("manifest.json").get("inputs", {}):
            if name not in names and name not in self.unmapped:
                raise DuagError(
                    f"{folder / name}: no such folder, expected the results that manifest.json names"
                )
        return {name: RobotRun(name, folder / name, self._digests(name)) for name in names}

    @cached_property
    def unmapped(self) -> dict[str, Unmapped]:
        """Robots that the run went on without, by name, in order: no map could be begun in their logs."""
        rows = self._json("manifest.json").get("unmapped", {})
        where = f"{self.path / 'manifest.json'}: unmapped"
        return {name: Unmapped.of(row, f"{where}: {name}") for name, row in sorted(rows.items())}

    @cached_property
    def largest_component(self) -> tuple[str, ...]:
        """The robots that agree to share one world, most robots first, then most components, then lowest names.

        A robot is a member if its own estimate of the component is the same as that of the others.
        """
        claims = [robot.component for robot in self.robots.values()]
        members = {
            claim: tuple(r for r in self.robots if self.robots[r].component == claim) for claim in claims
        }
        return min(
            members.values(), key=lambda names: (-len({robot_of(n) for n in names}), -len(names), names)
        )

    @property
    def final_maps(self) -> list[Path]:
        """The files of the final maps that are there, by robot, without those of no Gaussian."""
        return [path for path in sorted(self.path.glob("robots/*/refined.ply")) if gaussians_in_ply(path)]

    @property
    def calibration(self) -> list[str]:
        """What the calibration that the run began with found, in sentences; empty: it began with none."""
        cameras = self._json("manifest.json").get("calibration", {}).get("cameras", [])
        try:
            return [str(line) for camera in cameras for line in camera["summary"]]
        except (KeyError, TypeError) as error:
            raise DuagError(
                f"{self.path / 'manifest.json'}: calibration.cameras has no summaries, expected one of each"
            ) from error

    @property
    def recording(self) -> Path:
        """Where the manifest says that the recording of this run is.

        Raises:
            DuagError: this is not a finished run, or the recording is no longer there.
        """
        path = self.path / "manifest.json"
        if not path.is_file():
            raise DuagError(f"{path}: no such file, expected the manifest of a finished run")
        named = self._json(path.name).get("recording")
        if named is None:
            raise DuagError(f"{path}: names no recording, expected the manifest of a finished run")
        if not (self.path / named).is_dir():
            raise DuagError(f"{path}: recording {named} not found; give --recording")
        return (self.path / named).resolve()

    def recording_at(self, path: str | Path | None = None) -> Path:
        """The recording that this run was made of, wherever it is now.

        Args:
            path: its folder; None: where the manifest says.

        Raises:
            DuagError: it is not there, or another one, by the digests of its logs.
        """
        path = self.recording if path is None else Path(path)
        recording = Recording(path)
        for robot, expected in self._json("manifest.json").get("inputs", {}).items():
            log = recording.log(robot)
            found = stated_digest(log) or digest_file(log)  # recording.json is not trusted
            if found != expected:
                raise DuagError(
                    f"{log}: has digest {found[:12]}, expected {str(expected)[:12]}, the log that "
                    f"{self.path} was made of"
                )
        return path

    @property
    def config_file(self) -> Path:
        """config.toml, checked against the manifest where there is one.

        Raises:
            DuagError: it is missing, or not what the run was made with.
        """
        path = self.path / "config.toml"
        if not path.is_file():
            raise DuagError(f"{path}: no such file, expected the configuration of the run")
        expected = self._json("manifest.json").get("config")
        if expected is not None and (found := digest_file(path)) != expected:
            raise DuagError(f"{path}: has digest {found[:12]}, expected {expected[:12]} as in manifest.json")
        return path

    @property
    def config_text(self) -> str:
        """The resolved configuration as TOML."""
        return self.config_file.read_text(encoding="utf-8")

    @cached_property
    def config(self) -> RunConfig:
        """The settings of the run.

        Raises:
            DuagError: config.toml is missing, not what the run was made with, or names an unknown setting.
        """
        return load_config(RunConfig, self.config_file)

    @property
    def timing(self) -> dict[str, dict[str, Any]]:
        """Label -> {"stage", "robot", "wall_s", "cpu_s", "peak_rss_mb", "executed"}; empty without timing.json.

        What a row of somebody else does not say follows from its label; then the stage counts as executed.
        """
        stages = self._json("timing.json").get("stages", {})
        rows = stages.values() if isinstance(stages, dict) else [None]
        if not all(isinstance(row, dict) and all(_is_number(row.get(n)) for n in TIMES) for row in rows):
            raise DuagError(
                f"{self.path / 'timing.json'}: found no table of {', '.join(TIMES)} of every stage, expected one"
            )
        return {name: _of_label(name) | {"executed": True} | row for name, row in stages.items()}

    @property
    def metrics(self) -> dict[str, Any]:
        """metrics.json; empty if the run was not evaluated.

        Raises:
            DuagError: a table is missing or not what it should be; so does the result where a missing name is read.
        """
        metrics = self._json("metrics.json", METRICS_SCHEMA)
        return sound_metrics(metrics, self.path / "metrics.json") if metrics else {}

    def _digests(self, robot: str) -> dict[str, str]:
        outputs = self._json("manifest.json").get("outputs", {})
        start = f"robots/{robot}/"
        return {name.removeprefix(start): d for name, d in outputs.items() if name.startswith(start)}

    def _json(self, name: str, schema: int = SCHEMA) -> dict[str, Any]:
        path = self.path / name
        if not path.is_file():
            return {}
        content = read_json(path, "the file of a run")
        if content.get("schema", schema) != schema:
            raise DuagError(f"{path}: schema is {content['schema']}, expected {schema}")
        for key, kind in (TYPES if name == "manifest.json" else {}).items():
            if not isinstance(content.get(key, kind()), kind):
                found = type(content[key]).__name__
                raise DuagError(f"{path}: {key} is a {found}, expected a {kind.__name__}")
        return content


def _of_label(name: str) -> dict[str, str | None]:
    """Stage and robot of a row of timing.json, as `timing.label` names it."""
    stage, _, robot = name.partition(".")
    return {"stage": stage, "robot": robot or None}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def position_information(geometry: NDArray[np.float32]) -> NDArray[np.float64]:
    """Position block [n, 3, 3], 1/m^2, of geometry information [n, 45] (upper triangle of 9x9, row-major).

    Args:
        geometry: [n, 45].
    """
    values = geometry.astype(np.float64)
    row_1, row_2 = 9, 17  # places of the diagonal elements (1, 1) and (2, 2) in the upper triangle
    F = np.empty((len(values), 3, 3))
    F[:, 0, 0], F[:, 0, 1], F[:, 0, 2] = values[:, 0], values[:, 1], values[:, 2]
    F[:, 1, 1], F[:, 1, 2] = values[:, row_1], values[:, row_1 + 1]
    F[:, 2, 2] = values[:, row_2]
    F[:, 1, 0], F[:, 2, 0], F[:, 2, 1] = F[:, 0, 1], F[:, 0, 2], F[:, 1, 2]
    return F
