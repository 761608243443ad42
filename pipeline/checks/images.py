"""What the images show: repeated ones, depth that is missing or saturated, colors in the wrong order."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.progress import track
from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.messages import unpack_stamp
from duagc.pipeline.recording import Record, RgbdFrame
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics as topic_table

STUCK = 5  # equal images in a row
MANY_REPEATED = 0.4  # of all images
LITTLE_DEPTH = 0.2  # of the pixels
SATURATED = 65535
MUCH_SATURATED = 0.005
BINS = 8  # of a color histogram, per channel
SWAPPED_RATIO = 0.5  # distance of colors after exchanging red and blue, relative to before
DIFFERENT_COLORS = 0.15  # squared Hellinger distance


@dataclass
class Repeats:
    """How often the images of a topic come again. stamps_ns: publish times in the order of the log."""

    stamps_ns: list[int] = field(default_factory=list)
    repeated: int = 0
    longest: int = 1
    other_stamps: int = 0
    _run: int = 1
    _last: int = -1

    def add(self, record: Record) -> None:
        """Take in the next image."""
        image = record.proto()
        digest = zlib.crc32(image.data)
        same = digest == self._last and len(self.stamps_ns) > 0
        self._run = self._run + 1 if same else 1
        self.repeated += same
        self.longest, self._last = max(self.longest, self._run), digest
        self.stamps_ns.append(record.publish_time_ns)
        self.other_stamps += unpack_stamp(image) != record.publish_time_ns


def read_repeats(log: LogFile, robot: str) -> dict[str, Repeats]:
    """Read every image of a robot once, in the order of the log."""
    names = [row.of(robot) for row in (topic_table.COLOR, topic_table.DEPTH, topic_table.RAW_DEPTH)]
    found = {name: Repeats() for name in names if log.entries(name)}
    total = sum(len(log.entries(name)) for name in found)
    for record in track(log.records(sorted(found)), f"check {robot}", total):
        found[record.topic].add(record)
    return found


def check_repeats(robot: str, topic: str, repeats: Repeats) -> Iterator[Finding]:
    """Findings about images that come again."""
    count = len(repeats.stamps_ns)
    if repeats.other_stamps:
        yield Finding(
            Severity.WARNING,
            "times",
            robot,
            f"{repeats.other_stamps} images of {topic} say another time than their message",
            "one time",
            "the time of the message is used",
        )
    if repeats.repeated:
        stuck = repeats.longest >= STUCK or repeats.repeated > MANY_REPEATED * count
        yield Finding(
            Severity.WARNING if stuck else Severity.NOTE,
            "repeats",
            robot,
            f"{repeats.repeated} of {count} images of {topic} repeat the one before, {repeats.longest} in a row",
            "new images",
            "the camera stood still or its driver was stuck" if stuck else "",
        )


@dataclass(frozen=True)
class Sight:
    """What some frames of a robot show.

    Attributes:
        depth_m: percentiles 1, 50, 99 of the known depth, NaN if there is none.
        known: shares of the pixels.
        saturated: shares of the pixels.
        colors: histogram of RGB [BINS, BINS, BINS], sums to 1.
    """

    depth_m: tuple[float, float, float]
    known: float
    saturated: float
    colors: NDArray[np.float64]

    @staticmethod
    def of(frames: Iterator[RgbdFrame], scale: float) -> Sight:
        """From frames, of which every 4th row and column counts. scale: meters per unit."""
        depths, counts = [], np.zeros(BINS**3)
        for frame in frames:
            depths.append(frame.depth[::4, ::4].ravel())
            codes = (frame.color[::4, ::4].reshape(-1, 3) // (256 // BINS)).astype(np.int64)
            counts += np.bincount(codes @ [BINS * BINS, BINS, 1], minlength=BINS**3)
        depth = np.concatenate(depths)
        known = depth[depth > 0]
        low, middle, high = np.percentile(known, (1, 50, 99)) if len(known) else (np.nan,) * 3
        saturated = float((known >= (SATURATED - 0.5) * scale).mean()) if len(known) else 0.0
        colors = (counts / counts.sum()).reshape(BINS, BINS, BINS)
        return Sight((float(low), float(middle), float(high)), len(known) / len(depth), saturated, colors)


def check_sight(robot: str, sight: Sight) -> Iterator[Finding]:
    """Findings about missing and saturated depth."""
    if sight.known == 0:
        yield Finding(Severity.ERROR, "depth", robot, "no pixel has depth", "some depth in every image")
    elif sight.known < LITTLE_DEPTH:
        yield Finding(
            Severity.WARNING,
            "depth",
            robot,
            f"{sight.known:.0%} of the pixels have depth",
            f"more than {LITTLE_DEPTH:.0%}",
            "tracking and mapping use these alone",
        )
    if sight.saturated > MUCH_SATURATED:
        yield Finding(
            Severity.WARNING,
            "depth",
            robot,
            f"{sight.saturated:.1%} of the known depth is the largest number, {SATURATED}",
            "0 where nothing was measured",
            "let the converter take this number for none",
        )


def check_colors(sights: Mapping[str, Sight]) -> Iterator[Finding]:
    """Robots whose colors agree far better with red and blue exchanged: one of them has them in the wrong order."""
    for a, b in combinations(sorted(sights), 2):
        as_is = _distance(sights[a].colors, sights[b].colors)
        swapped = _distance(sights[a].colors, sights[b].colors.transpose(2, 1, 0))
        if as_is > DIFFERENT_COLORS and swapped < SWAPPED_RATIO * as_is:
            yield Finding(
                Severity.WARNING,
                "color order",
                b,
                f"its colors are those of {a} with red and blue exchanged",
                "the same order in all logs",
                "see whether the source is RGB or BGR",
            )


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Squared Hellinger distance of two histograms, 0 to 1."""
    return float(1 - np.sqrt(a * b).sum())
