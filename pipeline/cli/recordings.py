"""Commands that make recordings and say what is in them."""

import json
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli.common import (
    EXIT_DIFFERENT,
    EXIT_FAILED,
    ConfigFile,
    Force,
    Json,
    Out,
    Overrides,
    app,
    say,
)


@app.command()
def simulate(
    out: Out,
    robots: Annotated[int, typer.Option(min=1, max=8, help="Number of robots.")] = 2,
    frames: Annotated[int, typer.Option(min=2, help="Frames per robot.")] = 160,
    scene: Annotated[
        str,
        typer.Option(
            help="room, office, corridor, outdoor, or a folder of textured meshes (GLB, glTF, OBJ, PLY)."
        ),
    ] = "room",
    paradigm: Annotated[
        str,
        typer.Option(help="wander, concentric, leader-follower, crossing or parallel: how the paths lie."),
    ] = "wander",
    up: Annotated[
        str,
        typer.Option(help="Axis that is up in the meshes: y, z, or auto (y for GLB, glTF, OBJ; z for PLY)."),
    ] = "auto",
    width: Annotated[int, typer.Option(min=32, help="Pixels.")] = 480,
    height: Annotated[int, typer.Option(min=32, help="Pixels.")] = 360,
    overlap: Annotated[float, typer.Option(min=0, max=1, help="Share of the view that neighbors see.")] = 0.6,
    noise: Annotated[str, typer.Option(help="none or kinect.")] = "none",
    seed: Annotated[int, typer.Option(help="Seed of scene, paths and noise.")] = 0,
    sensor: Annotated[
        str, typer.Option(help="rgbd, stereo (depth by matching), or lidar (points with the images).")
    ] = "rgbd",
    readout_ms: Annotated[float, typer.Option(help="Rolling shutter: from the first row to the last.")] = 0,
    exposure_ms: Annotated[float, typer.Option(help="Motion blur: how long the shutter is open.")] = 0,
    gain_stops: Annotated[float, typer.Option(help="Largest change of the exposure over time.")] = 0,
    camera_stops: Annotated[
        float, typer.Option(help="Difference of the robots' cameras, by channel: factors of two of light.")
    ] = 0,
    clock_ms: Annotated[float, typer.Option(help="Largest offset of a robot's clock.")] = 0,
    movers: Annotated[int, typer.Option(min=0, max=8, help="Figures that walk about, with masks.")] = 0,
    preview: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Contact sheet to write: paths from above, views over time."),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render; changes no result.")] = 2,
    force: Force = False,
) -> None:
    """Render a recording of a robot team, in a procedural scene or among textured meshes, with exact ground truth.

    Examples:
    `duagc simulate --robots 3 --noise kinect --out recordings/room`,
    `duagc simulate --scene office --robots 4 --paradigm crossing --preview office.png --out recordings/office`,
    `duagc simulate --scene scans/house --width 640 --height 480 --frames 300 --out recordings/house`
    """
    from duagc.converters.simulate.sensors.rig import Rig
    from duagc.converters.simulate.team import simulate as simulate_recording

    simulate_recording(
        out,
        robots=robots,
        frames=frames,
        scene=scene,
        up=up,
        paradigm=paradigm,
        preview=preview,
        rig=Rig(sensor, readout_ms / 1000, exposure_ms / 1000, gain_stops, clock_ms / 1000, camera_stops),
        movers=movers,
        size=(width, height),
        overlap=overlap,
        noise=noise,
        seed=seed,
        workers=workers,
        force=force,
    )
    _say_warnings(out)
    print(out)


def _say_warnings(out: Path) -> None:
    """What a new recording says about itself that its maker may not have wanted."""
    for line in json.loads((out / "recording.json").read_text())["warnings"]:
        say(f"{out}: warning: {line}")


@app.command()
def convert(
    dataset: Annotated[
        str | None,
        typer.Argument(help="Name of the dataset (see --list), or a converter of your own in a .py."),
    ] = None,
    source: Annotated[Path | None, typer.Argument(metavar="SRC", help="Where its files are.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write; must not exist.")] = None,
    robots: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Cut one sequence into this many robots; else one, or as many as the dataset has.",
            show_default=False,
        ),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Option of the converter; repeatable."),
    ] = None,
    options_file: Annotated[
        Path | None,
        typer.Option(
            "--options",
            metavar="TOML",
            help="File of options, such as `duagc calibrate --out` writes; --set wins over it.",
        ),
    ] = None,
    time_source: Annotated[
        str | None,
        typer.Option(
            help="Of logs of other programs: header, log (recording) or publish.", show_default=False
        ),
    ] = None,
    force: Force = False,
    list_datasets: Annotated[
        bool, typer.Option("--list", help="List the datasets and their options.")
    ] = False,
) -> None:
    """Convert a dataset, as it is distributed, into one log per robot.

    Examples: `duagc convert 7scenes ~/data/redkitchen --robots 2 --out recordings/redkitchen`,
    `duagc convert 7scenes ~/data/redkitchen --robots 2 --options cameras.toml --out recordings/calibrated`
    """
    from duagc.converters import registry

    if list_datasets:
        print(registry.describe())
        return
    if dataset is None or source is None or out is None:
        raise typer.BadParameter("expected DATASET SRC --out REC, or --list")
    said = [*(options or []), *([f"time_source={time_source}"] if time_source else [])]
    registry.convert(
        dataset, source, out, robots=robots, force=force, options=said, options_file=options_file
    )
    _say_warnings(out)
    print(out)


