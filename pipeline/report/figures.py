"""Figures of the report: arrays in, SVG text out. The same arrays give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Numbers = NDArray[Any]

# Okabe-Ito: distinguishable with every common color blindness; dark enough on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000", "#444444")
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
INK, FAINT, GRID = "#22303c", "#6b7a87", "#e3e8ec"
LONG, KEPT = 16, 12  # letters: of a word that is too long for a legend, and of what becomes of it

_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "duagc",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
}


def color_of(index: int) -> str:
    """Color of the robot (or other series) number `index`.

    Args:
        index: from 0; colors come again after the last one.
    """
    return COLORS[index % len(COLORS)]


def shortened(label: str) -> str:
    """A label whose long words, names of robots, lack their middle: four in a row leave room for the axes.

    Args:
        label: words with spaces between them.
    """
    head, tail = KEPT // 2, (KEPT - 1) // 2
    return " ".join(
        word if len(word) <= LONG else f"{word[:head]}…{word[-tail:]}" for word in label.split(" ")
    )


def _styled(draw: Callable[..., Figure]) -> Callable[..., str]:
    """Make a function that draws a figure one that returns its SVG text, all in the style of the report."""

    @wraps(draw)
    def styled(*args: Any, **kwargs: Any) -> str:
        with plotting.style(_STYLE):
            buffer = io.StringIO()
            draw(*args, **kwargs).savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
            return buffer.getvalue()

    return styled


def _figure(width_in: float, height_in: float) -> tuple[Figure, Any]:
    """A figure with one set of axes, on a canvas that needs no screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _legend_above(axes: Any, entries: int) -> None:
    """A legend in one or two lines above the axes, at their left end."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        ncols=min(4, entries),
        borderaxespad=0.2,
        fontsize=9,
        columnspacing=1.2,
        handlelength=1.6,
        handletextpad=0.5,
    )


@_styled
def top_view(ways: Sequence[Mapping[str, Any]]) -> Figure:
    """Ways seen from above, meters.

    Args:
        ways: per robot "robot", "index" (which gives the color), "before", "after" and "true" [n, 2] in meters; "true"
            may be None.
    """
    drawn = np.concatenate([way["after"] for way in ways])
    wide, high = np.maximum(np.ptp(drawn, axis=0), 1e-9)
    figure, axes = _figure(9.6, float(np.clip(7.6 * high / wide, 2.4, 6.0)) + 0.6)
    for way in ways:
        i = way["index"]
        color = color_of(i)
        if way["true"] is not None:
            axes.plot(
                *way["true"].T, color="#9aa7b1", linewidth=4.5, alpha=0.55, solid_capstyle="round", zorder=1
            )
        axes.plot(*way["before"].T, color=color, linewidth=1.2, linestyle=(0, (3, 2)), zorder=2)
        axes.plot(*way["after"].T, color=color, zorder=3, label=shortened(way["robot"]))
        axes.plot(*way["after"][0], marker=MARKS[i % len(MARKS)], markersize=8, color=color, zorder=4)
    axes.plot([], [], color=INK, label="after consensus")
    axes.plot([], [], color=INK, linewidth=1.2, linestyle=(0, (3, 2)), label="before")
    if any(way["true"] is not None for way in ways):
        axes.plot([], [], color="#9aa7b1", linewidth=4.5, alpha=0.55, label="ground truth")
    axes.plot([], [], linestyle="none", marker="o", color=INK, label="start")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("meters")
    axes.set_ylabel("meters")
    return figure


@_styled
def lines(
    series: Mapping[str, tuple[Numbers, Numbers]],
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    level: float | None = None,
    robots: Sequence[str] = (),
) -> Figure:
    """Curves over a common axis.

    Args:
        series: name -> (x, y).
        x_label: of the common axis.
        y_label: of the other axis.
        log: logarithmic y axis; values that are not positive are left out.
        level: a horizontal line to compare with, for example a tolerance.
        robots: all of the team, also those without a curve: each has the color of its place.
    """
    from matplotlib.ticker import MaxNLocator

    figure, axes = _figure(5.4, 3.2)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    for place, (name, (x, y)) in enumerate(series.items()):
        i = robots.index(name) if name in robots else place
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        keep = np.isfinite(y) & ((y > 0) | (not log))
        axes.plot(
            x[keep],
            y[keep],
            color=color_of(i),
            label=shortened(name),
            marker=MARKS[i % len(MARKS)] if np.count_nonzero(keep) <= 40 else None,
            markersize=4,
            linestyle="-" if i == 0 else (0, (4, 1 + i)),  # equal curves stay visible under each other
        )
    if log and any(np.any(np.asarray(y) > 0) for _, y in series.values()):
        axes.set_yscale("log")
    if level is not None:
        axes.axhline(level, color=FAINT, linewidth=1.0, linestyle=(0, (1, 2)), label=f"tolerance {level:g}")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    if series:
        _legend_above(axes, len(series) + (level is not None))
    return figure


@_styled
def stacked(x: Numbers, parts: Mapping[str, Numbers], x_label: str, y_label: str) -> Figure:
    """Stacked areas: how a total divides into parts over a common axis.

    Args:
        x: common axis [n]; without numbers the figure is empty.
        parts: values [n] by label, lowest first.
        x_label: of the axis, with its unit.
        y_label: of the axis, with its unit.
    """
    from matplotlib.ticker import MaxNLocator

    figure, axes = _figure(5.4, 3.2)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    if len(x):
        axes.stackplot(
            x,
            *parts.values(),
            labels=list(parts),
            colors=[color_of(i) for i in range(len(parts))],
            alpha=0.85,
            step="mid",
            linewidth=0,
        )
        _legend_above(axes, len(parts))
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_ylim(bottom=0)
    return figure


@_styled
def bars(names: Sequence[str], parts: Mapping[str, Sequence[float]], x_label: str) -> Figure:
    """Horizontal stacked bars: one bar per name, one color per part.

    Args:
        names: of the bars, from the top.
        parts: one number per bar, by label, from the left.
        x_label: of the axis, with its unit.
    """
    from matplotlib.ticker import MaxNLocator

    figure, axes = _figure(5.4, 1.1 + 0.34 * max(1, len(names)))
    left = np.zeros(len(names))
    for i, (part, values) in enumerate(parts.items()):
        axes.barh(names, values, left=left, color=color_of(i), label=part, height=0.62)
        left = left + np.asarray(values, dtype=np.float64)
    if (labels := [shortened(name) for name in names]) != list(names):
        axes.set_yticks(range(len(names)), labels)  # equal ones stay bars of their own
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(x_label)
    if len(parts) > 1:
        _legend_above(axes, len(parts))
    return figure


@_styled
def reliability(bins: Mapping[str, Sequence[tuple[float, float]]], robots: Sequence[str] = ()) -> Figure:
    """Predicted against observed error per decile, millimeters, both axes logarithmic; the diagonal is right.

    Args:
        bins: (predicted, observed) error of every decile, meters, by robot.
        robots: all of the team, also those without a decile: each has the color of its place.
    """
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    figure, axes = _figure(5.4, 4.0)
    values = [1e3 * v for pairs in bins.values() for pair in pairs for v in pair if v > 0]
    if values:
        span = [min(values) / 1.3, max(values) * 1.3]
        axes.plot(span, span, color=FAINT, linewidth=1.0, linestyle=(0, (1, 2)), label="right prediction")
        for axis in (axes.xaxis, axes.yaxis):
            axis.axes.set(**{f"{axis.axis_name}scale": "log"})
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if span[1] < 1e3 * span[0] else (1.0,)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_formatter(NullFormatter())
    for place, (name, pairs) in enumerate(bins.items()):
        i = robots.index(name) if name in robots else place
        x, y = 1e3 * np.array(pairs).T
        axes.plot(x, y, color=color_of(i), marker=MARKS[i % len(MARKS)], markersize=5, label=shortened(name))
    axes.set_xlabel("predicted error (mm, root mean square)")
    axes.set_ylabel("observed error (mm, root mean square)")
    _legend_above(axes, len(bins) + bool(values))
    return figure


@_styled
def map_sizes(robots: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """What a larger map brings and costs: four panels against the cap of its Gaussians, on a logarithmic axis.

    Args:
        robots: per robot a list of "cap", "psnr_db", "depth_l1_m", "depth_l1_layer_m", "keyframe_s", "refinement_s",
            "peak_memory_mb"; None where there is no such value.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    panels = (
        ("PSNR, held out, dB", 1.0, {"psnr_db": ""}),
        ("depth L1, held out, mm", 1e3, {"depth_l1_m": "blended", "depth_l1_layer_m": "one layer"}),
        ("processor time, s", 1.0, {"keyframe_s": "a keyframe", "refinement_s": "final refinement"}),
        ("peak memory, MB", 1.0, {"peak_memory_mb": ""}),
    )
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    caps = sorted({row["cap"] for rows in robots.values() for row in rows})
    for axes, (label, scale, kinds) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for k, (name, kind) in enumerate(kinds.items()):
            line = ("-", (0, (4, 2)))[k]
            for i, (robot, rows) in enumerate(robots.items()):
                points = [(row["cap"], scale * row[name]) for row in rows if row[name] is not None]
                axes.plot(
                    *np.reshape(points, (-1, 2)).T,
                    color=color_of(i),
                    linestyle=line,
                    marker=MARKS[i % len(MARKS)],
                    markersize=5,
                    label=None if kind else shortened(robot),
                )
            if kind:
                axes.plot([], [], color=INK, linestyle=line, label=kind)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(caps))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda cap, _: f"{cap / 1000:g}k"))
        if label.startswith("processor"):
            axes.set_yscale("log")
        axes.set_xlabel("most Gaussians")
        axes.set_ylabel(label)
        _legend_above(axes, 4)
    return figure


