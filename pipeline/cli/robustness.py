"""The command that measures what degraded cameras cost."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from duagc.pipeline.cli.bench import numbers, sizes_of
from duagc.pipeline.cli.common import ConfigFile, Json, Overrides, Workers, bench_app, of_home


@bench_app.command("robustness")
def bench_robustness(
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder of the results; cells finished there are taken from it."),
    ] = Path("outputs/robustness"),
    only: Annotated[
        str | None,
        typer.Option(help="Dials, separated by commas, and all for all together; every one by default."),
    ] = None,
    levels: Annotated[str, typer.Option(help="Values of the dials; 1 is the middle, 0 clean.")] = "1",
    scene: Annotated[str, typer.Option(help="Scene, or a folder of textured meshes.")] = "room",
    robots: Annotated[int, typer.Option(min=1, max=8, help="Number of robots.")] = 2,
    frames: Annotated[int, typer.Option(min=2, help="Frames of the walk of each robot, at 30 Hz.")] = 60,
    size: Annotated[str, typer.Option(help="Image size.")] = "320x240",
    noise: Annotated[str, typer.Option(help="none or kinect, in the clean cell as well.")] = "kinect",
    seed: Annotated[int, typer.Option(help="Seed of scene, walks and noise.")] = 0,
    keep: Annotated[bool, typer.Option("--keep", help="Keep recordings and runs, in --out/runs.")] = False,
    true_images: Annotated[
        bool,
        typer.Option(
            "--true-images",
            help="Run nothing: what plain PSNR the true images have against those of each dial.",
        ),
    ] = False,
    list_dials: Annotated[
        bool, typer.Option("--list", help="List the dials, their middle values and where these come from.")
    ] = False,
    workers: Workers = 2,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """What degraded cameras cost: tracked share, ATE, PSNR, joined robots and the worst pose called good.

    The same walk is simulated clean, with each dial turned up alone, and with all together, and run with the settings
    of every other run; only fused maps, which are not scored, are not finetuned. Written to --out: robustness.json,
    robustness.md and robustness.svg. A cell takes about a minute of processor time; what is finished is not computed
    again unless code, settings or walk changed.

    Examples: `duagc bench robustness --out outputs/robustness`,
    `duagc bench robustness --only blur,lens --levels 0.5,1,1.5 --out outputs/robustness`,
    `duagc bench robustness --only missing --keep --out outputs/robustness`,
    `duagc bench robustness --true-images --out outputs/robustness`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.base.files import new_file
    from duagc.pipeline.bench import robustness, robustness_tables
    from duagc.pipeline.bench import true_images as reference
    from duagc.pipeline.config.base import dump_config, load_config
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.evaluation.results import write_json
    from duagc.pipeline.report import figures
    from duagc.pipeline.runner import run as run_stages

    if list_dials:
        for dial in robustness.DIALS.values():
            print(f"{dial.name:<16}{dial.text(1):>8}  {dial.source}")
        return
    known = reference.DIALS_OF_FRAMES if true_images else (*robustness.DIALS, robustness.ALL)
    dials = known if only is None else tuple(only.split(","))
    for name in dials:
        if name not in known:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(known)}", param_hint="--only")
    if len(sizes := sizes_of(size, "--size")) != 1:
        raise typer.BadParameter(f"{size!r} is not one image size", param_hint="--size")
    determinism.configure_opencv()
    settings = load_config(RunConfig, config, [*robustness.UNSCORED, *(overrides or [])])
    plan = robustness.RobustnessPlan(
        dials=dials,
        levels=tuple(numbers("--levels", levels, 0.01, 4.0)),
        scene=of_home(scene),
        robots=robots,
        frames=frames,
        size=sizes[0],
        noise=noise,
        seed=seed,
    )

    if true_images:
        rows = reference.run(plan, out, workers=workers)
        print(reference.as_json(rows) if as_json else reference.format_table(rows))
        return

    def write(rows: list[dict[str, Any]]) -> None:
        write_json(out / "robustness.json", {"rows": rows})
        for name, text in (
            ("robustness.md", robustness_tables.format_table(rows) + "\n"),
            ("robustness.svg", figures.robustness(rows)),
        ):
            with new_file(out / name) as part:
                part.write_text(text, encoding="utf-8")

    rows = robustness.run(
        plan,
        out,
        lambda recording, run: run_stages(recording, run, settings, workers=workers, log=lambda line: None),
        dump_config(settings),
        workers=workers,
        keep=keep,
        finished=write,
    )
    write(rows)
    print(json.dumps(rows, indent=2) if as_json else robustness_tables.format_table(rows))
