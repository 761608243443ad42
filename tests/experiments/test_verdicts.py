"""Verdicts: what is planted is found, what is not there is not."""

import math

import pytest

from duagc.pipeline.base.random_streams import generator
from duagc.pipeline.experiments.rule import ExperimentFile
from duagc.pipeline.experiments.verdicts import ResultRow, RuleVerdict, compare, judge

METRIC = "team.ate_rmse_m"


def file_of(*rules: dict[str, object], better: str = "less") -> ExperimentFile:
    sides = {
        "first": {"configuration": "a", "metric": METRIC},
        "second": {"configuration": "b", "metric": METRIC},
    }
    profile = {"seeds": [0], "data": {}}
    return ExperimentFile.model_validate(
        {
            **dict.fromkeys(("title", "question", "claim", "limits"), ""),
            "profiles": {"small": profile},
            "configurations": {"a": {}, "b": {}},
            "metrics": {METRIC: {"title": "ATE", "better": better}},
            "rules": [sides | {"name": str(k), "claim": "", "reason": "", **r} for k, r in enumerate(rules)],
        }
    )


def rows(a: list[float | None], b: list[float | None], recording: str = "") -> list[ResultRow]:
    return [
        ResultRow(recording, name, seed, {METRIC: value}, {} if value is not None else {METRIC: "nobody met"})
        for name, values in (("a", a), ("b", b))
        for seed, value in enumerate(values)
    ]


def one(rule: dict[str, object], a: list[float | None], b: list[float | None]) -> RuleVerdict:
    (verdict,) = judge("test", file_of(rule), rows(a, b))
    return verdict


BASE = [1.00, 1.30, 0.80, 1.10, 0.95]
SCATTER = [0.004, -0.006, 0.003, 0.001, -0.002]


def moved(by: float) -> list[float | None]:
    return [x + by + s for x, s in zip(BASE, SCATTER, strict=True)]


@pytest.mark.parametrize(
    ("kind", "by", "word"),
    [
        ("better", -0.2, "holds"),
        ("better", -0.1, "fails"),  # on the margin
        ("better", 0.2, "fails"),
        ("no_worse", 0.0, "holds"),
        ("no_worse", -0.5, "holds"),
        ("no_worse", 0.2, "fails"),
        ("equivalent", 0.0, "holds"),
        ("equivalent", 0.2, "fails"),
        ("equivalent", -0.2, "fails"),
    ],
)
def test_a_rule_knows_its_margin(kind: str, by: float, word: str) -> None:
    """Less is better, the margin is 0.1."""
    verdict = one({"kind": kind, "margin": 0.1}, moved(by), [*BASE])
    assert verdict.word == word
    assert ("the contrary is shown" in verdict.why) == (word == "fails" and by != -0.1)


def test_quotients_are_of_the_side_that_is_compared_with() -> None:
    double = [2 * x for x in BASE]
    verdict = one({"kind": "better", "margin": 0.8, "ratio": True}, [*BASE], [*double])
    assert verdict.word == "holds"
    assert verdict.mean == pytest.approx(math.log(2))
    assert one({"kind": "better", "margin": 1.1, "ratio": True}, [*BASE], [*double]).word == "fails"
    none = one({"kind": "better", "margin": 0.1, "ratio": True}, [0.0, *BASE[1:]], [*double])
    assert none.word == "not testable here"
    assert "of which there is no ratio" in none.why


def test_a_side_may_be_a_number() -> None:
    """Less is better: at most 0.9 is shown of values about 0.8, and at least 0.7 by turning the sides."""
    at_most = {"kind": "better", "second": {"value": 0.9}}
    at_least = {"kind": "better", "first": {"value": 0.7}, "second": {"configuration": "a", "metric": METRIC}}
    near = [0.81, 0.79, 0.80, 0.805, 0.80]
    assert one(at_most, [*near], []).word == one(at_least, [*near], []).word == "holds"
    assert one(at_most, [x + 0.2 for x in near], []).word == "fails"
    assert one(at_least, [x - 0.2 for x in near], []).word == "fails"
    within = {"kind": "equivalent", "second": {"value": 0.8}, "margin": 0.02}
    assert one(within, [*near], []).word == "holds"
    assert one(within, [x + 0.03 for x in near], []).word == "fails"
    assert one(at_most, [None, *near[1:]], []).word == "not testable here"


