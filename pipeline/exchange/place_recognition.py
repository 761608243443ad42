"""Place recognition: which pairs of keyframes may show the same place, and which of them are worth verifying.

To verify costs the neighbor's sample of a keyframe, some 80 kB. It brings the expected information about the relative
pose of the two robots, in nats:

    P(loop closure | score) (P(apart) gain of the first one + P(joined) gain in addition to the others)

The probability follows from the score, or from the overlap of both views where verified loop closures tell that
(`view_overlap`): then pairs are tried that descriptors alone would not have found. To verify with a sample that is
here already costs nothing but time.

A pair of robots is joined when at least `min_support` loop closures were verified. The nearer others are, the less a
further one adds: what was known before is the sum of their information, each with the drift of both odometries from
there to here added to its variance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.exchange import PlacesConfig
from duagc.pipeline.registration.descriptors import Descriptors, matches
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.place_index import PlaceIndex

FIRST_SIGMA = np.array([10.0, 1.0])  # of the relative frame before anything is known (m, rad)
MOST_LIKELY = 0.95
"""Probability of a loop closure for many matching descriptors; it falls as 1 - exp((4 - score) / 5). Counted on 413
tried pairs of RedKitchen and a scanned house: 56 % at 8 to 9 matches, 70 % at 10 to 12, 94, 90 and 96 % beyond."""
HALF_OVERLAP, OVERLAP_SCALE = 0.6, 0.06
"""Of the probability by overlap. Counted on 425 pairs of RedKitchen, fr1_desk and three simulated teams: 7 % at 0.4 to
0.5, 24, 56, 83, 90 and 100 % in the tenths from there on, 1 of 283 below."""
LEAST_OVERLAP = 0.4


@dataclass(frozen=True)
class Candidate:
    """Two keyframes, one of each robot, that may show the same place.

    Attributes:
        own_keyframe: index of the own keyframe.
        peer_keyframe: index of the neighbor's keyframe.
        score: number of matching descriptors.
        overlap: share of the own view that the other one should see; 0 if no loop closure says so.
    """

    own_keyframe: int
    peer_keyframe: int
    score: int
    overlap: float = 0.0

    @property
    def ends(self) -> tuple[int, int]:
        """Own keyframe and the neighbor's."""
        return self.own_keyframe, self.peer_keyframe

    @property
    def probability(self) -> float:
        """Of a loop closure, before it is verified."""
        by_score = MOST_LIKELY * (1.0 - float(np.exp((4.0 - self.score) / 5.0)))
        if self.overlap < LEAST_OVERLAP:
            return max(0.0, by_score)
        by_overlap = 1.0 + float(np.exp((HALF_OVERLAP - self.overlap) / OVERLAP_SCALE))
        return max(by_score, MOST_LIKELY / by_overlap)


def scored(
    own: list[Features], peer: list[Descriptors], ratio: float, min_score: int
) -> tuple[list[Candidate], list[Candidate]]:
    """Pairs of keyframes with at least `min_score` matches, best first; and those that come nearest for the rest.

    Of many own keyframes those are compared that `PlaceIndex` gives.

    Args:
        own: all features of each own keyframe.
        peer: the compact descriptors of each keyframe of the neighbor.
        ratio: of the ratio test of the matches.
        min_score: matches from which a pair is a candidate.
    Returns:
        Candidates; for every keyframe of the neighbor that resembles no own one enough, the pair that comes nearest.
    """
    candidates: list[Candidate] = []
    unlike: list[Candidate] = []
    index = PlaceIndex()
    for features in own:
        index.add(features.descriptors)
    for j, theirs in enumerate(peer):
        alike = index.alike(theirs)
        scores = [Candidate(i, j, len(matches(own[i].descriptors, theirs, ratio))) for i in alike]
        candidates += [c for c in scores if c.score >= min_score]
        if scores and max(c.score for c in scores) < min_score:
            unlike.append(max(scores, key=lambda c: (c.score, -c.own_keyframe)))
    return sorted(candidates, key=_best_first), unlike


