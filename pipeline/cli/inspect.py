"""Commands that show what happened in a run, and hand its maps to other programs."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.common import Force, Json, Out, app, say


@app.command()
def view(
    path: Annotated[Path, typer.Argument(help="A run or a recording.", show_default=False)],
    save: Annotated[Path | None, typer.Option(help="Write a .rrd file instead of opening a window.")] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a PNG instead of opening a window.")] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Of a run: where its recording is now.", show_default=False)
    ] = None,
) -> None:
    """Open a run or a recording in Rerun.

    Example: `duagc view outputs/demo/run --save demo.rrd`
    """
    from duagc.pipeline.viewing import rerun_view

    rerun_view.view(path, save=save, screenshot=screenshot, recording=recording)
    for written in filter(None, (save, screenshot)):
        print(written)


@app.command()
def export(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    out: Out,
    points: Annotated[
        bool,
        typer.Option(
            "--points", help="A point cloud with normals, opacity and sigma_m in place of Gaussian splats."
        ),
    ] = False,
    tile: Annotated[
        float | None,
        typer.Option(metavar="METERS", help="Cut each map into cubes of this edge.", show_default=False),
    ] = None,
    robots: Annotated[
        list[str] | None,
        typer.Option("--robot", help="Whose map; repeatable. Default: all robots.", show_default=False),
    ] = None,
    min_opacity: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="With --points: leave out Gaussians below it. Default: 0.5.",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write each robot's final map as .ply for splat viewers, or as a point cloud; whole or in tiles.

    The folder has export.json, which says what every file holds and where it is.

    Examples:
    `duagc export outputs/demo/run --points --robot alpha --out outputs/cloud`,
    `duagc export outputs/house --tile 5 --out outputs/house_tiles`
    """
    from duagc.pipeline.base.byte_counts import bytes_text
    from duagc.pipeline.viewing.map_export import ExportPlan
    from duagc.pipeline.viewing.map_export import export as export_maps

    if min_opacity is not None and not points:
        raise typer.BadParameter("expected together with --points", param_hint="--min-opacity")
    plan = ExportPlan("points" if points else "splats", tile, tuple(robots or ()))
    if min_opacity is not None:
        plan = replace(plan, min_opacity=min_opacity)
    files = export_maps(run_folder, out, plan, force=force)
    size = sum(path.stat().st_size for path in files)
    say(f"{len(files)} file{'s' * (len(files) != 1)}, {bytes_text(size)}")
    print(out)


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
