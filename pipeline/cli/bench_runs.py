"""Commands that measure whole runs: for every second of log, as logs get longer, and what they state."""

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.bench import MOST_ROBOTS, counts, numbers
from duagc.pipeline.cli.common import Json, Overrides, bench_app

Recorded = Annotated[Path, typer.Argument(help="Folder of a recording.", show_default=False)]


def _options(overrides: list[str] | None) -> list[str]:
    return [word for override in overrides or [] for word in ("--set", override)]


@bench_app.command("realtime")
def bench_realtime(
    recording: Recorded,
    robots: Annotated[str, typer.Option(help="Sizes of the team: the first robots by name.")] = "1,2",
    threads: Annotated[str, typer.Option(help="Processors that a run may use.")] = "1,2",
    other: Annotated[
        Path | None,
        typer.Option(help="`duagc` of another version, which runs the same in turn.", show_default=False),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, max=1e6, help="Of every log; else all of it.", show_default=False)
    ] = None,
    no_open3d: Annotated[bool, typer.Option("--no-open3d", help="Without Open3D's odometry.")] = False,
    no_evaluation: Annotated[
        bool, typer.Option("--no-evaluation", help="Without metrics and report (not with --other).")
    ] = False,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Whole runs, stage by stage, in seconds for every second of log: below 1 a team is mapped as fast as it records.

    Lists are separated by commas; every combination is a run with nothing from any store. Needs an idle machine.

    Examples: `duagc bench realtime recordings/redkitchen`,
    `duagc bench realtime recordings/office8 --robots 1,2,4,8 --threads 2 --seconds 4`,
    `duagc bench realtime recordings/redkitchen --robots 2 --threads 2 --other ../before/.venv/bin/duagc`
    """
    from duagc.pipeline.bench import realtime
    from duagc.pipeline.kernels.arguments import MAX_THREADS

    if no_evaluation and other is not None:
        raise typer.BadParameter("other versions may not know it", param_hint="--no-evaluation")
    plan = realtime.RealtimePlan(
        recording,
        tuple(counts("--robots", robots, MOST_ROBOTS)),
        tuple(counts("--threads", threads, MAX_THREADS)),
        other=other,
        open3d=not no_open3d,
        seconds=seconds,
        options=(*_options(overrides), *(["--no-evaluation"] if no_evaluation else [])),
    )
    result = realtime.run(plan)
    print(json.dumps(result, indent=2) if as_json else realtime.format_table(result))


@bench_app.command("length")
def bench_length(
    recording: Recorded,
    seconds: Annotated[str, typer.Option(help="Lengths of the logs, from their beginning.")],
    threads: Annotated[int, typer.Option(min=1, help="Processors that a run may use.")] = 2,
    keep: Annotated[
        Path | None,
        typer.Option(help="Folder where the runs stay; what is there is not run again.", show_default=False),
    ] = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Time, memory and accuracy of whole runs against the length of their logs.

    Lengths are separated by commas. "more" is the processor time of every further second of log. With `--keep`, a
    bench that was stopped goes on where it was, and has no wall time of the runs that it found.

    Example: `duagc bench length recordings/redkitchen --seconds 2.5,5,10`
    """
    from duagc.pipeline.bench import length

    lengths = tuple(numbers("--seconds", seconds, 0.1, 1e6))
    result = length.run(length.LengthPlan(recording, lengths, threads, tuple(_options(overrides)), keep))
    print(json.dumps(result, indent=2) if as_json else length.format_table(result))


@bench_app.command("information")
def bench_information(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A finished run.", show_default=False)],
    recording: Annotated[
        Path | None, typer.Option(help="Folder of its recording, if it moved.", show_default=False)
    ] = None,
    sample: Annotated[int, typer.Option(min=1, help="Gaussians of each robot, drawn at random.")] = 400,
    windows: Annotated[str, typer.Option(help="Numbers of keyframes K to sum over.")] = "1,2,4,8,10",
    robot: Annotated[str | None, typer.Option(help="One robot; all by default.", show_default=False)] = None,
    seed: Annotated[int, typer.Option(help="Seed of the sample.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to write, which must not exist: information.md, information.json, gaussians.parquet, "
            "r_k.svg.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """What the information of single Gaussians is like: cross terms, windows, squared gradients; verdicts by rules.

    Sums derivatives of single pixels in float64 over the run's own keyframes; opens no ground truth. 400 Gaussians
    take some minutes a robot.

    Example: `duagc bench information outputs/redkitchen --out outputs/information`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.base.atomic_folder import new_folder
    from duagc.pipeline.base.errors import DuagError
    from duagc.pipeline.base.files import new_file
    from duagc.pipeline.experiments import information_structure, information_tables
    from duagc.pipeline.recording import Recording
    from duagc.pipeline.runs.folder import RunFolder

    determinism.configure_opencv()
    if out is not None and out.exists():
        raise DuagError(f"{out}: exists, expected a new folder")
    run = RunFolder(run_folder)
    source = Recording(run.recording_at(recording))
    plan = information_structure.StructurePlan(
        sample, tuple(counts("--windows", windows)), robots=(robot,) if robot else (), seed=seed
    )
    with nullcontext() if out is None else new_folder(out, force=False) as folder:
        found = information_structure.run(run, source, plan)
        code = information_structure.code_digest()
        text = json.dumps(information_tables.numbers(found, code), indent=2)
        if folder is not None:
            for name, content in (
                ("information.json", f"{text}\n"),
                ("information.md", information_tables.page(found, code)),
                ("r_k.svg", information_tables.plot(found)),
            ):
                with new_file(folder / name) as part:
                    part.write_text(content, encoding="utf-8")
            information_structure.write_gaussians(found.columns, folder / "gaussians.parquet")
    print(text if as_json else information_tables.format_tables(found))