class Planner:
    """Which samples to request from a neighbor next, given what became of the earlier candidates."""

    def __init__(
        self,
        candidates: Sequence[Candidate],
        config: PlacesConfig,
        *,
        drift_own: Array,
        drift_peer: Array,
        closures: LoopClosureConfig,
    ) -> None:
        """Start with all candidates.

        Args:
            candidates: best first.
            config: budget of requests.
            drift_own: [n, 2], variance along the own odometry (m^2, rad^2).
            drift_peer: [n, 2], the same of the neighbor.
            closures: for their least variance.
        """
        self.config, self.min_support = config, closures.min_support
        self.drift_own, self.drift_peer = drift_own, drift_peer
        self.variance = 2 * np.array([closures.sigma_floor_m**2, closures.sigma_floor_rad**2])
        self.left: dict[int, list[Candidate]] = {}  # by keyframe of the neighbor, the most probable first
        for c in candidates:
            self.left.setdefault(c.peer_keyframe, []).append(c)
        self.requested: set[int] = set()  # keyframes of the neighbor
        self._weaker: dict[tuple[int, int], Candidate] = {}  # of keyframes that were requested
        self._chosen: set[tuple[int, int]] = set()
        self._outcomes: list[tuple[Candidate, float]] = []  # and the probability that it is a loop closure

    def take(self, candidate: Candidate, closure: bool) -> None:
        """What became of a candidate.

        Args:
            candidate: that was tried.
            closure: whether it was verified as a loop closure.
        """
        self._chosen.add(candidate.ends)
        self._outcomes.append((candidate, float(closure)))

    def expect(self, overlaps: Mapping[tuple[int, int], float], score: Callable[[int, int], int]) -> None:
        """Take into account where views should overlap.

        Args:
            overlaps: share of the own view that the neighbor's should see, by own keyframe and the neighbor's.
            score: matching descriptors of a pair that was no candidate.
        """
        known = {c.ends: c for candidates in self.left.values() for c in candidates} | self._weaker
        for (i, j), overlap in overlaps.items():
            if overlap < LEAST_OVERLAP or (i, j) in self._chosen:
                continue
            before = known.get((i, j))
            of_keyframe = [c for c in self.left.get(j, []) if c.own_keyframe != i]
            new = Candidate(i, j, score(i, j) if before is None else before.score, overlap)
            self.left[j] = sorted([*of_keyframe, new], key=lambda c: (-c.probability, c.own_keyframe))
            self._weaker.pop((i, j), None)

    def next(self) -> list[Candidate]:
        """The next candidates to verify, those of some keyframes of the neighbor; none if nothing is worth it."""
        chosen: list[Candidate] = []
        for _ in range(self.config.keyframes_per_request):
            assumed = [*self._outcomes, *((c, c.probability) for c in chosen)]
            full = len(self.requested) >= self.config.max_requested_keyframes
            possible = [j for j in sorted(self.left) if j in self.requested or not full]
            worth = {j: self.worth(j, assumed) for j in possible}
            best = max(worth, key=lambda j: (worth[j], -j), default=None)
            if best is None or worth[best] < self.config.worth_nats:
                break
            of_keyframe, most = self.left.pop(best), self.config.candidates_per_keyframe
            chosen += of_keyframe[:most]
            self._weaker |= {c.ends: c for c in of_keyframe[most:]}
            self._chosen |= {c.ends for c in of_keyframe[:most]}
            self.requested.add(best)
        return chosen

    def not_requested(self) -> list[tuple[Candidate, str]]:
        """Every candidate with enough matches that was not verified, with the reason."""
        out = [(c, "its keyframe has better ones") for _, c in sorted(self._weaker.items())]
        full = len(self.requested) >= self.config.max_requested_keyframes
        for j, candidates in sorted(self.left.items()):
            reason = f"keyframe {j} is worth {self.worth(j, self._outcomes):.2f} nats"
            budget = f"the budget of {self.config.max_requested_keyframes} keyframes is used up"
            reason += f", {budget}" if full else f", {self.config.worth_nats:g} needed"
            out += [(c, reason) for c in candidates]
        return [(c, reason) for c, reason in out if c.score >= self.config.min_score]

    def worth(self, peer_keyframe: int, assumed: Sequence[tuple[Candidate, float]]) -> float:
        """Expected information (nats) of verifying the candidates of a keyframe of the neighbor.

        Args:
            peer_keyframe: index of this keyframe.
            assumed: candidates before it, each with the probability that it is a loop closure.
        """
        before, total = list(assumed), 0.0
        for c in self.left[peer_keyframe][: self.config.candidates_per_keyframe]:
            total += c.probability * self._gain(c, before)
            before.append((c, c.probability))
        return total

    def _gain(self, candidate: Candidate, before: Sequence[tuple[Candidate, float]]) -> float:
        """Information (nats) of a loop closure in addition to others that may exist."""
        apart = _fewer_than([p for _, p in before], self.min_support)
        first = 3 * float(np.log(FIRST_SIGMA**2 / self.variance).sum()) / 2
        if not before:
            return first
        i, j = np.array([(c.own_keyframe, c.peer_keyframe) for c, _ in before]).T
        between = np.abs(self.drift_own[i] - self.drift_own[candidate.own_keyframe])
        between = between + np.abs(self.drift_peer[j] - self.drift_peer[candidate.peer_keyframe])
        p = np.array([p for _, p in before])
        known = (p[:, None] / (self.variance + between)).sum(axis=0) + 1 / FIRST_SIGMA**2
        further = 3 * float(np.log1p(1 / (known * self.variance)).sum()) / 2
        return apart * first + (1 - apart) * further


def _fewer_than(probabilities: Sequence[float], count: int) -> float:
    """Probability that fewer than `count` of independent events happen."""
    happened = np.zeros(count)
    happened[0] = 1.0
    for p in probabilities:
        happened[1:] = happened[1:] * (1 - p) + happened[:-1] * p
        happened[0] *= 1 - p
    return float(happened.sum())


def _best_first(c: Candidate) -> tuple[int, int, int]:
    return -c.score, c.peer_keyframe, c.own_keyframe
