"""How far a camera can have come: no farther than its speed allows, and than is usual where it sees so far."""

from __future__ import annotations

from duagc.pipeline.config.frontend import FailureConfig
from duagc.pipeline.registration.align import reach_factor

FASTER = 2.0
"""Times the speed with which a camera was followed, by which it may be faster at other times."""


def fastest_m_s(followed_m_s: float, limits: FailureConfig) -> float:
    """The speed that a camera may have, m/s; vehicles are faster than what is carried by hand.

    Args:
        followed_m_s: with which it was followed.
        limits: the speed that any camera may have.
    """
    return max(limits.max_speed_m_s, FASTER * followed_m_s)


def farthest_m(speed_m_s: float, elapsed_s: float, seen_m: float, *, slack_m: float = 0.0) -> float:
    """How far a camera can have come in a time, meters.

    Args:
        speed_m_s: that it may have.
        elapsed_s: the time; nothing before 0.
        seen_m: median depth of what it sees.
        slack_m: what its places may be off besides.
    """
    return (speed_m_s * max(elapsed_s, 0.0) + slack_m) * reach_factor(seen_m)
