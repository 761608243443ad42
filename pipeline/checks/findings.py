"""What a check says: findings with what was found, what was expected and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """error: a run would fail or mislead. warning: a run may fail or be worse than it could be. note: good to know."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One thing that somebody should know.

    Attributes:
        severity: how bad.
        check: its name.
        robot: "" if it concerns the whole recording.
        found: what is so.
        expected: instead of it.
        advice: what to do.
        confidence: probability that what was found holds for the recording; 1 if all of it was looked at.
    """

    severity: Severity
    check: str
    robot: str
    found: str
    expected: str
    advice: str = ""
    confidence: float = 1.0

    def line(self) -> str:
        """One line for people."""
        where = f"{self.robot}: " if self.robot else ""
        advice = f"; {self.advice}" if self.advice else ""
        sure = f"{self.severity.value} ({_percent(self.confidence)})"
        return f"{sure}: {where}{self.check}: {self.found}, expected {self.expected}{advice}"


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
        """The findings of one severity.

        Args:
            severity: of the wanted findings.
        """
        return [finding for finding in self.findings if finding.severity is severity]

    @property
    def sound(self) -> bool:
        """Whether there is no error."""
        return not self.of(Severity.ERROR)

    def plain(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {"sound": self.sound, **asdict(self)}


def lines(findings: Iterable[Finding]) -> list[str]:
    """The findings as text, the most severe first.

    Args:
        findings: in any order; of equal severity they stay in theirs.
    """
    order = list(Severity)
    return [f.line() for f in sorted(findings, key=lambda f: order.index(f.severity))]


def judged(findings: Iterable[Finding], sure: float, likely: float) -> Iterator[Finding]:
    """Findings with no more severity than their confidence allows: one level less if only likely, none if not.

    Args:
        findings: with the severity that they have where they are sure.
        sure: confidence from which on they have it.
        likely: confidence below which they are left out.
    """
    order = list(Severity)
    for finding in findings:
        if finding.confidence >= sure:
            yield finding
        elif finding.confidence >= likely:
            lower = order[min(order.index(finding.severity) + 1, len(order) - 1)]
            yield replace(finding, severity=lower)


def _percent(share: float) -> str:
    """Never rounded up to certainty."""
    return "100 %" if share == 1 else f"{min(100 * share, 99.9):.3g} %"
