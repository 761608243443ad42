"""The structure of information as tables in Markdown, as JSON, and as a plot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.evaluation.uncertainty_calibration import spearman
from duagc.pipeline.experiments.information_measures import PAIRS
from duagc.pipeline.experiments.information_structure import STRATA, Structure, quantile, thirds
from duagc.pipeline.report import figures

RATIOS = {
    "r_meters": "14x14, meters",
    "r_millimeters": "14x14, millimeters",
    "r_unit_diagonal": "14x14, unit diagonal",
    "r_chart": "13x13, unit diagonal",
    "r_turned": "control: turned at random",
}
COSTS = {
    "sigma_normal": "mean, along the normal",
    "sigma_surface": "mean, along the surface",
    "sigma_color": "color",
    "sigma_opacity": "opacity",
    "stated_normal": "stated, along the normal",
    "stated_surface": "stated, along the surface",
    "stated_weight": "stated weight of the mean",
}
SQUARED = {
    "squared_gradients": "mean",
    "squared_gradients_least": "least",
    "squared_gradients_most": "largest",
    "squared_gradients_trace": "mean of the diagonal",
    "squared_gradients_normal": "mean's block, along the normal",
    "squared_gradients_color": "color alone: mean",
    "squared_gradients_color_trace": "color alone: mean of the diagonal",
    "squared_gradients_color_normal": "color alone: along the normal",
}
OF_STRATA = ("r_unit_diagonal", "mean_shape", "sigma_normal", "stated_normal", "squared_gradients")
SHARES = (0.1, 0.5, 0.9, 0.99)


def numbers(found: Structure, code: str) -> dict[str, Any]:
    """All tables as JSON; what is infinite or unknown is null.

    Args:
        found: of `information_structure.run`.
        code: digest of the code.
    """
    c = found.columns
    names = [*RATIOS, *("_".join(pair) for pair in PAIRS), *COSTS, *SQUARED]
    names += [f"{kind}_{K}" for kind in ("rolling", "latest", "r_latest") for K in found.summary["windows"]]
    tree = {
        **found.summary,
        "code_sha256": code,
        "measures": {name: _quantiles(c[name]) for name in names},
        "strata": {
            stratum: [
                {
                    "from": low,
                    "to": high,
                    "gaussians": int(part.sum()),
                    **{name: _quantiles(c[name][part]) for name in OF_STRATA},
                }
                for low, high, part in thirds(c[stratum])
            ]
            for stratum in STRATA
        },
        "ranks": ranks(found),
    }
    return {key: _plain(value) for key, value in tree.items()}


def ranks(found: Structure) -> dict[str, float]:
    """Rank correlations over the Gaussians: of (2) over the information with the residual, and of the two.

    Args:
        found: of `information_structure.run`.
    """
    c = found.columns
    pairs = {
        "(2) over J^T R^-1 J, color residual": ("squared_gradients", "residual"),
        "(2) of the color alone over its J^T R^-1 J, color residual": ("squared_gradients_color", "residual"),
        "deviations along the normal by (2) and by J^T R^-1 J": ("squared_m", "normal_m"),
        "the same of the color alone": ("squared_m_color", "normal_m_color"),
    }
    out = {}
    for name, (a, b) in pairs.items():
        known = np.isfinite(c[a]) & np.isfinite(c[b])
        out[name] = spearman(c[a][known], c[b][known])
    return out


def format_tables(found: Structure) -> str:
    """Everything for people.

    Args:
        found: of `information_structure.run`.
    """
    c, summary = found.columns, found.summary
    parts = [
        "\n".join(_facts(name, facts) for name, facts in summary["robots"].items()),
        "Rules: share of the Gaussians for which they are met, with its 95 % interval (Wilson).",
        _table(
            ["rule", "met by", "verdict"],
            [
                [f"{'control: ' * v['control']}{v['claim']}", v["why"], f"**{v['verdict']}**"]
                for v in summary["verdicts"]
            ],
        ),
        "Off-diagonal blocks: share of the norm (r_k) by percentile of the Gaussians, and how many are within 0.1.",
        _table(
            ["r_k", *_heads(), "<= 0.1, %"],
            [[title, *_cells(c[name]), _percent(c[name] <= 0.1)] for name, title in RATIOS.items()],
        ),
        "Largest canonical correlation of two blocks of the 13x13.",
        _table(
            ["blocks", *_heads()],
            [[f"{a}, {b}", *_cells(c[f"{a}_{b}"])] for a, b in PAIRS],
        ),
        "Deviations with cross terms over those without; the last row: weight without over with.",
        _table(
            ["of", *_heads(), "> 1.1, %", "> 2, %"],
            [
                [title, *_cells(c[name]), _percent(c[name] > 1.1), _percent(c[name] > 2)]
                for name, title in COSTS.items()
            ],
        ),
        "By thirds of the Gaussians: medians; of the deviations also the 90th percentile.",
        _table(
            [
                "third by",
                "from",
                "to",
                "r_k",
                "mean, shape",
                "normal",
                "90 %",
                "stated",
                "90 %",
                "squared gradients",
            ],
            [_stratum(stratum, *third, found=found) for stratum in STRATA for third in thirds(c[stratum])],
        ),
        "Windows: deviation along the normal over that from all keyframes, and Gaussians that the window knows.",
        _table(
            [
                "keyframes K",
                "last K: known, %",
                "50 %",
                "90 %",
                "last K that saw it: 50 %",
                "90 %",
                "their r_k: 50 %",
            ],
            [
                [
                    str(K),
                    _percent(np.isfinite(c[f"rolling_{K}"][~np.isnan(c[f"rolling_{K}"])])),
                    *_cells(c[f"rolling_{K}"], (0.5, 0.9)),
                    *_cells(c[f"latest_{K}"], (0.5, 0.9)),
                    *_cells(c[f"r_latest_{K}"], (0.5,)),
                ]
                for K in summary["windows"]
            ],
        ),
        "Squared gradients (2) over J^T R^-1 J: generalized eigenvalues.",
        _table(["eigenvalue", *_heads()], [[title, *_cells(c[name])] for name, title in SQUARED.items()]),
        "\n".join(f"- rank correlation, {name}: {value:.2f}" for name, value in ranks(found).items()),
    ]
    return "\n\n".join(parts)


def page(found: Structure, code: str) -> str:
    """The tables as a page of the documentation.

    Args:
        found: of `information_structure.run`.
        code: digest of the code.
    """
    s = found.summary
    windows = ",".join(map(str, s["windows"]))
    return f"""---