def test_five_seeds_cannot_show_a_difference_of_either_sign() -> None:
    verdict = one({"kind": "differs"}, moved(0.5), [*BASE])
    assert verdict.word == "not testable here"
    assert "5 pairs, of which the exact test cannot reach 0.05" in verdict.why
    assert one({"kind": "differs"}, [*moved(0.5), 2.0], [*BASE, 1.4]).word == "holds"


def test_a_seed_against_the_claim_is_heard_by_the_exact_test() -> None:
    """The t test would let it pass: 5 seeds must agree, or there must be more of them."""
    a: list[float | None] = [*BASE]
    b: list[float | None] = [x + gap for x, gap in zip(BASE, (0.30, 0.32, 0.28, 0.31, -0.001), strict=True)]
    verdict = one({"kind": "better"}, a, b)
    assert verdict.p < 0.05 < verdict.p_exact
    assert verdict.word == "fails"
    assert "not shown by 5 seeds, and neither is the contrary" in verdict.why


def test_absent_values_are_no_pairs_and_say_why() -> None:
    verdict = one({"kind": "better"}, [None, *moved(-0.2)[1:]], [*BASE])
    assert verdict.word == "not testable here"
    assert "4 pairs" in verdict.why
    assert "; seeds 0: team.ate_rmse_m of a: nobody met" in verdict.why
    assert one({"kind": "better"}, [], [*BASE]).why.endswith("; seeds 0, 1, 2, 3, 4: the run of a is missing")


def test_the_family_is_adjusted_and_controls_stand_apart() -> None:
    rule = {"kind": "no_worse", "margin": 0.1}
    (alone,) = judge("test", file_of(rule), rows(moved(0.09), [*BASE]))
    three = judge("test", file_of(rule, rule, rule, rule | {"control": True}), rows(moved(0.09), [*BASE]))
    assert alone.p < 0.05
    assert [v.p / alone.p for v in three] == pytest.approx([3, 3, 3, 1])


def test_a_control_that_holds_is_seen() -> None:
    held, failed = judge(
        "test",
        file_of({"kind": "better", "control": True}, {"kind": "better", "margin": 9.0, "control": True}),
        rows(moved(-0.2), [*BASE]),
    )
    assert not held.as_expected
    assert failed.as_expected


def test_a_real_recording_is_no_seed() -> None:
    file = file_of({"kind": "better"})
    both = [*rows(moved(-0.2), [*BASE]), *rows([0.5], [9.5], "kitchen")]
    assert judge("test", file, both) == judge("test", file, rows(moved(-0.2), [*BASE]))
    assert dict(compare(file.rules[0], file, both, "kitchen").gaps) == {0: 9.0}


def test_more_is_better_turns_the_sign() -> None:
    file = file_of({"kind": "better", "margin": 0.1}, better="more")
    assert judge("test", file, rows(moved(0.2), [*BASE]))[0].word == "holds"
    assert judge("test", file, rows(moved(-0.2), [*BASE]))[0].word == "fails"


def test_nothing_is_rarely_called_better() -> None:
    """Fifty experiments in which both sides are drawn alike; four rules each, of five seeds."""
    held = 0
    for k in range(50):
        stream = generator(k, "nothing")
        a, b = (list(stream.normal(1.0, 0.1, 5)) for _ in range(2))
        held += any(v.word == "holds" for v in judge("test", file_of(*[{"kind": "better"}] * 4), rows(a, b)))
    assert held <= 4


def test_seeds_that_the_first_side_does_not_reach_are_not_left_out() -> None:
    """Ten seeds, in five of which only the first side has no value: the others show nothing of it."""
    base = [*BASE, *[x + 0.01 for x in BASE]]
    better = [x - 0.3 for x in base]
    kinds = ({"kind": "better"}, {"kind": "no_worse", "margin": 0.01})
    for changed in kinds:
        assert one(changed, [*better], [*base]).word == "holds"
        verdict = one(changed, [None, *better[1:]], [*base])
        assert verdict.word == "fails"
        assert verdict.why.startswith("shown by 9 seeds, and not by all; seeds 0: ")
        assert one(changed, [*better], [None, *base[1:]]).word == "holds", "a rival that does not end loses"
    alike = {"kind": "equivalent", "margin": 0.02}
    near = [x + 0.001 * (k % 3 - 1) for k, x in enumerate(base)]
    assert one(alike, [*near], [*base]).word == "holds"
    assert one(alike, [*near], [None, *base[1:]]).word == "fails"
    nothing = one({"kind": "better", "ratio": True, "margin": 0.1}, [*better], [0.0, *base[1:]])
    assert nothing.word == "fails", "less is better, and nothing is less than nothing"
