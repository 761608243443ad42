"""Recognising places: which pairs of keyframes may show the same place, by their features."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.registration.features import Descriptors, Features, matches


@dataclass(frozen=True)
class Candidate:
    """Two keyframes, one of each robot, that may show the same place; score = number of matching descriptors."""

    own_keyframe: int
    peer_keyframe: int
    score: int


@dataclass(frozen=True)
class Choice:
    """kept: pairs to verify, best first. left: pairs with enough matches that the budget leaves out, best first.

    unlike: for every keyframe of the neighbour that resembles no own one enough, the pair that comes nearest.
    """

    kept: list[Candidate]
    left: list[Candidate]
    unlike: list[Candidate]


def candidates(
    own: list[Features],
    peer: list[Descriptors],
    ratio: float,
    min_score: int,
    per_keyframe: int,
    max_keyframes: int,
) -> Choice:
    """Pairs of keyframes worth verifying.

    Args:
        own: all features of each own keyframe. peer: the compact descriptors of each keyframe of the neighbour.
        min_score: matches from which a pair counts. per_keyframe: pairs kept per keyframe of the neighbour.
        max_keyframes: keyframes of the neighbour that may be asked for, best scores first.
    """
    scored: list[Candidate] = []
    unlike: list[Candidate] = []
    for j, theirs in enumerate(peer):
        scores = [Candidate(i, j, len(matches(o.descriptors, theirs, ratio))) for i, o in enumerate(own)]
        scored += [c for c in scores if c.score >= min_score]
        if scores and max(c.score for c in scores) < min_score:
            unlike.append(max(scores, key=lambda c: (c.score, -c.own_keyframe)))
    scored.sort(key=lambda c: (-c.score, c.peer_keyframe, c.own_keyframe))
    taken: dict[int, int] = {}
    kept, left = [], []
    for c in scored:
        used = taken.get(c.peer_keyframe, 0)
        if used < per_keyframe and (used or len(taken) < max_keyframes):
            taken[c.peer_keyframe] = used + 1
            kept.append(c)
        else:
            left.append(c)
    return Choice(kept, left, unlike)
