"""Commands that run the stages, one by one or all, and compare runs."""

import json
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.base.stop_signals import STOPPING
from duagc.pipeline.cli.common import (
    EXIT_DIFFERENT,
    ConfigFile,
    Force,
    Json,
    Out,
    Overrides,
    StoreFolder,
    Workers,
    app,
    say,
)

MEASURING = {"evaluation", "report"}
"""Stages that `--no-evaluation` leaves out."""


@app.command()
def demo(
    out: Out = Path("outputs/demo"),
    robots: Annotated[int, typer.Option(min=2, max=4, help="Robots to simulate.")] = 2,
    frames: Annotated[int, typer.Option(min=20, help="Frames per robot.")] = 160,
    seed: Annotated[int, typer.Option(help="Seed of scene, paths and run.")] = 0,
    workers: Workers = 2,
    force: Force = False,
) -> None:
    """Simulate a team, fuse its maps, evaluate and report: the whole job on an embedded default.

    Example: `duagc demo --out outputs/demo`
    """
    from duagc.converters.simulate.team import simulate as simulate_recording
    from duagc.pipeline.base.atomic_folder import DEMO, new_folder
    from duagc.pipeline.cache.store import default_store

    store = default_store(out)
    with new_folder(out, force, DEMO) as folder:
        say(f"simulate: {robots} robots, {frames} frames each")
        with ThreadPoolExecutor(1) as meanwhile:
            meanwhile.submit(_read_code, store)  # what is wrong with the store, the run itself will say
            simulate_recording(folder / "recording", robots=robots, frames=frames, seed=seed, workers=workers)
        from duagc.pipeline.config.run import RunConfig
        from duagc.pipeline.runner import run as run_stages

        run_stages(
            folder / "recording",
            folder / "run",
            RunConfig(seed=seed),
            workers=workers,
            store=store,
            log=say,
        )
    _print_outputs(out / "run")


def _read_code(store: Path) -> None:
    """Import what a run needs, and read its code, in a thread, while the main one does something else."""
    signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)  # they are the main thread's, which may hold them back
    from duagc.pipeline.runner import read_code

    read_code(store)


@app.command()
def run(
    recording: Annotated[Path, typer.Argument(help="Folder of a recording.", show_default=False)],
    out: Out,
    config: ConfigFile = None,
    overrides: Overrides = None,
    workers: Workers = 2,
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate",
            help="First calibrate the cameras from the images; use that if it is better (OUT/calibrated).",
        ),
    ] = False,
    since: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="STAGE",
            help="Compute this stage and those after it, also if their results are stored.",
            show_default=False,
        ),
    ] = None,
    until: Annotated[
        str,
        typer.Option(
            metavar="STAGE",
            help="Last stage: frontend, information, exchange, fusion, evaluation, report, rrd.",
        ),
    ] = "rrd",
    why: Annotated[
        bool, typer.Option("--why", help="Compute nothing; say what would be computed, and what changed.")
    ] = False,
    store: StoreFolder = None,
    no_cache: Annotated[
        bool, typer.Option("--no-cache", help="Neither take results from the store nor keep any.")
    ] = False,
    no_evaluation: Annotated[
        bool, typer.Option("--no-evaluation", help="Leave out metrics and report.")
    ] = False,
    follow: Annotated[
        bool,
        typer.Option("--follow", help="Serve the run to Rerun on port 9876 while it is computed."),
    ] = False,
    force: Force = False,
) -> None:
    """Run all stages on a recording: maps, information, exchange, fusion, metrics, report, view.

    Stages whose code, settings and inputs did not change are taken from the store: a run that was stopped goes on
    where it was.

    Examples:
    `duagc run recordings/redkitchen --out outputs/redkitchen`,
    `duagc run recordings/desk --calibrate --out outputs/desk`,
    `duagc run recordings/room --out outputs/lossy --set exchange.link.loss_probability=0.3`,
    `duagc run recordings/room --out outputs/room --until frontend`
    """
    from duagc.pipeline.cache.store import default_store
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig

    if no_cache and (store is not None or since is not None or why):
        raise typer.BadParameter("expected without --store, --from, --why", param_hint="--no-cache")
    if no_evaluation and not MEASURING.isdisjoint((since, until)):
        raise typer.BadParameter(
            "expected without --from or --until evaluation or report", param_hint="--no-evaluation"
        )
    settings = load_config(RunConfig, config, overrides or [])
    place = None if no_cache else store or default_store(out)
    if why:
        from duagc.pipeline.existing_run import why as say_why
        from duagc.pipeline.run_plan import RunPlan

        plan = RunPlan(
            workers, force, calibrate, store=place, since=since, until=until, evaluated=not no_evaluation
        )
        for line in say_why(recording, out, settings, plan):
            print(line)
        return
    from duagc.pipeline.runner import run as run_stages

    run_stages(
        recording,
        out,
        settings,
        workers=workers,
        force=force,
        calibrate=calibrate,
        store=place,
        since=since,
        until=until,
        evaluated=not no_evaluation,
        follow=follow,
        log=say,
    )
    _say_times(out)
    _print_outputs(out)
    if not calibrate:
        _say_advice(out, recording)


