"""Carry out an experiment: simulate its recordings once, run its cells as a batch, keep what its rules need."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path
from typing import Any

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import digest_of_values, new_file, read_json, read_text
from duagc.pipeline.batch.batch import run_batch
from duagc.pipeline.batch.cell import read_state, run_folder
from duagc.pipeline.batch.engines import Engine
from duagc.pipeline.batch.results import gather
from duagc.pipeline.batch.suite import BatchCell, Suite, read_suite
from duagc.pipeline.cache.code_identity import CodeReader
from duagc.pipeline.config import packages
from duagc.pipeline.config.base import Config, load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation.results import reason_of
from duagc.pipeline.experiments.metric_names import names_in, needs_surface, needs_truth
from duagc.pipeline.experiments.rule import Experiment, Profile, SimulatedData, config_of, data_of
from duagc.pipeline.experiments.statistics import mean
from duagc.pipeline.experiments.verdicts import ResultRow
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs import stages

RESULT, SUITE, RECORDINGS = "result.json", "suite.toml", "recordings"
SIMULATED = "seed_"  # in front of the names of simulated recordings
UNTIL = "evaluation"
SIMULATOR = "duagc.converters.simulate.team:simulate"
STEERING = "duagc.pipeline.experiments.steering:simulate_steered"


class ResultFile(Config):
    """The result of an experiment."""

    experiment: str = ""
    rule_sha256: str
    code_sha256: str | None = None
    profile: str
    seeds: list[int]
    recordings: list[str]
    rows: list[ResultRow]


def check_recordings(experiments: Sequence[Experiment], recordings: Mapping[str, Path]) -> None:
    """Refuse recordings with a name that is taken, that cannot be opened, or that lack truth that is needed.

    Args:
        experiments: that will be run.
        recordings: folders by name.

    Raises:
        DuagError: names the recording, what it lacks and what needs it.
    """
    for name, folder in recordings.items():
        if not re.fullmatch(rf"(?!{SIMULATED})[A-Za-z0-9_.]+", name):
            raise DuagError(f"--recording {name}: expected letters, digits, _ and ., and no seed_ in front")
        recording = Recording(folder)
        without = [robot for robot in recording.robots if recording.groundtruth(robot) is None]
        lacks = [(f"ground truth of {robot}", needs_truth) for robot in without[:1]]
        if recording.geometry() is None:
            lacks.append(("true surface (groundtruth.ply)", needs_surface))
        for experiment, (lack, needs) in product(experiments, lacks):
            needed = next((name for name in experiment.file.metrics if needs(name)), None)
            if needed is not None:
                raise DuagError(
                    f"{folder}: has no {lack}, expected it for metric {needed} of {experiment.name}"
                )


def check_packages(experiment: Experiment, profile: str) -> None:
    """Refuse an experiment one of whose configurations needs a package that is not installed.

    Args:
        experiment: that will be run.
        profile: its name.

    Raises:
        DuagError: names the package and what installs it.
    """
    chosen = experiment.profile(profile)
    for configuration in experiment.file.configurations:
        settings = config_of(experiment.file, chosen, configuration)
        try:
            packages.check_packages(load_config(RunConfig, None, settings))
        except DuagError as error:
            raise DuagError(f"{experiment.path}: configuration {configuration}: {error}") from error


def check_place(experiment: Experiment, profile: str, out: Path) -> None:
    """Refuse to mix results of two rules, or of two profiles, in one folder.

    Args:
        experiment: that will be run.
        profile: its name.
        out: folder of all experiments.

    Raises:
        DuagError: another rule or profile has been there.
    """
    path = out / experiment.name / RESULT
    if not path.is_file():
        return
    earlier = read_result(path)
    check_rule(experiment, earlier, path)
    if earlier["profile"] != profile:
        raise DuagError(
            f"{path}: is of profile {earlier['profile']}, expected {profile}; choose another --out"
        )


def check_rule(experiment: Experiment, result: Mapping[str, Any], path: Path) -> None:
    """Refuse a result that was made under another rule.

    Args:
        experiment: as its file is now.
        result: as it was written.
        path: of the result.

    Raises:
        DuagError: the digests differ.
    """
    if result["rule_sha256"] != experiment.sha256:
        raise DuagError(
            f"{path}: was made under rule {str(result['rule_sha256'])[:12]}, expected {experiment.sha256[:12]} "
            f"of {experiment.name}; run it again into another --out"
        )


def read_result(path: Path) -> dict[str, Any]:
    """What an experiment came to.

    Args:
        path: of its file.

    Raises:
        DuagError: it is none.
    """
    try:
        text = read_text(path, "the result of an experiment")
        ResultFile.model_validate_json(text, strict=True)
        return dict(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise DuagError(
            f"{path}: is no result of an experiment, expected what `duagc experiment run` writes"
        ) from error


def recording_folder(out: Path, data: SimulatedData, seed: int, made_by: str) -> Path:
    """Folder of a simulated recording; experiments with the same data share it, simulators that differ do not.

    Args:
        out: folder of all experiments.
        data: what is simulated.
        seed: of it.
        made_by: digest of what makes it.
    """
    digest = hashlib.sha256(f"{made_by}\n{data.model_dump_json()}".encode()).hexdigest()[:12]
    return out / RECORDINGS / f"{digest}-{seed}"


def prepare(
    experiment: Experiment,
    profile: Profile,
    out: Path,
    *,
    recordings: Mapping[str, Path],
    store: Path,
    log: Callable[[str], None],
) -> Suite:
    """Simulate the recordings that are missing, and write the suite of all cells.

    Args:
        experiment: that will be run.
        profile: how much is computed.
        out: folder of all experiments.
        recordings: of the user, folders by name.
        store: of what was computed before.
        log: gets a line for every recording that is simulated.

    Raises:
        DuagError: a recording cannot be read.
    """
    folders, own = dict[str, Path](), dict[str, tuple[int, SimulatedData]]()
    for data in dict.fromkeys(
        data_of(experiment.file, profile, name) for name in experiment.file.configurations
    ):
        made_by = simulator_digest(store, data, profile)
        for seed in profile.seeds:
            folder = recording_folder(out, data, seed, made_by)
            name = f"{SIMULATED}{seed}" + ("" if data == profile.data else f".{folder.name.split('-')[0]}")
            folders[name], own[name] = folder, (seed, data)
            if not folder.exists():
                log(f"simulate: {data.robots} robots, {data.frames} frames each, seed {seed}")
                folder.parent.mkdir(parents=True, exist_ok=True)
                _simulate(folder, data, seed, profile)
    for name, folder in recordings.items():
        folders[name] = folder.resolve()
    path = out / experiment.name / SUITE
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path) as part:
        part.write_text(_suite_text(experiment, profile, folders, path.parent, own=own), encoding="utf-8")
    return read_suite(path)


def _simulate(folder: Path, data: SimulatedData, seed: int, profile: Profile) -> None:
    if data.steering:
        from duagc.pipeline.experiments.steering import simulate_steered  # with the front end

        simulate_steered(folder, data.settings(seed), data.steering, profile.set)
    else:
        simulate(folder, **vars(data.settings(seed)))


def _suite_text(
    experiment: Experiment,
    profile: Profile,
    folders: Mapping[str, Path],
    base: Path,
    *,
    own: Mapping[str, tuple[int, SimulatedData]],
) -> str:
    """Every simulated recording with its own seed and the configurations that it is for; real ones with the first."""
    lines = [f"seeds = {list(profile.seeds)}", f'until = "{UNTIL}"', "[recordings]"]
    lines += [
        f"{json.dumps(name)} = {json.dumps(os.path.relpath(path, base))}" for name, path in folders.items()
    ]
    for name in experiment.file.configurations:
        settings = config_of(experiment.file, profile, name)
        lines += [f"[configurations.{name}]", f"set = {json.dumps(settings)}"]
    for name in folders:
        only, data = own.get(name, (profile.seeds[0], profile.data))
        left_out = [f"seed = {seed}" for seed in profile.seeds if seed != only]
        left_out += [
            f"configuration = {json.dumps(other)}"
            for other in experiment.file.configurations
            if data_of(experiment.file, profile, other) != data
        ]
        for row in left_out:
            lines += ["[[exclude]]", f"recording = {json.dumps(name)}", row]
    return "\n".join(lines) + "\n"


def carry_out(
    experiment: Experiment,
    profile: str,
    out: Path,
    *,
    recordings: Mapping[str, Path],
    engine: Engine,
    store: Path,
    log: Callable[[str], None],
) -> list[str]:
    """Run an experiment and write its result.

    Args:
        experiment: the experiment.
        profile: name of how much is computed.
        out: folder of all experiments.
        recordings: of the user, folders by name.
        engine: where the cells run.
        store: of what was computed before.
        log: gets progress.

    Returns:
        Names of the cells that failed.

    Raises:
        DuagError: what a user can fix; or the code was changed meanwhile.
    """
    chosen = experiment.profile(profile)
    code = code_digest(store, experiment, chosen)
    suite = prepare(experiment, chosen, out, recordings=recordings, store=store, log=log)
    folder = out / experiment.name
    run_batch(suite, folder, store, engine, log=lambda line: log(f"{experiment.name}: {line}"))
    if code_digest(store, experiment, chosen) != code:
        raise DuagError(
            f"{folder}: the code changed while its runs were computed, expected one; "
            "the same command computes those of other code again"
        )
    done = gather(suite, folder)
    rows = [_row(experiment, cell, folder, done.get(cell.name, {})) for cell in suite.cells.values()]
    document = {
        "experiment": experiment.name,
        "rule_sha256": experiment.sha256,
        "code_sha256": code,
        "profile": profile,
        "seeds": list(chosen.seeds),
        "recordings": list(recordings),
        "rows": [asdict(row) for row in rows],
    }
    with new_file(folder / RESULT) as part:
        part.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return [name for name in suite.cells if name not in done]


def code_digest(store: Path, experiment: Experiment, profile: Profile) -> str:
    """Digest of the simulator and the stages up to the evaluation, with all that they import and the built kernels.

    Every run of an experiment is of this code: those of other code are not taken from the store.

    Args:
        store: of what was computed before, which remembers digests.
        experiment: whose code it is: what steers a robot counts where one is steered.
        profile: how much is computed.
    """
    used = stages.STAGES[: 1 + stages.STAGES.index(stages.EVALUATION)]
    steering = [STEERING] if is_steered(experiment, profile) else []
    return _digest_of([SIMULATOR, *steering, *(stage.code for stage in used)], store)


def is_steered(experiment: Experiment, profile: Profile) -> bool:
    """Whether a robot of an experiment is steered while it is simulated.

    Args:
        experiment: the experiment.
        profile: how much is computed.
    """
    data = (data_of(experiment.file, profile, name) for name in experiment.file.configurations)
    return any(one.steering for one in data)


def simulator_digest(store: Path, data: SimulatedData, profile: Profile) -> str:
    """Digest of what makes recordings, with all that it imports; of a steered robot its settings as well.

    Args:
        store: of what was computed before, which remembers digests.
        data: of the recordings.
        profile: that they are of.
    """
    if not data.steering:
        return _digest_of([SIMULATOR], store)
    return "\n".join([_digest_of([STEERING, SIMULATOR], store), *profile.set])


def _digest_of(functions: Sequence[str], store: Path) -> str:
    """Digest of functions and of all that they import."""
    reader, modules = CodeReader(store / "code.json"), dict[str, str]()
    for function in functions:
        modules |= reader.version_of(function).modules
    return digest_of_values(modules)


def _row(experiment: Experiment, cell: BatchCell, folder: Path, numbers: Mapping[str, object]) -> ResultRow:
    """The metrics that the experiment names, of one cell."""
    values, reasons = dict[str, float | None](), dict[str, str]()
    failure = read_state(folder, cell.name).error
    for metric in experiment.file.metrics:
        found = [numbers[name] for name in names_in(metric, numbers)]
        known = [float(value) for value in found if isinstance(value, int | float)]
        values[metric] = mean(known) if known and len(known) == len(found) else None
        if values[metric] is None:
            reasons[metric] = failure or _reason(run_folder(folder, cell.name), metric)
    recording = "" if cell.recording.startswith(SIMULATED) else cell.recording
    return ResultRow(recording, cell.configuration, cell.seed, values, reasons)


def _reason(run: Path, metric: str) -> str:
    """Why the run has no such metric, as it says itself."""
    path = run / "metrics.json"
    grouped = read_json(path, "the metrics of a run").get("reasons", {}) if path.is_file() else {}
    return reason_of(grouped, metric) or next(_matching(grouped, metric), "the run does not have it")


def _matching(grouped: Mapping[str, Sequence[str]], metric: str) -> Iterator[str]:
    """Reasons of names that a metric with `*` stands for."""
    for reason, patterns in grouped.items():
        if any(fnmatchcase(pattern, metric) for pattern in patterns):
            yield reason
