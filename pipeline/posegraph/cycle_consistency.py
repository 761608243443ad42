"""Relative frames of many pairs of robots: cycles of three robots show which of them belong together.

Loop closures of one pair may form several groups, each of which agrees on another relative frame, because places look
alike; the pair alone cannot decide which group is right. Around a cycle of three robots the motions must compose to the
identity. Where they do not, and no other cycle confirms the links, the one that is weaker by far is left out. If there
is none, it cannot be decided which of them is false, and none of them counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    # with an infinite margin every cycle closes, which is no evidence
    detours = {} if math.isinf(margin) else _all_detours(pairs, margin)
    scores = {pair: _scores(proposals, detours.get(pair)) for pair, proposals in pairs.items()}
    best = {pair: int(np.argmax(score)) for pair, score in scores.items()}  # the first of equals
    cycles = _cycles(detours)
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
        around = placed @ se3.inverse(np.array([p.T_a_b for p in proposals]))
        fits = _closes(around, variance + [p.variance for p in proposals], margin).tolist()
        chosen[a, b] = fits.index(True) if any(fits) else None
        if chosen[a, b] is None:
            off_m, off_rad = (float(d) for d in se3.distance(placed, proposals[0].T_a_b))
            names = ", ".join(sorted({name for edge in path for name in edge} - {a, b}))
            contradictions[a, b] = f"is {off_m:.2f} m and {off_rad:.2f} rad off the path by {names}"
    return Placement(T_world_map, parent, chosen, contradictions, _undecided(pairs, cycles))


@dataclass(frozen=True)
class _Detours:
    """Paths of a pair by a third robot, for every proposal of the one link and every one of the other.

    Attributes:
        first: by third robot, in order of the names, its first path.
        weight: [m], of the weaker link of each path.
        confirms: bool [m, k], whether each path ends where each of the k direct proposals does.
    """

    first: dict[str, int]
    weight: Array
    confirms: NDArray[np.bool_]


def _all_detours(pairs: Mapping[Pair, Sequence[Proposal]], margin: float) -> dict[Pair, _Detours]:
    """The detours of every pair."""
    links = {(b, a): [p.reversed() for p in proposals] for (a, b), proposals in pairs.items()} | dict(pairs)
    motions = {link: np.array([p.T_a_b for p in proposals]) for link, proposals in links.items()}
    variances = {link: np.array([p.variance for p in proposals]) for link, proposals in links.items()}
    weights = {link: np.array([p.weight for p in proposals]) for link, proposals in links.items()}
    neighbors: dict[str, set[str]] = {}
    for a, b in links:
        neighbors.setdefault(a, set()).add(b)

    out = {}
    for a, b in pairs:
        thirds = sorted(neighbors[a] & neighbors[b])
        if not thirds:
            out[a, b] = _Detours({}, np.zeros(0), np.zeros((0, len(pairs[a, b])), dtype=bool))
            continue
        # every first link with every second one
        T = [(motions[a, c][:, None] @ motions[c, b]).reshape(-1, 4, 4) for c in thirds]
        variance = [(variances[a, c][:, None] + variances[c, b]).reshape(-1, 2) for c in thirds]
        weight = [np.minimum(weights[a, c][:, None], weights[c, b]).ravel() for c in thirds]
        first = np.cumsum([0, *(len(w) for w in weight[:-1])])
        around = np.concatenate(T)[:, None] @ se3.inverse(motions[a, b])
        limit = np.concatenate(variance)[:, None] + variances[a, b]
        out[a, b] = _Detours(
            dict(zip(thirds, first.tolist(), strict=True)),
            np.concatenate(weight),
            _closes(around, limit, margin),
        )
    return out


def _scores(proposals: Sequence[Proposal], detours: _Detours | None) -> Array:
    """Weight of every proposal [k] of a pair and what cycles of three robots add."""
    own = np.array([p.weight for p in proposals])
    if detours is None or not detours.first:
        return own
    confirmed = np.where(detours.confirms, detours.weight[:, None], 0.0)
    added = np.maximum.reduceat(confirmed, list(detours.first.values()), axis=0)
    return np.cumsum([own, *added], axis=0)[-1]  # in order of the names


def _cycles(detours: Mapping[Pair, _Detours]) -> dict[Cycle, bool]:
    """Every three robots that have all met, and whether some of their proposals close the cycle."""
    closes: dict[tuple[str, str, str], bool] = {}
    for (a, c), around in detours.items():
        if around.first:
            closed = np.logical_or.reduceat(around.confirms.any(axis=1), list(around.first.values()))
            closes |= {(a, b, c): bool(k) for b, k in zip(around.first, closed, strict=True)}
    return {((a, b), (b, c), (a, c)): closes[a, b, c] for a, b, c in sorted(closes) if a < b < c}


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


def _closes(T: Array, variance: Array, margin: float) -> NDArray[np.bool_]:
    """Whether motions [..., 4, 4] round cycles are none, within `margin` times their variance [..., 2]."""
    distance_m, angle_rad = se3.distance(np.eye(4), T)
    limit = CHI2_3_999 * margin * variance
    return np.asarray((distance_m**2 < limit[..., 0]) & (angle_rad**2 < limit[..., 1]))


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
