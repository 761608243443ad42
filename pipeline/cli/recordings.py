"""Commands that say what is in a recording, and that calibrate or recover one."""

import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli.common import (
    EXIT_DIFFERENT,
    EXIT_FAILED,
    ConfigFile,
    Force,
    Json,
    Overrides,
    StoreFolder,
    app,
    say,
)

if TYPE_CHECKING:
    from duagc.pipeline.recording import Recording


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
        typer.Option(
            help="Of a recording: write a PNG of some color and depth images of every robot.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Say what is in a recording, a run or a log; of a log of another program also what would be converted and why.

    Examples: `duagc info recordings/redkitchen --preview redkitchen.png`,
    `duagc info campus.bag --toml > campus.toml`
    """
    from duagc.converters.logs import describe
    from duagc.pipeline import recording

    if describe.is_foreign(path):
        if preview is not None:
            raise DuagError(f"{path}: is another program's log, expected a recording with --preview")
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
    config: Annotated[
        Path | None,
        typer.Option("--config", help="TOML file of limits; see docs/reference/config.md, at its end."),
    ] = None,
    overrides: Overrides = None,
    store: StoreFolder = None,
    as_json: Json = False,
) -> None:
    """Say whether a recording is sound: times, pairs, depth scale, calibration, what a run will take.

    Where the store has results that were computed here, the time that a run takes is predicted from what these took.
    Exit code 1 if there is an error; warnings and notes leave it 0.

    Example: `duagc check recordings/redkitchen`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.cache.store import default_store
    from duagc.pipeline.checks import check
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.checks import ChecksConfig

    determinism.configure_opencv()
    settings = load_config(ChecksConfig, config, overrides or [])
    report = check.check(path, settings, store=store or default_store(Path("outputs") / "run"))
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
    views: Annotated[
        int | None,
        typer.Option(
            min=12,
            help="Most views of each half of the recording; else `calibration.views`.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="TOML", help="File to write: options for `duagc convert`."),
    ] = None,
    apply: Annotated[
        Path | None,
        typer.Option(metavar="REC", help="Recording to write: this one with the cameras that were found."),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Tasks done at the same time; changes no result.")] = 2,
    force: Force = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Estimate lens, rotation between the cameras, delay and depth error of an RGB-D recording from its own images.

    Prints every number with its standard deviation, and how well views agree that were not used. Ground truth is not
    looked at. An error, and nothing written, if the images do not determine the cameras or agree no better.

    Examples: `duagc calibrate recordings/desk --apply recordings/desk-calibrated`,
    `duagc calibrate recordings/redkitchen --out cameras.toml`, then
    `duagc convert 7scenes ~/data/redkitchen --robots 2 --options cameras.toml --out recordings/calibrated`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.camera_calibration import report
    from duagc.pipeline.camera_calibration.calibrate import calibrate as calibrate_recording
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.recording import Recording

    determinism.configure_opencv()
    settings, recording = load_config(RunConfig, config, overrides or []), Recording(path)
    recording.check_names()
    if out is not None:
        report.check_out(out, force, recording.description, path)
    with ExitStack() as place:
        folder = None if apply is None else _place_of_calibrated(place, recording, apply, force)
        found = calibrate_recording(
            path, settings.frontend, robots or [], views or settings.calibration.views, workers=workers
        )
        print(json.dumps(report.plain(found), indent=2) if as_json else report.format_calibration(found))
        if refused := found.refusal(settings.calibration):
            raise DuagError(f"{path}: found no better calibration than its own: {refused}")
        if not as_json and out is None and apply is None:
            print(f"\n{report.uses(found)}")
        if folder is not None and apply is not None:
            from duagc.pipeline.recalibration import CalibrationOutcome, write

            outcome = CalibrationOutcome.of(found, robots or recording.robots, settings.calibration)
            write(recording, [outcome], folder, apply.resolve().name)
            for line in outcome.lines():
                say(line)
    if out is not None:
        report.write(found, out)


def _place_of_calibrated(place: ExitStack, recording: "Recording", out: Path, force: bool) -> Path:
    """Where to write a calibrated recording, before anything is measured."""
    from duagc.converters.calibrated_copy import why_not
    from duagc.pipeline.base.atomic_folder import RECORDING, check_apart, new_folder, resolved

    for robot in recording.robots:
        if why := why_not(recording.log(robot)):
            raise DuagError(why)
    if resolved(out) == resolved(recording.path):
        raise DuagError(f"{out}: is the recording itself, expected the name of another")
    check_apart(out, [recording.path])
    return place.enter_context(new_folder(out, force, RECORDING))


@app.command()
def recover(
    source: Annotated[Path, typer.Argument(help="A damaged log or recording; it stays as it is.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Log or folder to write.", show_default=False)],
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
