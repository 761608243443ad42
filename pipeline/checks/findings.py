"""What a check says: findings with what was found, what was expected and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """error: a run would fail or mislead. warning: a run may fail or be worse than it could be. note: good to know."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One thing that somebody should know. robot: "" if it concerns the whole recording."""

    severity: Severity
    check: str
    robot: str
    found: str
    expected: str
    advice: str = ""

    def line(self) -> str:
        """One line for people."""
        where = f"{self.robot}: " if self.robot else ""
        advice = f"; {self.advice}" if self.advice else ""
        return f"{self.severity.value}: {where}{self.check}: {self.found}, expected {self.expected}{advice}"


@dataclass
class Report:
    """Everything that `check` found out about a recording.

    Attributes:
        robots: what was measured of each, plain numbers and text.
        estimate: of `duagc run`, see `checks.estimate`.
    """

    path: str
    findings: list[Finding] = field(default_factory=list)
    robots: dict[str, dict[str, Any]] = field(default_factory=dict)
    estimate: dict[str, float] = field(default_factory=dict)

    def of(self, severity: Severity) -> list[Finding]:
        """The findings of one severity."""
        return [finding for finding in self.findings if finding.severity is severity]

    @property
    def sound(self) -> bool:
        """Whether there is no error."""
        return not self.of(Severity.ERROR)

    def plain(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {"sound": self.sound, **asdict(self)}


def lines(findings: Iterable[Finding]) -> list[str]:
    """The findings as text, the most severe first."""
    order = list(Severity)
    return [f.line() for f in sorted(findings, key=lambda f: order.index(f.severity))]
