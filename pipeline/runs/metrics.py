"""What readers of metrics.json may rely on: tables of numbers, and a line for one that is missing or no number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Strict, TypeAdapter, ValidationError

from duagc.pipeline.base.errors import DuagError

Number = Annotated[float, Strict()]
Scores = dict[str, Number | None]
Sets = dict[str, Scores]
Maps = dict[str, Sets]


class _Table(BaseModel):
    """Numbers besides those that are named."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Number | None]


class _Robot(_Table):
    frames: Number
    camera: Scores = {}
    depth_scale: Scores = {}
    rendering: Maps


class _Team(_Table):
    robots: Number
    robots_in_largest_component: Number


class _Consensus(_Table):
    solver: str | None = None
    converged: bool | None


class _Metrics(BaseModel):
    """All tables; what earlier versions did not write may be missing."""

    robots: dict[str, _Robot]
    team: _Team
    coverage: Sets = {}
    components: Sets = {}
    rendering: Maps
    calibration: Scores
    pixel_calibration: Maps = {}
    exchange: Scores
    consensus: _Consensus
    protocol: dict[str, str]
    reasons: dict[str, list[str]]


KINDS = {
    "model": "a table",
    "dict": "a table",
    "list": "a list",
    "float": "a number",
    "string": "a text",
    "bool": "true or false",
}
"""What was expected, by how pydantic's names of errors begin."""
_SOUND = TypeAdapter(_Metrics)


class Table(dict[str, Any]):
    """A table of a file; one that is read there and missing is an error of the file."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        """Take a table with all tables in it.

        Args:
            values: by name.
            where: the file, and what comes before the names.
        """
        inner = {k: Table(v, f"{where}{k}.") if isinstance(v, Mapping) else v for k, v in values.items()}
        super().__init__(inner)
        self._where = where

    def __missing__(self, name: str) -> Any:
        raise DuagError(f"{self._where}{name}: found none, expected a value")


def sound_metrics(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The content of metrics.json, of which every table holds what it should.

    Args:
        content: as it was read.
        path: of the file.

    Raises:
        DuagError: a value is missing or of another kind; so does the result where a missing name is read.
    """
    try:
        _SOUND.validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        name, kind = ".".join(map(str, first["loc"])), first["type"]
        if len(first["loc"]) == 1:
            raise DuagError(f"{path}: found no table {name}, expected one") from error
        found = "none" if kind == "missing" else f"a {type(first['input']).__name__}"
        expected = KINDS.get(kind.partition("_")[0], "a value")
        raise DuagError(f"{path}: {name}: found {found}, expected {expected}") from error
    return Table(content, f"{path}: ")
