"""The main job: from a recording to fused maps, metrics, report and view.

Robots are prepared in parallel processes; the exchange is one ordered stage in one process. Everything is
written into a temporary folder next to the output, which gets its final name when all is done.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import TYPE_CHECKING, Any

from duagc import __version__
from duagc.pipeline.base import determinism
from duagc.pipeline.base.atomic_folder import new_folder
from duagc.pipeline.base.component_names import component_name, robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.config.base import dump_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.digest import digest_file, result_files
from duagc.pipeline.runs.folder import SCHEMA
from duagc.pipeline.runs.robot_data import AgentInput, SessionResult
from duagc.pipeline.runs.stages import Stage

if TYPE_CHECKING:
    from duagc.pipeline.recording import Recording

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "mcap", "protobuf")


class Timing:
    """Runs stages inside their declarations, and keeps wall time, processor time and peak memory of each.

    None of the times is part of any digest.
    """

    def __init__(self) -> None:
        self.stages: dict[str, dict[str, Any]] = {}

    @contextmanager
    def stage(self, stage: Stage, folder: Path, robot: str | None = None) -> Iterator[None]:
        """Enforce and time a stage while the block runs.

        Args:
            stage: with what it declares.
            folder: of the robot if the stage is per robot, else of the run.
            robot: whose stage it is; None for a stage of the whole team.

        Raises:
            DuagError: the stage reads or writes what it did not declare.
        """
        with self.measured(stage.name, robot), stage.running(folder, robot):
            yield

    @contextmanager
    def measured(self, name: str, robot: str | None = None) -> Iterator[None]:
        """Time what is done while the block runs.

        Args:
            name: of what is done.
            robot: for whom; None for the whole team.
        """
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.stages[f"{name}.{robot}" if robot else name] = {
            "stage": name,
            "robot": robot,
            "wall_s": round(time.perf_counter() - wall, 3),
            "cpu_s": round(time.process_time() - cpu, 3),
            "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        }


def threads_per_worker(workers: int) -> int:
    """Threads of each of `workers` processes on this machine."""
    return max(1, len(os.sched_getaffinity(0)) // workers)


def prepare_robot(log: Path, robot: str, folder: Path, config: RunConfig, *, threads: int) -> dict[str, Any]:
    """Front end and Fisher information of one robot, from its own log alone.

    Args:
        log: the robot's log.
        robot: its name.
        folder: where frontend.mcap and information.mcap go. A component that did not join the largest one gets a
            folder of its own next to it, such as `alpha-2`.
        config: of the run.
        threads: of the kernels; changes no bit of the result.

    Returns:
        The timings of the stages.
    """
    from duagc.pipeline.frontend.stage import run_frontend
    from duagc.pipeline.information.stage import run_information
    from duagc.pipeline.recording import open_rgbd

    determinism.configure_opencv()
    with open_rgbd(log) as camera:
        if camera.robot != robot:
            raise DuagError(f"{log}: is the log of {camera.robot}, expected that of {robot}")
    timing = Timing()
    with timing.stage(stages.FRONTEND, folder, robot):
        parts = run_frontend(
            log, folder / "frontend.mcap", config.frontend, seed=config.seed, threads=threads, progress=True
        )
    timing.stages[f"frontend.{robot}"]["parts"] = parts
    for name, of_component in {robot: folder, **_component_folders(robot, folder)}.items():
        with timing.stage(stages.INFORMATION, of_component, name):
            run_information(
                log,
                of_component / "frontend.mcap",
                of_component / "information.mcap",
                config=config.information,
                moving=config.frontend.moving,
                thickness_floor_m=config.thickness_floor_m,
                threads=threads,
            )
    return timing.stages


def _component_folders(robot: str, folder: Path) -> dict[str, Path]:
    """Move the logs of further components into folders of their own; by name of the component."""
    out = {}
    for path in sorted(folder.glob("frontend.*.mcap"), key=lambda p: int(p.name.split(".")[1])):
        name = component_name(robot, int(path.name.split(".")[1]))
        out[name] = folder.with_name(name)
        out[name].mkdir()
        path.rename(out[name] / "frontend.mcap")
    return out


def prepare_robots(
    logs: dict[str, Path], folders: dict[str, Path], config: RunConfig, workers: int
) -> dict[str, Any]:
    """`prepare_robot` for every robot, `workers` at a time, in processes of their own."""
    threads = threads_per_worker(workers)
    timings: dict[str, Any] = {}
    with worker_pool(workers) as pool:
        jobs = [pool.submit(prepare_robot, logs[r], r, folders[r], config, threads=threads) for r in logs]
        for job in jobs:
            timings.update(job.result())
    return timings


def run(
    recording_path: Path,
    out: Path,
    config: RunConfig,
    *,
    workers: int = 2,
    force: bool = False,
    calibrate: bool = False,
    log: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
) -> None:
    """Run all stages on a recording.

    The result is the same to the last bit in every process: where the numeric libraries were imported before
    `configure_determinism`, all stages run in a child process. Child processes import the main script again: call
    this under `if __name__ == "__main__":`.

    Args:
        recording_path: folder of the recording.
        out: folder of the run; must not exist unless `force`.
        config: settings of all stages.
        workers: robots prepared at the same time; changes no bit of the result.
        force: replace an earlier run in `out`.
        calibrate: calibrate the cameras from the recording's own images first. Where views that were not used say
            that it is better, the run is of the calibrated recording, which is kept in its folder `calibrated`.
        log: gets a line at the start of every stage, and every warning.

    Raises:
        DuagError: what a user can fix; nothing is left under the name `out`.
    """
    determinism.configure_determinism()
    if determinism.is_deterministic():
        _run(recording_path, out, config, workers=workers, force=force, calibrate=calibrate, log=log)
    else:
        _run_in_child(recording_path, out, config, workers=workers, force=force, calibrate=calibrate, log=log)


def _run(
    recording_path: Path,
    out: Path,
    config: RunConfig,
    *,
    workers: int,
    force: bool,
    calibrate: bool,
    log: Callable[[str], None],
) -> None:
    from duagc.pipeline.evaluation import check_ground_truth
    from duagc.pipeline.recording import Recording, content_digest

    recording = Recording(recording_path)
    with new_folder(out, force) as folder:
        check_ground_truth(recording)
        timing = Timing()
        (folder / "config.toml").write_text(dump_config(config))
        calibration: dict[str, Any] = {}
        if calibrate:
            recording, calibration = _calibrated(recording, folder, config, timing, workers=workers, log=log)
        logs = {robot: recording.log(robot) for robot in recording.robots}
        for path in logs.values():
            if (found := content_digest(path)) != (expected := recording.digest(path.name)):
                log(
                    f"warning: {path}: has digest {found[:12]}, expected {expected[:12]} as in recording.json"
                )
        robots = {robot: folder / "robots" / robot for robot in recording.robots}
        for path in robots.values():
            path.mkdir(parents=True)
        log(f"front end and information: {len(logs)} robots, {min(workers, len(logs))} at a time")
        timing.stages.update(prepare_robots(logs, robots, config, min(workers, len(logs))))
        names = sorted(path.name for path in (folder / "robots").iterdir())
        for name in sorted(set(names) - set(logs)):
            log(
                f"warning: {name}: what {robot_of(name)} saw after it was lost did not join the rest of its path"
            )
        robots = {name: folder / "robots" / name for name in names}
        logs = {name: recording.log(name) for name in names}
        log("exchange and consensus")
        results = _exchange(logs, folder, config, timing)
        for robot, result in results.items():
            log(f"fusion: {robot}")
            with timing.stage(stages.FUSION, robots[robot], robot):
                left_out = fuse_robot(robot, logs[robot], robots[robot], result, config=config)
            for neighbor, reason in left_out.items():
                log(f"warning: {robot} uses nothing of {neighbor}'s map: {reason}")
        _write_json(folder / "manifest.json", _manifest(recording, folder, config) | calibration)
        _write_json(folder / "timing.json", {"stages": timing.stages})
        log("evaluation")
        _evaluate(folder, recording.path, timing)
        log("report and view")
        _present(folder, recording.path, timing)


def _run_in_child(
    recording_path: Path,
    out: Path,
    config: RunConfig,
    *,
    workers: int,
    force: bool,
    calibrate: bool,
    log: Callable[[str], None],
) -> None:
    """`_run` in a process that is started with the settings of `determinism`; its lines come back to `log`."""
    lines: SimpleQueue[str | None] = multiprocessing.get_context("spawn").SimpleQueue()

    def relay() -> None:
        while (line := lines.get()) is not None:
            log(line)

    relaying = threading.Thread(target=relay)
    relaying.start()
    try:
        with worker_pool(1, _keep_queue, (lines,)) as pool:
            pool.submit(
                _run_and_send, recording_path, out, config, workers=workers, force=force, calibrate=calibrate
            ).result()
    finally:
        lines.put(None)
        relaying.join()


_lines: list[SimpleQueue[str | None]] = []


def _keep_queue(lines: SimpleQueue[str | None]) -> None:
    """Where a child process sends its lines: a queue can be handed to a process only while it starts."""
    _lines.append(lines)


def _run_and_send(
    recording_path: Path, out: Path, config: RunConfig, *, workers: int, force: bool, calibrate: bool
) -> None:
    _run(recording_path, out, config, workers=workers, force=force, calibrate=calibrate, log=_lines[0].put)


def _calibrated(
    recording: Recording,
    folder: Path,
    config: RunConfig,
    timing: Timing,
    *,
    workers: int,
    log: Callable[[str], None],
) -> tuple[Recording, dict[str, Any]]:
    """The recording that the run is of, and what the manifest says about its calibration."""
    from duagc.pipeline.recalibration import calibrated
    from duagc.pipeline.recording import Recording

    def place() -> Path:
        (folder / stages.CALIBRATED).mkdir()
        return folder / stages.CALIBRATED

    log("calibration")
    with timing.measured("calibration"):
        outcomes, written = calibrated(recording, place, recording.name, config, workers=workers)
    for line in (line for outcome in outcomes for line in outcome.lines()):
        log(line)
    entry = {"of": os.path.relpath(recording.path, folder), "cameras": [o.plain() for o in outcomes]}
    return Recording(folder / stages.CALIBRATED) if written else recording, {"calibration": entry}


def _exchange(
    logs: dict[str, Path], folder: Path, config: RunConfig, timing: Timing
) -> dict[str, SessionResult]:
    from duagc.pipeline.exchange.session import run_session

    determinism.configure_opencv()
    inputs = [agent_input(robot, log, folder / "robots" / robot, config) for robot, log in logs.items()]
    with timing.stage(stages.EXCHANGE, folder):
        return run_session(
            inputs,
            config.exchange,
            seed=config.seed,
            exchange_path=folder / "exchange.mcap",
            consensus_path=folder / "consensus.mcap",
        )


def agent_input(robot: str, log: Path, folder: Path, config: RunConfig) -> AgentInput:
    """What the agent of a robot may know before the first packet: its own log and its own results."""
    files = folder / "frontend.mcap", folder / "information.mcap"
    return AgentInput(robot, log, *files, thickness_floor_m=config.thickness_floor_m)


def fuse_robot(
    robot: str, log: Path, folder: Path, result: SessionResult, *, config: RunConfig
) -> dict[str, str]:
    """Fused map and corrected trajectory of one robot, into the folder of its own results; one robot at a time.

    Returns:
        Neighbors of whose maps nothing is used, and why.
    """
    from duagc.pipeline.fusion.stage import run_fusion

    checks = run_fusion(
        agent_input(robot, log, folder, config),
        result,
        folder,
        config=config.fusion,
        matching=config.matching,
        moving=config.frontend.moving,
        weights=config.exchange.weights,
        seed=config.seed,
        threads=threads_per_worker(1),
    )
    return {check.peer: check.reason for check in checks if not check.trusted}


def _evaluate(folder: Path, recording: Path, timing: Timing) -> None:
    from duagc.pipeline.evaluation import evaluate

    with timing.stage(stages.EVALUATION, folder):
        evaluate(folder, recording, threads=threads_per_worker(1))
    _write_json(folder / "timing.json", {"stages": timing.stages})


def _present(folder: Path, recording: Path, timing: Timing) -> None:
    from duagc.pipeline.report import write_report
    from duagc.pipeline.viewing.run_rrd import write_rrd

    with timing.stage(stages.REPORT, folder):
        write_report(folder, recording)
    with timing.stage(stages.VIEW, folder):
        write_rrd(folder, recording, folder / "run.rrd")
    _write_json(folder / "timing.json", {"stages": timing.stages})


def _manifest(recording: Any, folder: Path, config: RunConfig) -> dict[str, Any]:
    """What went in and what came out, by digest."""
    from importlib.metadata import version

    return {
        "schema": SCHEMA,
        "duagc": __version__,
        "libraries": {name: version(name) for name in LIBRARIES},
        "recording": os.path.relpath(recording.path, folder),
        "config": digest_file(folder / "config.toml"),
        "inputs": {robot: digest_file(recording.log(robot)) for robot in recording.robots},
        "outputs": {p.as_posix(): digest_file(folder / p) for p in result_files(folder)},
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n")
