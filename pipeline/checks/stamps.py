"""Times of the images: order, rate, gaps, and which belong together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.recording.pairing import TOLERANCE_NS, Pairing

GAP_RATIO = 1.5  # an interval this much longer than the median one is a gap
LONG_GAP_NS = 500_000_000  # in this time a robot turns out of its last view
RATES_HZ = (0.5, 400.0)  # of cameras; outside it, times are more likely in a wrong unit
FEW_PAIRS = 0.95
LATE_NS = 10_000_000


def check_stamps(robot: str, topic: str, stamps_ns: Sequence[int]) -> Iterator[Finding]:
    """Findings about the times of one topic's images, in the order of the log."""
    times = np.asarray(stamps_ns, dtype=np.int64)
    steps = np.diff(times)
    back, twice = int((steps < 0).sum()), len(times) - len(np.unique(times))
    if back:
        yield Finding(
            Severity.WARNING,
            "times",
            robot,
            f"{topic} goes back in time {back} times",
            "increasing times",
            "images are used in order of time; see whether the clock of the source jumped",
        )
    if twice:
        yield Finding(
            Severity.WARNING,
            "times",
            robot,
            f"{twice} of {len(times)} images of {topic} repeat a time and are not used",
            "a time of its own for every image",
            "take the times of recording, or those of the headers, whichever differ",
        )
    steps = np.diff(np.unique(times))
    if not len(steps):
        return
    rate = 1e9 / float(np.median(steps))
    if not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        yield Finding(
            Severity.WARNING,
            "times",
            robot,
            f"{topic} has {rate:.3g} images a second",
            f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g}",
            "see whether the times of the source are seconds, milliseconds or nanoseconds",
        )
    gaps = steps[steps > GAP_RATIO * np.median(steps)]
    if len(gaps):
        long = int((gaps > LONG_GAP_NS).sum())
        yield Finding(
            Severity.WARNING if long else Severity.NOTE,
            "gaps",
            robot,
            f"{topic} has {len(gaps)} gaps, {long} of them over {LONG_GAP_NS / 1e9:g} s, the longest "
            f"{gaps.max() / 1e9:.3f} s",
            f"an image every {np.median(steps) / 1e6:.1f} ms",
            "tracking may be lost there" if long else "",
        )


def check_pairs(robot: str, pairing: Pairing) -> Iterator[Finding]:
    """Findings about which depth belongs to which color."""
    frames, alone = len(pairing.pairs), len(pairing.color_alone)
    if alone:
        few = frames < FEW_PAIRS * (frames + alone)
        yield Finding(
            Severity.WARNING if few else Severity.NOTE,
            "pairs",
            robot,
            f"{alone} of {frames + alone} color images have no depth within {TOLERANCE_NS / 1e6:g} ms",
            "depth for every color image",
            "they are left out" + ("; see whether the cameras have one clock" if few else ""),
        )
    offsets = np.array([depth - color for color, depth in pairing.pairs], dtype=np.int64)
    typical = float(np.median(offsets)) if len(offsets) else 0.0
    if abs(typical) > LATE_NS:
        yield Finding(
            Severity.WARNING,
            "pairs",
            robot,
            f"depth is {typical / 1e6:+.1f} ms from its color (median)",
            f"within {LATE_NS / 1e6:g} ms",
            "at 1 m/s this displaces depth by a centimeter or more; correct the times of one of them",
        )
