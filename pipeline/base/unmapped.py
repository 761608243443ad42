"""Robots of whose logs no map could be begun: a run goes on without them, and says so."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError


@dataclass(frozen=True)
class Unmapped:
    """A log without a frame to begin a map with.

    Attributes:
        frames: of the log.
        frames_without_pixel: those that show nothing.
        duration_s: from the first frame to the last.
        reasons: why no frame was good enough, as the front end names them, the most frequent first.
        found: the same as part of a line for users.
    """

    frames: int
    frames_without_pixel: int
    duration_s: float
    reasons: tuple[str, ...]
    found: str

    def plain(self) -> dict[str, Any]:
        """As a table of plain values."""
        return asdict(self) | {"reasons": list(self.reasons)}

    @staticmethod
    def of(row: Any, where: str) -> Unmapped:
        """What `plain` made.

        Args:
            row: the table.
            where: begins the line of an error.

        Raises:
            DuagError: it is no such table.
        """
        names = {field.name for field in fields(Unmapped)}
        if not isinstance(row, dict) or set(row) != names or not isinstance(row["reasons"], list):
            raise DuagError(f"{where}: found {row!r}, expected a table of {', '.join(sorted(names))}")
        return Unmapped(**row | {"reasons": tuple(row["reasons"])})


class NothingToMapError(DuagError):
    """No frame of a log begins a map."""

    def __init__(self, log: Path, unmapped: Unmapped) -> None:
        """Of a log.

        Args:
            log: its file.
            unmapped: what is known of it.
        """
        super().__init__(f"{log}: {unmapped.found}")
        self.log, self.unmapped = log, unmapped

    def __reduce__(self) -> tuple[type[NothingToMapError], tuple[Path, Unmapped]]:
        """As it was made, for another process."""
        return type(self), (self.log, self.unmapped)
