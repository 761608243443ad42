"""What a run does, step by step: how each stage is called, on which files, with which settings.

A step gets no setting but those that its stage declares, and a stored result of it counts for as long as the function
here and all that it imports stay the same. So imports are inside the functions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

from duagc.pipeline.base import determinism
from duagc.pipeline.base.component_names import component_name
from duagc.pipeline.base.thread_share import threads_per_worker
from duagc.pipeline.base.worker_reports import Hear

if TYPE_CHECKING:
    from duagc.pipeline.base.checkpoints import Checkpoints
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.evaluation.map_agreement import MatchedViews
    from duagc.pipeline.exchange.session import RoundWatch
    from duagc.pipeline.recording import Recording
    from duagc.pipeline.runs.robot_data import AgentInput, SessionResult


def calibration(recording: Recording, folder: Path, config: RunConfig, *, workers: int) -> dict[str, Any]:
    """Calibrate a recording from its own images.

    Args:
        recording: as it is.
        folder: of the run; gets a folder `calibrated` if that is better.
        config: of the run.
        workers: robots that are tracked at the same time; changes no bit of the result.

    Returns:
        What was found, of every camera and in sentences.
    """
    from duagc.pipeline.recalibration import calibrated
    from duagc.pipeline.runs.stages import CALIBRATED

    def place() -> Path:
        (folder / CALIBRATED).mkdir()
        return folder / CALIBRATED

    outcomes, _ = calibrated(recording, place, recording.name, config, workers=workers)
    return {
        "cameras": [outcome.plain() for outcome in outcomes],
        "lines": [line for outcome in outcomes for line in outcome.lines()],
    }


def check_log(log: Path, robot: str) -> dict[str, int]:
    """Refuse the log of another robot, before the front end would stumble over it.

    Args:
        log: that the recording names.
        robot: whose it should be.

    Returns:
        Its frames, the pixels of an image, and whether depth is of other times than color.

    Raises:
        DuagError: the log is damaged, or another robot's.
    """
    from duagc.pipeline.recording import open_rgbd

    determinism.configure_opencv()
    with open_rgbd(log) as camera:
        camera.check_robot(robot)
        return {
            "frames": len(camera),
            "pixels": camera.camera.width * camera.camera.height,
            "moved": int(camera.needs_motion),
        }


def frontend(
    log: Path, folder: Path, config: RunConfig, *, threads: SupportsIndex, checkpoints: Checkpoints
) -> dict[str, float]:
    """Track and map one robot.

    Args:
        log: the robot's log.
        folder: where frontend.mcap goes; frontend.2.mcap, of a component that did not join the largest one, too.
        config: of the run.
        threads: of the kernels; changes no bit of the result.
        checkpoints: from which it goes on, and to which it saves; they change no bit of the result.

    Returns:
        Wall times of its parts.
    """
    from duagc.pipeline.frontend.stage import run_frontend

    determinism.configure_opencv()
    return run_frontend(
        log,
        folder / "frontend.mcap",
        config.frontend,
        seed=config.seed,
        threads=threads,
        checkpoints=checkpoints,
    )


def move_components(robot: str, folder: Path) -> dict[str, Path]:
    """Move the logs of further components into folders of their own; all folders by name, the robot's first.

    Args:
        robot: whose they are.
        folder: of the robot.
    """
    out = {robot: folder}
    for path in sorted(folder.glob("frontend.*.mcap"), key=lambda p: int(p.name.split(".")[1])):
        name = component_name(robot, int(path.name.split(".")[1]))
        out[name] = folder.with_name(name)
        out[name].mkdir(exist_ok=True)
        path.rename(out[name] / "frontend.mcap")
    return out


def information(log: Path, folder: Path, config: RunConfig, *, threads: SupportsIndex) -> None:
    """Fisher information of one robot's map.

    Args:
        log: the robot's log.
        folder: with frontend.mcap; gets information.mcap.
        config: of the run.
        threads: of the kernels; changes no bit of the result.
    """
    from duagc.pipeline.information.stage import run_information

    determinism.configure_opencv()
    run_information(
        log,
        folder / "frontend.mcap",
        folder / "information.mcap",
        config=config.information,
        moving=config.frontend.moving,
        thickness_floor_m=config.frontend.mapping.seeding.thickness_m,
        threads=threads,
    )


def agent_input(robot: str, log: Path, folder: Path, config: RunConfig) -> AgentInput:
    """What the agent of a robot may know before the first packet: its own log and its own results.

    Args:
        robot: name, or that of a component.
        log: of its sensors.
        folder: of its own results.
        config: of the run.
    """
    from duagc.pipeline.runs.robot_data import AgentInput

    files = folder / "frontend.mcap", folder / "information.mcap"
    thickness_m = config.frontend.mapping.seeding.thickness_m
    return AgentInput(robot, log, *files, thickness_floor_m=thickness_m)


def check_links(robots: Sequence[str], config: RunConfig) -> None:
    """Refuse links of robots that are not there, before hours are spent on their maps.

    Args:
        robots: names of all robots of the recording.
        config: of the run.

    Raises:
        DuagError: a window or waypoint names another robot, or a robot has no waypoint.
    """
    from duagc.pipeline.network.link_model import check_names

    if config.exchange.link.enabled:
        check_names(config.exchange.link, robots)


def exchange(
    logs: dict[str, Path],
    folder: Path,
    config: RunConfig,
    *,
    checkpoints: Checkpoints,
    watch: RoundWatch | None = None,
) -> None:
    """Let the team meet.

    Args:
        logs: of the robots' sensors, by name of the component.
        folder: of the run; gets exchange.mcap, consensus.mcap, and what each robot takes home.
        config: of the run.
        checkpoints: from which it goes on, and to which it saves; they change no bit of the result.
        watch: hears of every round, and changes nothing.
    """
    from duagc.pipeline.exchange.session import run_session
    from duagc.pipeline.runs.session_file import NAME, write_session_result

    determinism.configure_opencv()
    inputs = [agent_input(robot, log, folder / "robots" / robot, config) for robot, log in logs.items()]
    results = run_session(
        inputs,
        config.exchange,
        seed=config.seed,
        exchange_path=folder / "exchange.mcap",
        consensus_path=folder / "consensus.mcap",
        watch=watch,
        checkpoints=checkpoints,
    )
    for robot, result in results.items():
        write_session_result(folder / "robots" / robot / NAME, result)


def fusion(
    robot: str,
    log: Path,
    folder: Path,
    config: RunConfig,
    *,
    threads: SupportsIndex,
    checkpoints: Checkpoints,
) -> dict[str, Any]:
    """Fused map and corrected trajectory of one robot, from what it took home.

    Args:
        robot: its name.
        log: of its sensors.
        folder: of its own results.
        config: of the run.
        threads: of the kernels; changes no bit of the result.
        checkpoints: from which it goes on, and to which it saves; they change no bit of the result.

    Returns:
        `left_out`: neighbors of whose maps nothing is used, and why; `robots`: in its component.
    """
    from duagc.pipeline.runs.session_file import NAME, read_session_result

    result = read_session_result(folder / NAME)
    left_out = fuse_robot(robot, log, folder, result, config=config, threads=threads, checkpoints=checkpoints)
    return {"left_out": left_out, "robots": len(result.component)}


def read_ahead(robot: str, log: Path, folder: Path, config: RunConfig) -> None:
    """Read what the fusion of a robot needs, while the robots meet; this process keeps it.

    Args:
        robot: its name.
        log: of its sensors.
        folder: of its own results.
        config: of the run.
    """
    from duagc.pipeline.base.workers import when_idle
    from duagc.pipeline.fusion import own_images

    determinism.configure_opencv()
    source = agent_input(robot, log, folder, config)
    when_idle(lambda: own_images.read_ahead(source, config.fusion.finetune))


def fuse_robot(
    robot: str,
    log: Path,
    folder: Path,
    result: SessionResult,
    *,
    config: RunConfig,
    threads: SupportsIndex,
    checkpoints: Checkpoints | None = None,
) -> dict[str, str]:
    """Fused map and corrected trajectory of one robot, into the folder of its own results.

    Args:
        robot: its name.
        log: of its sensors.
        folder: of its own results; gets the fused map and the corrected trajectory.
        result: of the session, as this robot has it.
        config: of the run.
        threads: of the rasterizer; changes no bit of the result.
        checkpoints: from which it goes on, and to which it saves; None: none. They change no bit of the
            result.

    Returns:
        Neighbors of whose maps nothing is used, and why.

    Raises:
        DuagError: a file lacks what it should hold, or two files do not belong together.
    """
    from duagc.pipeline.fusion.stage import run_fusion

    determinism.configure_opencv()
    checks = run_fusion(
        agent_input(robot, log, folder, config),
        result,
        folder,
        config=config.fusion,
        matching=config.exchange.matching.of_maps(config.frontend.mapping.seeding.thickness_m),
        moving=config.frontend.moving,
        weights=config.exchange.weights,
        seed=config.seed,
        threads=threads,
        checkpoints=checkpoints,
    )
    return {check.peer: check.reason for check in checks if not check.trusted}


def evaluation(
    folder: Path,
    recording: Path,
    workers: int = 1,
    saved: Path | None = None,
    *,
    matched: Mapping[str, MatchedViews] | None = None,
    hear: Hear = lambda step: None,
) -> None:
    """Measure the run.

    Args:
        folder: of the run; gets metrics.json and metrics.parquet.
        recording: folder of its recording.
        workers: robots measured at the same time; changes no bit of the result.
        saved: folder of what is done, from which it goes on; None: nothing is saved.
        matched: `matched_views` of robots, by name, where they are known already; changes no bit.
        hear: gets its steps; changes nothing.
    """
    from duagc.pipeline.evaluation import evaluate

    determinism.configure_opencv()
    threads = threads_per_worker(workers)
    evaluate(folder, recording, threads=threads, workers=workers, saved=saved, matched=matched, hear=hear)


def matched_views(robot: str, log: Path, folder: Path) -> MatchedViews:
    """What the evaluation of a robot can do as soon as its front end is done.

    Args:
        robot: its name.
        log: of its sensors.
        folder: of the run.
    """
    from duagc.pipeline.evaluation.robot_measures import matched_views_of

    return matched_views_of(robot, log, folder)


def report(folder: Path, recording: Path, workers: int = 1) -> None:
    """Write the page of the run.

    Args:
        folder: of the run; gets report/index.html.
        recording: folder of its recording.
        workers: robots drawn at the same time; changes no bit of the result.
    """
    from duagc.pipeline.report import write_report

    determinism.configure_opencv()
    write_report(folder, recording, workers=workers)


def view(folder: Path, recording: Path, workers: int = 1) -> None:
    """Write the run as Rerun shows it.

    Args:
        folder: of the run; gets run.rrd.
        recording: folder of its recording.
        workers: as of the other readers; one process does it.
    """
    from duagc.pipeline.viewing.run_rrd import write_rrd

    determinism.configure_opencv()
    write_rrd(folder, recording, folder / "run.rrd")
