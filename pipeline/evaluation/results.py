"""What an evaluation says: numbers, absent numbers with a reason, and the two files that hold them.

`metrics.json` follows the contract of docs/reference/metrics.md. An absent value is null there, never zero, and the
top-level map `reasons` says why, by the path of the value: {"team.ate_rmse_m": "..."}.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from duagc.pipeline.base.files import new_file


@dataclass(frozen=True)
class Absent:
    """A value that does not exist, and why."""

    reason: str


def split_reasons(tree: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Replace every Absent leaf of nested mappings by None and collect its reason under its dotted path.

    Args:
        tree: numbers, texts and Absent, in nested mappings.

    Returns:
        The tree with None for every Absent, and the reasons by dotted name.

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


def group_reasons(reasons: Mapping[str, str], robots: Collection[str]) -> dict[str, list[str]]:
    """Every reason once, with patterns of the names that it explains; `reason_of` reads them.

    Args:
        reasons: reason by dotted name, of all absent values.
        robots: names below "robots."; what all of them lack for the same reason is one pattern.

    Returns:
        Patterns by reason. `*.lpips` is that name anywhere, `team.*` is every absent value below "team".
    """
    anywhere: list[str] = []
    patterns = _patterns(reasons, robots, anywhere)
    frequent = Counter(name.rpartition(".")[2] for name in reasons).most_common()
    for key, count in frequent:
        alike = {why for name, why in reasons.items() if name.endswith(f".{key}")}
        useful = count > 1 and len(alike) == 1
        shorter = _patterns(reasons, robots, [*anywhere, key]) if useful else patterns
        if len(shorter) < len(patterns):
            anywhere.append(key)
            patterns = shorter
    grouped: dict[str, list[str]] = {}
    for pattern, reason in patterns.items():
        grouped.setdefault(reason, []).append(pattern)
    for name, reason in reasons.items():
        if reason_of(grouped, name) != reason:  # a pattern of another reason comes first
            grouped.setdefault(reason, []).append(name)
    return grouped


def _patterns(
    reasons: Mapping[str, str], robots: Collection[str], anywhere: Collection[str]
) -> dict[str, str]:
    """Reason by pattern, with the keys of `anywhere`, which have one reason each, as `*.key`."""
    patterns: dict[str, str] = {}
    rest: dict[str, str] = {}
    for name, reason in reasons.items():
        key = name.rpartition(".")[2]
        if key in anywhere and key != name:
            patterns[f"*.{key}"] = reason
        else:
            rest[name] = reason
    for name, reason in list(rest.items()):
        _, _, value = name.removeprefix("robots.").partition(".")
        alike = [f"robots.{robot}.{value}" for robot in robots]
        if len(alike) > 1 and name in alike and all(rest.get(other) == reason for other in alike):
            for other in alike:
                del rest[other]
            rest[f"robots.*.{value}"] = reason
    covered = {name: reason for name, reason in reasons.items() if name.rpartition(".")[2] not in anywhere}
    return patterns | _prefixes(rest, (), covered)


def _prefixes(
    reasons: Mapping[str, str], prefix: tuple[str, ...], covered: Mapping[str, str]
) -> dict[str, str]:
    """Names below a prefix as few patterns: `prefix.*` where all names of `covered` below it have one reason."""
    if len(reasons) == 1:
        return dict(reasons)
    pattern = ".".join((*prefix, "*"))
    if prefix:
        covered = {name: reason for name, reason in covered.items() if fnmatchcase(name, pattern)}
    if prefix and len(set(covered.values())) == 1:
        return {pattern: next(iter(reasons.values()))}
    children: dict[str, dict[str, str]] = {}
    for name, reason in reasons.items():
        children.setdefault(name.split(".")[len(prefix)], {})[name] = reason
    return {
        pattern: reason
        for child, below in children.items()
        for pattern, reason in _prefixes(below, (*prefix, child), covered).items()
    }


def reason_of(grouped: Mapping[str, Sequence[str]], name: str) -> str:
    """Why the value of a dotted name is absent; "" if no reason names it.

    The name itself counts before a key anywhere (`*.lpips`), and that before a pattern with a prefix.

    Args:
        grouped: patterns by reason, as `group_reasons` writes them.
        name: dotted name of the value.
    """
    for reason, patterns in grouped.items():
        if name in patterns:
            return reason
    for anywhere in (True, False):
        for reason, patterns in grouped.items():
            if any(p.startswith("*.") == anywhere and fnmatchcase(name, p) for p in patterns):
                return reason
    return ""


def leaves(tree: Mapping[str, Any], prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(path, value) of every leaf of nested mappings, in order.

    Args:
        tree: nested mappings.
        prefix: path of `tree` itself; it stands before every path.
    """
    for key, child in tree.items():
        if isinstance(child, Mapping):
            yield from leaves(child, (*prefix, key))
        else:
            yield (*prefix, key), child


def mean(values: list[float | Absent]) -> float | Absent:
    """Mean of the values that exist; the first reason if none does.

    Args:
        values: numbers and Absent, in any mix.
    """
    numbers = [v for v in values if not isinstance(v, Absent)]
    if numbers:
        return math.fsum(numbers) / len(numbers)
    return next((v for v in values if isinstance(v, Absent)), Absent("there is nothing to average"))


def unit_of(name: str) -> str:
    """The unit of a metric, from the words of its name; "1" for counts, shares and scores.

    Args:
        name: of the metric, as in metrics.json, without its path.
    """
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
    """Write a document of finite numbers; the name appears only when the file is complete.

    Args:
        path: of the file; replaced if it exists.
        document: numbers, texts and None in nested mappings and lists.

    Raises:
        ValueError: a number is not finite.
    """
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    with new_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_parquet(path: Path, rows: list[Row]) -> None:
    """Write the long table: scope, robot, view_set, frame_index (null: not of one view), name, value, unit, reason.

    Args:
        path: of the file; replaced if it exists.
        rows: of the table, in order.
    """
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
