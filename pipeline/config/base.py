"""Configuration: frozen models with defaults and documentation, overridden by a TOML file or by `a.b=value`."""

import ast
import inspect
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import TOO_LONG, read_toml


class Config(BaseModel):
    """Base of every section: immutable, unknown names refused, defaults validated."""

    LISTED: ClassVar[str] = "docs/reference/config.md"  # where users find its settings

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        allow_inf_nan=False,
    )

    @classmethod
    def summary(cls) -> str:
        """The first paragraph of what the section says of itself; "" if it says nothing."""
        return inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0]

    @classmethod
    def documentation(cls) -> dict[str, str]:
        """The text below each setting of the section, by its name; read from the source when somebody asks.

        pydantic would read it (`use_attribute_docstrings`) in every process that imports a section.
        """
        found: dict[str, str] = {}
        for base in reversed(cls.__mro__):
            if issubclass(base, Config):
                found |= _documented(base.__module__).get(base.__name__, {})
        return found


@cache
def _documented(module: str) -> dict[str, dict[str, str]]:
    """The texts below the attributes of all classes of a module, by class and attribute."""
    found: dict[str, dict[str, str]] = {}
    for node in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))):
        if isinstance(node, ast.ClassDef):
            found[node.name] = texts = {}
            for setting, text in pairwise(node.body):
                match setting, text:
                    case (
                        ast.AnnAssign(target=ast.Name(id=name)),
                        ast.Expr(value=ast.Constant(value=str(words))),
                    ):
                        texts[name] = inspect.cleandoc(words)
    return found


NO_NUMBER = "is true or false, expected a number"

LARGEST = 2**62
"""Of numbers; as nanoseconds 146 years."""

EXPECTED = {
    "tuple_type": "expected a list in brackets, such as [1, 2], texts in quotes",
    "int_parsing_size": f"expected at most {LARGEST:g}",
    "missing": "expected a value",
    "model_type": "expected a section of settings",
}
"""What is said of a wrong value in place of pydantic's words, by the type of its error."""

MOST_SAID = 100
"""Characters of an override, a name or a value that a message repeats."""
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

Model = TypeVar("Model", bound=Config)


def load_config(model: type[Model], path: str | Path | None = None, overrides: Sequence[str] = ()) -> Model:
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
        values = read_toml(Path(path), "a TOML configuration")
    for override in overrides:
        _apply(values, override)
    for name in booleans_for_numbers(model, values):
        raise DuagError(f"{_said_where(name, source, overrides)}: {name} {NO_NUMBER}")
    try:
        config = model.model_validate(values)
        check_numbers(config, source, overrides)
        return config
    except ValidationError as error:
        found = error.errors()
        first = next((one for one in found if one["type"] == "extra_forbidden"), found[0])
        path_of = [str(part) for part in first["loc"]]
        source, name = _said_where(".".join(path_of), source, overrides), _written(path_of)
        if first["type"] == "extra_forbidden":
            nearest = _nearest(model, path_of)
            raise DuagError(
                f"{source}: {name} is not a known setting, {nearest}; see {model.LISTED}"
            ) from error
        if first["type"] == "value_error":
            raise DuagError(f"{source}: {first['ctx']['error']}") from error
        value = "is missing," if first["type"] == "missing" else f"= {short(repr(first['input']))}:"
        raise DuagError(f"{source}: {name} {value} {expected_of(first)}") from error


def expected_of(complaint: Mapping[str, object]) -> str:
    """What pydantic expected in place of a wrong value, in the words of every other message.

    Args:
        complaint: one of `ValidationError.errors()`.
    """
    message = str(complaint["msg"]).replace("Input should be", "expected", 1)
    message = re.sub("^expected (greater|less) than", r"expected a number \1 than", message)
    return EXPECTED.get(str(complaint["type"]), message)


def _said_where(name: str, source: str, overrides: Sequence[str]) -> str:
    """The last override that says a setting, a section around it or a part of it; or the source of all others."""
    for override in reversed(overrides):
        said = f"{override.partition('=')[0].strip()}."
        if said.startswith(f"{name}.") or f"{name}.".startswith(said):
            return f"--set {short(override)}"
    return source


def short(text: str) -> str:
    """A text as a message repeats it: no more of it than finds it again.

    Args:
        text: a name, a value or an override.
    """
    return text if len(text) <= MOST_SAID else f"{text[:MOST_SAID]} ..."


def _written(path: Sequence[str]) -> str:
    """A dotted name as TOML has it: a part that is empty or holds a dot or a blank stands in quotes."""
    return short(".".join(part if _BARE_KEY.fullmatch(part) else f'"{part}"' for part in path))


