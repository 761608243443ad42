"""Commands that show what happened in a run."""

import json
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.common import Json, app


@app.command()
def view(
    path: Annotated[Path, typer.Argument(help="A run or a recording.", show_default=False)],
    save: Annotated[Path | None, typer.Option(help="Write a .rrd file instead of opening a window.")] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a PNG instead of opening a window.")] = None,
) -> None:
    """Open a run or a recording in Rerun.

    Example: `duagc view outputs/demo/run --save demo.rrd`
    """
    from duagc.pipeline.viewing import rerun_view

    rerun_view.view(path, save=save, screenshot=screenshot)


@app.command()
def inspect(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", show_default=False)],
    round_: Annotated[
        int | None, typer.Option("--round", metavar="K", help="Where every robot stood.", show_default=False)
    ] = None,
    packet: Annotated[
        int | None,
        typer.Option("--packet", metavar="N", help="By its place in exchange.mcap.", show_default=False),
    ] = None,
    gaussian: Annotated[
        str | None,
        typer.Option("--gaussian", metavar="ROBOT:ID", help="Of a robot's own map.", show_default=False),
    ] = None,
    closures: Annotated[
        bool, typer.Option("--closures", help="Every candidate between robots, and why it was kept or not.")
    ] = False,
    as_json: Json = False,
) -> None:
    """What happened to one round, one packet, one Gaussian or the closures of a run, in words and numbers.

    Example: duagc inspect outputs/demo/run --gaussian alpha:1200
    """
    from duagc.pipeline.runs.folder import RunFolder
    from duagc.pipeline.viewing.inspection import Inspector, format_facts

    if [round_, packet, gaussian, closures or None].count(None) != 3:
        raise typer.BadParameter("expected exactly one of --round, --packet, --gaussian, --closures")
    inspector = Inspector(RunFolder(run_folder))
    if round_ is not None:
        facts = inspector.round(round_)
    elif packet is not None:
        facts = inspector.packet(packet)
    elif closures:
        facts = inspector.closures()
    else:
        robot, colon, number = str(gaussian).partition(":")
        if not colon or not number.isdecimal():
            raise typer.BadParameter(f"{gaussian!r} is not like alpha:1200", param_hint="--gaussian")
        facts = inspector.gaussian(robot, int(number))
    print(json.dumps(facts, indent=2) if as_json else format_facts(facts))
