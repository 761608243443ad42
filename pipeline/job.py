"""A run that is being made: its stages in order, robots in parallel, and what it says about itself."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from duagc.pipeline import manifest, preparation, steps
from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.files import digest_of_values, new_file
from duagc.pipeline.base.thread_share import threads_per_worker
from duagc.pipeline.base.worker_reports import Step
from duagc.pipeline.cache.carrier import Carried, NotStoredError
from duagc.pipeline.cache.code_identity import CodeVersion
from duagc.pipeline.cache.file_digests import FileDigests
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.chain import UNMAPPED, Chain, Prepared, warnings_of, with_map
from duagc.pipeline.config.base import dump_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.preparation import Say, with_expected, workers_that_fit
from duagc.pipeline.recording import Recording
from duagc.pipeline.robot_processes import FusionProcesses, RobotProcesses
from duagc.pipeline.run_plan import RunPlan
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.digest import digest_file
from duagc.pipeline.time_left import EVERY_S, TimeLeft
from duagc.pipeline.watch import Watch, ticking

if TYPE_CHECKING:
    from duagc.pipeline.evaluation.map_agreement import MatchedViews

Found = TypeVar("Found")
READER_SHARE = 2.0  # memory of the evaluation of a robot, relative to its preparation
FUSION_SHARE = 1.5  # the same of its fusion
TITLES = {
    stages.CALIBRATION.name: "calibration",
    stages.EXCHANGE.name: "exchange and consensus",
    stages.FUSION.name: "fusion",
    stages.EVALUATION.name: "evaluation",
    stages.REPORT.name: "report",
    stages.VIEW.name: "view",
}
"""Stages that this process does, as they are announced."""


class Job:
    """A run that is being made, or looked at."""

    def __init__(
        self,
        recording: Recording,
        folder: Path,
        config: RunConfig,
        plan: RunPlan,
        *,
        log: Say,
        place: Path,
        looking: bool = False,
        versions: Mapping[str, CodeVersion] | None = None,
    ) -> None:
        """Prepare what carries out the stages and, if results are stored, read the versions of the code.

        Args:
            recording: that the run is of.
            folder: of the run.
            config: settings of all stages.
            plan: how it is done.
            log: gets a line at the start of every stage, and every warning.
            place: where an earlier run may be.
            looking: only look what is there: nothing is computed or written.
            versions: of the code of the stages, by entry; None: they are read.
        """
        self.recording, self.folder, self.config, self.plan, self.log = recording, folder, config, plan, log
        self.carrier = preparation.carrier_of(
            folder, config, plan, log=log, place=place, looking=looking, begun=self._announce
        )
        self.store = self.carrier.store
        self._versions = {} if self.store is None else preparation.versions(self.store, versions)
        self.digests = FileDigests(None) if self.store is None else self.store.files
        self.missing: list[StageKey] = []
        self._notes: dict[str, Any] = {}  # further rows of the manifest
        self._before: list[Carried] = []
        self._inputs: dict[Path, str] = {}
        self._known_sizes: dict[str, dict[str, int]] = {}
        self._place = place
        self._watch = Watch(self._hear)
        self._where: Any = None  # of the server that shows the run
        self._time_left: TimeLeft | None = None

    def run(self) -> None:
        """Do everything; now and then say how far it is.

        Raises:
            DuagError: what a user can fix.
        """
        if self.plan.follow:
            from duagc.pipeline.viewing.follow import Follower

            follower, self._where = Follower.serving(self.recording)
            self._watch = Watch(self._hear, follower)
            self.log(f"follow the run with: rerun {self._where[0]}")
        try:
            with ticking(self._say_time_left, EVERY_S):
                self._run()
        finally:
            if self._watch.follower is not None:
                self._watch.follower.close()

    def _hear(self, step: Step) -> None:
        if self._time_left is not None:
            self._time_left.step(*step)

    def _say_time_left(self) -> None:
        if self._time_left is not None:
            self.log(self._time_left.line())

    def _run(self) -> None:
        if self.plan.has(stages.EXCHANGE):
            steps.check_links(self.recording.robots, self.config)
        list(in_order(self._digest, map(self.recording.log, self.recording.robots)))  # side by side
        if self.plan.has(stages.EVALUATION) and (self.plan.calibrate or not self._is_stored()):
            from duagc.pipeline.evaluation import check_ground_truth

            check_ground_truth(self.recording)  # before minutes of work
        with new_file(self.folder / "config.toml") as part:
            part.write_text(dump_config(self.config))
        self.calibrate()
        for path in map(self.recording.log, self.recording.robots):
            if (found := self._digest(path)) != (expected := self.recording.digest(path.name)):
                self.log(
                    f"warning: {path}: has digest {found[:12]}, expected {expected[:12]} as in recording.json"
                )
        self.stages()

    def calibrate(self) -> None:
        """Go on with the calibrated recording, if the plan asks for one and it is better.

        Raises:
            NotStoredError: it would have to be computed while only looking.
        """
        if not self.plan.calibrate:
            return
        chain = Chain(self.recording, self.carrier, self.digests)
        carried = self._noted(chain.calibration, self.plan.workers)
        cameras, lines = carried.entry.result["cameras"], carried.entry.result["lines"]
        for line in lines if not self.carrier.looking else ():
            self.log(line)
        of = preparation.way(self.folder, self.recording.path)
        self._notes["calibration"] = {"of": of, "cameras": cameras}
        self._before = [carried]
        if carried.entry.files:
            place = self.folder / stages.CALIBRATED
            if not place.is_dir():
                raise NotStoredError(carried.entry.key)  # only looking: nobody has taken it from the store
            self.recording = Recording(place)

    def stages(self) -> list[Carried]:
        """All stages of the plan, in their order.

        Raises:
            NotStoredError: one would have to be computed while only looking; `missing` has those that are known.
            DuagError: as the stages.
        """
        plan, chain = self.plan, Chain(self.recording, self.carrier, self.digests, self._watch)
        every = self._prepared(chain)
        own = [c for robot in every.values() for c in (robot.frontend, robot.information) if c is not None]
        done = list({c.label: c for c in own}.values())
        prepared, unmapped = with_map(every, self.recording)
        self._notes |= {UNMAPPED: unmapped} if unmapped else {}
        workers = cache(lambda: self._fitting(self._sizes(self.recording.robots), READER_SHARE))
        cameras = self._notes.get("calibration", {}).get("cameras")
        notes = {"calibration": digest_of_values(cameras)} if cameras else {}
        notes |= {UNMAPPED: digest_of_values(unmapped)} if unmapped else {}
        computed = self._computes_exchange(prepared)
        with self._matching(prepared, workers, computed) as matched:
            with self._starting_fusion(prepared, computed) as ready:
                if plan.has(stages.EXCHANGE):
                    exchange = self._noted(chain.exchange, prepared)
                    done.append(exchange)
                if plan.has(stages.FUSION):
                    done += self._fused(chain, prepared, exchange, ready)
            self._write(done)
            if self._watch.follower is not None and plan.has(stages.FUSION):
                self._watch.follower.finished(self.folder, self.recording.path)
            if plan.has(stages.EVALUATION):
                evaluate = partial(chain.reader, matched=matched)
                done.append(self._noted(evaluate, stages.EVALUATION, done, notes, workers))
                self._write(done)
        readers = self._shown(chain, done, notes, workers)
        self._write([*done, *readers])
        return [*self._before, *done, *readers]

    def _computes_exchange(self, prepared: dict[str, Prepared]) -> bool:
        """Whether the exchange is part of the plan and nowhere stored."""
        if self.carrier.looking or not self.plan.has(stages.EXCHANGE):
            return False
        looking = self._looking()
        _, absent = self._looked_up([stages.EXCHANGE.name], lambda _: looking.exchange(prepared))
        return bool(absent)

    def _matching(
        self, prepared: dict[str, Prepared], workers: Callable[[], int], computed: bool
    ) -> AbstractContextManager[Callable[[], dict[str, MatchedViews]]]:
        """The part of the evaluation that needs no more than the front ends, next to an exchange that is computed."""
        if not computed or not self.plan.has(stages.EVALUATION) or workers() == 1:
            return nullcontext(dict)
        return self._processes().matching({name: self.recording.log(name) for name in prepared})

    def _starting_fusion(
        self, prepared: dict[str, Prepared], computed: bool
    ) -> AbstractContextManager[FusionProcesses | None]:
        """The processes of the fusion, which start next to an exchange that is computed; None: there are none."""
        if not computed or not self.plan.has(stages.FUSION):
            return nullcontext(None)
        sizes, quiet = list(self._sizes(prepared).values()), replace(self.carrier, say=lambda line: None)
        workers = workers_that_fit(sizes, quiet, self.plan.workers, share=FUSION_SHARE)  # said when it begins
        return self._processes().starting_fusion([*prepared], workers) if workers > 1 else nullcontext(None)

    def _shown(
        self, chain: Chain, done: list[Carried], notes: dict[str, str], workers: Callable[[], int]
    ) -> list[Carried]:
        """Report and view; next to each other if there are several workers."""
        config = digest_of_values(dump_config(self.config))
        of_report = notes | {
            "config.toml": config,
            "times": digest_of_values(manifest.times([*self._before, *done])),
        }
        both = ((stages.REPORT, of_report), (stages.VIEW, notes))
        wanted = {stage.name: (stage, done, more, workers) for stage, more in both if self.plan.has(stage)}
        found, absent = self._looked_up(wanted, lambda name: self._looking().reader(*wanted[name]))
        if self.carrier.looking:
            return list(found.values())
        if len(wanted) > 1 and stages.VIEW.name in absent and workers() > 1:
            with self._processes().viewing(done, notes) as drawn:
                report = self._noted(chain.reader, stages.REPORT, done, of_report, lambda: workers() - 1)
                return [report, drawn.result()]
        return [self._noted(chain.reader, *of) for of in wanted.values()]

    def look(self) -> tuple[list[Carried], list[StageKey]]:
        """What is there, and what would have to be computed as far as that is known."""
        found: dict[str, Carried] = {}

        def note(carried: Carried) -> None:
            found[carried.label] = carried

        self.carrier.found = note
        with suppress(NotStoredError):
            self.calibrate()
            self.stages()
        return list(found.values()), self.missing

    def _announce(self, key: StageKey, stored: bool) -> None:
        """Say that a stage begins, and why where an earlier result of it is there."""
        if self._time_left is not None and not stored:
            self._time_left.begin(key.stage)
        title = TITLES.get(key.stage)
        if title is None:
            return
        title = f"{title}: {key.robot}" if key.robot else title
        self.log(f"{title}: from the store" if stored else title)

    def _noted(self, do: Callable[..., Carried], *arguments: Any) -> Carried:
        try:
            return do(*arguments)
        except NotStoredError as error:
            self.missing.append(error.key)
            raise

    def _fused(
        self, chain: Chain, prepared: dict[str, Prepared], exchange: Carried, ready: FusionProcesses | None
    ) -> list[Carried]:
        """The fused map of every robot; `workers` at a time in processes of their own, which may be ready."""
        looking = self._looking()
        found, absent = self._looked_up(
            prepared, lambda name: looking.fusion(name, prepared[name], exchange, threads=1)
        )
        if self.carrier.looking:
            return list(found.values())
        workers, fused = self._fitting(self._sizes(absent), FUSION_SHARE), dict[str, Carried]()
        if workers > 1:
            self.log(f"fusion: {len(absent)} robots, {workers} at a time")
            if self._time_left is not None:
                self._time_left.begin(stages.FUSION.name)
            wanted = {name: prepared[name] for name in absent}
            fused = self._processes().fuse(wanted, exchange, workers, ready)
        threads, done = threads_per_worker(1), []
        for name, robot in prepared.items():
            done.append(fused.get(name) or chain.fusion(name, robot, exchange, threads=threads))
            for neighbor, reason in done[-1].entry.result["left_out"].items():
                self.log(f"warning: {name} uses nothing of {neighbor}'s map: {reason}")
        return done

    def _looked_up(
        self, robots: Iterable[str], look: Callable[[str], Found]
    ) -> tuple[dict[str, Found], list[str]]:
        """What the store has of some robots, by name, and those of which it has nothing."""
        found, absent = dict[str, Found](), list[str]()
        for robot in robots:
            try:
                found[robot] = look(robot)
            except NotStoredError as error:
                self.missing.append(error.key)
                absent.append(robot)
        if not self.carrier.looking:
            self.missing.clear()
        elif absent:
            raise NotStoredError(self.missing[0])
        return found, absent

    def _processes(self) -> RobotProcesses:
        of = self.recording.path, self.folder, self.config, self.plan, self._place, self._where
        return RobotProcesses(*of, self._versions)

    def _prepared(self, chain: Chain) -> dict[str, Prepared]:
        """Every robot with its own results, by name; `workers` at a time in processes of their own."""
        alone = not self.plan.has(stages.INFORMATION)
        looking = self._looking()
        stored, absent = self._looked_up(
            self.recording.robots, lambda robot: looking.robot(robot, threads=1, alone=alone)
        )
        found = {name: part for of_robot in stored.values() for name, part in of_robot.items()}
        if self.carrier.looking:
            return dict(sorted(found.items()))
        for robot in stored:
            found |= chain.robot(robot, threads=threads_per_worker(1), alone=alone)
        if absent:
            sizes = with_expected(self._sizes(absent), self.recording, self.config.frontend)
            workers = self._fitting(sizes)
            self.log(f"front end and information: {len(absent)} robots, {workers} at a time")
            self._time_left = self._expected(sizes, found, workers)
            logs = [] if self.plan.calibrate else [self.recording.log(robot) for robot in absent]
            check = partial(preparation.say_registration, logs, self.log)
            prepare = partial(self._processes().prepare, hear=self._hear, meanwhile=check)
            found |= prepare(absent, workers, alone=alone)
        else:
            self.log(f"front end and information: {len(found)} robots from the store")
            self._time_left = self._expected({}, found, self.plan.workers)
        for line in warnings_of(found, self.recording):
            self.log(f"warning: {line}")
        return dict(sorted(found.items()))

    def _expected(
        self, sizes: dict[str, dict[str, int]], found: dict[str, Prepared], workers: int
    ) -> TimeLeft:
        """What the run will take: `sizes` of the logs whose robots are to be prepared; the others were found."""
        known = {name: robot.frontend.entry.result for name, robot in found.items()}
        wanted = [stage for stage in stages.STAGES if self.plan.has(stage)]
        mapping = self.config.frontend.mapping
        return TimeLeft(sizes, mapping, found=known, workers=workers, wanted=wanted)

    def _fitting(self, sizes: dict[str, dict[str, int]], share: float = 1.0) -> int:
        return workers_that_fit(list(sizes.values()), self.carrier, self.plan.workers, share=share)

    def _sizes(self, robots: Collection[str]) -> dict[str, dict[str, int]]:
        """Sizes of logs, each looked at once."""
        new = sorted({robot_of(name) for name in robots} - self._known_sizes.keys())
        found = in_order(lambda robot: steps.check_log(self.recording.log(robot), robot), new)
        self._known_sizes |= dict(zip(new, found, strict=True))
        return {name: self._known_sizes[robot_of(name)] for name in robots}

    def _looking(self) -> Chain:
        """The stages as they are stored: nothing is computed."""
        return Chain(self.recording, replace(self.carrier, looking=True), self.digests)

    def _is_stored(self) -> bool:
        """Whether nothing would be computed."""
        of = self.recording, self.folder, self.config, self.plan
        looking = Job(*of, log=self.log, place=self._place, looking=True, versions=self._versions)
        try:
            looking.stages()
        except NotStoredError:
            return False
        return True

    def _digest(self, path: Path) -> str:
        """Digest of an input, as it was when it was first looked at."""
        if path not in self._inputs:
            self._inputs[path] = digest_file(path) if self.store is None else self.digests.of(path).content
        return self._inputs[path]

    def _write(self, done: list[Carried]) -> None:
        """manifest.json and timing.json, of what is done."""
        if self.carrier.looking:
            return
        manifest.write_timing(self.folder, self._before, done)
        manifest.write_manifest(
            self.folder,
            self.recording.path,
            {robot: self._digest(self.recording.log(robot)) for robot in self.recording.robots},
            done,
            stages=None if self.store is None else [*self._before, *done],
            more=self._notes,
        )
