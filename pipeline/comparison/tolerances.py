"""How far values may be apart, from a file that says why."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pydantic import Field, ValidationError

from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import read_toml
from duagc.pipeline.comparison.fields import Unequal
from duagc.pipeline.config.base import Config, expected_of


class Tolerance(Config):
    """How far apart the values of some fields may be."""

    where: str
    """Topic, or file of a run, such as `/*/odometry` or `metrics.json`; `*` stands for anything."""

    field: str
    """Dotted name of the field; `*` stands for anything."""

    absolute: float = Field(0.0, ge=0.0)
    """In the unit of the field."""

    relative: float = Field(0.0, ge=0.0)
    """Of the value of the first run, element by element."""

    reason: str
    """Why this much is right."""


@dataclass(frozen=True)
class Tolerances:
    """All tolerances of a comparison; the first that fits a field counts."""

    rows: tuple[Tolerance, ...] = ()

    def allow(self, where: str, found: Unequal) -> bool:
        """Whether a difference is small enough.

        Args:
            where: topic or file.
            found: the difference.
        """
        for row in self.rows:
            if fnmatchcase(where, row.where) and fnmatchcase(found.name, row.field):
                return found.within(row.absolute, row.relative)
        return False


def read_tolerances(path: Path) -> Tolerances:
    """Read tolerances, `[[tolerance]]` tables with where, field, absolute or relative, and reason.

    Args:
        path: TOML file.

    Raises:
        DuagError: it is not such a file; a tolerance without a reason is none.
    """
    content = read_toml(path, "a TOML file of tolerances")
    rows = content.pop("tolerance", [])
    if content or not isinstance(rows, list):
        raise DuagError(
            f"{path}: found {', '.join(content) or 'no tables'}, expected [[tolerance]] tables only"
        )
    known = list(Tolerance.model_fields)
    out = []
    for number, row in enumerate(rows, 1):
        try:
            out.append(Tolerance.model_validate(row))
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(map(str, first["loc"]))
            hint = (
                closest(name, known, "a field") if first["type"] == "extra_forbidden" else expected_of(first)
            )
            raise DuagError(f"{path}: tolerance {number}: {name}: {hint}") from error
        if not out[-1].reason.strip():
            raise DuagError(f"{path}: tolerance {number}: reason is empty, expected why this much is right")
    return Tolerances(tuple(out))
