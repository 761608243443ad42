"""From values to verdicts: a rule holds, fails, or cannot be tested here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import ConfigDict

from duagc.pipeline.base.random_streams import generator
from duagc.pipeline.experiments.rule import ExperimentFile, Rule, RuleSide
from duagc.pipeline.experiments.statistics import (
    bca_interval,
    holm,
    least_sign_flip_p,
    mean,
    sign_flip_p,
    t_test_p,
    two_one_sided_p,
)

Word = Literal["holds", "fails", "not testable here"]


@dataclass(frozen=True)
class ResultRow:
    """The metrics of one run.

    Attributes:
        recording: name of it; empty for a simulated one.
        configuration: name of it.
        seed: of recording and run.
        values: by metric; None: absent.
        reasons: why, of absent ones.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)  # of rows that are read

    recording: str
    configuration: str
    seed: int
    values: Mapping[str, float | None]
    reasons: Mapping[str, str]


@dataclass(frozen=True)
class PairedGaps:
    """Paired differences of one rule.

    Attributes:
        gaps: by seed, positive where the first side is better; of a ratio, logarithms.
        missing: why there is none, by seed.
        against: seeds of these in which only the first side has no value; of a claim that both are alike, only one.
    """

    gaps: Mapping[int, float]
    missing: Mapping[int, str]
    against: frozenset[int] = frozenset()


@dataclass(frozen=True)
class RuleVerdict:
    """What a rule came to.

    Attributes:
        rule: the rule.
        word: the verdict.
        why: the reason, for people.
        gaps: paired differences by seed, positive where the first side is better.
        against: seeds without one that speak against the rule.
        mean: of them; NaN if there are too few.
        low: lower end of the bootstrap interval of the mean.
        high: upper end.
        p: of the t test, adjusted over the rules of the experiment.
        p_exact: of the sign-flip test.
    """

    rule: Rule
    word: Word
    why: str
    gaps: Mapping[int, float]
    against: frozenset[int] = frozenset()
    mean: float = math.nan
    low: float = math.nan
    high: float = math.nan
    p: float = math.nan
    p_exact: float = math.nan

    @property
    def as_expected(self) -> bool:
        """Whether a control came out as it must; true of what is none."""
        return not self.rule.control or self.word == "fails"


def compare(rule: Rule, file: ExperimentFile, rows: Sequence[ResultRow], recording: str = "") -> PairedGaps:
    """Paired differences of a rule on one recording, or on the simulated ones.

    Args:
        rule: the rule.
        file: that has it.
        rows: of all runs.
        recording: name of it; empty for the simulated ones.
    """
    at = {(row.configuration, row.seed): row for row in rows if row.recording == recording}
    gaps, missing, against = dict[int, float](), dict[int, str](), set[int]()
    sign = 1.0 if file.metrics[rule.metric].better == "more" else -1.0
    for seed in sorted({seed for _, seed in at}):
        pair = [
            _value(at.get((side.configuration, seed)), side) if side.value is None else side.value
            for side in (rule.first, rule.second)
        ]
        absent = [value for value in pair if isinstance(value, str)]
        if absent:
            missing[seed] = absent[0]
            one_way = rule.kind in ("better", "no_worse")  # a rival without a value speaks for the claim
            if len(absent) == 1 and (isinstance(pair[0], str) or not one_way):
                against.add(seed)
            continue
        first, second = (float(value) for value in pair)
        if not rule.ratio:
            gaps[seed] = sign * (first - second)
        elif min(first, second) > 0:
            gaps[seed] = sign * math.log(first / second)
        else:
            missing[seed] = f"{rule.metric} is {min(first, second):g}, of which there is no ratio"
            if rule.kind not in ("better", "no_worse") or sign * first < sign * second:
                against.add(seed)
    return PairedGaps(gaps, missing, frozenset(against))


def _value(row: ResultRow | None, side: RuleSide) -> float | str:
    if row is None:
        return f"the run of {side.configuration} is missing"
    value = row.values.get(side.metric)
    if value is None:
        return f"{side.metric} of {side.configuration}: {row.reasons.get(side.metric) or 'absent'}"
    return value


