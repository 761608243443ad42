"""Edges of public pose graphs: `.g2o` and the csv of Kimera-Multi.

Weights are SE-Sync's: tau = 3 / trace of the covariance's translation block, kappa = 3 / (2 trace of its rotation
block), so that costs compare with certified optima.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry import se3

SYMBOL_BITS = 56  # a gtsam symbol is a character in the highest byte and an index below it
_IGNORED_TAGS = {
    "VERTEX_SE3:QUAT",
    "FIX",
    "PARAMS_SE3OFFSET",
}  # start values and gauge: agents find their own

MAX_TRANSLATION_M = 1e6  # as far as robots can tell each other
WEIGHTS = (1e-18, 1e18)  # of the information and of kappa and tau
QUATERNION_NORMS = (1e-3, 1e3)
_SINGULAR = 1e-13  # least eigenvalue of a block by its greatest, each direction scaled to one
KIMERA_COLUMNS = [
    "robot_src",
    "pose_src",
    "robot_dst",
    "pose_dst",
    "qx",
    "qy",
    "qz",
    "qw",
    "tx",
    "ty",
    "tz",
    "kappa",
    "tau",
]
"""Of `measurements.csv` of Kimera-Multi, which may have more."""

Key = tuple[str, int]
"""Robot (or "" before a graph is cut), index."""


@dataclass(frozen=True)
class Edges:
    """Measured relative poses as a file lists them.

    Attributes:
        i: key of the pose that each is seen from.
        j: key of the pose that is seen.
        T_i_j: [m, 4, 4], pose j's frame to pose i's.
        kappa: [m], SE-Sync's weight of the rotation.
        tau: [m], SE-Sync's weight of the translation, 1/m^2.
        inlier: bool [m], what a reference file names as true, for the evaluation; None if there is none.
    """

    i: list[Key]
    j: list[Key]
    T_i_j: Array
    kappa: Array
    tau: Array
    inlier: NDArray[np.bool_] | None = None

    def select(self, keep: NDArray[np.bool_]) -> Edges:
        """The edges of a mask.

        Args:
            keep: bool [m].
        """
        at = np.flatnonzero(keep).tolist()
        inlier = None if self.inlier is None else self.inlier[keep]
        i, j = [self.i[k] for k in at], [self.j[k] for k in at]
        return Edges(i, j, self.T_i_j[keep], self.kappa[keep], self.tau[keep], inlier)


def read_g2o(path: Path) -> Edges:
    """Edges of one `.g2o` file in 3-D; keys with a gtsam symbol name their robot by its character.

    Args:
        path: the file.

    Raises:
        DuagError: names the line that is not understood, or whose numbers nobody can compute with.
    """
    i: list[Key] = []
    j: list[Key] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path, "a pose graph").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0] in _IGNORED_TAGS:
            continue
        if "SE2" in words[0] or words[0] in ("VERTEX2", "EDGE2"):
            raise DuagError(f"{path}: line {number} is {words[0]}: a 2-D graph, expected 3-D (EDGE_SE3:QUAT)")
        if words[0] != "EDGE_SE3:QUAT":
            raise DuagError(f"{path}: line {number} is {words[0]}, expected VERTEX_SE3:QUAT or EDGE_SE3:QUAT")
        try:
            keys, row = [int(word) for word in words[1:3]], [float(word) for word in words[3:]]
        except ValueError:
            raise DuagError(f"{path}: line {number} holds something that is not a number") from None
        sound = len(row) == 28 and np.isfinite(row).all() and min(keys) >= 0 and max(keys) < 1 << 64
        if not sound or not any(row[3:7]):
            raise DuagError(
                f"{path}: line {number} is not an edge: 2 keys of 64 bits and 28 finite numbers expected"
            )
        ends = [_symbol(key) for key in keys]
        _check_ends(path, number, ends[0], ends[1])
        named = [end[0] for end in (*i[:1], *ends) if end[0]]  # names of robots
        if named and len(named) < len(ends) + len(i[:1]):
            raise DuagError(
                f"{path}: line {number}: found keys {keys[0]} and {keys[1]}, expected all keys of the file plain "
                f"or all of them gtsam symbols, which name their robot"
            )
        i.append(ends[0])
        j.append(ends[1])
        rows.append(row)
        lines.append(number)
    if not rows:
        raise DuagError(f"{path}: no EDGE_SE3:QUAT in this file")
    values = np.array(rows)
    upper = values[:, 7:]
    _check_motions(path, lines, values[:, :3], values[:, 3:7])
    _check(path, lines, "information", np.abs(upper).max(axis=1), limits=(0.0, WEIGHTS[1]))
    diagonal = upper[:, np.equal(*np.triu_indices(6))]
    positive = np.where(diagonal > 0, diagonal, np.inf).min(axis=1)  # others are refused for their sign
    _check(path, lines, "information", np.where(np.isinf(positive), 1.0, positive), limits=WEIGHTS)
    kappa, tau = _isotropic(upper, path, lines)
    _check(path, lines, "kappa", kappa, limits=WEIGHTS)
    _check(path, lines, "tau", tau, limits=WEIGHTS)
    return Edges(i, j, se3.from_quat_translation(values[:, [6, 3, 4, 5]], values[:, :3]), kappa, tau)


def _check_motions(path: Path, lines: list[int], t: Array, quats: Array) -> None:
    """Refuse motions that no robot can send on, and quaternions [m, 4] that hardly are any."""
    lengths, norms = (np.hypot.reduce(v, axis=1) for v in (t, quats))  # squares might overflow
    _check(path, lines, "translation in m", lengths, limits=(0.0, MAX_TRANSLATION_M))
    _check(path, lines, "quaternion norm", norms, limits=QUATERNION_NORMS)


def _check(path: Path, lines: list[int], topic: str, found: Array, *, limits: tuple[float, float]) -> None:
    """Refuse the first line whose value is not within the limits."""
    least, most = limits
    outside = np.flatnonzero(~((found >= least) & (found <= most)))
    if len(outside):
        number, value = lines[outside[0]], found[outside[0]]
        raise DuagError(f"{path}: line {number}: {topic} found {value:.3g}, expected {least:g} to {most:g}")


def _symbol(key: int) -> Key:
    character = key >> SYMBOL_BITS
    return (chr(character), key & ((1 << SYMBOL_BITS) - 1)) if character else ("", key)


def _check_ends(path: Path, number: int, i: Key, j: Key) -> None:
    """Refuse an edge from a pose to itself: it says nothing, and no graph has a place for it."""
    if i == j:
        raise DuagError(
            f"{path}: line {number} is an edge from pose {i[1]} to itself, expected an edge between two poses"
        )


def _isotropic(upper: Array, path: Path, lines: list[int]) -> tuple[Array, Array]:
    """SE-Sync's kappa and tau [m] from the upper triangles [m, 21] of the information matrices."""
    at = np.triu_indices(6)
    full = np.zeros((len(upper), 6, 6))
    full[:, at[0], at[1]] = full[:, at[1], at[0]] = upper
    for block in (full[:, :3, :3], full[:, 3:, 3:]):
        diagonal = np.diagonal(block, axis1=1, axis2=2)
        root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        values = np.linalg.eigvalsh(block / root[:, :, None] / root[:, None, :])
        bad = ~(values[:, 0] > _SINGULAR * values[:, -1]) | (diagonal <= 0).any(axis=1)
        if bad.any():
            k = int(np.argmax(bad))
            raise DuagError(
                f"{path}: line {lines[k]}: the information of edge {k + 1} is singular or indefinite, "
                f"expected positive definite"
            )
    tau = 3 / np.trace(np.linalg.inv(full[:, :3, :3]), axis1=1, axis2=2)
    kappa = 3 / (2 * np.trace(np.linalg.inv(full[:, 3:, 3:]), axis1=1, axis2=2))
    return kappa, tau


