"""Relative frames of many pairs of robots: cycles of three robots say which of them belong together.

Closures of one pair may form several groups, each of which agrees on another relative frame, because places look
alike; which group is right the pair cannot tell. Round a cycle of three robots the motions must compose to none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus.closures import CHI2_3_999, chain_frames, spanning_tree
from pipeline.geometry import se3

Array = NDArray[np.float64]
Pair = tuple[str, str]


@dataclass(frozen=True)
class Proposal:
    """One relative frame of two robots, and the closures that agree on it.

    support: how many. T_a_b: [4, 4], map frame of the later name in that of the earlier one. variance: of the
    translation anywhere in the two maps and of the rotation (m^2, rad^2), by the closures and both robots' drift.
    """

    support: int
    T_a_b: Array
    variance: tuple[float, float]

    def turned(self) -> Proposal:
        """The same as the other robot says it."""
        return Proposal(self.support, se3.inverse(self.T_a_b), self.variance)


@dataclass(frozen=True)
class Placement:
    """Where everybody's map lies, and which proposal of every pair fits to that.

    T_world_map: [4, 4] by robot, in the frame of its component's lowest name. parent: tree that they were placed
    along. chosen: proposal of every pair; None if none fits. contradictions: what is wrong with those pairs, in words.
    """

    T_world_map: dict[str, Array]
    parent: dict[str, str | None]
    chosen: dict[Pair, int | None]
    contradictions: dict[Pair, str]


def place(pairs: Mapping[Pair, Sequence[Proposal]], robots: Sequence[str], margin: float) -> Placement:
    """Place all robots along the best supported tree; cycles of three robots add to the support of a proposal.

    A proposal counts its own closures, and for every third robot as many as the weaker of the two other links has, if
    the three motions close within `margin` times their variance.

    Args:
        pairs: proposals by (earlier, later) name. robots: all names.
    """
    scores = {pair: [_score(pair, k, pairs, margin) for k in range(len(pairs[pair]))] for pair in pairs}
    best = {pair: int(np.argmax(score)) for pair, score in scores.items()}  # the first of equals
    support = {pair: float(scores[pair][k]) for pair, k in best.items()}
    frames = {pair: (pairs[pair][k].T_a_b, support[pair]) for pair, k in best.items()}
    T_world_map = chain_frames(frames, robots)
    parent = spanning_tree(support, robots)
    chosen: dict[Pair, int | None] = {}
    contradictions: dict[Pair, str] = {}
    for (a, b), proposals in pairs.items():
        if parent[a] == b or parent[b] == a:
            chosen[a, b] = best[a, b]
            continue
        placed = se3.inverse(T_world_map[a]) @ T_world_map[b]
        way = _way(a, b, parent)
        variance = np.array([pairs[edge][best[edge]].variance for edge in way]).sum(axis=0)
        fits = [_closes(placed @ se3.inverse(p.T_a_b), variance + p.variance, margin) for p in proposals]
        chosen[a, b] = fits.index(True) if any(fits) else None
        if chosen[a, b] is None:
            off_m, off_rad = (float(d) for d in se3.distance(placed, proposals[0].T_a_b))
            names = ", ".join(sorted({name for edge in way for name in edge} - {a, b}))
            contradictions[a, b] = f"is {off_m:.2f} m and {off_rad:.2f} rad off the way by {names}"
    return Placement(T_world_map, parent, chosen, contradictions)


def _score(pair: Pair, k: int, pairs: Mapping[Pair, Sequence[Proposal]], margin: float) -> int:
    """Closures of a proposal and what cycles of three robots add."""
    a, b = pair
    proposal = pairs[pair][k]
    score = proposal.support
    thirds = sorted({name for other in pairs for name in other} - {a, b})
    for c in thirds:
        confirmed = [
            min(first.support, second.support)
            for first in _turned(pairs, a, c)
            for second in _turned(pairs, c, b)
            if _closes(
                first.T_a_b @ second.T_a_b @ se3.inverse(proposal.T_a_b),
                np.array([first.variance, second.variance, proposal.variance]).sum(axis=0),
                margin,
            )
        ]
        score += max(confirmed, default=0)
    return score


def _turned(pairs: Mapping[Pair, Sequence[Proposal]], a: str, b: str) -> list[Proposal]:
    """Proposals of a pair as motions from b to a."""
    if (a, b) in pairs:
        return list(pairs[a, b])
    return [p.turned() for p in pairs.get((b, a), ())]


def _closes(T: Array, variance: Array, margin: float) -> bool:
    """Whether a motion round a cycle is none, within `margin` times its variance."""
    distance_m, angle_rad = (float(d) for d in se3.distance(np.eye(4), T))
    limit = CHI2_3_999 * margin * variance
    return bool(distance_m**2 < limit[0] and angle_rad**2 < limit[1])


def _way(a: str, b: str, parent: Mapping[str, str | None]) -> list[Pair]:
    """Links from a to b along the tree."""
    ways = []
    for robot in (a, b):
        way: list[Pair] = []
        while (nearer := parent[robot]) is not None:
            way.append((min(robot, nearer), max(robot, nearer)))
            robot = nearer
        ways.append(way)
    return [edge for edge in ways[0] if edge not in ways[1]] + [e for e in ways[1] if e not in ways[0]]
