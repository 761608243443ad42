"""What an evaluation says: numbers, absent numbers with a reason, and the two files that hold them.

`metrics.json` follows the contract of docs/reference/metrics.md. An absent value is null there, never zero, and the
top-level map `reasons` says why, by the path of the value: {"team.ate_rmse_m": "..."}.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc.pipeline.base.files import new_file


@dataclass(frozen=True)
class Absent:
    """A value that does not exist, and why."""

    reason: str


def split_reasons(tree: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Replace every Absent leaf of nested mappings by None and collect its reason under its dotted path.

    Raises:
        ValueError: a leaf is None (absent without a reason) or not a finite number: both are bugs of the caller.
    """
    reasons: dict[str, str] = {}

    def walk(node: Any, path: tuple[str, ...]) -> Any:
        if isinstance(node, Mapping):
            return {key: walk(child, (*path, key)) for key, child in node.items()}
        if isinstance(node, Absent):
            reasons[".".join(path)] = node.reason
            return None
        if node is None or (isinstance(node, float) and not math.isfinite(node)):
            raise ValueError(f"metric {'.'.join(path)} is {node}; absent values carry a reason")
        return node

    return walk(tree, ()), reasons


def leaves(tree: Mapping[str, Any], prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(path, value) of every leaf of nested mappings, in order."""
    for key, child in tree.items():
        if isinstance(child, Mapping):
            yield from leaves(child, (*prefix, key))
        else:
            yield (*prefix, key), child


def mean(values: list[float | Absent]) -> float | Absent:
    """Mean of the values that exist; the first reason if none does."""
    numbers = [v for v in values if not isinstance(v, Absent)]
    if numbers:
        return math.fsum(numbers) / len(numbers)
    return next((v for v in values if isinstance(v, Absent)), Absent("there is nothing to average"))


def unit_of(name: str) -> str:
    """The unit of a metric, from the words of its name; "1" for counts, shares and scores."""
    words = name.removesuffix("_p99").split("_")
    if words[0] in ("bytes", "nll"):
        return {"bytes": "B", "nll": "nat"}[words[0]]
    if words[-1] in ("db", "sigma"):
        return {"db": "dB", "sigma": "sigma"}[words[-1]]
    return next((unit for unit in ("m", "rad", "px") if unit in words), "1")


@dataclass(frozen=True)
class Row:
    """One number of the long table. frame_index is -1 unless the number belongs to one view."""

    scope: str
    robot: str
    view_set: str
    frame_index: int
    name: str
    value: float | Absent


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document of finite numbers; the name appears only when the file is complete."""
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    with new_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_parquet(path: Path, rows: list[Row]) -> None:
    """Write the long table: scope, robot, view_set, frame_index (null: not of one view), name, value, unit, reason."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    values = [None if isinstance(r.value, Absent) else float(r.value) for r in rows]
    reasons = [r.value.reason if isinstance(r.value, Absent) else None for r in rows]
    table = pa.table(
        {
            "scope": pa.array([r.scope for r in rows], pa.string()),
            "robot": pa.array([r.robot or None for r in rows], pa.string()),
            "view_set": pa.array([r.view_set or None for r in rows], pa.string()),
            "frame_index": pa.array(
                [r.frame_index if r.frame_index >= 0 else None for r in rows], pa.int64()
            ),
            "name": pa.array([r.name for r in rows], pa.string()),
            "value": pa.array(values, pa.float64()),
            "unit": pa.array([unit_of(r.name) for r in rows], pa.string()),
            "reason": pa.array(reasons, pa.string()),
        }
    )
    with new_file(path) as part:
        pq.write_table(table, part, compression="zstd")
