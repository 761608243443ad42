"""A suite: a matrix of recordings, configurations and seeds, read whole before anything runs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import read_toml
from duagc.pipeline.config.base import (
    NO_NUMBER,
    Config,
    booleans_for_numbers,
    expected_of,
    load_config,
    short,
)
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.run_plan import LAST, NAMES

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.]*")


class SuiteConfiguration(Config):
    """Settings of some cells."""

    file: str | None = None
    """TOML file of settings, relative to that of the suite."""

    set: tuple[str, ...] = ()
    """`a.b=value`; these win over the file."""


class Exclusion(Config):
    """Cells that are left out: those to which all that is named here applies."""

    recording: str | None = None
    configuration: str | None = None
    seed: int | None = None


class SuiteFile(Config):
    """What stands in the file of a suite."""

    recordings: dict[str, str]
    """Folders by name, relative to the file."""

    configurations: dict[str, SuiteConfiguration]
    """The first one is what the others are compared with."""

    seeds: tuple[int, ...] = (0,)
    """Of the runs; each replaces the `seed` of the configuration."""

    exclude: tuple[Exclusion, ...] = ()
    """Cells that are left out."""

    until: str = LAST
    """Last stage of every run."""


@dataclass(frozen=True)
class BatchCell:
    """One run of a suite.

    Attributes:
        recording: name of it.
        configuration: name of it.
        seed: of the run.
        folder: of the recording.
        config: settings.
        until: the last stage.
    """

    recording: str
    configuration: str
    seed: int
    folder: Path
    config: RunConfig
    until: str = LAST

    @property
    def name(self) -> str:
        """Unique in the suite."""
        return f"{self.recording}-{self.configuration}-{self.seed}"


@dataclass(frozen=True)
class Suite:
    """All cells of a suite, in the order of the file.

    Attributes:
        path: of the file.
        cells: by name.
        configurations: names.
    """

    path: Path
    cells: Mapping[str, BatchCell]
    configurations: tuple[str, ...]


def read_suite(path: Path) -> Suite:
    """Read a suite; everything that it names is looked at.

    Args:
        path: TOML file.

    Raises:
        DuagError: it is no suite, or names what does not exist.
    """
    values = read_toml(path, "a suite")
    for name in booleans_for_numbers(SuiteFile, values):
        raise DuagError(f"{path}: {name} {NO_NUMBER}")
    try:
        file = SuiteFile.model_validate(values)
    except ValidationError as error:
        raise DuagError(f"{path}: {_complaint(error)}") from error
    for kind, names in (("recording", file.recordings), ("configuration", file.configurations)):
        if not names:
            raise DuagError(f"{path}: found no {kind}, expected at least one")
        for name in names:
            if not _NAME.fullmatch(name):
                raise DuagError(f"{path}: {kind} {name!r}: expected a name of letters, digits, _ and .")
    if not file.seeds or len(set(file.seeds)) != len(file.seeds):
        raise DuagError(f"{path}: seeds are {list(file.seeds)}, expected different ones, at least one")
    if file.until not in NAMES:
        raise DuagError(
            f"{path}: until {short(file.until)}: is no stage, {closest(file.until, NAMES, 'a stage')}"
        )
    _check_exclusions(path, file)
    cells = {cell.name: cell for cell in _cells(path, file)}
    if not cells:
        raise DuagError(f"{path}: every cell is excluded, expected at least one")
    return Suite(path, cells, tuple(file.configurations))


def _complaint(error: ValidationError) -> str:
    first = error.errors()[0]
    *section, name = map(str, first["loc"])
    if first["type"] != "extra_forbidden":
        found = "" if first["type"] == "missing" else f" = {short(repr(first['input']))}"
        return f"{'.'.join([*section, name])}{found}: {expected_of(first)}"
    models: dict[str, type[Config]] = {"configurations": SuiteConfiguration, "exclude": Exclusion}
    model = models[section[0]] if section else SuiteFile
    return f"{'.'.join([*section, name])} is unknown, {closest(name, list(model.model_fields), 'a name')}"


def _check_exclusions(path: Path, file: SuiteFile) -> None:
    known: dict[str, list[Any]] = {
        "recording": list(file.recordings),
        "configuration": list(file.configurations),
        "seed": list(file.seeds),
    }
    for row in file.exclude:
        for kind, names in known.items():
            value = getattr(row, kind)
            if value is not None and value not in names:
                hint = closest(str(value), list(map(str, names)), f"a {kind}")
                raise DuagError(f"{path}: exclude: {kind} {value}: is not in the suite, {hint}")


def _cells(path: Path, file: SuiteFile) -> Iterator[BatchCell]:
    from duagc.pipeline.recording import Recording

    folders = {name: path.parent / folder for name, folder in file.recordings.items()}
    for folder in folders.values():
        recording = Recording(folder)
        for robot in recording.robots:
            recording.log(robot)
    for recording_name, (name, of_name), seed in product(folders, file.configurations.items(), file.seeds):
        one = {"recording": recording_name, "configuration": name, "seed": seed}
        if any(_applies(row, one) for row in file.exclude):
            continue
        settings = None if of_name.file is None else path.parent / of_name.file
        try:
            config = load_config(RunConfig, settings, [*of_name.set, f"seed={seed}"])
        except DuagError as error:
            raise DuagError(f"{path}: configuration {name}: {error}") from error
        yield BatchCell(
            recording_name, name, seed, folder=folders[recording_name], config=config, until=file.until
        )


def _applies(row: Exclusion, cell: Mapping[str, Any]) -> bool:
    said = {kind: value for kind, value in row.model_dump().items() if value is not None}
    return bool(said) and all(cell[kind] == value for kind, value in said.items())
