"""From files as they are distributed to recordings: one module per dataset, named in one table."""

import tomllib
from collections.abc import Sequence
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.errors import DuagError, closest

# name on the command line -> module with `Options` and `convert(src, out, robots=, force=, **options)`
DATASETS = {
    "7scenes": "converters.seven_scenes",
    "aria-multiagent": "converters.aria_multiagent",
    "bonn": "converters.bonn",
    "icl-nuim": "converters.icl_nuim",
    "kimera-multi": "converters.kimera_multi",
    "replica": "converters.replica",
    "ros": "converters.ros",
    "replica-multiagent": "converters.replica_multiagent",
    "s3e": "converters.s3e",
    "scannet": "converters.scannet",
    "scannetpp": "converters.scannetpp",
    "tum": "converters.tum",
}


def _module(dataset: str) -> ModuleType:
    if dataset.endswith(".py"):
        return _from_file(Path(dataset))
    if dataset not in DATASETS:
        raise DuagError(f"dataset {dataset!r}, {closest(dataset, sorted(DATASETS), 'datasets')}")
    return import_module(DATASETS[dataset])


def _from_file(path: Path) -> ModuleType:
    """A converter of the user's own."""
    if not path.is_file():
        raise DuagError(f"{path}: no such file, expected a converter in Python, or the name of a dataset")
    spec = spec_from_file_location(path.stem, path)
    assert spec is not None  # there is a loader for every .py
    assert spec.loader is not None
    module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (ImportError, SyntaxError) as error:
        raise DuagError(f"{path}: {type(error).__name__} {error}, expected a converter in Python") from error
    if not hasattr(module, "convert"):
        raise DuagError(
            f"{path}: found no `convert`, expected convert(src, out, robots=1, force=False, **options)"
        )
    return module


def convert(
    dataset: str,
    src: Path,
    out: Path,
    robots: int | None = None,
    force: bool = False,
    options: Sequence[str] = (),
) -> None:
    """Convert a dataset into a recording.

    Args:
        dataset: a name in `DATASETS`, or a Python file with a converter like those.
        src: where its files are. out: the folder to write.
        robots: how many robots to make of it; None: one, or as many as the dataset has.
        force: replace a recording that is there.
        options: `name=value` of the converter, values in TOML notation.
    """
    module = _module(dataset)
    count = {} if robots is None else {"robots": robots}
    module.convert(Path(src), Path(out), force=force, **count, **parse_options(options))


def parse_options(options: Sequence[str]) -> dict[str, Any]:
    """Options by name. options: `name=value`, values in TOML notation; what is none is text."""
    values: dict[str, Any] = {}
    for option in options:
        name, separator, text = option.partition("=")
        if not separator or not name.strip():
            raise DuagError(f"--set {option}: expected NAME=VALUE")
        try:
            values[name.strip()] = tomllib.loads(f"value = {text.strip()}")["value"]
        except tomllib.TOMLDecodeError:
            values[name.strip()] = text.strip()
    return values


def describe() -> str:
    """The datasets and the options of their converters, as text."""
    lines = []
    for name in sorted(DATASETS):
        module = _module(name)
        lines.append(f"{name}: {(module.__doc__ or '').splitlines()[0]}")
        for option, field in module.Options.model_fields.items():
            lines.append(f"    --set {option}={field.default}  {' '.join((field.description or '').split())}")
    return "\n".join(lines)