@_styled
def robustness(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """ATE and PSNR of degraded cameras, a line for each dial, next to the clean one.

    Args:
        rows: of `duagc bench robustness`: "dial", "level", "ate_m", "psnr_db"; the first is the clean one.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dials = list(dict.fromkeys(row["dial"] for row in rows))
    levels = sorted({row["level"] for row in rows})
    figure = Figure(figsize=(9.6, 1.2 + 0.32 * len(dials)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, key, factor, label in (
        (panels[0], "ate_m", 1000.0, "ATE, mm"),
        (panels[1], "psnr_db", 1.0, "PSNR of own maps at held-out views, dB"),
    ):
        for i, level in enumerate(levels):
            known = [row for row in rows if row["level"] == level and row.get(key) is not None]
            axes.plot(
                [factor * row[key] for row in known],
                [dials.index(row["dial"]) for row in known],
                linestyle="none",
                marker=MARKS[i % len(MARKS)],
                color=color_of(i),
                label="clean" if level == 0 else f"{level:g} x middle",
            )
        if rows[0].get(key) is not None:
            axes.axvline(factor * rows[0][key], color=FAINT, linewidth=1.0, linestyle=(0, (3, 2)))
        axes.set_xlabel(label)
    panels[0].set_xscale("log")
    panels[0].set_yticks(range(len(dials)), dials)
    panels[0].invert_yaxis()
    panels[1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


@_styled
def margins(rules: Sequence[Mapping[str, Any]]) -> Figure:
    """Paired differences against margins, a row for each rule, in units of its margin.

    Args:
        rules: "name", "gaps" (of the seeds), "interval" (low, mean, high; NaN if unknown), "bounds" that the mean must
            pass, "word" (the verdict).
    """
    from matplotlib.ticker import FuncFormatter

    figure, axes = _figure(9.6, 1.0 + 0.42 * max(1, len(rules)))
    colors = {"holds": COLORS[2], "fails": COLORS[1]}
    for k, rule in enumerate(rules):
        color = colors.get(rule["word"], FAINT)
        for bound in rule["bounds"]:
            axes.plot([bound, bound], [k - 0.35, k + 0.35], color=INK, linewidth=1.2)
        low, middle, high = rule["interval"]
        axes.plot([low, high], [k, k], color=color, linewidth=3.0, alpha=0.5, solid_capstyle="butt")
        axes.plot([middle], [k], marker="D", color=color, markersize=6, linestyle="none")
        axes.plot(rule["gaps"], [k + 0.2] * len(rule["gaps"]), ".", color=FAINT, markersize=5)
    axes.set_yticks(range(len(rules)), [rule["name"] for rule in rules])
    axes.set_ylim(len(rules) - 0.5, -0.5)
    axes.set_xscale("symlog", linthresh=2.0)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.set_xlabel("difference in units of the margin; positive: the first side is better")
    axes.grid(visible=False, axis="y")
    return figure
