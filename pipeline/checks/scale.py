"""Lengths by registration against lengths by another sensor, where the camera translates enough to know them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.checks.confidence import above
from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.checks.moves import Move
from duagc.pipeline.config.checks import MotionChecks
from duagc.pipeline.geometry.statistics import mad_sigma

FEWEST = 2  # pairs


@dataclass(frozen=True)
class _Length:
    """Meters that a pair moved, by registration and by another sensor.

    random_m: standard deviation of both, by chance. mistaken_m: what its rotation may make of itself.
    """

    measured_m: float
    other_m: float
    random_m: float
    mistaken_m: float

    @property
    def sigma_m(self) -> float:
        return float(np.hypot(self.random_m, self.mistaken_m))

    @property
    def longer_m(self) -> float:
        """With a wrong scale, only one of the two may say that the camera translates."""
        return max(self.measured_m, self.other_m)


def check_scale(
    robot: str,
    found: Sequence[Move],
    sensor: str,
    lengths: Callable[[int, int], float | None],
    *,
    config: MotionChecks,
) -> Iterator[Finding]:
    """Compare lengths by registration with those of another sensor.

    A camera that turns and hardly translates does not observe scale: a share of the rotation, at the distance of what
    it sees, looks like a translation. So a pair counts if its length is beyond what that share and the covariance of
    the registration explain.

    Args:
        robot: its name.
        found: registered pairs.
        sensor: its name in words.
        lengths: meters moved between two times (ns), None where it does not know.
        config: of the checks.
    """
    known = [length for move in found if (length := _length(move, lengths, config)) is not None]
    observable = [length for length in known if length.longer_m > config.observable_sigmas * length.sigma_m]
    if len(known) >= FEWEST and len(observable) < FEWEST:
        yield _not_observable(robot, known, sensor, config.observable_sigmas)
    if len(observable) < FEWEST:
        return
    least = np.array([max(length.other_m, 1e-6) for length in observable])
    logs = np.log([max(length.measured_m, 1e-6) for length in observable]) - np.log(least)
    ratio = float(np.exp(np.median(logs)))
    sigma = _sigma_of_log(observable, logs)
    confidence = above(abs(float(np.log(ratio))), float(np.log(config.max_scale)), sigma)
    if confidence <= 0.5:
        return
    yield Finding(
        Severity.ERROR,
        "depth scale",
        robot,
        f"the camera moves {ratio:.3g} times as far by its depth as by {sensor} "
        f"({len(observable)} of {len(known)} pairs observe it)",
        "1",
        "depth_scale, or the unit of the poses, is wrong by this factor",
        confidence=confidence,
    )


def _length(move: Move, lengths: Callable[[int, int], float | None], config: MotionChecks) -> _Length | None:
    other_m = lengths(move.first_ns, move.second_ns)
    if move.T_first_second is None or other_m is None:
        return None
    measured_m = float(np.linalg.norm(move.T_first_second[:3, 3]))
    share = config.mistaken_share + abs(move.depth_offset_ns) / max(move.second_ns - move.first_ns, 1)
    random_m = float(np.hypot(move.sigma_m, config.reference_sigma_m))
    return _Length(measured_m, other_m, random_m, share * move.turned_rad * move.depth_m)


def _sigma_of_log(observable: Sequence[_Length], logs: np.ndarray) -> float:
    """Standard deviation of the logarithm of the median ratio: what differs between pairs, and what they share."""
    longer = np.array([length.longer_m for length in observable])
    spread = mad_sigma(logs - np.median(logs))
    random = np.array([length.random_m for length in observable]) / longer
    shared = float(np.median(np.array([length.mistaken_m for length in observable]) / longer))
    of_median = 1.2533 * max(spread, float(np.median(random))) / np.sqrt(len(observable))
    return float(np.hypot(of_median, shared))


def _not_observable(robot: str, known: Sequence[_Length], sensor: str, sigmas: float) -> Finding:
    moved_mm = 1000 * float(np.median([length.other_m for length in known]))
    needed_mm = 1000 * sigmas * float(np.median([length.sigma_m for length in known]))
    return Finding(
        Severity.NOTE,
        "depth scale",
        robot,
        f"the camera hardly translates, {moved_mm:.1f} mm between two frames by {sensor}",
        f"{needed_mm:.0f} mm or more, to tell a translation from its rotation"
        if np.isfinite(needed_mm)
        else "views that determine all directions of the motion",
        "nothing is known of the scale here",
    )