def read_kimera(path: Path) -> Edges:
    """Edges of one robot's `measurements.csv` of Kimera-Multi; `weight` and `is_known_inlier` are ignored.

    Args:
        path: the file.

    Raises:
        DuagError: a column is missing, or a line is not understood or has numbers that nobody can compute
            with.
    """
    reader = csv.DictReader(read_text(path, "a pose graph").splitlines(), skipinitialspace=True)
    missing = [name for name in KIMERA_COLUMNS if name not in (reader.fieldnames or [])]
    if missing:
        raise DuagError(f"{path}: no column {missing[0]}, expected {', '.join(KIMERA_COLUMNS)}")
    i: list[Key] = []
    j: list[Key] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, fields in enumerate(reader, start=2):
        try:
            ids = [int(fields[name]) for name in KIMERA_COLUMNS[:4]]
            row = [float(fields[name]) for name in KIMERA_COLUMNS[4:]]
        except (TypeError, ValueError):
            raise DuagError(f"{path}: line {number} holds something that is not a number") from None
        if min(ids) < 0 or not np.isfinite(row).all() or min(row[7:]) <= 0 or not any(row[:4]):
            raise DuagError(f"{path}: line {number} is not a measurement with positive kappa and tau")
        i.append((f"robot{ids[0]}", ids[1]))
        j.append((f"robot{ids[2]}", ids[3]))
        _check_ends(path, number, i[-1], j[-1])
        rows.append(row)
        lines.append(number)
    if not rows:
        raise DuagError(f"{path}: no measurements in this file")
    v = np.array(rows)
    _check_motions(path, lines, v[:, 4:7], v[:, :4])
    _check(path, lines, "kappa", v[:, 7], limits=WEIGHTS)
    _check(path, lines, "tau", v[:, 8], limits=WEIGHTS)
    return Edges(i, j, se3.from_quat_translation(v[:, [3, 0, 1, 2]], v[:, 4:7]), v[:, 7], v[:, 8])
