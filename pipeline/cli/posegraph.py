"""The commands that solve public pose graphs, and make large ones."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from duagc.pipeline.cli.common import Json, app


@app.command()
def posegraph(
    path: Annotated[
        Path, typer.Argument(help="A .g2o file, or a folder of a team's pose graphs.", show_default=False)
    ],
    robots: Annotated[
        int | None, typer.Option(min=1, help="Cut a single graph among so many robots. [default: 4]")
    ] = None,
    loss: Annotated[float, typer.Option(min=0, max=1, help="Share of the packets that are lost.")] = 0.0,
    solver: Annotated[
        Literal["admm", "elimination", "paper"],
        typer.Option(help="Edge-ADMM, exact elimination along a tree of robots, or the printed iteration."),
    ] = "admm",
    robust: Annotated[
        Literal["none", "gnc"],
        typer.Option(help="gnc: loop closures may be outliers, odometry is trusted."),
    ] = "none",
    only_reference: Annotated[
        bool,
        typer.Option("--only-reference", help="Leave out what the reference next to the graph calls false."),
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
    `duagc posegraph kimera_campus_outdoor --robust gnc --loss 0.3 --json`,
    `duagc generate-posegraph town` and then `duagc posegraph town --robust gnc`
    """
    from duagc.pipeline.config.posegraph import settings
    from duagc.pipeline.team_posegraph.solve import solve
    from duagc.pipeline.team_posegraph.table import format_result

    config = settings(solver, robust, loss=loss, seed=seed, max_rounds=max_rounds)
    result = solve(path, config, robots, only_reference=only_reference)
    print(json.dumps(result, indent=2) if as_json else format_result(result))


@app.command("generate-posegraph")
def generate_posegraph(
    out: Annotated[Path, typer.Argument(help="The folder to write.", show_default=False)],
    robots: Annotated[int, typer.Option(min=1, max=99, help="Number of robots.")] = 8,
    keyframes: Annotated[int, typer.Option(min=10, help="Keyframes of each.")] = 1000,
    closures: Annotated[int, typer.Option(min=0, help="Loop closures of the whole team.")] = 3000,
    false: Annotated[float, typer.Option(min=0, max=1, help="Share of them that is false.")] = 0.6,
    seed: Annotated[int, typer.Option(help="Of walks, noise and loop closures.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace a pose graph that is there.")] = False,
) -> None:
    """Make the pose graph of a team in a town, with false loop closures in clusters that agree among themselves.

    Writes the tables of Kimera-Multi, with a reference of what is true; `duagc posegraph` reads them.

    Examples:
    `duagc generate-posegraph town`,
    `duagc generate-posegraph small --robots 3 --keyframes 100 --closures 80 --false 0.5 --seed 1`
    """
    from duagc.pipeline.experiments import team_graphs

    graph = team_graphs.generate(robots, keyframes, closures, false, seed=seed)
    team_graphs.write(graph, out, force=force)
    print(
        f"{out}: {robots} robots, {robots * keyframes} keyframes, {len(graph.closures)} loop closures, "
        f"{sum(not true for true in graph.true)} of them false"
    )
