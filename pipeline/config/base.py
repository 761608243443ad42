"""Configuration: frozen models with defaults and documentation, overridden by a TOML file or by `a.b=value`."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text


class Config(BaseModel):
    """Base of every section: immutable, unknown names refused, defaults validated."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True
    )


Model = TypeVar("Model", bound=Config)


def load_config(model: type[Model], path: Path | None = None, overrides: Sequence[str] = ()) -> Model:
    """Read a configuration.

    Args:
        model: the class to read.
        path: TOML file with sections as in the model; None for the defaults.
        overrides: `section.name=value`, value in TOML notation, a bare word taken as text; later ones win.
    Raises:
        DuagError: names the file or the override, what was found and what was expected.
    """
    values: dict[str, Any] = {}
    source = "configuration"
    if path is not None:
        source = str(path)
        try:
            values = tomllib.loads(read_text(path, "a TOML configuration"))
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise DuagError(f"{path}: not valid TOML: {error}") from error
    for override in overrides:
        _apply(values, override)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise DuagError(f"{source}: {name} is not a known setting; see `duagc config show`") from error
        if first["type"] == "value_error":
            raise DuagError(f"{source}: {first['ctx']['error']}") from error
        raise DuagError(f"{source}: {name} = {first['input']!r}: {first['msg']}") from error


def _apply(values: dict[str, Any], override: str) -> None:
    name, separator, text = override.partition("=")
    keys = name.strip().split(".")
    if not separator or not all(keys):
        raise DuagError(f"--set {override}: expected section.name=value")
    for key in keys[:-1]:
        values = values.setdefault(key, {})
        if not isinstance(values, dict):
            raise DuagError(f"--set {override}: {key} is a value, not a section")
    try:
        values[keys[-1]] = tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        values[keys[-1]] = text.strip()


def dump_config(config: Config) -> str:
    """TOML text of a configuration, every setting with its documentation as a comment.

    Args:
        config: the settings.
    """
    import tomlkit

    document = tomlkit.document()
    _fill(document, config)
    return tomlkit.dumps(document)


def _plain(value: Any) -> Any:
    """What TOML can hold: tuples become lists, models in them tables without what is not set."""
    if isinstance(value, Config):
        return value.model_dump(mode="json", exclude_none=True)
    return [_plain(element) for element in value] if isinstance(value, tuple) else value


def _fill(table: Any, config: Config) -> None:
    import tomlkit

    sections = []
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Config):
            sections.append((name, value))
            continue
        if field.description:
            for line in field.description.strip().splitlines():
                table.add(tomlkit.comment(line.strip()))
        if value is None:  # TOML has no null; leaving a setting out means its default, which is None
            table.add(tomlkit.comment(f"{name} is not set"))
            continue
        table.add(name, tomlkit.item(_plain(value)))
    for name, section in sections:
        inner = tomlkit.table()
        if type(section).__doc__:
            inner.add(tomlkit.comment(str(type(section).__doc__).strip().splitlines()[0]))
        _fill(inner, section)
        table.add(name, inner)
