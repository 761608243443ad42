"""What plain PSNR a dial leaves to any map of one appearance: the true images of the walk against those of the dial.

A map of one appearance shows every place as the clean camera does, in one gain; a camera that changes its gain, or
moves while its shutter is open, does not. So the images of the clean cell themselves are compared with those of a cell,
at held-out views, in the one gain of each robot and channel that suits these views best. No run takes part.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench.robustness import (
    CLEAN,
    PSNR_LOSS_DB,
    Cell,
    RobustnessPlan,
    finished_row,
    simulate_cell,
)
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.recording import Recording, open_rgbd

DIALS_OF_FRAMES = ("exposure", "white_balance", "blur")
"""Dials that change the colors of single frames, and neither what the camera sees nor when."""

_EQUAL = 1e-12
"""Squared error (of colors in 0..1) below which images are equal."""

Moments = NDArray[np.float64]
"""Of the colors of views: means of x x, x y and y y, [views, 3, 3 channels]; x the true color, y that of the dial."""


def run(plan: RobustnessPlan, out: Path, *, workers: int = 2) -> list[dict[str, Any]]:
    """Simulate the clean walk and the cells of a plan, and compare their images.

    Args:
        plan: its dials are of `DIALS_OF_FRAMES`.
        out: folder of results; its clean cell says how far off a map is.
        workers: processes that render; changes no result.

    Returns:
        Rows, in the order of the cells.
    """
    clean_db = _clean_psnr_db(plan, out)
    with tempfile.TemporaryDirectory(prefix="duagc-bench-") as name:
        clean, *cells = plan.cells()

        def made(cell: Cell) -> Recording:
            simulate_cell(cell, plan, Path(name) / cell.name, workers=workers)
            return Recording(Path(name) / cell.name)

        def rows() -> Iterator[dict[str, Any]]:
            true = made(clean)
            for cell in cells:
                shown = made(cell)
                moments = [moments_of(true.log(robot), shown.log(robot)) for robot in true.robots]
                yield _row(cell, moments, clean_db)

        return list(track(rows(), "true images", len(cells)))


def _row(cell: Cell, robots: Sequence[Moments], clean_db: float | None) -> dict[str, Any]:
    """One row: mean of the robots, as PSNR of a run is."""
    error = None if clean_db is None else 10 ** (-clean_db / 10)
    as_good = None if error is None else float(np.mean([best_psnr_db(m, error) for m in robots]))
    return {
        "dial": cell.dial,
        "value": cell.value(),
        "views": sum(len(m) for m in robots),
        "true_images_db": float(np.mean([best_psnr_db(m) for m in robots])),
        "as_good_as_clean_db": as_good,
        "bound_db": None if clean_db is None else clean_db - PSNR_LOSS_DB,
    }


def _clean_psnr_db(plan: RobustnessPlan, out: Path) -> float | None:
    """PSNR of own maps of the clean cell that was measured on the same walk; None: there is none."""
    row = finished_row(out, Cell(CLEAN, 0.0), plan)
    return None if row is None else row.get("psnr_db")


def moments_of(true: Path, shown: Path) -> Moments:
    """Moments of the colors of a robot's held-out views.

    Args:
        true: its log, clean.
        shown: its log with a dial turned up.
    """
    found = []
    with open_rgbd(true) as clean, open_rgbd(shown) as turned:
        for index in filter(is_held_out, range(len(clean))):
            before, after = clean.frame(index), turned.frame(index)
            if before.stamp_ns != after.stamp_ns:
                raise ValueError(
                    f"frame {index} is of {after.stamp_ns} ns, expected {before.stamp_ns}, as clean"
                )
            x, y = (frame.color.reshape(-1, 3).astype(np.float64) / 255 for frame in (before, after))
            found.append([np.mean(x * x, axis=0), np.mean(x * y, axis=0), np.mean(y * y, axis=0)])
    return np.array(found)


def best_psnr_db(moments: Moments, error: float = 0.0) -> float:
    """Mean PSNR of views in the one gain of each channel for which it is largest, dB; infinite if all are equal.

    Args:
        moments: of the views.
        error: squared, that every view has besides.
    """
    from scipy.optimize import minimize

    xx, xy, yy = moments[:, 0], moments[:, 1], moments[:, 2]

    def loss(gains: NDArray[np.float64]) -> float:
        squares = np.mean(gains * gains * xx - 2 * gains * xy + yy, axis=1) + error
        return float(np.mean(10 * np.log10(np.maximum(squares, _EQUAL))))

    start = xy.sum(axis=0) / xx.sum(axis=0)
    if loss(start) <= 10 * np.log10(_EQUAL):
        return float("inf")
    return -float(minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9}).fun)


def format_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table in Markdown.

    Args:
        rows: of `run`.
    """
    keys = ("true_images_db", "as_good_as_clean_db", "bound_db")
    head = (
        "dial",
        "value",
        "views",
        "true images, dB",
        "with the error of the clean map, dB",
        "asked for, dB",
    )
    cells = [
        [
            row["dial"],
            row["value"],
            row["views"],
            *(None if row[k] is None else f"{row[k]:.2f}" for k in keys),
        ]
        for row in rows
    ]
    return "\n".join(
        [
            *markdown(head, cells),
            "\nThe clean images themselves against those of the dial, held-out views, in the best one gain of each "
            "robot and channel: no map of one appearance has a larger plain PSNR, unless it shows the views wrongly. "
            "With the error of the map of the clean cell, if --out has one, it is what a map as good as that reaches.",
        ]
    )


def as_json(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as JSON; what is infinite is null.

    Args:
        rows: of `run`.
    """
    plain = [{k: None if v == float("inf") else v for k, v in row.items()} for row in rows]
    return json.dumps(plain, indent=2)
