"""What stands before the sections of a page: counts of verdicts, and what information is good for."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.experiments.rule import Experiment
from duagc.pipeline.experiments.verdicts import RuleVerdict, Word

USES = Path(__file__).parent / "uses.toml"
ORDER: tuple[Word, ...] = ("holds", "fails", "not testable here")


@dataclass(frozen=True)
class Use:
    """Something that information could be good for.

    Attributes:
        what: in words.
        experiment: whose rule says whether it is.
        rule: name of the rule.
    """

    what: str
    experiment: str
    rule: str


def read_uses(path: Path = USES) -> list[Use]:
    """The uses of information, in the order of their file.

    Args:
        path: the file.

    Raises:
        DuagError: a rule is not named with its experiment.
    """
    uses = []
    for entry in tomllib.loads(path.read_text(encoding="utf-8"))["use"]:
        experiment, dot, rule = entry["rule"].partition(".")
        if not dot:
            raise DuagError(f"{path}: rule {entry['rule']!r}, expected experiment.rule")
        uses.append(Use(entry["what"], experiment, rule))
    return uses


def counted(experiment: Experiment, verdicts: Sequence[RuleVerdict]) -> dict[str, str | int]:
    """How many claims of an experiment hold and fail, and whether its controls fail as they must.

    Args:
        experiment: the experiment.
        verdicts: of its rules.
    """
    claims = [v.word for v in verdicts if not v.rule.control]
    controls = [v.as_expected for v in verdicts if v.rule.control]
    return {
        "name": experiment.name,
        "title": experiment.file.title,
        "holds": claims.count("holds"),
        "fails": claims.count("fails"),
        "untestable": claims.count("not testable here"),
        "controls": f"{sum(controls)} of {len(controls)}",
    }


def judged_uses(
    uses: Sequence[Use], verdicts: Mapping[str, Sequence[RuleVerdict]]
) -> list[tuple[Use, RuleVerdict]]:
    """Uses with their verdicts: those that hold first, then those that fail; without those of other experiments.

    Args:
        uses: of information.
        verdicts: of the rules, by experiment.

    Raises:
        DuagError: an experiment has no such rule.
    """
    found = []
    for use in uses:
        if use.experiment not in verdicts:
            continue
        named = [v for v in verdicts[use.experiment] if v.rule.name == use.rule]
        if not named:
            raise DuagError(f"{USES}: {use.experiment} has no rule {use.rule!r}, expected one of its rules")
        found.append((use, named[0]))
    return sorted(found, key=lambda pair: ORDER.index(pair[1].word))
