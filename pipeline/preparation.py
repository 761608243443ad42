"""Stages of robots that have no results yet, in processes of their own, as many as fit into memory."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from duagc.pipeline import steps, watch
from duagc.pipeline.base import worker_reports
from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.machine import memory_bytes
from duagc.pipeline.base.thread_share import SharedThreads, ThreadShare, keep_share
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.cache.carrier import Carried, Carrier
from duagc.pipeline.cache.code_identity import CodeVersion
from duagc.pipeline.cache.file_digests import FileDigests
from duagc.pipeline.cache.footprint import fitting, robot_bytes
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store
from duagc.pipeline.chain import Chain, Prepared
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.recording import Recording
from duagc.pipeline.run_plan import RunPlan
from duagc.pipeline.runs import stages

MEASURED = 20  # results of front ends that memory is estimated from
FUSION = "duagc.pipeline.fusion.stage"
LONG_FRAMES = 1000  # a shorter log is tracked, and its keyframes are counted, within seconds
Say = Callable[[str], None]


def say(line: str) -> None:
    """Say something on standard error."""
    print(line, file=sys.stderr, flush=True)


def way(folder: Path, path: Path) -> str:
    """The relative path from one place to another, by the folders that symbolic links lead to.

    Args:
        folder: where it begins; "..", of a folder that is reached by a link, is not the folder of the link.
        path: where it ends.
    """
    return os.path.relpath(os.path.realpath(path), os.path.realpath(folder))


def stages_of(run: Path) -> dict[str, Any]:
    """What the manifest of a run says of its stages; empty if there is none, or none that says it.

    Args:
        run: folder of the run.
    """
    try:
        content = json.loads((run / "manifest.json").read_bytes())
        rows = content["stages"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return rows if isinstance(rows, dict) else {}


def versions(store: Store, known: Mapping[str, CodeVersion] | None = None) -> dict[str, CodeVersion]:
    """Versions of the code of all stages, by entry, read now: results of code that is edited later are not kept.

    Args:
        store: of the run, which remembers them.
        known: those that somebody of the same run has read.
    """
    store.code.adopt(dict(known or {}))
    for stage in (stages.CALIBRATION, *stages.STAGES):
        store.code.version_of(stage.code)
    return store.code.versions


def read_code(store: Path) -> None:
    """Read the code of all stages, so that a run that begins soon finds it read.

    Args:
        store: folder of the store of that run.
    """
    versions(Store(store))


def carrier_of(
    folder: Path,
    config: RunConfig,
    plan: RunPlan,
    *,
    log: Say,
    place: Path,
    looking: bool = False,
    begun: Callable[[StageKey, bool], None] = lambda key, stored: None,
) -> Carrier:
    """What carries out the stages of a run.

    Args:
        folder: of the run.
        config: settings of all stages.
        plan: how it is done.
        log: gets a line when something is unusual.
        place: where an earlier run may be.
        looking: only look what is there: nothing is computed or written.
        begun: called before a stage is computed, or, with True, when it was taken from the store.
    """
    store = None if plan.store is None else Store(plan.store)
    earlier = {} if store is None else stages_of(place)
    return Carrier(
        folder,
        config,
        store,
        log,
        again=plan.again,
        looking=looking,
        earlier=earlier,
        place=place,
        begun=begun,
    )


def with_expected(
    sizes: Mapping[str, Mapping[str, int]], recording: Recording, config: FrontendConfig
) -> dict[str, dict[str, int]]:
    """Sizes of logs, with what is expected of those of `LONG_FRAMES` and more: keyframes, and whether depth is exact.

    Args:
        sizes: `frames`, and the rest of what is known, of every robot.
        recording: of these robots.
        config: of their front ends.
    """

    def counted(robot: str) -> dict[str, int]:
        size = dict(sizes[robot])
        if size["frames"] < LONG_FRAMES:
            return size
        from duagc.pipeline.checks.check import expected_size

        return size | expected_size(recording.log(robot), config)

    return dict(zip(sizes, in_order(counted, sizes), strict=True))


def say_registration(logs: Sequence[Path], log: Say) -> None:
    """Say where color and depth do not belong together.

    Args:
        logs: of robots that are not calibrated.
        log: gets a line for every finding.
    """
    from duagc.pipeline.checks.check import check_registration

    for findings in in_order(check_registration, logs):
        for finding in findings:
            log(finding.line())


def workers_that_fit(
    sizes: Sequence[dict[str, int]], carrier: Carrier, asked: int, *, share: float = 1.0
) -> int:
    """How many of some robots are looked at at the same time, so that they fit into memory.

    Args:
        sizes: `frames` and `pixels` of an image of every robot.
        carrier: of the run, that says so if they are fewer.
        asked: how many the user wants.
        share: of memory, relative to the preparation of a robot.
    """
    asked = min(asked, len(sizes))
    if asked <= 1:
        return 1
    measured = [] if carrier.store is None else carrier.store.recent(stages.FRONTEND.name, MEASURED)
    needed = [share * robot_bytes(size, measured) for size in sizes]
    _, free = memory_bytes()
    workers = fitting(asked, needed, free)
    if workers < asked and free is not None:
        carrier.say(
            f"{workers} at a time instead of {asked}: a robot may take {max(needed) / 1e9:.1f} GB of memory, "
            f"found {free / 1e9:.1f} GB free"
        )
    return workers


@dataclass(frozen=True)
class FusionPool:
    """Processes that wait for the fusion of robots.

    Attributes:
        pool: of them.
        share: of the machine's threads.
        robots: that they are for.
        workers: how many they are.
    """

    pool: ProcessPoolExecutor
    share: ThreadShare
    robots: int
    workers: int


@dataclass(frozen=True)
class RobotProcesses:
    """Stages of robots, each robot by one of some processes.

    Attributes:
        recording: that the run is of.
        folder: of the run.
        config: settings of all stages.
        plan: how it is done.
        place: where an earlier run may be.
        where: of the server that shows the run; None: nobody follows.
        versions: of the code of the stages, by entry, as the run began with them.
    """

    recording: Path
    folder: Path
    config: RunConfig
    plan: RunPlan
    place: Path
    where: Any = None
    versions: Mapping[str, CodeVersion] = field(default_factory=dict)

    def prepare(
        self,
        robots: Sequence[str],
        workers: int,
        *,
        alone: bool,
        hear: worker_reports.Hear,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> dict[str, Prepared]:
        """Front end and information of robots; by name of the component.

        Args:
            robots: their names.
            workers: how many at the same time.
            alone: leave the information out.
            hear: gets steps of front ends, in another thread.
            meanwhile: is done here while the processes start.
        """
        found, share = dict[str, Prepared](), ThreadShare(workers, len(robots))
        with (
            worker_reports.listening(hear) as queue,
            worker_pool(workers, _keep, (queue, *share.handed)) as pool,
        ):
            tasks = [pool.submit(self.prepare_one, robot, alone=alone) for robot in robots]
            for task in tasks:
                task.add_done_callback(share.done)
            meanwhile()
            for task in tasks:
                found |= task.result()
        return found

    def prepare_one(self, robot: str, *, alone: bool) -> dict[str, Prepared]:
        """Front end and information of one robot, in a process of its own.

        Args:
            robot: its name.
            alone: leave the information out.
        """
        heard = watch.in_worker(self.where)
        try:
            return self._chain(heard).robot(robot, threads=SharedThreads(), alone=alone)
        finally:
            heard.tell((robot, "", 0, 0))
            if heard.follower is not None:
                heard.follower.close()

    @contextmanager
    def starting_fusion(self, robots: int, workers: int) -> Iterator[FusionPool]:
        """Processes for fused maps, which start and import what they need while this one does something else.

        Args:
            robots: how many.
            workers: how many at the same time.
        """
        share = ThreadShare(workers, robots)
        with worker_pool(workers, keep_share, share.handed) as pool:
            for _ in range(workers):
                pool.submit(import_module, FUSION)
            yield FusionPool(pool, share, robots, workers)

    def fuse(
        self,
        robots: Mapping[str, Prepared],
        exchange: Carried,
        workers: int,
        ready: FusionPool | None = None,
    ) -> dict[str, Carried]:
        """The fused maps of robots, by name.

        Args:
            robots: with their own results, by name.
            exchange: of the team.
            workers: how many at the same time.
            ready: processes that wait for it; used if they are as many.
        """
        if ready is None or (ready.robots, ready.workers) != (len(robots), workers):
            with self.starting_fusion(len(robots), workers) as started:
                return self.fuse(robots, exchange, workers, started)
        tasks = {
            name: ready.pool.submit(self.fuse_one, name, robot, exchange) for name, robot in robots.items()
        }
        for task in tasks.values():
            task.add_done_callback(ready.share.done)
        return {name: task.result() for name, task in tasks.items()}

    def fuse_one(self, name: str, robot: Prepared, exchange: Carried) -> Carried:
        """The fused map of one robot, in a process of its own.

        Args:
            name: of the robot.
            robot: with its own results.
            exchange: of the team.
        """
        return self._chain(watch.UNWATCHED).fusion(name, robot, exchange, threads=SharedThreads())

    @contextmanager
    def matching(self, logs: Mapping[str, Path]) -> Iterator[Callable[[], dict[str, Any]]]:
        """While a process does what the evaluation can do already; what to call for it, by robot.

        Args:
            logs: of the robots' sensors, by name of the component.
        """
        with worker_pool(1) as pool:
            tasks = {
                name: pool.submit(steps.matched_views, name, log, self.folder) for name, log in logs.items()
            }
            pool.shutdown(wait=False)  # the process ends when it is done
            yield lambda: {name: task.result() for name, task in tasks.items()}

    @contextmanager
    def viewing(self, done: Sequence[Carried], more: Mapping[str, str]) -> Iterator[Future[Carried]]:
        """While the run is written as Rerun shows it, in a process of its own.

        Args:
            done: as of `Chain.reader`.
            more: as of `Chain.reader`.
        """
        with worker_pool(1) as pool:
            yield pool.submit(self.view, done, more)

    def view(self, done: Sequence[Carried], more: Mapping[str, str]) -> Carried:
        """The run as Rerun shows it.

        Args:
            done: as of `Chain.reader`.
            more: as of `Chain.reader`.
        """
        return self._chain(watch.UNWATCHED).reader(stages.VIEW, done, more, lambda: 1)

    def _chain(self, heard: watch.Watch) -> Chain:
        """The stages, in a process that knows nothing of the run yet."""

        def log(line: str) -> None:
            say(f"duagc: {line}")

        carrier = carrier_of(self.folder, self.config, self.plan, log=log, place=self.place)
        digests = FileDigests(None) if carrier.store is None else carrier.store.files
        if carrier.store is not None:
            carrier.store.code.adopt(dict(self.versions))
        return Chain(Recording(self.recording), carrier, digests, heard)


def _keep(queue: Any, busy: Any, in_all: int) -> None:
    """What a worker process keeps: where it reports its steps, and its share of the threads."""
    worker_reports.keep_queue(queue)
    keep_share(busy, in_all)
