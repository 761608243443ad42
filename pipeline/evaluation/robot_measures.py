"""What is measured of every robot by itself, and takes its time: renders, agreement of images, calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from duagc.pipeline.base import determinism, worker_reports
from duagc.pipeline.base.checkpoints import Checkpoints, Shown
from duagc.pipeline.base.worker_reports import Hear
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.evaluation import (
    groundtruth,
    map_agreement,
    map_errors,
    pixel_errors,
    uncertainty_calibration,
)
from duagc.pipeline.evaluation.map_agreement import MatchedViews
from duagc.pipeline.evaluation.rendering import Scored, poses_by_stamp, robot_scores
from duagc.pipeline.evaluation.results import Absent, Row
from duagc.pipeline.evaluation.true_paths import TruePaths
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.stages import EVALUATION
from duagc.pipeline.splat.gaussians import Gaussians

FRONTEND = "frontend.mcap"


@dataclass(frozen=True)
class RobotMeasures:
    """What is measured of one robot by itself, and takes its time.

    Attributes:
        scores: of its maps, by view.
        agreement: of its images with each other at its poses.
        calibration: scores of its fused map next to the true surface; a reason where there is none.
        reliability: of these, rows of the long table.
        pixels: calibration of the depth that its maps render, by map and set of views.
    """

    scores: list[Scored]
    agreement: dict[str, Any]
    calibration: dict[str, Any]
    reliability: list[Row]
    pixels: pixel_errors.Scores


@dataclass(frozen=True)
class RobotTask:
    """Measures robots of a run; also in a process of its own.

    Attributes:
        run_dir: folder of the run.
        recording: folder of its recording.
        threads: views rendered at the same time; changes no bit of the result.
        progress: show it on standard error.
        most_views: of a set that maps are scored at, evenly spread.
        saved: folder of the parts that are done, from which a process goes on that follows one that was killed.
        matched: what is known already of the features of robots, by name.
    """

    run_dir: Path
    recording: Path
    threads: int
    progress: bool
    most_views: int
    saved: Path | None = None
    matched: Mapping[str, MatchedViews] = field(default_factory=dict)

    def in_worker(self, name: str, further: Mapping[str, Gaussians]) -> RobotMeasures:
        """In a process that knows nothing of the run yet.

        Args:
            name: of the robot.
            further: maps besides those of the run, by kind.
        """
        determinism.configure_opencv()
        with EVALUATION.running(self.run_dir):
            run, source = RunFolder(self.run_dir), Recording(self.recording)
            truth = TruePaths.of(run, source)
            return self.of(name, run, source, truth=truth, further=further, hear=worker_reports.tell)

    def of(
        self,
        name: str,
        run: RunFolder,
        source: Recording,
        *,
        truth: TruePaths,
        further: Mapping[str, Gaussians],
        hear: Hear,
    ) -> RobotMeasures:
        """In this process.

        Args:
            name: of the robot.
            run: the run.
            source: its recording.
            truth: paths next to the true ones.
            further: maps besides those of the run, by kind.
            hear: gets every step.
        """

        def report(part: str, done: int, total: int, shown: Shown | None) -> None:
            hear((name, part, done, total))

        robot = run.robots[name]
        save = Checkpoints(None if self.saved is None else self.saved / name, report=report)
        scores = robot_scores(
            run,
            source,
            name,
            threads=self.threads,
            progress=self.progress,
            further=further,
            most_views=self.most_views,
            save=save,
        )
        hear((name, "surface", 0, 1))
        calibration, rows = save.done("calibration", lambda: _calibration_of(robot, source, truth))
        hear((name, "pixels", 0, 1))
        pixels = save.done(
            "pixels", lambda: pixel_errors.scores_of_robot(run, source, name, threads=self.threads)
        )
        hear((name, "agreement", 0, 1))
        matched = self.matched.get(name)
        agreement = save.done("agreement", lambda: _agreement_section(robot, source, truth, matched))
        hear((name, "agreement", 1, 1))
        return RobotMeasures(scores, agreement, calibration, rows, pixels)


@contextmanager
def measuring(
    task: RobotTask,
    run: RunFolder,
    source: Recording,
    truth: TruePaths,
    *,
    workers: int,
    further: Mapping[str, Mapping[str, Gaussians]],
    hear: Hear,
) -> Iterator[Callable[[], dict[str, RobotMeasures]]]:
    """What to call for the measures of every robot, by name; other processes are at work in the meantime.

    Args:
        task: measures one.
        run: the run.
        source: its recording.
        truth: paths next to the true ones.
        workers: robots measured at the same time, in processes of their own if more than one.
        further: maps besides those of the run, by robot and kind.
        hear: gets every step, in another thread where there are other processes.
    """
    if min(workers, len(run.robots)) == 1:
        yield lambda: {
            name: task.of(name, run, source, truth=truth, further=further.get(name, {}), hear=hear)
            for name in run.robots
        }
        return
    with (
        worker_reports.listening(hear) as queue,
        worker_pool(min(workers, len(run.robots)), worker_reports.keep_queue, (queue,)) as pool,
    ):
        begun = {name: pool.submit(task.in_worker, name, further.get(name, {})) for name in run.robots}
        yield lambda: {name: result.result() for name, result in begun.items()}


def matched_views_of(name: str, log: Path, run_dir: Path) -> MatchedViews:
    """What of the measures of a robot needs no more than its log and its front end, and takes seconds.

    Args:
        name: of the robot.
        log: of its sensors.
        run_dir: folder of the run.
    """
    determinism.configure_opencv()
    with EVALUATION.running(run_dir):
        robot = RobotRun(name, run_dir / "robots" / name)
        return map_agreement.matched_views(
            log, list(_held_out_stamps(robot)), frontend=robot.folder / FRONTEND
        )


def _held_out_stamps(robot: RobotRun) -> dict[int, int]:
    """Stamp of every held-out frame that was tracked, by its index."""
    return {f.frame_index: f.stamp_ns for f in robot.frames if f.held_out and f.status != "lost"}


def _agreement_section(
    robot: RobotRun, source: Recording, truth: TruePaths, matched: MatchedViews | None
) -> dict[str, Any]:
    held_out = _held_out_stamps(robot)
    paths = {"": poses_by_stamp(robot.trajectory), "_before_consensus": poses_by_stamp(robot.odometry)}
    true, frontend = truth.after[robot.robot], robot.folder / FRONTEND
    log = source.log(robot.robot)
    return map_agreement.section(log, held_out, paths, true, frontend=frontend, matched=matched)


def _calibration_of(robot: RobotRun, source: Recording, truth: TruePaths) -> tuple[dict[str, Any], list[Row]]:
    """The calibration of a fused map, and how errors and sigmas go together."""
    surface = groundtruth.surface(source)
    if isinstance(surface, Absent):
        return dict.fromkeys(map_errors.NAMES, surface), []
    T_gt_world = truth.T_gt_world(robot.robot)
    if isinstance(T_gt_world, Absent):
        return dict.fromkeys(map_errors.NAMES, T_gt_world), []
    errors = map_errors.map_errors(robot.fused_map, surface, T_gt_world)
    return map_errors.scores(errors, robot.robot), _reliability_rows(robot.robot, errors)


def _reliability_rows(robot: str, errors: map_errors.MapErrors) -> list[Row]:
    if len(errors.error_m) < map_errors.MIN_GAUSSIANS:
        return []
    rows = []
    for decile, (predicted_m, observed_m) in enumerate(
        uncertainty_calibration.reliability(errors.sigma_m, errors.error_m)
    ):
        rows.append(Row("reliability", robot, f"decile {decile}", -1, "predicted_rms_m", predicted_m))
        rows.append(Row("reliability", robot, f"decile {decile}", -1, "observed_rms_m", observed_m))
    return rows
