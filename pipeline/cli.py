"""The command `duagc`. Every command imports what it needs when it runs, so that `--help` is quick."""

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from pipeline import __version__, numeric
from pipeline.errors import DuagError

EXIT_FAILED, EXIT_DIFFERENT = 1, 3
TYPER_INTERRUPTED = 130  # what typer makes of Ctrl-C, without a word

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
config_app = typer.Typer(no_args_is_help=True, help="Settings of a run and their documentation.")
bench_app = typer.Typer(no_args_is_help=True, help="Speed, side by side with something else in the same run.")
app.add_typer(config_app, name="config")
app.add_typer(bench_app, name="bench")

Out = Annotated[
    Path, typer.Option("--out", "-o", help="Folder to write; must not exist.", show_default=False)
]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
Workers = Annotated[int, typer.Option(min=1, help="Robots prepared at the same time; changes no result.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="a.b=VALUE", help="Change one setting; repeatable.")
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="TOML file; see `duagc config show`.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


def main() -> None:
    """Entry point: one line and exit code 1 for whatever a user can fix."""
    numeric.settle()
    try:
        app()
    except DuagError as error:
        print(f"duagc: {error}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except SystemExit as stop:
        if stop.code != TYPER_INTERRUPTED:
            raise
        print("duagc: interrupted", file=sys.stderr)
        sys.exit(EXIT_FAILED)


def say(line: str) -> None:
    """Progress goes to standard error, results to standard output."""
    print(f"duagc: {line}", file=sys.stderr, flush=True)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"duagc {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Recordings of a robot team to one uncertainty-weighted Gaussian map, without a central server.

    Start with `duagc demo`, or with your own data: `duagc convert`, then `duagc run`.
    """


@app.command()
def demo(
    out: Out = Path("outputs/demo"),
    robots: Annotated[int, typer.Option(min=2, max=4, help="Robots to simulate.")] = 2,
    frames: Annotated[int, typer.Option(min=20, help="Frames per robot.")] = 160,
    seed: Annotated[int, typer.Option(help="Seed of scene, paths and run.")] = 0,
    workers: Workers = 2,
    force: Force = False,
) -> None:
    """Simulate a team, fuse its maps, evaluate and report: the whole job on an embedded default.

    Example: `duagc demo --out outputs/demo`
    """
    from converters.simulate import simulate as simulate_recording
    from pipeline.new_folder import new_folder
    from pipeline.runner import RunConfig
    from pipeline.runner import run as run_stages

    with new_folder(out, force) as folder:
        say(f"simulate: {robots} robots, {frames} frames each")
        simulate_recording(folder / "recording", robots=robots, frames=frames, seed=seed, workers=workers)
        run_stages(folder / "recording", folder / "run", RunConfig(seed=seed), workers=workers, say=say)
    _print_outputs(out / "run")


@app.command()
def simulate(
    out: Out,
    robots: Annotated[int, typer.Option(min=1, max=8, help="Number of robots.")] = 2,
    frames: Annotated[int, typer.Option(min=2, help="Frames per robot.")] = 160,
    scene: Annotated[
        str, typer.Option(help="room, or a folder of textured meshes (GLB, glTF, OBJ, PLY).")
    ] = "room",
    up: Annotated[
        str,
        typer.Option(help="Axis that is up in the meshes: y, z, or auto (y for GLB, glTF, OBJ; z for PLY)."),
    ] = "auto",
    width: Annotated[int, typer.Option(min=32, help="Pixels.")] = 480,
    height: Annotated[int, typer.Option(min=32, help="Pixels.")] = 360,
    overlap: Annotated[
        float, typer.Option(min=0, max=1, help="Share of the view that neighbours see.")
    ] = 0.6,
    noise: Annotated[str, typer.Option(help="none or kinect.")] = "none",
    seed: Annotated[int, typer.Option(help="Seed of scene, paths and noise.")] = 0,
    workers: Workers = 2,
    force: Force = False,
) -> None:
    """Render a recording of a robot team, in a procedural room or among textured meshes, with exact ground truth.

    Examples:
    `duagc simulate --robots 3 --noise kinect --out recordings/room`,
    `duagc simulate --scene scans/house --width 640 --height 480 --frames 300 --out recordings/house`
    """
    from converters.simulate import simulate as simulate_recording

    simulate_recording(
        out,
        robots=robots,
        frames=frames,
        scene=scene,
        up=up,
        size=(width, height),
        overlap=overlap,
        noise=noise,
        seed=seed,
        workers=workers,
        force=force,
    )
    print(out)


@app.command()
def run(
    recording: Annotated[Path, typer.Argument(help="Folder of a recording.", show_default=False)],
    out: Out,
    config: ConfigFile = None,
    overrides: Overrides = None,
    workers: Workers = 2,
    force: Force = False,
    no_cache: Annotated[
        bool, typer.Option("--no-cache", help="Compute every stage (this version always does).")
    ] = False,
) -> None:
    """Run all stages on a recording: maps, information, exchange, fusion, metrics, report, view.

    Examples:
    `duagc run recordings/redkitchen --out outputs/redkitchen`,
    `duagc run recordings/room --out outputs/lossy --set exchange.link.loss_probability=0.3`
    """
    from pipeline.config import load
    from pipeline.runner import RunConfig
    from pipeline.runner import run as run_stages

    run_stages(
        recording, out, load(RunConfig, config, overrides or []), workers=workers, force=force, say=say
    )
    _print_outputs(out)


def _print_outputs(run_folder: Path) -> None:
    print(f"report     {run_folder / 'report' / 'index.html'}")
    print(f"view       {run_folder / 'run.rrd'}")
    for path in sorted(run_folder.glob("robots/*/refined.ply")):
        print(f"map        {path}")
    print(f"metrics    {run_folder / 'metrics.json'}")


@app.command()
def replay(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    robot: Annotated[str | None, typer.Option(help="One robot; all by default.")] = None,
    recording: Annotated[Path | None, typer.Option(help="Where the recording is now.")] = None,
) -> None:
    """Recompute each robot from its own log and the packets that reached it; compare bit for bit.

    Exit code 3 if anything differs. Example: `duagc replay outputs/demo/run`
    """
    from pipeline.replay import replay as replay_robots
    from pipeline.run_folder import RunFolder

    run = RunFolder(run_folder)
    robots = [robot] if robot else list(run.robots)
    comparisons = replay_robots(run_folder, recording or run.recording, robots, say)
    for c in comparisons:
        verdict = (
            "equal" if c.equal else f"DIFFERS: recorded {c.recorded[:12]}, recomputed {c.recomputed[:12]}"
        )
        print(f"{c.robot:<10} {c.name:<17} {verdict}")
    if not all(c.equal for c in comparisons):
        raise typer.Exit(EXIT_DIFFERENT)


@app.command()
def posegraph(
    path: Annotated[
        Path, typer.Argument(help="A .g2o file, or a folder of a team's pose graphs.", show_default=False)
    ],
    robots: Annotated[
        int | None, typer.Option(min=1, help="Cut a single graph into so many robots. [default: 4]")
    ] = None,
    loss: Annotated[float, typer.Option(min=0, max=1, help="Share of the packets that are lost.")] = 0.0,
    solver: Annotated[
        Literal["admm", "elimination", "paper"],
        typer.Option(help="Edge-ADMM, exact elimination along a tree of robots, or the printed iteration."),
    ] = "admm",
    robust: Annotated[
        Literal["none", "gnc"],
        typer.Option(help="gnc: closures and loops may be false, odometry is trusted."),
    ] = "none",
    only_reference: Annotated[
        bool,
        typer.Option("--only-reference", help="Leave out what the reference beside the graph calls false."),
    ] = False,
    max_rounds: Annotated[int, typer.Option(min=1, help="Give up after so many rounds.")] = 5000,
    seed: Annotated[int, typer.Option(help="Of the losses; nothing else is random.")] = 0,
    as_json: Json = False,
) -> None:
    """Let a team of agents solve a public 3-D pose graph over lossy links, and compare with the optimum.

    Reads `.g2o`, folders of one `.g2o` per robot (gtsam symbols as keys), and Kimera-Multi `robot*/measurements.csv`.

    Examples:
    `duagc posegraph sphere2500.g2o --robots 8`,
    `duagc posegraph parking-garage.g2o --solver elimination`,
    `duagc posegraph kimera_campus_outdoor --robust gnc --loss 0.3 --json`
    """
    from pipeline.posegraph.config import settings
    from pipeline.posegraph.solve import solve
    from pipeline.posegraph.table import format_result

    config = settings(solver, robust, loss, seed, max_rounds)
    result = solve(path, config, robots, only_reference=only_reference)
    print(json.dumps(result, indent=2) if as_json else format_result(result))


@app.command()
def digest(
    path: Annotated[Path, typer.Argument(help="A log, a recording or a run.", show_default=False)],
) -> None:
    """Print 64 hex characters that stand for the content: messages and results, not encoders or clocks.

    Example: `duagc digest outputs/demo/run`
    """
    from pipeline.digest import digest as digest_path

    print(digest_path(path))


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A recording, a run or a log.", show_default=False)],
    as_json: Json = False,
) -> None:
    """Say what is in a recording, a run or a log.

    Example: `duagc info recordings/redkitchen`
    """
    from pipeline import recording

    content = recording.info(path)
    print(json.dumps(content, indent=2) if as_json else recording.format_info(content))


@app.command()
def evaluate(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    recording: Annotated[Path | None, typer.Option(help="Where the recording is now.")] = None,
    as_json: Json = False,
) -> None:
    """Measure a run against ground truth, where there is any, and write metrics.json.

    Example: `duagc evaluate outputs/demo/run --json`
    """
    from pipeline.evaluation import evaluate as evaluate_run
    from pipeline.run_folder import RunFolder
    from pipeline.runner import threads_per_worker

    metrics = evaluate_run(
        run_folder, recording or RunFolder(run_folder).recording, threads=threads_per_worker(1)
    )
    print(json.dumps(metrics, indent=2) if as_json else run_folder / "metrics.json")


@app.command()
def report(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)],
    recording: Annotated[Path | None, typer.Option(help="Where the recording is now.")] = None,
) -> None:
    """Write the self-contained HTML report of a run.

    Example: `duagc report outputs/demo/run`
    """
    from pipeline.report import write_report
    from pipeline.run_folder import RunFolder

    print(write_report(run_folder, recording or RunFolder(run_folder).recording))


@app.command()
def view(
    path: Annotated[Path, typer.Argument(help="A run or a recording.", show_default=False)],
    save: Annotated[Path | None, typer.Option(help="Write a .rrd file instead of opening a window.")] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a PNG instead of opening a window.")] = None,
) -> None:
    """Open a run or a recording in Rerun.

    Example: `duagc view outputs/demo/run --save demo.rrd`
    """
    from pipeline import viewer

    viewer.view(path, save=save, screenshot=screenshot)


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
    as_json: Json = False,
) -> None:
    """What happened to one round, one packet or one Gaussian of a run, in words and numbers.

    Example: duagc inspect outputs/demo/run --gaussian alpha:1200
    """
    from pipeline.inspection import Inspector, format_facts
    from pipeline.run_folder import RunFolder

    if [round_, packet, gaussian].count(None) != 2:
        raise typer.BadParameter("expected exactly one of --round, --packet, --gaussian")
    inspector = Inspector(RunFolder(run_folder))
    if round_ is not None:
        facts = inspector.round(round_)
    elif packet is not None:
        facts = inspector.packet(packet)
    else:
        robot, colon, number = str(gaussian).partition(":")
        if not colon or not number.isdecimal():
            raise typer.BadParameter(f"{gaussian!r} is not like alpha:1200", param_hint="--gaussian")
        facts = inspector.gaussian(robot, int(number))
    print(json.dumps(facts, indent=2) if as_json else format_facts(facts))


@app.command()
def convert(
    dataset: Annotated[str | None, typer.Argument(help="Name of the dataset; see --list.")] = None,
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
    force: Force = False,
    list_datasets: Annotated[
        bool, typer.Option("--list", help="List the datasets and their options.")
    ] = False,
) -> None:
    """Convert a dataset, as it is distributed, into one log per robot.

    Example: `duagc convert 7scenes ~/data/redkitchen --robots 2 --out recordings/redkitchen`
    """
    import converters

    if list_datasets:
        print(converters.describe())
        return
    if dataset is None or source is None or out is None:
        raise typer.BadParameter("expected DATASET SRC --out REC, or --list")
    converters.convert(dataset, source, out, robots=robots, force=force, options=options or [])
    print(out)


@config_app.command("show")
def config_show(config: ConfigFile = None, overrides: Overrides = None) -> None:
    """Print the resolved configuration as TOML, every setting with its documentation."""
    from pipeline.config import dump, load
    from pipeline.runner import RunConfig

    print(dump(load(RunConfig, config, overrides or [])), end="")


@config_app.command("check")
def config_check(config: Annotated[Path, typer.Argument(show_default=False)]) -> None:
    """Say whether a configuration file is sound."""
    from pipeline.config import load
    from pipeline.runner import RunConfig

    load(RunConfig, config)
    print(f"{config}: sound")


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
    """Time the rasterizer, beside the machine's own peak and a plain torch rasterizer.

    Lists are separated by commas. Takes about two minutes on an idle machine; a busy one gives other times.
    """
    from pipeline.kernels import available_isas, bench

    isas = available_isas() if isa is None else isa.split(",")
    for name in isas:
        if name not in available_isas():
            raise typer.BadParameter(
                f"{name!r} is not one of {', '.join(available_isas())}", param_hint="--isa"
            )
    plan = bench.Plan(
        sizes=tuple(_sizes(sizes)),
        gaussians=tuple(_counts("--gaussians", "60k,300k,1M" if full else gaussians)),
        threads=tuple(_counts("--threads", threads)),
        rounds=max(rounds, 15) if full else rounds,
        torch_too=not no_torch,
        isas=tuple(isas),
        portable_everywhere=isa is not None,
    )
    result = bench.run(plan)
    print(json.dumps(result, indent=2) if as_json else bench.format_tables(result))


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
    max_rounds: Annotated[int, typer.Option(min=1, help="A session ends here.")] = 3000,
    seed: Annotated[int, typer.Option(help="Seed of evidence and links.")] = 0,
    as_json: Json = False,
) -> None:
    """What it costs a team to agree on matched Gaussians, mode by mode, against the central optimum.

    Lists are separated by commas; every combination is a row. The defaults take some minutes.

    Example: duagc bench consensus --robots 4 --topology chain --loss 0,0.9 --contrast 47
    """
    from pipeline.exchange import bench

    for option, words, known in (
        ("--topology", topology.split(","), ("full", "ring", "chain", "star")),
        ("--mode", mode.split(","), bench.MODES),
    ):
        for word in words:
            if word not in known:
                raise typer.BadParameter(f"{word!r} is not one of {', '.join(known)}", param_hint=option)
    plan = bench.Plan(
        robots=tuple(_counts("--robots", robots)),
        topologies=tuple(topology.split(",")),
        losses=tuple(_numbers("--loss", loss, 0.0, 0.99)),
        contrasts=tuple(_numbers("--contrast", contrast, 1.0, 1e8)),
        unknown=tuple(_numbers("--unknown", unknown, 0.0, 0.99)),
        modes=tuple(mode.split(",")),
        tracks=tracks,
        max_rounds=max_rounds,
        seed=seed,
    )
    result = bench.run(plan)
    print(json.dumps(result, indent=2) if as_json else bench.format_table(result))


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
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Time, memory and accuracy of tracking and mapping, part by part, beside Open3D's odometry.

    Examples: `duagc bench frontend recordings/house --caps 30k,60k,200k,600k`,
    `duagc bench frontend recordings/redkitchen --no-ablation --json`
    """
    import tempfile

    from converters.simulate import simulate as simulate_recording
    from pipeline.config import load
    from pipeline.evaluation import frontend_bench
    from pipeline.runner import RunConfig

    settings = load(RunConfig, config, overrides or [])
    with tempfile.TemporaryDirectory(prefix="duagc-bench-") as folder:
        if recording is None:
            recording = Path(folder) / "room"
            simulate_recording(recording, robots=1, frames=60, seed=settings.seed)
        plan = frontend_bench.Plan(
            recording,
            settings.frontend,
            () if caps == "none" else tuple(_counts("--caps", caps)),
            ablation,
            open3d,
            threads,
            settings.seed,
            (robot,) if robot else (),
        )
        result = frontend_bench.run(plan)
    print(json.dumps(result, indent=2) if as_json else frontend_bench.format_tables(result))


def _numbers(option: str, text: str, low: float, high: float) -> list[float]:
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


def _counts(option: str, text: str) -> list[int]:
    """Positive numbers out of text like 60k,1M."""
    counts = []
    for word in text.split(","):
        digits, unit = (word[:-1], word[-1]) if word[-1:] in ("k", "M") else (word, "")
        if not digits.isdecimal() or int(digits) == 0:
            raise typer.BadParameter(
                f"{word!r} is not a positive number, such as 2, 60k or 1M", param_hint=option
            )
        counts.append(int(digits) * {"": 1, "k": 1000, "M": 1_000_000}[unit])
    return counts


def _sizes(text: str) -> list[tuple[int, int]]:
    """Widths and heights out of text like 320x240,640x480."""
    sizes = []
    for word in text.split(","):
        width, cross, height = word.partition("x")
        if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
            raise typer.BadParameter(f"{word!r} is not an image size, such as 640x480", param_hint="--sizes")
        sizes.append((int(width), int(height)))
    return sizes
