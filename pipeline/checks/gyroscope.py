"""Turns by a gyroscope against turns by registration: a mounting, unit or time that is wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from duagc.pipeline.checks.confidence import share_above
from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.checks.moves import Move
from duagc.pipeline.geometry import so3
from duagc.pipeline.recording import MotionPrior

FEWEST = 3  # pairs
LEAST_RAD = 0.02  # that registration and a bias may explain
MOST_SHARE = 0.5  # of the turn


def check_gyroscope(robot: str, found: Sequence[Move], prior: MotionPrior | None) -> Iterator[Finding]:
    """A finding if the gyroscope of a log does not know how the camera turns.

    Args:
        robot: its name.
        found: registered pairs.
        prior: how the camera moved by other sensors; None: there are none.
    """
    turned_rad, off_rad = [], []
    for move in found:
        motion = None if prior is None else prior.between(move.first_ns, move.second_ns)
        if motion is None or motion.knows_translation or move.T_first_second is None:
            continue
        R = move.T_first_second[:3, :3]
        turned_rad.append(float(np.linalg.norm(so3.log(R))))
        off_rad.append(float(np.linalg.norm(so3.log(R.T @ motion.T_start_stop[:3, :3]))))
    wrong = sum(
        off > max(LEAST_RAD, MOST_SHARE * turned) for off, turned in zip(off_rad, turned_rad, strict=True)
    )
    if len(off_rad) < FEWEST or 2 * wrong <= len(off_rad):
        return
    yield Finding(
        Severity.WARNING,
        "gyroscope",
        robot,
        f"the camera turns by {np.rad2deg(np.median(turned_rad)):.1f} deg between two frames, and its gyroscope is "
        f"{np.rad2deg(np.median(off_rad)):.1f} deg off (medians)",
        f"off by less than {MOST_SHARE:.0%} of the turn",
        "see whether its rates are in rad/s, how it is mounted and its times; a run corrects it or goes without it",
        confidence=share_above(wrong, len(off_rad)),
    )
