"""How sure a check can be of what it found in a part of a recording."""

from __future__ import annotations

from math import comb, erf, nextafter, sqrt


def share_above(supporting: int, of: int, share: float = 0.5) -> float:
    """Probability that more than a share of a recording shows what some of its parts show.

    The parts are taken as drawn at random, and every share as equally likely before: the posterior of the share is
    Beta(supporting + 1, of - supporting + 1).

    Args:
        supporting: parts that show it.
        of: parts that were looked at.
        share: of the recording.
    """
    terms = (comb(of + 1, j) * share**j * (1 - share) ** (of + 1 - j) for j in range(supporting + 1))
    return min(float(sum(terms)), nextafter(1.0, 0.0))  # parts are never all


def above(value: float, limit: float, sigma: float) -> float:
    """Probability that a number is above a limit, of which a value with a normal error was measured.

    Args:
        value: that was measured.
        limit: in the same unit.
        sigma: standard deviation of its error.
    """
    if sigma == 0:
        return float(value > limit)
    return 0.5 * (1 + erf((value - limit) / (sigma * sqrt(2))))
