"""The commands that decide claims by rules that were written before."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli.common import EXIT_DIFFERENT, Commands, StoreFolder, app, of_home, say

if TYPE_CHECKING:
    from duagc.pipeline.experiments.rule import Experiment

experiment_app = Commands(
    no_args_is_help=True, help="Claims, decided by rules that are written before the run."
)
app.add_typer(experiment_app, name="experiment")


@experiment_app.command("list")
def list_experiments() -> None:
    """List the experiments with their titles, and what all of them take.

    Example: `duagc experiment list`
    """
    from duagc.pipeline.experiments.rule import experiment_names, read_experiment

    found = [read_experiment(name) for name in experiment_names()]
    width = max((len(one.name) for one in found), default=0)
    for one in found:
        print(f"{one.name:<{width}}  {one.file.title}")
    for profile in ("small", "full"):
        say(f"all, {profile}: {_predicted(found, profile)}")


@experiment_app.command()
def show(
    name: Annotated[str, typer.Argument(help="Of the experiment.", show_default=False)],
) -> None:
    """Print the file of an experiment: question, configurations, rules, margins.

    Example: `duagc experiment show h1_team`
    """
    from duagc.pipeline.experiments.rule import read_experiment

    found = read_experiment(name)
    print(f"# {found.name}, sha256 {found.sha256}")
    for profile, of in found.file.profiles.items():
        print(f"# {profile}: {len(of.seeds)} seeds, {_predicted([found], profile)}")
    print(found.path.read_text(encoding="utf-8"), end="")


@experiment_app.command()
def run(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Experiments.", show_default=False)
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder of all experiments; goes on where it was stopped.")
    ] = Path("outputs/experiments"),
    everything: Annotated[
        bool, typer.Option("--all", help="Every experiment; one of them needs the extra gicp.")
    ] = False,
    profile: Annotated[str, typer.Option(help="small or full.")] = "small",
    recording: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FOLDER", help="A recording to run as well; repeatable.", show_default=False
        ),
    ] = None,
    engine: Annotated[str, typer.Option(help="local, slurm (extra `slurm`), ray (extra `ray`).")] = "local",
    workers: Annotated[int, typer.Option(min=1, help="Runs at the same time, each with its processors.")] = 1,
    store: StoreFolder = None,
) -> None:
    """Run experiments and write their page: every configuration, on a recording that each seed draws.

    Everything that the rules name is looked at before anything runs. Recordings are simulated once and shared by
    experiments; all runs share a store. A run that fails is tried again once; the exit code is 3 then. The page is
    `index.html`.

    Examples: `duagc experiment run --all --out outputs/experiments`,
    `duagc experiment run h1_team --recording kitchen=recordings/redkitchen --out outputs/h1`
    """
    from duagc.pipeline.batch.engines import engine_of
    from duagc.pipeline.cache.store import Store, default_store
    from duagc.pipeline.experiments.carry_out import carry_out, check_packages, check_place, check_recordings
    from duagc.pipeline.experiments.pages import PAGE, judge_folder, results_in, write_report
    from duagc.pipeline.experiments.predicted import predicted_each_s, time_left_s
    from duagc.pipeline.experiments.rule import experiment_names, read_experiment
    from duagc.pipeline.time_left import in_words

    if engine not in ("local", "slurm", "ray"):
        raise typer.BadParameter(f"{engine!r} is not one of local, slurm, ray", param_hint="--engine")
    if bool(names) == everything:
        raise typer.BadParameter("expected names of experiments, or --all", param_hint="NAME")
    if repeated := [name for name, count in Counter(names or ()).items() if count > 1]:
        raise typer.BadParameter(
            f"found {', '.join(repeated)} more than once, expected every name once", param_hint="NAME"
        )
    chosen = [read_experiment(name) for name in (experiment_names() if everything else names or [])]
    recordings = _named_folders(recording or ())
    for experiment in chosen:
        experiment.profile(profile)
        check_packages(experiment, profile)
        check_place(experiment, profile, out)
    results_in(out)  # those that are there already come into the page
    check_recordings(chosen, recordings)
    place = store or default_store(out / "run")
    Store(place)  # what is none is refused before anything is simulated
    failed: list[str] = []
    took_s: list[float] = []
    predicted_s = predicted_each_s(chosen, profile)
    for number, experiment in enumerate(chosen, 1):
        begun = time.monotonic()
        if len(chosen) > 1:
            left = in_words(time_left_s(predicted_s, took_s, workers))
            say(f"{experiment.name}: experiment {number} of {len(chosen)}, about {left} left in all")
        with engine_of(engine, workers, out / experiment.name) as opened:
            failed += carry_out(
                experiment,
                profile,
                out,
                recordings=recordings,
                engine=opened,
                store=place,
                log=say,
            )
        took_s.append(time.monotonic() - begun)
    write_report(out, judge_folder(out))
    print(f"page       {out / PAGE}")
    if failed:
        say(f"{len(failed)} runs failed: {', '.join(failed)}")
        raise typer.Exit(EXIT_DIFFERENT)


@experiment_app.command()
def report(
    out: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of all experiments.", show_default=False)
    ],
) -> None:
    """Judge the results in a folder and write their page; a result made under another rule is refused.

    Writes `index.html`, `experiments.md`, `verdicts.json`, and `costs.md`: what the runs took.

    Example: `duagc experiment report outputs/experiments`
    """
    from duagc.pipeline.experiments.pages import PAGE, judge_folder, write_report

    judged = judge_folder(out)
    write_report(out, judged)
    for one in judged:
        for verdict in one.verdicts:
            kind = "control" if verdict.rule.control else "rule"
            print(f"{one.experiment.name}  {kind} {verdict.rule.name}: {verdict.word} ({verdict.why})")
    print(f"page       {out / PAGE}")


def _predicted(experiments: Sequence[Experiment], profile: str) -> str:
    """What experiments take, as text for people."""
    from duagc.pipeline.experiments.predicted import predicted_time
    from duagc.pipeline.time_left import in_words

    took = predicted_time(experiments, profile)
    return f"{took.runs} runs, {took.different} different, about {in_words(took.cpu_s)} of processor time"


def _named_folders(texts: Sequence[str]) -> dict[str, Path]:
    """Recordings by their names, of NAME=FOLDER each."""
    named: dict[str, Path] = {}
    for text in texts:
        name, separator, folder = text.partition("=")
        if not separator or not name or not folder:
            raise DuagError(f"--recording {text}: expected NAME=FOLDER")
        if name in named:
            raise DuagError(f"--recording {text}: found {named[name]} as {name}, expected every name once")
        named[name] = Path(of_home(folder))
    return named
