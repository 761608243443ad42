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
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    loop_closures: Annotated[
        bool,
        typer.Option("--loop-closures", help="Every inter-robot candidate, and why it was kept or rejected."),
    ] = False,
    robot: Annotated[
        str | None,
        typer.Option("--robot", help="With --loop-closures: only those of this robot.", show_default=False),
    ] = None,
    round_: Annotated[
        int | None,
        typer.Option("--round", metavar="K", help="State of every robot in a round.", show_default=False),
    ] = None,
    packet: Annotated[
        int | None,
        typer.Option("--packet", metavar="N", help="The N-th packet in exchange.mcap.", show_default=False),
    ] = None,
    gaussian: Annotated[
        str | None,
        typer.Option(
            "--gaussian", metavar="ROBOT:ID", help="A Gaussian of a robot's own map.", show_default=False
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show why loop closures were kept or rejected, or what happened to one round, packet or Gaussian.

    Examples:
    `duagc inspect outputs/demo/run --loop-closures`,
    `duagc inspect outputs/demo/run --loop-closures --robot alpha --json`,
    `duagc inspect outputs/demo/run --gaussian alpha:1200`
    """
    from duagc.pipeline.runs.folder import RunFolder
    from duagc.pipeline.viewing.inspection import Inspector, format_facts, format_loop_closures

    if [round_, packet, gaussian, loop_closures or None].count(None) != 3:
        raise typer.BadParameter("expected exactly one of --loop-closures, --round, --packet, --gaussian")
    if robot is not None and not loop_closures:
        raise typer.BadParameter("expected together with --loop-closures", param_hint="--robot")
    inspector = Inspector(RunFolder(run_folder))
    if loop_closures:
        facts = inspector.loop_closures(robot)
    elif round_ is not None:
        facts = inspector.round(round_)
    elif packet is not None:
        facts = inspector.packet(packet)
    else:
        name, colon, number = str(gaussian).partition(":")
        if not colon or not number.isdecimal():
            raise typer.BadParameter(f"{gaussian!r} is not like alpha:1200", param_hint="--gaussian")
        facts = inspector.gaussian(name, int(number))
    text = format_loop_closures(facts) if loop_closures else format_facts(facts)
    print(json.dumps(facts, indent=2) if as_json else text)
