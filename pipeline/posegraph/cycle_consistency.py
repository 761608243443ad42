"""Relative frames of many pairs of robots: cycles of three robots show which of them belong together.

Loop closures of one pair may form several groups, each of which agrees on another relative frame, because places look
alike; the pair alone cannot decide which group is right. Around a cycle of three robots the motions must compose to the
identity. Where they do not, and no other cycle confirms the links, the one that is weaker by far is left out. If there
is none, it cannot be decided which of them is false, and none of them counts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import CHI2_3_999
from duagc.pipeline.posegraph.spanning_tree import chain_frames, spanning_tree

Pair = tuple[str, str]
Cycle = tuple[Pair, Pair, Pair]
CLEAR = 0.5
"""A link whose weight is below this share of the next one's is the false one of a cycle that does not close."""


@dataclass(frozen=True)
class Proposal:
    """One relative frame of two robots, and the loop closures that agree on it.

    Attributes:
        support: number of these loop closures.
        T_a_b: [4, 4], map frame of the later name in that of the earlier one.
        variance: of the translation anywhere in the two maps and of the rotation (m^2, rad^2), by the loop closures
            and both robots' drift.
        agreement: share of what one robot measured that the other, placed like this, sees at the same place, 0 to 1.
    """

    support: int
    T_a_b: Array
    variance: tuple[float, float]
    agreement: float

    @property
    def weight(self) -> float:
        """How much it counts: by the rest of the images, and by the closures, which see the same few places again."""
        return self.agreement * math.sqrt(self.support)

    def reversed(self) -> Proposal:
        """The same from the side of the other robot."""
        return Proposal(self.support, se3.inverse(self.T_a_b), self.variance, self.agreement)


@dataclass(frozen=True)
class Placement:
    """Where the maps of all robots lie, and which proposal of every pair fits to that.

    Attributes:
        T_world_map: [4, 4] by robot, in the frame of its component's lowest name.
        parent: tree that they were placed along, by robot; None for a root.
        chosen: index of the proposal of every pair; None if none fits.
        contradictions: why no proposal of these pairs fits, in words.
        undecided: pairs of which some must be false without a sign of which, with the reason; they should be revoked.
    """

    T_world_map: dict[str, Array]
    parent: dict[str, str | None]
    chosen: dict[Pair, int | None]
    contradictions: dict[Pair, str]
    undecided: dict[Pair, str]


def place(pairs: Mapping[Pair, Sequence[Proposal]], robots: Sequence[str], margin: float) -> Placement:
    """Place all robots along the best supported tree; cycles of three robots add to the support of a proposal.

    A proposal counts its own weight, and for every third robot that of the weaker of the two other links, if the three
    motions close within `margin` times their variance.

    Args:
        pairs: proposals by (earlier, later) name.
        robots: all names.
        margin: factor on variances; infinite if cycles decide nothing.
    """
    scores = {pair: [_score(pair, k, pairs, margin) for k in range(len(pairs[pair]))] for pair in pairs}
    best = {pair: int(np.argmax(score)) for pair, score in scores.items()}  # the first of equals
    cycles = _cycles(pairs, margin)
    support = {pair: float(scores[pair][k]) for pair, k in best.items()} | _refuted(cycles)
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
        path = _path(a, b, parent)
        variance = np.array([pairs[edge][best[edge]].variance for edge in path]).sum(axis=0)
        fits = [_closes(placed @ se3.inverse(p.T_a_b), variance + p.variance, margin) for p in proposals]
        chosen[a, b] = fits.index(True) if any(fits) else None
        if chosen[a, b] is None:
            off_m, off_rad = (float(d) for d in se3.distance(placed, proposals[0].T_a_b))
            names = ", ".join(sorted({name for edge in path for name in edge} - {a, b}))
            contradictions[a, b] = f"is {off_m:.2f} m and {off_rad:.2f} rad off the path by {names}"
    return Placement(T_world_map, parent, chosen, contradictions, _undecided(pairs, cycles))


