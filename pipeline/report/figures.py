"""Figures of the report: arrays in, SVG text out. The same arrays give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[Any]

# Okabe-Ito: told apart with every common colour blindness; dark enough on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000", "#444444")
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
INK, FAINT, GRID = "#22303c", "#6b7a87", "#e3e8ec"

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
    """Colour of the robot (or other series) number `index`."""
    return COLORS[index % len(COLORS)]


def _figure(width_in: float, height_in: float) -> tuple[Figure, Any]:
    """A figure with one set of axes, on the non-interactive canvas, in the style of the report."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        return figure, figure.add_subplot()


def _svg(figure: Figure) -> str:
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def top_view(ways: Sequence[Mapping[str, Any]]) -> str:
    """Ways seen from above, metres.

    Args:
        ways: per robot "robot", "index" (which gives the colour), "before", "after" and "true" [n, 2] in metres; "true"
            may be None.
    """
    figure, axes = _figure(7.6, 5.2)
    for way in ways:
        i = way["index"]
        color = color_of(i)
        if way["true"] is not None:
            axes.plot(
                *way["true"].T, color="#9aa7b1", linewidth=4.5, alpha=0.55, solid_capstyle="round", zorder=1
            )
        axes.plot(*way["before"].T, color=color, linewidth=1.2, linestyle=(0, (3, 2)), zorder=2)
        axes.plot(*way["after"].T, color=color, zorder=3, label=way["robot"])
        axes.plot(*way["after"][0], marker=MARKS[i % len(MARKS)], markersize=8, color=color, zorder=4)
    handles, _ = axes.get_legend_handles_labels()
    style = {"color": INK}
    extra = [
        axes.plot([], [], **style, label="after consensus")[0],
        axes.plot([], [], **style, linewidth=1.2, linestyle=(0, (3, 2)), label="before")[0],
    ]
    if any(way["true"] is not None for way in ways):
        extra.append(axes.plot([], [], color="#9aa7b1", linewidth=4.5, alpha=0.55, label="ground truth")[0])
    extra.append(axes.plot([], [], linestyle="none", marker="o", color=INK, label="start")[0])
    axes.legend(handles=handles + extra, loc="center left", bbox_to_anchor=(1.01, 0.5))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("metres")
    axes.set_ylabel("metres")
    return _svg(figure)


def lines(
    series: Mapping[str, tuple[Array, Array]],
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    level: float | None = None,
) -> str:
    """Curves over a common axis.

    Args:
        series: name -> (x, y). log: logarithmic y axis; values that are not positive are left out.
        level: a horizontal line to compare with, for example a tolerance.
    """
    figure, axes = _figure(7.6, 3.2)
    for i, (name, (x, y)) in enumerate(series.items()):
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        keep = np.isfinite(y) & ((y > 0) | (not log))
        few = np.count_nonzero(keep) <= 40
        axes.plot(
            x[keep],
            y[keep],
            color=color_of(i),
            label=name,
            marker=MARKS[i % len(MARKS)] if few else None,
            markersize=4,
        )
    if log and any(np.any(np.asarray(y) > 0) for _, y in series.values()):
        axes.set_yscale("log")
    if level is not None:
        axes.axhline(level, color=FAINT, linewidth=1.0, linestyle=(0, (1, 2)), label=f"tolerance {level:g}")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    if series:
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _svg(figure)


def stacked(x: Array, parts: Mapping[str, Array], x_label: str, y_label: str) -> str:
    """Stacked areas: how a total divides into parts over a common axis."""
    figure, axes = _figure(7.6, 3.2)
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
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), reverse=True)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_ylim(bottom=0)
    return _svg(figure)


def bars(names: Sequence[str], parts: Mapping[str, Sequence[float]], x_label: str) -> str:
    """Horizontal stacked bars: one bar per name, one colour per part."""
    figure, axes = _figure(7.6, 0.9 + 0.34 * max(1, len(names)))
    left = np.zeros(len(names))
    for i, (part, values) in enumerate(parts.items()):
        axes.barh(names, values, left=left, color=color_of(i), label=part, height=0.62)
        left = left + np.asarray(values, dtype=np.float64)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(x_label)
    if len(parts) > 1:
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _svg(figure)


def reliability(bins: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """Predicted against observed error per decile, millimetres, both axes logarithmic; the diagonal is right."""
    figure, axes = _figure(5.6, 4.2)
    values = [1e3 * v for pairs in bins.values() for pair in pairs for v in pair if v > 0]
    if values:
        span = [min(values) / 1.3, max(values) * 1.3]
        axes.plot(span, span, color=FAINT, linewidth=1.0, linestyle=(0, (1, 2)), label="right prediction")
        axes.set_xscale("log")
        axes.set_yscale("log")
    for i, (name, pairs) in enumerate(bins.items()):
        x, y = 1e3 * np.array(pairs).T
        axes.plot(x, y, color=color_of(i), marker=MARKS[i % len(MARKS)], markersize=5, label=name)
    axes.set_xlabel("predicted error (mm, root mean square)")
    axes.set_ylabel("observed error (mm, root mean square)")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _svg(figure)
