"""From files as they are distributed to recordings: one module per dataset, named in one table."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from duagc.pipeline.base.atomic_folder import check_apart
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.config.base import value_of

# name on the command line -> module with `Options` and `convert(src, out, robots=, force=, **options)`
DATASETS = {
    "7scenes": "duagc.converters.datasets.seven_scenes",
    "aria-multiagent": "duagc.converters.datasets.aria_multiagent",
    "bonn": "duagc.converters.datasets.bonn",
    "icl-nuim": "duagc.converters.datasets.icl_nuim",
    "kimera-multi": "duagc.converters.datasets.kimera_multi",
    "replica": "duagc.converters.datasets.replica",
    "ros": "duagc.converters.datasets.ros",
    "replica-multiagent": "duagc.converters.datasets.replica_multiagent",
    "s3e": "duagc.converters.datasets.s3e",
    "scannet": "duagc.converters.datasets.scannet",
    "scannetpp": "duagc.converters.datasets.scannetpp",
    "tum": "duagc.converters.datasets.tum",
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
    src: str | Path,
    out: str | Path,
    robots: int | None = None,
    *,
    force: bool = False,
    options: Sequence[str] = (),
    options_file: str | Path | None = None,
    masks: Sequence[str] = (),
) -> None:
    """Convert a dataset into a recording.

    Args:
        dataset: a name in `DATASETS`, or a Python file with a converter like those.
        src: where its files are.
        out: the folder to write.
        robots: how many robots to make of it; None: one, or as many as the dataset has.
        force: replace a recording that is there.
        options: `name=value` of the converter, values in TOML notation.
        options_file: TOML file of options; those of `options` win. `recording.json` keeps its text. Its tables
            [[masks]] hold masks of pixels: `file` or `polygon`, and `robot` unless for all.
        masks: PNG of the pixels that show the scene (0 = none), FILE of every robot or ROBOT=FILE.
    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    src, out, options_file = Path(src), Path(out), None if options_file is None else Path(options_file)
    files = [Path(mask.partition("=")[2] or mask) for mask in masks]
    check_apart(out, [src, *files, *([options_file] if options_file else [])])
    module = _module(dataset)
    count = {} if robots is None else {"robots": robots}
    said = parse_options(options)
    from duagc.converters.layouts.validity import USER_MASKS, user_masks

    with _options_of_file(options_file, module, dataset) as filed:
        for name in ("src", "out", "robots", "force"):
            if name in filed or name in said:
                raise DuagError(
                    f"{dataset}: {name} is no option of a converter, expected it among the arguments"
                )
        token = USER_MASKS.set(user_masks(masks, filed.pop("masks", ()), options_file))
        try:
            module.convert(src, out, force=force, **count, **{**filed, **said})
        finally:
            USER_MASKS.reset(token)
    if not (out / "recording.json").is_file():
        raise DuagError(
            f"{dataset}: wrote no {out}/recording.json, expected a recording; see RecordingWriter"
        )


@contextmanager
def _options_of_file(path: Path | None, module: ModuleType, dataset: str) -> Iterator[dict[str, Any]]:
    """Options by name, sound by themselves; recordings that are written meanwhile keep the text."""
    if path is None:
        yield {}
        return
    from duagc.converters.layouts.image_files import options_of
    from duagc.converters.writer import OPTIONS_FILE
    from duagc.pipeline.base.files import parse_toml, read_text

    expected = "options of a converter in TOML"
    text = read_text(path, expected)
    values = parse_toml(text, path, expected)
    if hasattr(module, "Options"):
        of_converter = {name: value for name, value in values.items() if name != "masks"}
        options_of(module.Options, of_converter, f"{path}, for {dataset}")
    token = OPTIONS_FILE.set({"name": path.name, "text": text})
    try:
        yield values
    finally:
        OPTIONS_FILE.reset(token)


def parse_options(options: Sequence[str]) -> dict[str, Any]:
    """Options by name.

    Args:
        options: `name=value`, values in TOML notation; what is none is text.

    Raises:
        DuagError: an option has no name or no value, or its value is too long or nested too deep.
    """
    values: dict[str, Any] = {}
    for option in options:
        name, separator, text = option.partition("=")
        if not separator or not name.strip():
            raise DuagError(f"--set {option}: expected NAME=VALUE")
        values[name.strip()] = value_of(text, f"--set {name.strip()}")
    return values


def describe() -> str:
    """The datasets and the options of their converters, as text."""
    lines = []
    for name in sorted(DATASETS):
        module = _module(name)
        summary, _, _ = (module.__doc__ or "").partition("\n")  # `python -OO` leaves none
        lines.append(f"{name}: {summary}")
        documented = module.Options.documentation()
        for option, field in module.Options.model_fields.items():
            lines.append(
                f"    --set {option}={field.default}  {' '.join(documented.get(option, '').split())}"
            )
    return "\n".join(lines)
