"""The main job: from a recording to fused maps, metrics, report and view.

Robots are prepared in parallel processes; the exchange is one ordered stage in one process. Every stage that is done
goes into a store, so that a run that was stopped, or is repeated with other settings, computes only what is missing.
Everything is written into a temporary folder next to the output, which gets its final name when all is done.
"""

from __future__ import annotations

from multiprocessing.queues import SimpleQueue
from pathlib import Path

from duagc.pipeline.base import determinism
from duagc.pipeline.base.atomic_folder import ANYTHING, RUN, check_apart, new_folder
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.worker_reports import listening
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.config.base import check_numbers
from duagc.pipeline.config.packages import check_packages
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.existing_run import follow_recording, is_up_to_date, keep_what_holds
from duagc.pipeline.job import Job
from duagc.pipeline.preparation import Say, read_code, say
from duagc.pipeline.run_plan import LAST, RunPlan

__all__ = ["read_code", "run"]


def run(
    recording_path: str | Path,
    out: str | Path,
    config: RunConfig,
    *,
    workers: int = 2,
    force: bool = False,
    calibrate: bool = False,
    store: str | Path | None = None,
    since: str | None = None,
    until: str = LAST,
    evaluated: bool = True,
    follow: bool = False,
    log: Say = say,
) -> None:
    """Run all stages on a recording.

    The result is the same to the last bit in every process: where the numeric libraries were imported before
    `configure_determinism`, all stages run in a child process. Child processes import the main script again: call
    this under `if __name__ == "__main__":`.

    Args:
        recording_path: folder of the recording.
        out: folder of the run. With a store, a run that is there already is completed if its code, settings and
            inputs are these; any other is in the way unless `force`.
        config: settings of all stages.
        workers: robots prepared at the same time; changes no bit of the result.
        force: replace an earlier run in `out`.
        calibrate: calibrate the cameras from the recording's own images first. Where views that were not used say
            that it is better, the run is of the calibrated recording, which is kept in its folder `calibrated`.
        store: folder of results that are not computed again; None: everything is computed, and nothing is kept.
        since: the first stage that is computed whatever the store has; None: none is.
        until: the last stage that is done.
        evaluated: whether the run is measured, and gets a report.
        follow: serve the run to Rerun while it is computed; changes no bit of the result.
        log: gets a line at the start of every stage, and every warning.

    Raises:
        DuagError: what a user can fix; nothing is left under the name `out`.
    """
    if not isinstance(config, RunConfig):
        raise DuagError(
            f"config is of type {type(config).__name__}, expected a RunConfig; load_config makes one"
        )
    check_numbers(config, "config")
    check_packages(config)
    recording_path, out, store = Path(recording_path), Path(out), None if store is None else Path(store)
    check_apart(out, [recording_path] if store is None else [recording_path, store])
    plan = RunPlan(
        workers, force, calibrate, store=store, since=since, until=until, evaluated=evaluated, follow=follow
    )
    determinism.configure_determinism()
    if determinism.is_deterministic():
        _run(recording_path, out, config, plan, log=log)
    else:
        _run_in_child(recording_path, out, config, plan, log=log)


def _run(recording_path: Path, out: Path, config: RunConfig, plan: RunPlan, *, log: Say) -> None:
    from duagc.pipeline.recording import Recording

    recording = Recording(recording_path)
    force, completed = plan.force, False
    if out.exists() and not force and plan.store is not None:
        if is_up_to_date(recording, out, config, plan, log=log):
            follow_recording(recording, out)
            log(f"{out}: up to date")
            return
        force = completed = True
    with new_folder(out, force, ANYTHING if completed else RUN) as folder:
        Job(recording, folder, config, plan, log=log, place=out).run()
        if completed:
            keep_what_holds(recording, folder, config, plan, out=out, log=log)


def _run_in_child(recording_path: Path, out: Path, config: RunConfig, plan: RunPlan, *, log: Say) -> None:
    """`_run` in a process that is started with the settings of `determinism`; its lines come back to `log`."""
    with listening(log) as lines, worker_pool(1, _keep_queue, (lines,)) as pool:
        pool.submit(_run_and_send, recording_path, out, config, plan).result()


_lines: list[SimpleQueue[str | None]] = []


def _keep_queue(lines: SimpleQueue[str | None]) -> None:
    """Where a child process sends its lines: a queue can be handed to a process only while it starts."""
    _lines.append(lines)


def _run_and_send(recording_path: Path, out: Path, config: RunConfig, plan: RunPlan) -> None:
    _run(recording_path, out, config, plan, log=_lines[0].put)