@app.command()
def info(
    path: Annotated[
        Path, typer.Argument(help="A recording, a run or a log, also of another program.", show_default=False)
    ],
    as_json: Json = False,
    as_toml: Annotated[
        bool,
        typer.Option("--toml", help="Of a log of another program: a file to convert it by, to be edited."),
    ] = False,
    preview: Annotated[
        Path | None,
        typer.Option(help="Write a PNG of some color and depth images of every robot.", show_default=False),
    ] = None,
) -> None:
    """Say what is in a recording, a run or a log; of a log of another program also what would be converted and why.

    Examples: `duagc info recordings/redkitchen --preview redkitchen.png`,
    `duagc info campus.bag --toml > campus.toml`
    """
    from duagc.converters.logs import describe
    from duagc.pipeline import recording

    if describe.is_foreign(path):
        described = describe.describe(path)
        text = describe.toml_text(described) if as_toml else describe.format_description(described)
        print(json.dumps(described, indent=2) if as_json else text)
        return
    if as_toml:
        raise DuagError(f"{path}: is none of another program's logs, expected one with --toml")
    content = recording.info(path)
    if preview is not None:
        recording.write_preview_of(path, preview)
    print(json.dumps(content, indent=2) if as_json else recording.format_info(content))


@app.command()
def check(
    path: Annotated[Path, typer.Argument(help="A recording, or the log of one robot.", show_default=False)],
    as_json: Json = False,
) -> None:
    """Say whether a recording is sound: times, pairs, depth scale, calibration, what a run will take.

    Exit code 1 if there is an error; warnings and notes leave it 0.

    Example: `duagc check recordings/redkitchen`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.checks import check

    determinism.configure_opencv()
    report = check.check(path)
    print(json.dumps(report.plain(), indent=2) if as_json else check.format_report(report))
    if not report.sound:
        raise typer.Exit(EXIT_FAILED)


@app.command()
def calibrate(
    path: Annotated[Path, typer.Argument(metavar="RECORDING", show_default=False)],
    robots: Annotated[
        list[str] | None,
        typer.Option(
            "--robot", help="Only this robot; repeatable. All, if none: they have one kind of camera."
        ),
    ] = None,
    views: Annotated[int, typer.Option(min=12, help="Most views of each half of the recording.")] = 56,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="TOML", help="File to write: options for `duagc convert`."),
    ] = None,
    force: Force = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Estimate lens, rotation between the cameras and depth error of an RGB-D recording from its own images.

    Prints every number with its standard deviation, and a check of each half by the other. Ground truth is not looked
    at. An error if the images do not determine the cameras.

    Example: `duagc calibrate recordings/redkitchen --out cameras.toml`, then
    `duagc convert 7scenes ~/data/redkitchen --robots 2 --options cameras.toml --out recordings/calibrated`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.camera_calibration import report
    from duagc.pipeline.camera_calibration.calibrate import calibrate as calibrate_recording
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.recording import Recording

    determinism.configure_opencv()
    if out is not None:
        report.check_out(out, force, Recording(path).description, path)
    found = calibrate_recording(
        path, load_config(RunConfig, config, overrides or []).frontend, robots or [], views
    )
    print(json.dumps(report.plain(found), indent=2) if as_json else report.format_calibration(found))
    if out is not None:
        report.write(found, out)


@app.command()
def recover(
    source: Annotated[Path, typer.Argument(help="A damaged log or recording; it stays as it is.")],
    out: Out,
    force: Force = False,
) -> None:
    """Save every message that is whole in a log that is cut or damaged, and list what is lost.

    Exit code 3 if something was lost.

    Examples: `duagc recover broken/alpha.mcap --out alpha.mcap`, `duagc recover broken --out recordings/saved`
    """
    from duagc.pipeline.recording import recovery

    salvaged = recovery.recover(source, out, force)
    for salvage in salvaged:
        print(salvage.line())
    if not all(salvage.whole for salvage in salvaged):
        raise typer.Exit(EXIT_DIFFERENT)
