"""Recompute a robot from its own log and the packets it received, and compare with what the run recorded.

This is the proof of decentralization: nothing of the other robots' logs, maps or memory is read.
"""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline import steps
from duagc.pipeline.base import determinism
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file
from duagc.pipeline.base.thread_share import threads_per_worker
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.digest import ROBOT_RESULTS, digest_file
from duagc.pipeline.runs.folder import RunFolder, written


@dataclass(frozen=True)
class Comparison:
    """One result of one robot, recorded and recomputed.

    Attributes:
        robot: whose result.
        name: of the file, or "packets sent".
        recorded: digest of what the run has.
        recomputed: digest of what was computed again.
    """

    robot: str
    name: str
    recorded: str
    recomputed: str

    @property
    def equal(self) -> bool:
        return self.recorded == self.recomputed


def replay(
    run: str | Path,
    recording: str | Path,
    robots: list[str],
    report: Callable[[str], None],
) -> list[Comparison]:
    """Recompute robots, front end included, without any store.

    Args:
        run: folder of a finished run.
        recording: folder of its recording.
        robots: which to recompute.
        report: gets a line at the start of every step.

    Returns:
        One comparison per result file, and one for the packets that the robot sent.

    Raises:
        DuagError: the run is incomplete, a robot is unknown, or numpy was imported before duagc.
    """
    from duagc.pipeline.recording import Recording

    determinism.configure_determinism()
    if not determinism.is_deterministic():
        raise DuagError(
            "replay: found numpy imported before duagc, expected duagc first: results would differ"
        )
    run = Path(run)
    config = load_config(RunConfig, RunFolder(run).config_file)
    logs = Recording(Path(recording))
    known = RunFolder(run).robots
    check_file(written(run / "exchange.mcap"), "the log of the exchange")
    for robot in robots:  # before hours of work
        if robot not in known:
            raise DuagError(f"{run}: robot {robot} not found, expected one of {', '.join(known)}")
        for name in ROBOT_RESULTS:
            check_file(known[robot].folder / name, "a result of a finished run")
    out = []
    for robot in robots:
        folder = Path(tempfile.mkdtemp(prefix=f"duagc-replay-{robot}-"))
        try:
            out += _replay_one(run, logs.log(robot), robot, folder, config=config, report=report)
        finally:
            shutil.rmtree(folder)
    return out


def _replay_one(
    run: Path, log: Path, robot: str, folder: Path, *, config: RunConfig, report: Callable[[str], None]
) -> list[Comparison]:
    from duagc.pipeline.exchange.replay import replay_agent

    report(f"{robot}: front end and information")
    _prepare(log, robot_of(robot), folder / robot_of(robot), config)
    folder = folder / robot
    report(f"{robot}: agent, from its delivered packets")
    result, sent = replay_agent(
        steps.agent_input(robot, log, folder, config),
        config.exchange,
        seed=config.seed,
        exchange_path=run / "exchange.mcap",
    )
    report(f"{robot}: fusion")
    with stages.FUSION.running(folder, robot):
        steps.fuse_robot(robot, log, folder, result, config=config, threads=threads_per_worker(1))
    comparisons = [Comparison(robot, "packets sent", sent.recorded, sent.recomputed)]
    for name in ROBOT_RESULTS:
        recorded = digest_file(run / "robots" / robot / name)
        comparisons.append(Comparison(robot, name, recorded, digest_file(folder / name)))
    return comparisons


def _prepare(log: Path, robot: str, folder: Path, config: RunConfig) -> None:
    """Front end and information of a robot and its components, each of these in a folder next to the robot's."""
    steps.check_log(log, robot)
    folder.mkdir()
    threads = threads_per_worker(1)
    with stages.FRONTEND.running(folder, robot):
        steps.frontend(log, folder, config, threads=threads, checkpoints=Checkpoints())
    for name, of_component in steps.move_components(robot, folder).items():
        with stages.INFORMATION.running(of_component, name):
            steps.information(log, of_component, config, threads=threads)
