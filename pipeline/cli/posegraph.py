"""The command that solves public pose graphs."""

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
        int | None, typer.Option(min=1, help="Cut a single graph into so many robots. [default: 4]")
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
    `duagc posegraph kimera_campus_outdoor --robust gnc --loss 0.3 --json`
    """
    from duagc.pipeline.config.posegraph import settings
    from duagc.pipeline.team_posegraph.solve import solve
    from duagc.pipeline.team_posegraph.table import format_result

    config = settings(solver, robust, loss=loss, seed=seed, max_rounds=max_rounds)
    result = solve(path, config, robots, only_reference=only_reference)
    print(json.dumps(result, indent=2) if as_json else format_result(result))
