"""The table of `duagc bench robustness`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from duagc.pipeline.bench.robustness import ATE_RATIO, GAP_SIGMA, PSNR_LOSS_DB, WORST_M, bounds_met
from duagc.pipeline.bench.tables import markdown

HEAD = (
    "dial",
    "value",
    "frames",
    "tracked %",
    "ATE mm",
    "x clean",
    "team mm",
    "PSNR dB",
    "- clean",
    "in exposure",
    "as moved",
    "joined",
    "components",
    "worst good mm",
    "gap sigma",
    "misses",
)


def format_table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown text of the rows there are; the first is the clean one.

    Args:
        rows: of `robustness.run`.
    """
    clean = rows[0]
    lines = markdown(HEAD, [_cells(row, clean) for row in rows])
    lines += [f"\n{row['dial']} {row['value']}: {row['failed']}" for row in rows if "failed" in row]
    lines += [f"\n{row['dial']} {row['value']}: lost {_lost(row)}" for row in rows if row.get("lost")]
    lines.append(
        f"\nBounds of each dial alone at its middle value: ATE at most {ATE_RATIO:g} x clean, PSNR at most "
        f"{PSNR_LOSS_DB:g} dB below it, one component, 99 % of matched Gaussians within {GAP_SIGMA:g} sigma of the "
        f"centralized answer; no pose called good farther than {1000 * WORST_M:g} mm from the truth. ATE: mean of "
        "the robots. PSNR: own maps, held-out views; in exposure: in the gain and offset of each half of the view "
        "fitted on the other half; as moved: drawn with the motion of the camera while its shutter was open."
    )
    return "\n".join(lines)


def _lost(row: dict[str, Any]) -> str:
    return ", ".join(f"{e['robot']} {e['first']} to {e['last']} ({e['reason']})" for e in row["lost"])


def _cells(row: dict[str, Any], clean: dict[str, Any]) -> list[object]:
    if "failed" in row:
        return [row["dial"], row["value"], *[None] * (len(HEAD) - 3), "run failed"]
    bounds = bounds_met(row, clean)
    missed = [name for name, met in bounds.items() if not met] if bounds else []
    if row["worst_good_m"] is not None and row["worst_good_m"] > WORST_M and not missed:
        missed = ["worst"]
    compared = "failed" not in clean
    return [
        row["dial"],
        row["value"] or None,
        row["frames"],
        f"{100 * row['tracked_share']:.1f}",
        _number(row["ate_m"], 1000, 2),
        _number(row["ate_m"], 1 / clean["ate_m"], 2) if compared and clean["ate_m"] else None,
        _number(row["ate_team_m"], 1000, 2),
        _number(row["psnr_db"], 1, 2),
        _number(_difference(row["psnr_db"], clean["psnr_db"]), 1, 2) if compared else None,
        _number(row["psnr_exposure_db"], 1, 2),
        _number(row["psnr_moved_db"], 1, 2),
        f"{row['joined']} of {row['robots']}",
        row["components"],
        _number(row["worst_good_m"], 1000, 1),
        _number(row["gap_sigma"], 1, 3),
        ", ".join(missed) or None,
    ]


def _difference(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else value - other


def _number(value: float | None, factor: float, digits: int) -> str | None:
    return None if value is None else f"{factor * value:.{digits}f}"
