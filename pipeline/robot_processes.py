"""Stages of robots that have no results yet, in processes of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from duagc.pipeline import steps, watch
from duagc.pipeline.base import plotting, worker_reports
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.thread_share import SharedThreads, ThreadShare, keep_share
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.cache.carrier import Carried
from duagc.pipeline.cache.code_identity import CodeVersion
from duagc.pipeline.cache.file_digests import FileDigests
from duagc.pipeline.chain import Chain, Prepared
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.preparation import carrier_of, say
from duagc.pipeline.recording import Recording
from duagc.pipeline.run_plan import RunPlan
from duagc.pipeline.runs import stages

FUSION = "duagc.pipeline.fusion.stage"
EXCHANGE = ("duagc.pipeline.exchange.session",)
VIEW = ("duagc.pipeline.viewing.run_rrd", "rerun.blueprint")


def import_next(plan: RunPlan) -> None:
    """Import what this process needs once the robots are prepared; what is missing is reported when it is needed.

    Args:
        plan: of the run.
    """
    wanted: tuple[str, ...] = EXCHANGE if plan.has(stages.EXCHANGE) else ()
    if plan.has(stages.VIEW) and not plan.has(stages.EVALUATION):  # else another process shows the run
        wanted += VIEW
        plotting.matplotlib()
    for module in wanted:
        with suppress(ImportError):
            _import(module)


def _import(module: str) -> None:
    import_module(module)


@dataclass(frozen=True)
class FusionProcesses:
    """Processes that wait for the fusion of robots.

    Attributes:
        pools: of one process each, which reads ahead for the robot of the same place.
        share: of the machine's threads.
        robots: that they are for.
        begun: what they do before.
    """

    pools: Sequence[ProcessPoolExecutor]
    share: ThreadShare
    robots: Sequence[str]
    begun: Sequence[Future[Any]]


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
            wait(tasks, return_when=FIRST_COMPLETED)
            # where no robot is left a processor has nothing else to do, and a disk may be slow
            threading.Thread(target=import_next, args=(self.plan,), daemon=True).start()
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
    def starting_fusion(self, robots: Sequence[str], workers: int) -> Iterator[FusionProcesses]:
        """Processes for fused maps, which start and read what they can while this one does something else.

        Args:
            robots: their names.
            workers: how many at the same time.
        """
        share = ThreadShare(workers, len(robots))
        with ExitStack() as stack:
            pools = [stack.enter_context(worker_pool(1, keep_share, share.handed)) for _ in range(workers)]
            begun: list[Future[Any]] = [pool.submit(_import, FUSION) for pool in pools]
            if not self.plan.has(stages.EVALUATION):  # part of which leaves no processor idle now
                first = zip(pools, robots, strict=False)
                begun += [pool.submit(self.read_ahead, robot) for pool, robot in first]
            yield FusionProcesses(pools, share, robots, begun)

    def read_ahead(self, robot: str) -> None:
        """Read what the fusion of a robot needs, in a process of its own. The fusion reports what is wrong.

        Args:
            robot: its name.
        """
        with suppress(DuagError):
            log = Recording(self.recording).log(robot)
            steps.read_ahead(robot, log, self.folder / "robots" / robot, self.config)

    def fuse(
        self,
        robots: Mapping[str, Prepared],
        exchange: Carried,
        workers: int,
        ready: FusionProcesses | None = None,
    ) -> dict[str, Carried]:
        """The fused maps of robots, by name.

        Args:
            robots: with their own results, by name.
            exchange: of the team.
            workers: how many at the same time.
            ready: processes that wait for it; used if they are as many, and for these robots.
        """
        if ready is None or (list(ready.robots), len(ready.pools)) != (list(robots), workers):
            with self.starting_fusion(list(robots), workers) as started:
                return self.fuse(robots, exchange, workers, started)
        left, tasks = list(robots), dict[str, Future[Carried]]()
        running = dict[Future[Carried], ProcessPoolExecutor]()

        def begin(pool: ProcessPoolExecutor) -> None:
            if left:
                name = left.pop(0)
                task = tasks[name] = pool.submit(self.fuse_one, name, robots[name], exchange)
                task.add_done_callback(ready.share.done)
                running[task] = pool

        for pool in ready.pools:
            begin(pool)
        while running:
            for task in wait(running, return_when=FIRST_COMPLETED).done:
                task.result()
                begin(running.pop(task))
        for task_before in ready.begun:
            task_before.result()  # raises what should not have happened
        return {name: tasks[name].result() for name in robots}

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
