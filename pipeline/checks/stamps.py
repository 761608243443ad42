"""Times of the images: order, rate, gaps, and which belong together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.config.checks import TimeChecks
from duagc.pipeline.recording.pairing import Pairing


def check_stamps(robot: str, topic: str, stamps_ns: Sequence[int], config: TimeChecks) -> Iterator[Finding]:
    """Findings about the times of one topic's images, in the order of the log.

    Args:
        robot: whose images they are.
        topic: of the images.
        stamps_ns: publish times, ns.
        config: thresholds.
    """
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
    if not config.rates_hz[0] <= rate <= config.rates_hz[1]:
        yield Finding(
            Severity.WARNING,
            "times",
            robot,
            f"{topic} has {rate:.3g} images a second",
            f"{config.rates_hz[0]:g} to {config.rates_hz[1]:g}",
            "see whether the times of the source are seconds, milliseconds or nanoseconds",
        )
    gaps = steps[steps > config.gap_ratio * np.median(steps)]
    if len(gaps):
        long = int((gaps > round(1e9 * config.long_gap_s)).sum())
        yield Finding(
            Severity.WARNING if long else Severity.NOTE,
            "gaps",
            robot,
            f"{topic} has {len(gaps)} gaps, {long} of them over {config.long_gap_s:g} s, the longest "
            f"{gaps.max() / 1e9:.3f} s",
            f"an image every {np.median(steps) / 1e6:.1f} ms",
            "tracking may be lost there" if long else "",
        )


def check_pairs(robot: str, pairing: Pairing, config: TimeChecks) -> Iterator[Finding]:
    """Findings about which depth belongs to which color.

    Args:
        robot: whose images they are.
        pairing: of its color and depth images.
        config: thresholds.
    """
    frames, alone = len(pairing.pairs), len(pairing.color_alone)
    own = len({depth for _, depth in pairing.pairs if depth is not None})
    few = own < config.min_paired * frames
    if few or alone:
        advice = "; see whether depth is missing, or the cameras have two clocks" if few else ""
        yield Finding(
            Severity.WARNING if few else Severity.NOTE,
            "pairs",
            robot,
            f"{own} depth images for {frames} color images; {alone} have none within "
            f"{pairing.tolerance_ns / 1e6:g} ms",
            "depth for every color image",
            f"shared depth is moved by the motion of the camera, and color without any is followed alone{advice}",
        )
    offsets = pairing.offsets_ns
    typical = float(np.median(offsets)) if len(offsets) else 0.0
    if abs(typical) > 1e9 * config.late_s:
        yield Finding(
            Severity.NOTE,
            "pairs",
            robot,
            f"depth is {typical / 1e6:+.1f} ms from its color (median)",
            f"within {1e3 * config.late_s:g} ms",
            "a run moves it by the motion of the camera; if a clock is wrong, correct its times",
        )