@app.command()
def gc(
    store: StoreFolder = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="A run; else the store next to it.", show_default=False)
    ] = None,
    largest: Annotated[
        str, typer.Option("--max", metavar="SIZE", help="k, M, G and T are understood.")
    ] = "20G",
    dry: Annotated[bool, typer.Option("--dry-run", help="Remove nothing; only say what would go.")] = False,
) -> None:
    """Bound the store of results: what was not used for longest is removed.

    Runs keep their own copies, and may be going on meanwhile. Without --store, $DUAGC_STORE, else that of outputs/.

    Example: `duagc gc --max 5G`
    """
    from duagc.pipeline.base.byte_counts import bytes_text
    from duagc.pipeline.cache.garbage import collect
    from duagc.pipeline.cache.store import default_store

    place = store or default_store(out or Path("outputs/run"))
    done = collect(place, _bytes("--max", largest), dry)
    verb = "would be removed" if dry else "removed"
    print(f"{place}: {done.entries} results {verb}, {bytes_text(done.freed_bytes)}")
    print(f"{done.kept_entries} results remain, {bytes_text(done.kept_bytes)}")


def _bytes(option: str, text: str) -> int:
    number, unit = text[:-1], text[-1:]
    factor = {"k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}.get(unit)
    try:
        size = int(float(number) * factor) if factor else int(text)
    except (ValueError, OverflowError):
        size = -1
    if size < 0:
        raise typer.BadParameter(f"{text!r} is not a size such as 20G", param_hint=option)
    return size


def _say_times(run_folder: Path) -> None:
    """What every stage took, and the most memory that its process held."""
    from duagc.pipeline.runs.folder import RunFolder
    from duagc.pipeline.runs.stages import STAGES

    rows = RunFolder(run_folder).timing.values()
    order = [stage.name for stage in STAGES]
    for row in sorted(rows, key=lambda row: order.index(row["stage"]) if row["stage"] in order else -1):
        name = f"{row['stage']} of {row['robot']}" if row["robot"] else row["stage"]
        wall, cpu, peak = row["wall_s"], row["cpu_s"], row["peak_rss_mb"]
        stored = "" if row["executed"] else "   from the store"
        say(f"{name:<24}{wall:>8.1f} s {cpu:>8.1f} s of processor {peak:>6.0f} MB{stored}")


def _say_advice(run_folder: Path, recording: Path) -> None:
    from duagc.pipeline.evaluation.network import Session
    from duagc.pipeline.recording import Recording
    from duagc.pipeline.report.advice import advice, joining_advice
    from duagc.pipeline.runs.folder import RunFolder

    run = RunFolder(run_folder)
    measured = advice(run, Recording(recording), Session(run)) if run.metrics else [joining_advice(run)]
    for said in filter(None, measured):
        say(said)


def _print_outputs(run_folder: Path) -> None:
    from duagc.pipeline.runs.folder import RunFolder

    for name, paths in (
        ("report", [run_folder / "report" / "index.html"]),
        ("view", [run_folder / "run.rrd"]),
        ("map", RunFolder(run_folder).final_maps),
        ("metrics", [run_folder / "metrics.json"]),
    ):
        for path in paths:
            if path.is_file():
                print(f"{name:<10} {path}")


@app.command()
def replay(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    robot: Annotated[str | None, typer.Option(help="One robot; all by default.")] = None,
    recording: Annotated[Path | None, typer.Option(help="Where the recording is now.")] = None,
) -> None:
    """Recompute each robot from its own log and the packets that reached it; compare bit for bit.

    Exit code 3 if anything differs. Example: `duagc replay outputs/demo/run`
    """
    from duagc.pipeline.replay import replay as replay_robots
    from duagc.pipeline.runs.folder import RunFolder

    run = RunFolder(run_folder)
    robots = [robot] if robot else list(run.robots)
    comparisons = replay_robots(run_folder, run.recording_at(recording), robots, say)
    for c in comparisons:
        verdict = (
            "equal" if c.equal else f"DIFFERS: recorded {c.recorded[:12]}, recomputed {c.recomputed[:12]}"
        )
        print(f"{c.robot:<10} {c.name:<17} {verdict}")
    if not all(c.equal for c in comparisons):
        raise typer.Exit(EXIT_DIFFERENT)


@app.command()
def evaluate(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    recording: Annotated[Path | None, typer.Option(help="Where the recording is now.")] = None,
    own_longer: Annotated[
        bool,
        typer.Option(
            "--own-longer",
            help="Also train each own map as long as the final one, without the team, and score it.",
        ),
    ] = False,
    views: Annotated[
        int, typer.Option(min=1, help="Most views of a set that maps are scored at, evenly spread.")
    ] = 40,
    as_json: Json = False,
) -> None:
    """Measure a run against ground truth, where there is any, and write metrics.json.

    Prints how each robot's maps compare: own, fused, refined.

    Example: `duagc evaluate outputs/demo/run --own-longer`
    """
    from duagc.pipeline.base.thread_share import threads_per_worker
    from duagc.pipeline.evaluation import evaluate as evaluate_run
    from duagc.pipeline.report.labels import comparison_text
    from duagc.pipeline.runs.folder import RunFolder
    from duagc.pipeline.runs.stages import EVALUATION

    run = RunFolder(run_folder)
    source, threads = run.recording_at(recording), threads_per_worker(1)
    longer = None
    if own_longer:
        from duagc.pipeline.experiments.own_longer import own_longer as train_longer
        from duagc.pipeline.recording import Recording

        longer = train_longer(run, Recording(source), threads)
    with EVALUATION.running(run_folder):
        metrics = evaluate_run(run_folder, source, threads=threads, own_longer=longer, most_views=views)
    if as_json:
        print(json.dumps(metrics, indent=2))
        return
    print(comparison_text(metrics))
    print(run_folder / "metrics.json")


@app.command()
def report(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    recording: Annotated[Path | None, typer.Option(help="Where the recording is now.")] = None,
) -> None:
    """Write the self-contained HTML report of a run.

    Example: `duagc report outputs/demo/run`
    """
    from duagc.pipeline.report import write_report
    from duagc.pipeline.runs.folder import RunFolder
    from duagc.pipeline.runs.stages import REPORT

    source = RunFolder(run_folder).recording_at(recording)
    with REPORT.running(run_folder):
        print(write_report(run_folder, source))


@app.command()
def digest(
    path: Annotated[Path, typer.Argument(help="A log, a recording or a run.", show_default=False)],
) -> None:
    """Print 64 hex characters that stand for the content: messages and results, not encoders or clocks.

    Example: `duagc digest outputs/demo/run`
    """
    from duagc.pipeline.runs.digest import digest as digest_path

    print(digest_path(path))
