"""The command that runs a matrix of recordings, configurations and seeds."""

import json
from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli.common import EXIT_DIFFERENT, Json, StoreFolder, app, say


@app.command()
def batch(
    suite: Annotated[
        Path, typer.Argument(metavar="SUITE", help="TOML file of the suite.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the batch.", show_default=False)],
    engine: Annotated[str, typer.Option(help="local, slurm (extra `slurm`), ray (extra `ray`).")] = "local",
    workers: Annotated[int, typer.Option(min=1, help="Runs at the same time, each with its processors.")] = 1,
    store: StoreFolder = None,
    status: Annotated[bool, typer.Option("--status", help="Run nothing; say how far every run is.")] = False,
    as_json: Json = False,
) -> None:
    """Run every recording with every configuration and every seed, and compare.

    All runs share a store, so that nothing is computed twice; the same command goes on where a batch was stopped. A
    run that fails is tried again once and does not stop the others; the exit code is 3 then. Results are in
    `results.parquet` and `index.html`, runs in `runs/`, what they said in `cells/`.

    Example: `duagc batch suites/links.toml --out outputs/links --workers 2`
    """
    from duagc.pipeline.base.atomic_folder import RECORDING, RUN
    from duagc.pipeline.batch.batch import run_batch, status_text
    from duagc.pipeline.batch.cell import read_state
    from duagc.pipeline.batch.engines import engine_of
    from duagc.pipeline.batch.results import PAGE, TABLE, gather
    from duagc.pipeline.batch.suite import read_suite
    from duagc.pipeline.cache.store import Store, default_store

    if engine not in ("local", "slurm", "ray"):
        raise typer.BadParameter(f"{engine!r} is not one of local, slurm, ray", param_hint="--engine")
    read = read_suite(suite)
    if status:
        states = {name: vars(read_state(out, name)) for name in read.cells}
        print(json.dumps(states, indent=2) if as_json else status_text(read, out))
        return
    if out.exists() and not out.is_dir():
        raise DuagError(f"{out}: is no folder, expected that of a batch")
    for kind in (RECORDING, RUN):
        if any((out / mark).is_file() for mark in kind.marks):
            raise DuagError(f"{out}: is {kind.name}, expected the folder of a batch, or a new one")
    place = store or default_store(out / "run")
    Store(place)  # what is none is refused before a cell begins
    with engine_of(engine, workers, out) as chosen:
        run_batch(read, out, place, chosen, log=say)
    done = gather(read, out)
    states = {name: vars(read_state(out, name)) for name in read.cells}
    failed = [name for name, state in states.items() if state["state"] != "done"]
    if as_json:
        print(json.dumps({"states": states, "numbers": done}, indent=2))
    else:
        print(f"table      {out / TABLE}\npage       {out / PAGE}")
    if failed:
        say(f"{len(failed)} of {len(states)} runs failed: {', '.join(failed)}")
        raise typer.Exit(EXIT_DIFFERENT)