def judge(name: str, file: ExperimentFile, rows: Sequence[ResultRow]) -> list[RuleVerdict]:
    """Verdicts of all rules on the simulated recordings.

    A rule holds if the paired t test says so after Holm's adjustment, and the exact sign-flip test, which needs no
    normal differences, says so too; and if no seed is left out because the first side alone has no value, as of a
    session that does not end.

    Args:
        name: of the experiment.
        file: of the experiment.
        rows: of all runs.
    """
    first = [_tested(name, rule, file, compare(rule, file, rows)) for rule in file.rules]
    tested = [k for k, verdict in enumerate(first) if verdict.word != "not testable here"]
    family = [k for k in tested if not file.rules[k].control]
    adjusted = dict(zip(family, holm([first[k].p for k in family]), strict=True))
    return [
        _decided(replace(verdict, p=adjusted.get(k, verdict.p)), file.level) if k in tested else verdict
        for k, verdict in enumerate(first)
    ]


def _tested(name: str, rule: Rule, file: ExperimentFile, found: PairedGaps) -> RuleVerdict:
    """With p values, which are not yet adjusted."""
    gaps = list(found.gaps.values())
    lost = "".join(
        f"; seeds {', '.join(str(seed) for seed, other in found.missing.items() if other == why)}: {why}"
        for why in dict.fromkeys(found.missing.values())
    )
    least = least_sign_flip_p(len(gaps)) * (2 if rule.kind == "differs" else 1)
    if len(gaps) < 2 or least > file.level:
        pairs = "1 pair" if len(gaps) == 1 else f"{len(gaps)} pairs"
        why = f"{pairs}, of which the exact test cannot reach {file.level:g}{lost}"
        return RuleVerdict(rule, "not testable here", why, found.gaps, found.against)
    p, p_exact = _p_values(rule, gaps)
    low, high = bca_interval(gaps, generator(0, "experiment", experiment=name, rule=rule.name))
    return RuleVerdict(
        rule,
        "fails",
        lost,
        found.gaps,
        found.against,
        mean=mean(gaps),
        low=low,
        high=high,
        p=p,
        p_exact=p_exact,
    )


def margin_of(rule: Rule) -> float:
    """The margin in the unit of the differences.

    Args:
        rule: that has it.
    """
    return math.log1p(rule.margin) if rule.ratio else rule.margin


def _p_values(rule: Rule, gaps: list[float]) -> tuple[float, float]:
    margin, turned = margin_of(rule), [-gap for gap in gaps]
    if rule.kind == "better":
        return t_test_p(gaps, margin), sign_flip_p(gaps, margin)
    if rule.kind == "no_worse":
        return t_test_p(gaps, -margin), sign_flip_p(gaps, -margin)
    if rule.kind == "equivalent":
        exact = max(sign_flip_p(gaps, -margin), sign_flip_p(turned, -margin))
        return two_one_sided_p(gaps, margin), exact
    exact = 2 * min(sign_flip_p(gaps, 0.0), sign_flip_p(turned, 0.0))
    return min(1.0, 2 * min(t_test_p(gaps, 0.0), t_test_p(turned, 0.0))), min(1.0, exact)


def _decided(verdict: RuleVerdict, level: float) -> RuleVerdict:
    lost = verdict.why
    if verdict.p <= level and verdict.p_exact <= level:
        if verdict.against:
            return replace(verdict, why=f"shown by {len(verdict.gaps)} seeds, and not by all{lost}")
        return replace(verdict, word="holds", why=f"both tests reject the contrary{lost}")
    return replace(verdict, why=f"{_contrary(verdict, level)}{lost}")


def _contrary(verdict: RuleVerdict, level: float) -> str:
    """Whether both tests show the contrary of the claim, or these seeds do not decide."""
    margin, kind = margin_of(verdict.rule), verdict.rule.kind
    gaps = list(verdict.gaps.values())
    turned = [-gap for gap in gaps]

    def shown(values: list[float], bound: float) -> bool:
        return max(t_test_p(values, bound), sign_flip_p(values, bound)) <= level

    if kind == "better" and shown(turned, -margin):
        return "the contrary is shown: less than the margin"
    if kind in ("no_worse", "equivalent") and shown(turned, margin):
        return "the contrary is shown: worse by more than the margin"
    if kind == "equivalent" and shown(gaps, margin):
        return "the contrary is shown: better by more than the margin"
    return f"not shown by {len(gaps)} seeds, and neither is the contrary"


def rows_of(document: Mapping[str, Any]) -> list[ResultRow]:
    """The runs of a result.

    Args:
        document: what stands in its file.
    """
    return [ResultRow(**row) for row in document["rows"]]
