"""The stages of a run in their order, each with what it is computed from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

from duagc.pipeline import steps
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.unmapped import NothingToMapError, Unmapped
from duagc.pipeline.cache.carrier import Carried, Carrier
from duagc.pipeline.cache.file_digests import FileDigests
from duagc.pipeline.recording import RECORDING_FILE, Recording, read_log
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.session_file import NAME as SESSION
from duagc.pipeline.runs.timing import Timing, label
from duagc.pipeline.watch import UNWATCHED, Watch
from duagc.schemas import topics

UNMAPPED = "unmapped"
"""Names, in the result of a front end, what is known of a log without a map."""


@dataclass(frozen=True)
class Prepared:
    """A robot, or a component of it, with its own results; a robot of whose log no map could be begun has none."""

    frontend: Carried
    information: Carried | None

    @property
    def unmapped(self) -> Unmapped | None:
        """Why the robot has no map; None: it has one."""
        row = self.frontend.entry.result.get(UNMAPPED)
        return None if row is None else Unmapped.of(row, self.frontend.label)


def with_map(
    prepared: Mapping[str, Prepared], recording: Recording
) -> tuple[dict[str, Prepared], dict[str, Any]]:
    """The robots that have a map, and what is known of the others, as the manifest has it.

    Args:
        prepared: every robot, by name.
        recording: of them.

    Raises:
        NothingToMapError: none has a map.
    """
    unmapped = {name: why for name, robot in prepared.items() if (why := robot.unmapped) is not None}
    mapped = {name: robot for name, robot in prepared.items() if name not in unmapped}
    if unmapped and not mapped:
        raise NothingToMapError(recording.log(min(unmapped)), unmapped[min(unmapped)])
    return mapped, {name: why.plain() for name, why in unmapped.items()}


def warnings_of(prepared: Mapping[str, Prepared], recording: Recording) -> list[str]:
    """What users should know of the front ends, a line each.

    Args:
        prepared: every robot, by name.
        recording: of them.
    """
    unmapped = {name: why for name, robot in sorted(prepared.items()) if (why := robot.unmapped) is not None}
    found = []
    if len(unmapped) < len(prepared):  # else the run ends
        found += [
            f"{recording.log(name)}: {why.found}; the run goes on without {name}"
            for name, why in unmapped.items()
        ]
    found += [
        f"{name}: what {robot_of(name)} saw after it was lost did not join the rest of its path"
        for name in sorted(set(prepared) - set(recording.robots))
    ]
    return found


class Chain:
    """The stages of a run in their order, each with what it is computed from."""

    def __init__(
        self, recording: Recording, carrier: Carrier, digests: FileDigests, watch: Watch = UNWATCHED
    ) -> None:
        """Keep what every stage needs; none is looked up or computed yet.

        Args:
            recording: that the run is of.
            carrier: does the stages.
            digests: of the files of the recording.
            watch: hears of the steps of the stages, and changes nothing.
        """
        self._recording, self._carrier, self._digests = recording, carrier, digests
        self._watch = watch

    def calibration(self, workers: int) -> Carried:
        """The recording with its cameras calibrated, if that is better; no file, if it is not.

        Args:
            workers: tasks that are done at the same time; changes no bit of the result.
        """
        carrier, recording = self._carrier, self._recording

        def calibrate(timing: Timing) -> dict[str, Any]:
            settings = carrier.settings_of(stages.CALIBRATION)
            with timing.measured(stages.CALIBRATION.name):
                return steps.calibration(recording, carrier.folder, settings, workers=workers)

        return carrier.carry(stages.CALIBRATION, None, self._recorded(), calibrate)

    def robot(self, robot: str, *, threads: SupportsIndex, alone: bool = False) -> dict[str, Prepared]:
        """Front end and Fisher information of one robot, from its own log alone; by name of the component.

        A robot of whose log no map could be begun has no files, and no information.

        Args:
            robot: its name.
            threads: of the kernels; changes no bit of the result.
            alone: leave the information out.
        """
        log, carrier = self._recording.log(robot), self._carrier
        folder = carrier.folder / "robots" / robot
        digest = self._digests.of(log).content if carrier.store is not None else ""
        inputs = {"log": digest}

        def track_and_map(timing: Timing) -> dict[str, Any]:
            size = steps.check_log(log, robot)
            folder.mkdir(parents=True, exist_ok=True)
            settings = carrier.settings_of(stages.FRONTEND)
            report = self._watch.frontend(robot, self._recording.robots.index(robot))
            checkpoints = carrier.checkpoints(carrier.key(stages.FRONTEND, robot, inputs), report)
            with timing.stage(stages.FRONTEND, folder, robot):
                try:
                    parts = steps.frontend(log, folder, settings, threads=threads, checkpoints=checkpoints)
                except NothingToMapError as error:
                    folder.rmdir()
                    return size | {"keyframes": 0, "exact": 0, UNMAPPED: error.unmapped.plain()}
            timing.went_on(label("frontend", robot), *checkpoints.before_s)
            timing.stages[label("frontend", robot)]["parts"] = parts
            made = [sum(1 for _ in read_log(path, [topics.KEYFRAME])) for path in folder.glob("*.mcap")]
            kind = next(read_log(folder / "frontend.mcap", [topics.MAP])).proto().depth
            return size | {"keyframes": sum(made), "exact": int(kind == "ray_plane")}

        def written() -> Iterator[Path]:
            if not folder.is_dir():
                return
            for of_component in steps.move_components(robot, folder).values():
                yield of_component / "frontend.mcap"

        front = carrier.carry(stages.FRONTEND, robot, inputs, track_and_map, files=written)
        names = [Path(name).parts[1] for name in front.entry.files]
        if alone or not names:
            return {name: Prepared(front, None) for name in names or [robot]}
        return {name: Prepared(front, self._information(name, front, digest, threads)) for name in names}

    def _information(self, name: str, front: Carried, log_digest: str, threads: SupportsIndex) -> Carried:
        log, carrier = self._recording.log(name), self._carrier
        folder = carrier.folder / "robots" / name

        def inform(timing: Timing) -> None:
            settings = carrier.settings_of(stages.INFORMATION)
            with timing.stage(stages.INFORMATION, folder, name):
                self._watch.tell((robot_of(name), "information", 0, 1))
                steps.information(log, folder, settings, threads=threads)

        inputs = {"log": log_digest, "frontend": front.content(f"robots/{name}/frontend.mcap")}
        return carrier.carry(stages.INFORMATION, name, inputs, inform)

    def exchange(self, prepared: Mapping[str, Prepared]) -> Carried:
        """The exchange of the team.

        Args:
            prepared: every robot, by name.
        """
        logs = {name: self._recording.log(name) for name in sorted(prepared)}
        carrier = self._carrier

        def meet(timing: Timing) -> None:
            settings = carrier.settings_of(stages.EXCHANGE)
            checkpoints = carrier.checkpoints(carrier.key(stages.EXCHANGE, None, inputs))
            with timing.stage(stages.EXCHANGE, carrier.folder):
                steps.exchange(
                    logs, carrier.folder, settings, checkpoints=checkpoints, watch=self._watch.round
                )
            timing.went_on(stages.EXCHANGE.name, *checkpoints.before_s)

        inputs: dict[str, str] = {}
        for name, robot in sorted(prepared.items()):
            inputs |= {f"{part} of {name}": digest for part, digest in _own(name, robot).items()}
        return carrier.carry(stages.EXCHANGE, None, inputs, meet)

    def fusion(self, name: str, robot: Prepared, exchange: Carried, *, threads: SupportsIndex) -> Carried:
        """The fused map of one robot.

        Args:
            name: of the robot.
            robot: with its own results.
            exchange: of the team.
            threads: of the kernels; changes no bit of the result.
        """
        log, carrier = self._recording.log(name), self._carrier
        folder = carrier.folder / "robots" / name

        inputs = _own(name, robot) | {"session": exchange.content(f"robots/{name}/{SESSION}")}

        def fuse(timing: Timing) -> dict[str, Any]:
            settings = carrier.settings_of(stages.FUSION)
            checkpoints = carrier.checkpoints(carrier.key(stages.FUSION, name, inputs))
            with timing.stage(stages.FUSION, folder, name):
                result = steps.fusion(name, log, folder, settings, threads=threads, checkpoints=checkpoints)
            timing.went_on(label("fusion", name), *checkpoints.before_s)
            return result

        return carrier.carry(stages.FUSION, name, inputs, fuse)

    def reader(
        self,
        stage: stages.Stage,
        done: Sequence[Carried],
        more: Mapping[str, str],
        workers: Callable[[], int],
        *,
        matched: Callable[[], Mapping[str, Any]] = dict,
    ) -> Carried:
        """Evaluation, report or view: of everything that is there.

        Args:
            stage: one of these.
            done: all stages before.
            more: digests of what else it reads.
            workers: how many robots it looks at at the same time, asked if it is computed; changes no bit.
            matched: of the evaluation: what is known already of the features of robots, asked if it is computed.
        """
        carrier, recording = self._carrier, self._recording.path
        inputs = {name: d.content for c in done for name, d in c.entry.files.items()}
        inputs |= {f"recording: {name}": digest for name, digest in self._recorded().items()} | dict(more)

        def read(timing: Timing) -> None:
            with timing.stage(stage, carrier.folder):
                if stage is stages.EVALUATION:
                    saved = carrier.checkpoints(carrier.key(stage, None, inputs)).folder
                    known, hear = matched(), self._watch.tell
                    steps.evaluation(carrier.folder, recording, workers(), saved, matched=known, hear=hear)
                else:
                    step = steps.report if stage is stages.REPORT else steps.view
                    step(carrier.folder, recording, workers())

        return carrier.carry(stage, None, inputs, read)

    def _recorded(self) -> dict[str, str]:
        """Digests of all that the recording names, true poses and geometry among it."""
        recording = self._recording
        if self._carrier.store is None:
            return {}
        files = [recording.path / RECORDING_FILE, recording.geometry()]
        for robot in recording.robots:
            files += [recording.log(robot), recording.groundtruth(robot)]
        return {path.name: self._digests.of(path).content for path in files if path is not None}


def _own(name: str, robot: Prepared) -> dict[str, str]:
    """What a robot's own results are computed from, and these."""
    assert robot.information is not None
    return {
        "log": robot.frontend.entry.key.inputs.get("log", ""),
        "frontend": robot.frontend.content(f"robots/{name}/frontend.mcap"),
        "information": robot.information.content(f"robots/{name}/information.mcap"),
    }
