"""Commands that measure speed, side by side with something else in the same run."""

import json
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.common import ConfigFile, Json, Overrides, bench_app, of_home


@bench_app.command("raster")
def bench_raster(
    sizes: Annotated[str, typer.Option(help="Image sizes.")] = "320x240,640x480,1200x680",
    gaussians: Annotated[
        str, typer.Option(help="Numbers of Gaussians; k and M are understood.")
    ] = "60k,300k",
    threads: Annotated[str, typer.Option(help="Numbers of threads.")] = "1,2",
    isa: Annotated[
        str | None,
        typer.Option(
            help="Instruction sets; by default all, the portable one in one round only.", show_default=False
        ),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds that are timed.")] = 7,
    full: Annotated[
        bool, typer.Option("--full", help="Also 1M Gaussians, and 15 rounds: some minutes.")
    ] = False,
    no_torch: Annotated[bool, typer.Option("--no-torch", help="Without the plain torch rasterizer.")] = False,
    as_json: Json = False,
) -> None:
    """Time the rasterizer, next to the machine's own peak and a plain torch rasterizer.

    Lists are separated by commas. Takes about two minutes on an idle machine; a busy one gives other times.
    """
    from duagc.pipeline.bench import raster, raster_tables
    from duagc.pipeline.kernels import available_isas
    from duagc.pipeline.kernels.arguments import MAX_THREADS

    isas = available_isas() if isa is None else isa.split(",")
    for name in isas:
        if name not in available_isas():
            raise typer.BadParameter(
                f"{name!r} is not one of {', '.join(available_isas())}", param_hint="--isa"
            )
    plan = raster.RasterPlan(
        sizes=tuple(sizes_of(sizes)),
        gaussians=tuple(counts("--gaussians", "60k,300k,1M" if full else gaussians)),
        threads=tuple(counts("--threads", threads, MAX_THREADS)),
        rounds=max(rounds, 15) if full else rounds,
        torch_too=not no_torch,
        isas=tuple(isas),
        portable_everywhere=isa is not None,
    )
    result = raster.run(plan)
    print(json.dumps(result, indent=2) if as_json else raster_tables.format_tables(result))


@bench_app.command("consensus")
def bench_consensus(
    robots: Annotated[str, typer.Option(help="Numbers of robots.")] = "2,4,8",
    topology: Annotated[str, typer.Option(help="full, ring, chain, star.")] = "full,ring,chain",
    loss: Annotated[str, typer.Option(help="Chances that a packet is lost.")] = "0,0.3,0.6,0.9",
    contrast: Annotated[str, typer.Option(help="Largest over smallest information.")] = "47,1e4",
    unknown: Annotated[str, typer.Option(help="Shares of tracks that a robot knows nothing of.")] = "0,0.2",
    mode: Annotated[
        str, typer.Option(help="evidence (compact), evidence_float32, evidence_float64, admm, paper.")
    ] = "evidence,evidence_float64,admm,paper",
    tracks: Annotated[int, typer.Option(min=1, help="Matched Gaussians.")] = 200,
    of_run: Annotated[
        Path | None,
        typer.Option(
            "--run", help="Evidence and matches of a finished run instead of made ones.", show_default=False
        ),
    ] = None,
    max_rounds: Annotated[int, typer.Option(min=1, help="A session ends here.")] = 3000,
    seed: Annotated[int, typer.Option(help="Seed of evidence and links.")] = 0,
    as_json: Json = False,
) -> None:
    """What it costs a team to agree on matched Gaussians, mode by mode, against the central optimum.

    Lists are separated by commas; every combination is a row, of two robots in full topology only. The defaults
    take some minutes. With --run, robots, contrast, unknown and tracks are those of the run.

    Examples: `duagc bench consensus --robots 4 --topology chain --loss 0,0.9 --contrast 47`,
    `duagc bench consensus --run outputs/redkitchen --topology full --loss 0 --mode evidence,admm,paper`
    """
    from duagc.pipeline.experiments import consensus_modes

    for option, words, known in (
        ("--topology", topology.split(","), ("full", "ring", "chain", "star")),
        ("--mode", mode.split(","), consensus_modes.MODES),
    ):
        for word in words:
            if word not in known:
                raise typer.BadParameter(f"{word!r} is not one of {', '.join(known)}", param_hint=option)
    plan = consensus_modes.ConsensusPlan(
        robots=tuple(counts("--robots", robots, MOST_ROBOTS)),
        topologies=tuple(topology.split(",")),
        losses=tuple(numbers("--loss", loss, 0.0, 0.99)),
        contrasts=tuple(numbers("--contrast", contrast, 1.0, 1e8)),
        unknown=tuple(numbers("--unknown", unknown, 0.0, 0.99)),
        modes=tuple(mode.split(",")),
        tracks=tracks,
        max_rounds=max_rounds,
        seed=seed,
    )
    if of_run is None:
        if min(plan.robots) < 2 or not plan.cases():
            raise typer.BadParameter(
                "a team takes two robots, a ring, chain or star three", param_hint="--robots"
            )
        result = consensus_modes.run(plan)
    else:
        from duagc.pipeline.experiments.team_of_run import team_of_run
        from duagc.pipeline.runs.folder import RunFolder

        parts = [consensus_modes.run_on(team_of_run(RunFolder(of_run), t), t, plan) for t in plan.topologies]
        result = {"plan": parts[0]["plan"], "rows": [row for part in parts for row in part["rows"]]}
    print(json.dumps(result, indent=2) if as_json else consensus_modes.format_table(result))


@bench_app.command("team")
def bench_team(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A finished run.", show_default=False)],
    checks: Annotated[
        str, typer.Option(help="frames, names, closures, loss, silence, solver.")
    ] = "frames,names,closures,loss,silence,solver",
    seeds: Annotated[int, typer.Option(min=1, help="How often what is drawn is drawn.")] = 3,
    recording: Annotated[
        Path | None, typer.Option(help="Folder of its recording, if it moved.", show_default=False)
    ] = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Repeat the exchange of a run under faults, and say what they do to the team's error.

    frames: every map in a random frame; names: robots under each other's names; closures: 20 % false ones; loss: 30,
    60 and 90 % of the packets; silence: all of them; solver: the other one. The front ends are those of the run.

    Example: `duagc bench team outputs/redkitchen --checks frames --seeds 100`
    """
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.experiments import team_faults
    from duagc.pipeline.recording import Recording
    from duagc.pipeline.runs.folder import RunFolder

    chosen = checks.split(",")
    for name in chosen:
        if name not in team_faults.CHECKS:
            raise typer.BadParameter(
                f"{name!r} is not one of {', '.join(team_faults.CHECKS)}", param_hint="--checks"
            )
    run = RunFolder(run_folder)
    settings = load_config(RunConfig, run.config_file, overrides or [])
    source = Recording(run.recording_at(recording))
    result = team_faults.run(run, source, settings.exchange, seed=settings.seed, checks=chosen, seeds=seeds)
    print(json.dumps(result, indent=2) if as_json else team_faults.format_table(result))


@bench_app.command("reference")
def bench_reference(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A finished run.", show_default=False)],
    recording: Annotated[
        Path | None, typer.Option(help="Folder of its recording, if it moved.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """A team's error next to what its images allow: all keyframes optimized in one place.

    From the run's poses and from the true ones. A run of one robot is also cut in parts. Needs ground truth.

    Example: `duagc bench reference outputs/redkitchen`
    """
    from duagc.pipeline.base import determinism
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig
    from duagc.pipeline.experiments import pose_reference
    from duagc.pipeline.recording import Recording
    from duagc.pipeline.runs.folder import RunFolder

    determinism.configure_opencv()
    run = RunFolder(run_folder)
    source = Recording(run.recording_at(recording))
    result = pose_reference.run(run, source, load_config(RunConfig, run.config_file, []).frontend)
    print(json.dumps(result, indent=2) if as_json else pose_reference.format_table(result))


@bench_app.command("frontend")
def bench_frontend(
    recording: Annotated[
        Path | None, typer.Argument(help="Folder of a recording; a small room is simulated without one.")
    ] = None,
    caps: Annotated[
        str, typer.Option(help="Most Gaussians of a map, each a run; k and M are understood; none = no maps.")
    ] = "60k",
    ablation: Annotated[bool, typer.Option(help="Tracking without one of its parts at a time.")] = True,
    open3d: Annotated[bool, typer.Option(help="Open3D's RGB-D odometry, in the same run.")] = True,
    robot: Annotated[str | None, typer.Option(help="One robot; all by default.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="Of the kernels.")] = 1,
    config: ConfigFile = None,
    plot: Annotated[
        Path | None,
        typer.Option(help="SVG file to write: scores, time and memory against the caps.", show_default=False),
    ] = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Time, memory and accuracy of tracking and mapping, part by part, next to Open3D's odometry.

    Examples: `duagc bench frontend recordings/house --caps 30k,60k,200k,600k --plot caps.svg`,
    `duagc bench frontend recordings/redkitchen --no-ablation --json`
    """
    import tempfile

    from duagc.converters.simulate.team import simulate as simulate_recording
    from duagc.pipeline.bench import frontend, frontend_tables
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig

    settings = load_config(RunConfig, config, overrides or [])
    chosen = () if caps == "none" else tuple(counts("--caps", caps))
    if plot is not None:
        if not chosen:
            raise typer.BadParameter("there is nothing to draw without maps; see --caps", param_hint="--plot")
        if plot.suffix != ".svg" or not plot.parent.is_dir():
            raise typer.BadParameter(f"{plot} is not a name.svg in a folder that exists", param_hint="--plot")
    with tempfile.TemporaryDirectory(prefix="duagc-bench-") as folder:
        if recording is None:
            recording = Path(folder) / "room"
            simulate_recording(recording, robots=1, frames=60, seed=settings.seed)
        plan = frontend.Plan(
            recording,
            settings.frontend,
            caps=chosen,
            ablation=ablation,
            open3d=open3d,
            threads=threads,
            seed=settings.seed,
            robots=(robot,) if robot else (),
        )
        result = frontend.run(plan)
    if plot is not None:
        from duagc.pipeline.base.files import new_file
        from duagc.pipeline.report import figures

        with new_file(plot) as part:
            part.write_text(figures.map_sizes(frontend.by_cap(result)), encoding="utf-8")
    print(json.dumps(result, indent=2) if as_json else frontend_tables.format_tables(result))


@bench_app.command("paths")
def bench_paths(
    scenes: Annotated[
        str, typer.Option(help="Scenes, or folders of textured meshes.")
    ] = "room,office,corridor,outdoor",
    paradigms: Annotated[
        str, typer.Option(help="Of concentric, leader-follower, crossing, parallel.")
    ] = "concentric,leader-follower,crossing,parallel",
    robots: Annotated[str, typer.Option(help="Numbers of robots.")] = "2,3,4,8",
    overlap: Annotated[str, typer.Option(help="Shares of the view to ask for.")] = "0.2,0.4,0.6,0.8",
    frames: Annotated[int, typer.Option(min=2, help="Frames per robot.")] = 160,
    up: Annotated[str, typer.Option(help="Axis that is up in meshes: y, z, or auto.")] = "auto",
    seed: Annotated[int, typer.Option(help="Seed of scenes and paths.")] = 0,
    as_json: Json = False,
) -> None:
    """Plan paths for every combination, without images: the overlap reached, speed, distances, processor time.

    Lists are separated by commas. A cell of the table has the overlap asked for that was met worst, what neighbors
    share then, and how fast the slowest and the fastest robot go, of the scene's usual speed.

    Example: `duagc bench paths --scenes scans/house --robots 3`
    """
    from duagc.converters.simulate.settings import MAX_ROBOTS
    from duagc.converters.simulate.trajectories.paradigms import PARADIGMS
    from duagc.pipeline.bench import paths

    for name in paradigms.split(","):
        if name not in PARADIGMS[1:]:
            raise typer.BadParameter(
                f"{name!r} is not one of {', '.join(PARADIGMS[1:])}", param_hint="--paradigms"
            )
    teams = counts("--robots", robots, MOST_ROBOTS)
    if max(teams) > MAX_ROBOTS:
        raise typer.BadParameter(f"{max(teams)} is more than {MAX_ROBOTS}", param_hint="--robots")
    asked = numbers("--overlap", overlap, 0, 1)
    places = [of_home(scene) for scene in scenes.split(",")]
    rows = paths.run(places, paradigms.split(","), teams, asked, frames=frames, seed=seed, up=up)
    print(json.dumps(rows, indent=2) if as_json else paths.format_table(rows))


@bench_app.command("convert")
def bench_convert(
    log: Annotated[Path, typer.Argument(help="A .bag, .db3 or .mcap of one robot.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder that is written to and removed; must not exist.")
    ] = Path("bench-convert"),
    options: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Option of `duagc convert ros`; repeatable."),
    ] = None,
    as_json: Json = False,
) -> None:
    """What converting a log costs compared with reading its messages and writing them as they are.

    Needs as much room on the disk as the log has, at most.

    Example: `duagc bench convert ~/logs/kitchen.bag --set imu=/imu/data`
    """
    from duagc.pipeline.bench import convert

    result = convert.run(log, options or [], out)
    print(json.dumps(result, indent=2) if as_json else convert.format_table(result))


def numbers(option: str, text: str, low: float, high: float) -> list[float]:
    """Numbers within limits out of text like 0,0.3."""
    numbers = []
    for word in text.split(","):
        try:
            number = float(word)
        except ValueError:
            number = float("nan")
        if not low <= number <= high:
            raise typer.BadParameter(f"{word!r} is not a number from {low:g} to {high:g}", param_hint=option)
        numbers.append(number)
    return numbers


LARGEST_PX, MOST_ROBOTS = 16_384, 64


def counts(option: str, text: str, most: int = 10**9) -> list[int]:
    """Positive numbers, up to one, out of text like 60k,1M."""
    counts = []
    for word in text.split(","):
        digits, unit = (word[:-1], word[-1]) if word[-1:] in ("k", "M") else (word, "")
        if not digits.isdecimal() or int(digits) == 0:
            raise typer.BadParameter(
                f"{word!r} is not a positive number, such as 2, 60k or 1M", param_hint=option
            )
        counts.append(int(digits) * {"": 1, "k": 1000, "M": 1_000_000}[unit])
        if counts[-1] > most:
            raise typer.BadParameter(f"{word!r} is more than {most}", param_hint=option)
    return counts


def sizes_of(text: str, option: str = "--sizes") -> list[tuple[int, int]]:
    """Widths and heights out of text like 320x240,640x480."""
    sizes = []
    for word in text.split(","):
        width, cross, height = word.partition("x")
        sound = cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)
        if not sound or max(int(width), int(height)) > LARGEST_PX:
            raise typer.BadParameter(
                f"{word!r} is not an image size up to {LARGEST_PX} px, such as 640x480", param_hint=option
            )
        sizes.append((int(width), int(height)))
    return sizes
