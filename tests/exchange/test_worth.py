"""What a candidate is worth, against its probability and its information written out."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.exchange import PlacesConfig
from duagc.pipeline.exchange.place_recognition import FIRST_SIGMA, MOST_LIKELY, Candidate, Planner

CLOSURES = LoopClosureConfig()
VARIANCE = 2 * np.array([CLOSURES.sigma_floor_m**2, CLOSURES.sigma_floor_rad**2])
DRIFT_OWN = np.stack([np.arange(40) * 0.01**2, np.arange(40) * 0.003**2], axis=1)
DRIFT_PEER = 3.0 * DRIFT_OWN


def planner(*candidates: Candidate) -> Planner:
    return Planner(candidates, PlacesConfig(), drift_own=DRIFT_OWN, drift_peer=DRIFT_PEER, closures=CLOSURES)


def test_the_more_descriptors_match_or_views_overlap_the_likelier_is_a_loop_closure() -> None:
    """The counted shares that stand next to the constants, within a tenth."""
    by_score = [Candidate(0, 0, score).probability for score in (0, 4, 8, 11, 20, 60)]
    np.testing.assert_allclose(by_score, [0, 0, 0.52, 0.72, 0.91, MOST_LIKELY], atol=0.01)
    by_overlap = [Candidate(0, 0, 0, overlap).probability for overlap in (0.39, 0.45, 0.55, 0.65, 0.75, 0.95)]
    np.testing.assert_allclose(by_overlap, [0, 0.07, 0.24, 0.56, 0.83, 0.95], atol=0.12)
    assert by_overlap == sorted(by_overlap)
    assert Candidate(0, 0, 20, 0.5).probability == by_score[4]  # the likelier of both


def gain(i: int, j: int, before: list[tuple[int, int, float]]) -> float:
    """Nats of a loop closure (i, j) if so many others exist, each with its probability; two join a pair of robots."""
    assert CLOSURES.min_support == 2
    none = np.prod([1 - p for _, _, p in before])
    one = 0.0
    for k, (_, _, p) in enumerate(before):
        one += p * np.prod([1 - q for m, (_, _, q) in enumerate(before) if m != k])
    known = 1 / FIRST_SIGMA**2
    for k, m, p in before:
        apart = np.abs(DRIFT_OWN[i] - DRIFT_OWN[k]) + np.abs(DRIFT_PEER[j] - DRIFT_PEER[m])
        known = known + p / (VARIANCE + apart)
    # of three directions of translation and three of rotation; half of log det after less before
    first = 0.5 * 3 * np.sum(np.log(FIRST_SIGMA**2 / VARIANCE))
    further = 0.5 * 3 * np.sum(np.log((known + 1 / VARIANCE) / known))
    return float((none + one) * first + (1 - none - one) * further)


@pytest.mark.parametrize(
    "before", [[], [(3, 4, 1.0)], [(3, 4, 1.0), (9, 2, 0.7)], [(3, 4, 0.2), (30, 38, 0.9)]]
)
def test_the_worth_of_a_sample_is_what_its_candidates_add_one_after_the_other(
    before: list[tuple[int, int, float]],
) -> None:
    one, other = Candidate(12, 7, 14), Candidate(15, 7, 9)
    plan = planner(one, other)
    expected = one.probability * gain(12, 7, before)
    expected += other.probability * gain(15, 7, [*before, (12, 7, one.probability)])
    assumed = [(Candidate(i, j, 10), p) for i, j, p in before]
    assert plan.worth(7, assumed) == pytest.approx(expected, rel=1e-12)