kind: results
generated: true
---
# Information of single Gaussians

{s["question"]}
{s["claim"]}
Not shown: {s["limits"]}

```text
duagc bench information RUN --sample {s["sample"]} --windows {windows} --seed {s["seed"]} --out DIR
```

Recording {s["recording"]}, rules `{s["rules_sha256"][:12]}`, code `{code[:12]}`; this page is its `information.md`.
Measures are defined in `pipeline/experiments/information_measures.py`.
A control is a claim known to be false, which must fail.

{format_tables(found)}
"""


def plot(found: Structure) -> str:
    """r_k by percentile of the Gaussians, SVG text.

    Args:
        found: of `information_structure.run`.
    """
    percent = np.arange(0, 101)
    series = {
        title: (percent, np.array([quantile(found.columns[name], p / 100) for p in percent]))
        for name, title in RATIOS.items()
    }
    return figures.lines(series, "percent of the Gaussians", "r_k", log=True, level=0.1)


def _facts(name: str, facts: dict[str, Any]) -> str:
    off = ", ".join(f"{block} {value:.1g}" for block, value in facts["difference_from_stage"].items())
    return (
        f"- {name}: {facts['seen']} of {facts['sampled']} sampled of {facts['gaussians']} Gaussians, "
        f"{facts['keyframes']} keyframes; largest relative difference from the stage's sums: {off}; "
        f"numbers of views that differ: {facts['views_that_differ']}"
    )


def _stratum(name: str, low: float, high: float, part: NDArray[np.bool_], *, found: Structure) -> list[str]:
    c = {measure: found.columns[measure][part] for measure in OF_STRATA}
    return [
        name,
        f"{low:.3g}",
        f"{high:.3g}",
        *_cells(c["r_unit_diagonal"], (0.5,)),
        *_cells(c["mean_shape"], (0.5,)),
        *_cells(c["sigma_normal"], (0.5, 0.9)),
        *_cells(c["stated_normal"], (0.5, 0.9)),
        *_cells(c["squared_gradients"], (0.5,)),
    ]


def _heads() -> list[str]:
    return [f"{100 * share:g} %" for share in SHARES]


def _cells(values: Array, shares: Sequence[float] = SHARES) -> list[str]:
    return [f"{quantile(values, share):.3g}" for share in shares]


def _percent(which: NDArray[np.bool_]) -> str:
    return f"{100 * np.mean(which):.1f}" if len(which) else "-"


def _quantiles(values: Array) -> dict[str, float]:
    return {f"{100 * share:g}": quantile(values, share) for share in SHARES}


def _table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(markdown(head, rows))


def _plain(value: Any) -> Any:
    """Rounded to six digits, so that processors agree; None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
