"""Commands that make recordings: of a simulated team, and of the files of a dataset."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.common import Force, Out, app, of_home, say


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
    auto_exposure: Annotated[
        float, typer.Option(help="Largest change of the gain by automatic exposure, a share: 0.3.")
    ] = 0,
    exposure_lag_ms: Annotated[float, typer.Option(help="Time constant of the automatic exposure.")] = 300,
    white_balance: Annotated[
        float, typer.Option(help="Largest drift of red against blue, a share of the light: 0.15.")
    ] = 0,
    vignette: Annotated[float, typer.Option(help="Share of the light that the corners lose: 0.4.")] = 0,
    blur_px: Annotated[
        float, typer.Option(help="Motion blur by pixels; sets how long the shutter is open.")
    ] = 0,
    lens_k1: Annotated[
        float,
        typer.Option(help="Radial distortion: -0.3; images are undistorted, with a rim and its mask."),
    ] = 0,
    depth_step_mm: Annotated[
        float, typer.Option(help="Distance between measurable depths at 1 m; grows with its square.")
    ] = 0,
    depth_delay_ms: Annotated[float, typer.Option(help="How much older depth is than its time says.")] = 0,
    missing: Annotated[float, typer.Option(help="Share of the frames that are missing: 0.2.")] = 0,
    rate_hz: Annotated[float, typer.Option(help="Frames a second, of a path with 30.")] = 30,
    movers: Annotated[int, typer.Option(min=0, max=8, help="Figures that walk about.")] = 0,
    masks: Annotated[
        bool, typer.Option(help="Say where they are; if not, only the ground truth has it.")
    ] = True,
    cover: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOT:FIRST:FRAMES",
            help="A lens is covered for these frames while the robot moves on; repeatable.",
        ),
    ] = None,
    triangles: Annotated[
        bool,
        typer.Option(
            "--triangles",
            help="Make triangles of the room, as lens, blur and rolling shutter do: the same paths as with these.",
        ),
    ] = False,
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
    `duagc simulate --scene scans/house --width 640 --height 480 --frames 300 --out recordings/house`,
    `duagc simulate --noise kinect --auto-exposure 0.3 --blur-px 4 --missing 0.2 --out recordings/handheld`
    """
    from duagc.converters.simulate.sensors.degradations import Degradations
    from duagc.converters.simulate.sensors.rig import Rig
    from duagc.converters.simulate.settings import Cover
    from duagc.converters.simulate.team import simulate as simulate_recording

    simulate_recording(
        out,
        robots=robots,
        frames=frames,
        scene=of_home(scene),
        up=up,
        paradigm=paradigm,
        preview=preview,
        rig=Rig(sensor, readout_ms / 1000, exposure_ms / 1000, gain_stops, clock_ms / 1000, camera_stops),
        movers=movers,
        masks=masks,
        covers=[Cover.parse(text) for text in cover or ()],
        degradations=Degradations(
            auto_exposure=auto_exposure,
            exposure_lag_s=exposure_lag_ms / 1000,
            white_balance=white_balance,
            vignette=vignette,
            blur_px=blur_px,
            lens_k1=lens_k1,
            depth_step_m=depth_step_mm / 1000,
            depth_delay_s=depth_delay_ms / 1000,
            missing=missing,
            rate_hz=rate_hz,
        ),
        triangles=triangles,
        size=(width, height),
        overlap=overlap,
        noise=noise,
        seed=seed,
        workers=workers,
        force=force,
    )
    _say_warnings(out)
    print(out)


def _convert_calibrated(convert_to: Callable[[Path, bool], None], out: Path, force: bool) -> None:
    """Write a recording calibrated where that is better, else as it was converted; nothing is left of the other."""
    from duagc.pipeline.base.atomic_folder import RECORDING, new_folder
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.recalibration import calibrated
    from duagc.pipeline.recording import Recording

    with new_folder(out, force, RECORDING) as folder:
        plain = folder / "plain" / out.resolve().name  # a recording has the name of its folder
        convert_to(plain, False)
        outcomes, written = calibrated(Recording(plain), lambda: folder, plain.name, RunConfig(), workers=2)
        for outcome in outcomes:
            for line in outcome.lines():
                say(line)
        if not written:
            for path in plain.iterdir():
                path.rename(folder / path.name)
        shutil.rmtree(folder / "plain")


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
    masks: Annotated[
        list[str] | None,
        typer.Option(
            "--mask",
            metavar="PNG",
            help="Pixels that show the scene: 0 = none, for example the robot itself. FILE or ROBOT=FILE; repeatable.",
        ),
    ] = None,
    time_source: Annotated[
        str | None,
        typer.Option(
            help="Of logs of other programs: header, log (recording) or publish.", show_default=False
        ),
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate",
            help="Calibrate the cameras from the images; deliver the calibrated recording if that is better.",
        ),
    ] = False,
    force: Force = False,
    list_datasets: Annotated[
        bool, typer.Option("--list", help="List the datasets and their options.")
    ] = False,
) -> None:
    """Convert a dataset, as it is distributed, into one log per robot.

    Examples: `duagc convert 7scenes ~/data/redkitchen --robots 2 --out recordings/redkitchen`,
    `duagc convert 7scenes ~/data/redkitchen --robots 2 --options cameras.toml --out recordings/calibrated`,
    `duagc convert ros campus.bag --mask alpha=bumper.png --out recordings/campus`
    """
    from duagc.converters import registry
    from duagc.pipeline.base.atomic_folder import check_apart

    if list_datasets:
        print(registry.describe())
        return
    if dataset is None or source is None or out is None:
        raise typer.BadParameter("expected DATASET SRC --out REC, or --list")
    said = [*(options or []), *([f"time_source={time_source}"] if time_source else [])]

    def convert_to(folder: Path, force: bool) -> None:
        registry.convert(
            of_home(dataset),
            source,
            folder,
            robots=robots,
            force=force,
            options=said,
            options_file=options_file,
            masks=["=".join(map(of_home, mask.split("=", 1))) for mask in masks or ()],
        )

    if calibrate:
        check_apart(out, [source])
        _convert_calibrated(convert_to, out, force)
    else:
        convert_to(out, force)
    _say_warnings(out)
    print(out)
