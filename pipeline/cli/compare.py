"""Commands that compare results: the regression gate."""

import json
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.common import EXIT_DIFFERENT, Json, app, golden_app

Golden = Annotated[
    Path,
    typer.Argument(
        metavar="GOLDEN", help="File of the golden run, .json; its .npz is next to it.", show_default=False
    ),
]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)]


@app.command()
def compare(
    first: Annotated[
        Path, typer.Argument(metavar="A", help="A run, a recording or a log.", show_default=False)
    ],
    second: Annotated[
        Path, typer.Argument(metavar="B", help="Another one of the same kind.", show_default=False)
    ],
    tolerance: Annotated[
        Path | None,
        typer.Option(help="TOML file of `[[tolerance]]` tables: where, field, absolute or relative, reason."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say what differs: of each topic the first message that does, with time, field and both values.

    Earlier stages come first, so the first line names where it began. Exit code 3 if anything differs.

    Example: `duagc compare outputs/before outputs/after --tolerance tolerances.toml`
    """
    from duagc.pipeline.comparison.compare import compare as compare_paths
    from duagc.pipeline.comparison.tolerances import Tolerances, read_tolerances

    tolerances = Tolerances() if tolerance is None else read_tolerances(tolerance)
    found = compare_paths(first, second, tolerances)
    print(json.dumps(found.plain(), indent=2) if as_json else found.text())
    if not found.equal:
        raise typer.Exit(EXIT_DIFFERENT)


@golden_app.command("update")
def golden_update(run_folder: Run, golden: Golden) -> None:
    """Store what a run computed: a digest of every file, topic and field, 16 bits of every message, the metrics.

    Example: `duagc golden update outputs/dock golden/dock.json`
    """
    from duagc.pipeline.comparison.golden import store

    store(golden, run_folder)
    print(golden)


@golden_app.command("check")
def golden_check(run_folder: Run, golden: Golden, as_json: Json = False) -> None:
    """Say in what a run differs from a golden one: stage, topic, first message, fields; metrics to 1e-9.

    Exit code 3 if anything differs.

    Example: `duagc golden check outputs/dock golden/dock.json`
    """
    from duagc.pipeline.comparison.golden import differences

    lines = differences(golden, run_folder)
    if as_json:
        print(json.dumps({"equal": not lines, "differences": lines}, indent=2))
    else:
        print("\n".join([*lines, f"{len(lines)} differences" if lines else "equal"]))
    if lines:
        raise typer.Exit(EXIT_DIFFERENT)
