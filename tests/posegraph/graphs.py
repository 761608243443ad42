"""Small pose graphs as files: robots on one noisy helix, with loops within and closures between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import se3, so3

Array = NDArray[np.float64]
KAPPA, TAU = 2000.0, 400.0  # 0.016 rad and 0.05 m
Row = tuple[int, int, Array]


def helix(n: int, turn: int = 8) -> Array:
    """True poses [n, 4, 4]: so many per turn, one meter above each other."""
    angle = 2 * np.pi * np.arange(n) / turn
    t = np.stack([2 * np.cos(angle), 2 * np.sin(angle), np.arange(n) / turn], axis=1)
    w = np.stack([0 * angle, 0 * angle, angle + np.pi / 2], axis=1)
    return se3.from_rotation_translation(so3.exp(w), t)


def helix_edges(n: int = 48, turn: int = 8, seed: int = 0) -> list[Row]:
    """Noisy odometry, and one edge from every second pose to the one a turn above."""
    rng, T = np.random.default_rng(seed), helix(n, turn)
    pairs = [(k, k + 1) for k in range(n - 1)] + [(k, k + turn) for k in range(0, n - turn, 2)]
    rows = []
    for i, j in pairs:
        w, v = rng.normal(size=3) / np.sqrt(2 * KAPPA), rng.normal(size=3) / np.sqrt(TAU)
        rows.append((i, j, se3.inverse(T[i]) @ T[j] @ se3.from_rotation_translation(so3.exp(w), v)))
    return rows


def wild_edges(n: int, count: int, seed: int = 0) -> list[Row]:
    """Edges that have nothing to do with the helix."""
    rng = np.random.default_rng(seed)
    rows = []
    while len(rows) < count:
        i, j = sorted(rng.integers(0, n, 2).tolist())
        if j - i > 2:
            rows.append((i, j, se3.from_quat_translation(rng.normal(size=4), 5 * rng.normal(size=3))))
    return rows


def symbol(robot: str, key: int) -> int:
    """gtsam's key of a character and an index."""
    return (ord(robot) << 56) + key


def g2o_line(i: int, j: int, T: Array, kappa: float = KAPPA, tau: float = TAU) -> str:
    """One edge; the information of a rotation is 2 kappa in radians, and g2o counts the quaternion's vector."""
    q = so3.to_quat_wxyz(T[:3, :3])[[1, 2, 3, 0]]
    information = np.diag(np.repeat([tau, 2 * kappa], 3))[np.triu_indices(6)]
    numbers = [*T[:3, 3], *q, *information]
    return f"EDGE_SE3:QUAT {i} {j} " + " ".join(repr(float(x)) for x in numbers) + "\n"


def write_g2o(path: Path, rows: Sequence[Row]) -> Path:
    """A graph in one file."""
    path.write_text("".join(g2o_line(i, j, T) for i, j, T in rows))
    return path


def write_team(folder: Path, rows: Sequence[Row], robots: int, n: int) -> Path:
    """One file per robot; an edge between two robots stands in both files, as it is distributed."""
    folder.mkdir()
    owner = [k * robots // n for k in range(n)]
    for a in range(robots):
        lines = [
            g2o_line(symbol("abcdefgh"[owner[i]], i), symbol("abcdefgh"[owner[j]], j), T)
            for i, j, T in rows
            if a in (owner[i], owner[j])
        ]
        (folder / f"{a}.g2o").write_text("".join(lines))
    return folder