def booleans_for_numbers(model: type[Config], values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Names of numbers for which true or false was said; pydantic would take them as 1 and 0.

    Args:
        model: the settings.
        values: of these, by name, as they were read.
        prefix: of their names.
    """
    for name, value in values.items():
        kind = field.annotation if (field := model.model_fields.get(name)) else None
        if isinstance(value, Mapping) and isinstance(kind, type) and issubclass(kind, Config):
            yield from booleans_for_numbers(kind, value, f"{prefix}{name}.")
        kinds = get_args(kind) or (kind,)
        if bool not in kinds and not {int, float}.isdisjoint(kinds):
            some = enumerate(value) if isinstance(value, list) else [(None, value)]
            for place, one in some:
                if isinstance(one, bool):
                    yield f"{prefix}{name}" + ("" if place is None else f".{place}")


def check_numbers(config: Config, source: str, overrides: Sequence[str] = (), prefix: str = "") -> None:
    """Refuse numbers below 0 where a setting says nothing else, numbers that no machine holds, and lists of none.

    Args:
        config: settings.
        source: where they are said, for the message.
        overrides: `section.name=value`, of which one may say a number instead.
        prefix: of their names.

    Raises:
        DuagError: names the setting, what was found and what was expected.
    """
    for name, field in type(config).model_fields.items():
        value, full = getattr(config, name), f"{prefix}{name}"
        wrong = "is empty, expected one value or more" if value == () and field.default else None
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, Config):
                check_numbers(number, source, overrides, f"{full}.")
            elif isinstance(number, int | float):
                if number < 0 and not field.metadata:
                    wrong = f"is {_short(number)}, expected 0 or more"
                elif abs(number) > LARGEST:
                    wrong = f"is {_short(number)}, expected at most {LARGEST:g}"
        if wrong is not None:
            raise DuagError(f"{_said_where(full, source, overrides)}: {full} {wrong}")


def _short(number: int | float) -> str:
    """With a few digits, also an integer that no float can hold."""
    try:
        return f"{number:g}"
    except OverflowError:
        from decimal import Decimal

        return f"{Decimal(number):.5e}"


def _nearest(model: type[Config], path: Sequence[str]) -> str:
    """What was perhaps meant by an unknown name: one of the same section, else the same name in another section."""
    section: Any = model
    for part in path[:-1]:
        if part.isdecimal():  # of a list of sections
            section = (*get_args(section), None)[0]
        elif isinstance(section, type) and issubclass(section, Config):
            section = field.annotation if (field := section.model_fields.get(part)) else None
    known = list(section.model_fields) if isinstance(section, type) and issubclass(section, Config) else []
    said = closest(path[-1], known, "a setting")
    if said.startswith("expected perhaps"):
        return _prefixed(said, path[:-1])
    elsewhere = [name for name in _names(model) if name.rpartition(".")[2] == path[-1]]
    return f"expected perhaps {' or '.join(elsewhere[:3])}" if elsewhere else said


def _prefixed(said: str, section: Sequence[str]) -> str:
    head, _, name = said.rpartition(" ")
    return f"{head} {'.'.join([*section, name])}"


def _names(model: type[Config], prefix: str = "") -> Iterator[str]:
    """Dotted names of all settings."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Config):
            yield from _names(field.annotation, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def differing_settings(first: Config, second: Config, prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Settings that differ, by dotted name, with both values.

    Args:
        first: settings.
        second: others of the same kind.
        prefix: of every name.
    """
    out: list[tuple[str, Any, Any]] = []
    for name in type(first).model_fields:
        one, other = getattr(first, name), getattr(second, name)
        if isinstance(one, Config) and type(one) is type(other):
            out += differing_settings(one, other, f"{prefix}{name}.")
        elif one != other:
            out.append((f"{prefix}{name}", one, other))
    return out


def _apply(values: dict[str, Any], override: str) -> None:
    name, separator, text = override.partition("=")
    keys = name.strip().split(".")
    if not separator or not all(keys):
        raise DuagError(f"--set {override}: expected section.name=value")
    for key in keys[:-1]:
        values = values.setdefault(key, {})
        if not isinstance(values, dict):
            raise DuagError(f"--set {override}: {key} is a value, not a section")
    values[keys[-1]] = value_of(text, f"--set {name}")


def value_of(text: str, where: str) -> Any:
    """A value in TOML notation; what is none is text.

    Args:
        text: of the value.
        where: of messages.

    Raises:
        DuagError: it is several lines, nested too deep, or a number of more than 4300 digits.
    """
    text = text.strip()
    if "\n" in text:
        raise DuagError(f"{where}: found {len(text.splitlines())} lines, expected one value")
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    except RecursionError as error:
        raise DuagError(f"{where}: is nested too deep, expected a value") from error
    except ValueError as error:
        raise DuagError(f"{where}: {TOO_LONG}, expected a value") from error


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

    sections, documentation = [], config.documentation()
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, Config):
            sections.append((name, value))
            continue
        for line in documentation.get(name, "").splitlines():
            table.add(tomlkit.comment(line.strip()))
        if value is None:  # TOML has no null; left out, a setting has its default, which is None
            table.add(tomlkit.comment(f"{name} is not set"))
            continue
        table.add(name, tomlkit.item(_plain(value)))
    for name, section in sections:
        inner = tomlkit.table()
        for line in section.summary().splitlines():
            inner.add(tomlkit.comment(line))
        _fill(inner, section)
        table.add(name, inner)
