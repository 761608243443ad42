"""Counts of verdicts, and what information is good for: by rules that exist."""

from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.experiments.overview import Use, counted, judged_uses, read_uses
from duagc.pipeline.experiments.rule import read_experiment
from duagc.pipeline.experiments.verdicts import RuleVerdict, Word


def verdict(experiment: str, rule: str, word: Word) -> RuleVerdict:
    found = next(r for r in read_experiment(experiment).file.rules if r.name == rule)
    return RuleVerdict(found, word, "", {})


def test_every_use_names_a_claim_of_an_experiment_once() -> None:
    uses = read_uses()
    assert len({(use.experiment, use.rule) for use in uses}) == len(uses) == len({use.what for use in uses})
    for use in uses:
        rules = {rule.name: rule for rule in read_experiment(use.experiment).file.rules}
        assert not rules[use.rule].control


def test_uses_that_hold_come_first_and_a_rule_that_is_gone_is_named() -> None:
    uses = [
        Use("loses", "compaction", "gain_paper"),
        Use("was not run", "h6_weights", "poses"),
        Use("wins", "compaction", "gain_random"),
    ]
    verdicts = {
        "compaction": [
            verdict("compaction", "gain_random", "holds"),
            verdict("compaction", "gain_paper", "fails"),
        ]
    }
    assert [use.what for use, _ in judged_uses(uses, verdicts)] == ["wins", "loses"]
    with pytest.raises(DuagError, match=r"uses\.toml: compaction has no rule 'none'"):
        judged_uses([Use("", "compaction", "none")], verdicts)


def test_controls_are_counted_by_themselves() -> None:
    experiment = read_experiment("compaction")
    words: dict[str, Word] = {"gain_random": "holds", "gain_paper": "fails", "rival_made_worse": "fails"}
    found = counted(experiment, [verdict("compaction", rule, word) for rule, word in words.items()])
    assert (found["holds"], found["fails"], found["untestable"], found["controls"]) == (1, 1, 0, "1 of 1")
    wrong = counted(experiment, [verdict("compaction", "rival_made_worse", "holds")])
    assert (wrong["holds"], wrong["controls"]) == (0, "0 of 1")


def test_a_use_without_an_experiment_is_refused(tmp_path: Path) -> None:
    (tmp_path / "uses.toml").write_text('[[use]]\nwhat = "a"\nrule = "order_7s"\n')
    with pytest.raises(DuagError, match=r"rule .order_7s., expected experiment\.rule"):
        read_uses(tmp_path / "uses.toml")