def _score(pair: Pair, k: int, pairs: Mapping[Pair, Sequence[Proposal]], margin: float) -> float:
    """Weight of a proposal and what cycles of three robots add."""
    a, b = pair
    proposal = pairs[pair][k]
    score = proposal.weight
    if math.isinf(margin):  # every cycle closes, which is no evidence
        return score
    thirds = sorted({name for other in pairs for name in other} - {a, b})
    for c in thirds:
        confirmed = [
            min(first.weight, second.weight)
            for first in _proposals(pairs, a, c)
            for second in _proposals(pairs, c, b)
            if _agree(first, second, proposal, margin)
        ]
        score += max(confirmed, default=0.0)
    return score


def _agree(first: Proposal, second: Proposal, direct: Proposal, margin: float) -> bool:
    """Whether the path by a third robot ends where the direct one does."""
    variance = np.array([first.variance, second.variance, direct.variance]).sum(axis=0)
    return _closes(first.T_a_b @ second.T_a_b @ se3.inverse(direct.T_a_b), variance, margin)


def _cycles(pairs: Mapping[Pair, Sequence[Proposal]], margin: float) -> dict[Cycle, bool]:
    """Every three robots that have all met, and whether some of their proposals close the cycle."""
    closed = {}
    for a, b, c in itertools.combinations(sorted({name for pair in pairs for name in pair}), 3):
        cycle = (a, b), (b, c), (a, c)
        if set(cycle) <= set(pairs):
            triples = itertools.product(pairs[a, b], pairs[b, c], pairs[a, c])
            closed[cycle] = any(_agree(ab, bc, ac, margin) for ab, bc, ac in triples)
    return closed


def _confirmed(cycles: Mapping[Cycle, bool]) -> set[Pair]:
    """Links of the cycles that close."""
    return {pair for cycle, closed in cycles.items() if closed for pair in cycle}


def _refuted(cycles: Mapping[Cycle, bool]) -> dict[Pair, float]:
    """No support for a link that spoils a cycle whose other two links stand in cycles that close."""
    confirmed = _confirmed(cycles)
    unconfirmed = [set(cycle) - confirmed for cycle, closed in cycles.items() if not closed]
    return {pair: 0.0 for links in unconfirmed if len(links) == 1 for pair in links}


def _undecided(pairs: Mapping[Pair, Sequence[Proposal]], cycles: Mapping[Cycle, bool]) -> dict[Pair, str]:
    """Links of cycles that do not close, if no other cycle confirms them and none is the weakest by far.

    A link with more loop closures than others may be the false one: alike places are seen again and again.
    """
    confirmed = _confirmed(cycles)
    out: dict[Pair, str] = {}
    for cycle, closed in cycles.items():
        weights = {p: max(k.weight for k in pairs[p]) for p in cycle if p not in confirmed}
        least, *rest = sorted(weights.values()) or [0.0]
        if closed or not rest or least < CLEAR * rest[0]:
            continue
        weighed = ", ".join(f"{a}-{b} {weight:.2f}" for (a, b), weight in sorted(weights.items()))
        reason = f"is in a cycle of three robots that does not close; which link is false is open ({weighed})"
        out |= dict.fromkeys(weights, reason)
    return out


def _proposals(pairs: Mapping[Pair, Sequence[Proposal]], a: str, b: str) -> list[Proposal]:
    """Proposals of a pair as motions from b to a."""
    if (a, b) in pairs:
        return list(pairs[a, b])
    return [p.reversed() for p in pairs.get((b, a), ())]


def _closes(T: Array, variance: Array, margin: float) -> bool:
    """Whether a motion round a cycle is none, within `margin` times its variance."""
    distance_m, angle_rad = (float(d) for d in se3.distance(np.eye(4), T))
    limit = CHI2_3_999 * margin * variance
    return bool(distance_m**2 < limit[0] and angle_rad**2 < limit[1])


def _path(a: str, b: str, parent: Mapping[str, str | None]) -> list[Pair]:
    """Links from a to b along the tree."""
    paths = []
    for robot in (a, b):
        path: list[Pair] = []
        while (nearer := parent[robot]) is not None:
            path.append((min(robot, nearer), max(robot, nearer)))
            robot = nearer
        paths.append(path)
    return [edge for edge in paths[0] if edge not in paths[1]] + [e for e in paths[1] if e not in paths[0]]
