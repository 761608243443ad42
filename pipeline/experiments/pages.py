"""The page of all experiments in a folder: verdicts, tables, differences, plots, and the command of each."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.random_streams import generator
from duagc.pipeline.base.templates import filled
from duagc.pipeline.cache.publish import publish
from duagc.pipeline.experiments.carry_out import RESULT, check_rule, is_steered, read_result
from duagc.pipeline.experiments.costs import write_costs
from duagc.pipeline.experiments.overview import counted, judged_uses, read_uses
from duagc.pipeline.experiments.rule import RULES, Experiment, Metric, Rule, read_experiment
from duagc.pipeline.experiments.statistics import bca_interval, mean
from duagc.pipeline.experiments.verdicts import (
    PairedGaps,
    ResultRow,
    RuleVerdict,
    compare,
    judge,
    margin_of,
    rows_of,
)
from duagc.pipeline.report import figures
from duagc.pipeline.report.pictures import svg_uri

PAGE, MARKDOWN, VERDICTS, FIGURE = "index.html", "experiments.md", "verdicts.json", "rules.svg"
KINDS = {"better": "better", "no_worse": "no worse", "equivalent": "equal", "differs": "different"}


@dataclass(frozen=True)
class JudgedExperiment:
    """An experiment with its result.

    Attributes:
        experiment: the experiment.
        result: what stands in its file.
        rows: its runs.
        verdicts: of its rules.
    """

    experiment: Experiment
    result: dict[str, Any]
    rows: list[ResultRow]
    verdicts: list[RuleVerdict]


def judge_folder(out: Path, rules: Path = RULES) -> list[JudgedExperiment]:
    """Judge every result in a folder by the rule under which it was made.

    Args:
        out: folder of all experiments.
        rules: folder of their files.

    Raises:
        DuagError: there is no result, or one was made under another rule.
    """
    found = results_in(out, rules)
    if not found:
        raise DuagError(f"{out}: found no {RESULT}, expected what `duagc experiment run` writes")
    judged = []
    for experiment, result in found:
        rows = rows_of(result)
        judged.append(
            JudgedExperiment(experiment, result, rows, judge(experiment.name, experiment.file, rows))
        )
    return judged


def results_in(out: Path, rules: Path = RULES) -> list[tuple[Experiment, dict[str, Any]]]:
    """The experiments that have a result in a folder, and these; a page can be made of them.

    Args:
        out: folder of all experiments.
        rules: folder of their files.

    Raises:
        DuagError: one was made under another rule.
    """
    found = []
    for path in sorted(out.glob(f"*/{RESULT}")):
        result = read_result(path)
        experiment = read_experiment(path.parent.name, rules)
        check_rule(experiment, result, path)
        experiment.profile(result["profile"])
        found.append((experiment, result))
    return found


def write_report(out: Path, judged: Sequence[JudgedExperiment]) -> None:
    """Write page, Markdown, verdicts, costs and figures of experiments.

    Args:
        out: folder of all experiments.
        judged: experiments with their results.
    """
    sections = [_section(one) for one in judged]
    for one, section in zip(judged, sections, strict=True):
        _write(out / one.experiment.name / FIGURE, section["figure"])
    package, mixed = "duagc.pipeline.experiments", _are_mixed(judged)
    content: dict[str, Any] = {
        "sections": sections,
        "mixed": mixed,
        "counts": [counted(one.experiment, one.verdicts) for one in judged],
        "uses": _uses(judged),
    }
    verdicts = {one.experiment.name: [_document(v) for v in one.verdicts] for one in judged}
    verdicts_text = json.dumps(verdicts, indent=2, allow_nan=False) + "\n"
    _write(out / PAGE, filled(package, "page.html.j2", title="Experiments", **content))
    _write(out / MARKDOWN, filled(package, "page.md.j2", escaped=False, **content))
    _write(out / VERDICTS, verdicts_text)
    write_costs(out, [one.experiment.name for one in judged])


def _are_mixed(judged: Sequence[JudgedExperiment]) -> bool:
    """Whether sections are not known to be of one code; those with a steered robot have a digest of their own."""
    for steered in (False, True):
        codes = {
            one.result.get("code_sha256")
            for one in judged
            if is_steered(one.experiment, one.experiment.profile(one.result["profile"])) == steered
        }
        if len(codes) > 1 or None in codes:
            return True
    return False


def _uses(judged: Sequence[JudgedExperiment]) -> list[dict[str, Any]]:
    """Rows of what information is good for, of the experiments that are there."""
    files = {one.experiment.name: one.experiment.file for one in judged}
    found = judged_uses(read_uses(), {one.experiment.name: one.verdicts for one in judged})
    return [
        {
            "what": use.what,
            "experiment": use.experiment,
            **_verdict_row(verdict, files[use.experiment].metrics[verdict.rule.metric]),
        }
        for use, verdict in found
    ]


def _write(path: Path, text: str) -> None:
    """Whole, though two commands that share a folder may write its page at the same time."""
    try:
        publish(path, text.encode())
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected to write a file") from error


def _document(verdict: RuleVerdict) -> dict[str, Any]:
    numbers = {name: getattr(verdict, name) for name in ("mean", "low", "high", "p", "p_exact")}
    return {
        "rule": verdict.rule.name,
        "control": verdict.rule.control,
        "verdict": verdict.word,
        "why": verdict.why,
        "margin": margin_of(verdict.rule),
        "gaps": {str(seed): gap for seed, gap in verdict.gaps.items()},
        **{name: value if math.isfinite(value) else None for name, value in numbers.items()},
    }


def _section(one: JudgedExperiment) -> dict[str, Any]:
    file, name, profile = one.experiment.file, one.experiment.name, one.result["profile"]
    controls = [v for v in one.verdicts if v.rule.control]
    data = file.profiles[profile].data
    drawn = figures.margins([_drawn(v) for v in one.verdicts])
    return {
        "name": name,
        "title": file.title,
        "question": file.question,
        "claim": file.claim,
        "limits": file.limits,
        "sha256": one.experiment.sha256,
        "code": f"code `{one.result['code_sha256'][:12]}`"
        if one.result.get("code_sha256")
        else "code not recorded",
        "profile": profile,
        "level": f"{file.level:g}",
        "seeds": ", ".join(map(str, one.result["seeds"])),
        "data": f"{data.robots} robots, {data.frames} frames of {data.width}x{data.height} each, "
        f"scene {data.scene}, overlap {data.overlap:g}, noise {data.noise}",
        "command": f"duagc experiment run {name} --profile {profile} --out DIR",
        "controls": len(controls),
        "controls_wrong": [v.rule.name for v in controls if not v.as_expected],
        "verdicts": [_verdict_row(v, file.metrics[v.rule.metric]) for v in one.verdicts],
        "metrics": [
            metric.title + (f" ({metric.unit})" if metric.unit else "") for metric in file.metrics.values()
        ],
        "configurations": [_configuration_row(one, row) for row in file.configurations],
        "recordings": [
            {"name": recording, "rows": [_recording_row(one, rule, recording) for rule in file.rules]}
            for recording in one.result["recordings"]
        ],
        "figure": drawn,
        "figure_uri": svg_uri(drawn),
    }


def _verdict_row(verdict: RuleVerdict, metric: Metric) -> dict[str, Any]:
    rule = verdict.rule
    known = math.isfinite(verdict.mean)
    return {
        "name": rule.name,
        "claim": rule.claim,
        "control": rule.control,
        "word": verdict.word,
        "why": verdict.why,
        "reason": rule.reason,
        "first": _side(rule, first=True),
        "second": _side(rule, first=False),
        "test": KINDS[rule.kind]
        + (f", margin {_size(rule, metric, margin_of(rule), sign='')}" if rule.margin else ""),
        "mean": _size(rule, metric, verdict.mean) if known else "–",
        "interval": f"{_size(rule, metric, verdict.low)} to {_size(rule, metric, verdict.high)}"
        if known
        else "–",
        "gaps": ", ".join(_size(rule, metric, gap) for gap in verdict.gaps.values()),
        "p": f"{verdict.p:.2g}" if known else "–",
        "p_exact": f"{verdict.p_exact:.2g}" if known else "–",
    }


def _side(rule: Rule, *, first: bool) -> str:
    """A side of a rule: configuration and metric, without what both have in common."""
    side, other = (rule.first, rule.second) if first else (rule.second, rule.first)
    if side.value is not None:
        return f"{side.value:g}"
    if side.configuration == other.configuration:
        return side.metric
    return side.configuration if side.metric == other.metric else f"{side.configuration}: {side.metric}"


def _size(rule: Rule, metric: Metric, gap: float, sign: str = "+") -> str:
    """A difference in the unit of its metric, or a quotient in percent; positive where the first side is better."""
    gap += 0.0  # no minus before a zero
    if rule.ratio:
        percent = 100 * math.expm1(gap)
        return f"{percent:{sign}.1f} %" if abs(percent) >= 0.1 else f"{percent:{sign}.1g} %"
    return f"{gap * metric.scale:{sign}.{metric.digits}f} {metric.unit}".rstrip()


def _configuration_row(one: JudgedExperiment, configuration: str) -> dict[str, Any]:
    """Mean and interval of every metric over the simulated recordings."""
    file, cells = one.experiment.file, []
    for name, metric in file.metrics.items():
        found = [r.values.get(name) for r in one.rows if not r.recording and r.configuration == configuration]
        values = [value for value in found if value is not None]
        if not values:
            cells.append({"value": "–", "interval": "", "lost": len(found)})
            continue
        stream = generator(0, "experiment", metric=name)  # equal values have equal intervals in all rows
        low, high = bca_interval(values, stream) if len(values) > 1 else (values[0], values[0])
        shown = [f"{x * metric.scale:.{metric.digits}f}" for x in (mean(values), low, high)]
        interval = f"{shown[1]} to {shown[2]}" if len(values) > 1 else ""
        cells.append({"value": shown[0], "interval": interval, "lost": len(found) - len(values)})
    settings = ", ".join(file.configurations[configuration].set)
    return {"name": configuration, "settings": settings, "cells": cells}


def _recording_row(one: JudgedExperiment, rule: Rule, recording: str) -> dict[str, str]:
    """A real recording is one: its differences are shown, and decide nothing."""
    found: PairedGaps = compare(rule, one.experiment.file, one.rows, recording)
    metric = one.experiment.file.metrics[rule.metric]
    shown = [_size(rule, metric, gap) for gap in found.gaps.values()]
    return {"name": rule.name, "claim": rule.claim, "value": ", ".join(shown or list(found.missing.values()))}


def _drawn(verdict: RuleVerdict) -> dict[str, Any]:
    """A verdict for the plot: differences in units of the margin, and the bounds that the mean must pass."""
    rule, margin = verdict.rule, margin_of(verdict.rule)
    unit = margin or max(map(abs, verdict.gaps.values()), default=1.0) or 1.0
    bounds = {"better": (margin / unit,), "no_worse": (-1.0,), "equivalent": (-1.0, 1.0), "differs": (0.0,)}
    return {
        "name": rule.name + (" (control)" if rule.control else ""),
        "gaps": [gap / unit for gap in verdict.gaps.values()],
        "interval": [x / unit for x in (verdict.low, verdict.mean, verdict.high)],
        "bounds": bounds[rule.kind],
        "word": verdict.word,
    }
