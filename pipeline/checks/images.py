"""What the images show: repeated ones, no light, depth that is missing or saturated, colors in the wrong order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.progress import track
from duagc.pipeline.checks.confidence import share_above
from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.config.checks import ImageChecks
from duagc.pipeline.frontend.failure import saturated_share_of
from duagc.pipeline.kernels.pyramid import gray_of_color
from duagc.pipeline.messages import unpack_stamp
from duagc.pipeline.recording import Record, RgbdFrame
from duagc.pipeline.recording.copies import copies, image_digest
from duagc.pipeline.recording.greatest_depth import SATURATED, greatest_apart
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics as topic_table

FEW_FRAMES = 0.1  # of a recording: so many with saturated or far depth are enough to be reported
BINS = 8  # of a color histogram, per channel
TAKE_FOR_NONE = "let the converter take it for none; `convert ros`: --set farthest_m=METERS"


@dataclass
class Repeats:
    """How often the images of a topic come again.

    Attributes:
        stamps_ns: publish times in the order of the log.
        digests: of all images.
        empty: depth images that are zero, unknown, everywhere. They repeat nothing.
        repeated: images that are the one before once more.
        longest: most of them in a row, the first one included.
        other_stamps: images that state another time than their message.
    """

    stamps_ns: list[int] = field(default_factory=list)
    digests: set[int] = field(default_factory=set)
    empty: int = 0
    repeated: int = 0
    longest: int = 1
    other_stamps: int = 0
    _run: int = 1
    _last: int = -1

    def add(self, record: Record) -> None:
        """Take in the next image.

        Args:
            record: of the topic, in the order of the log.
        """
        image = record.proto()
        digest = image_digest(image.data)
        empty = len(image.data) > 0 and not image.data.strip(b"\0")
        self.empty += empty
        same = digest == self._last and len(self.stamps_ns) > 0 and not empty
        self._run = self._run + 1 if same else 1
        self.repeated += same
        self.longest, self._last = max(self.longest, self._run), digest
        self.stamps_ns.append(record.publish_time_ns)
        self.digests.add(digest)
        self.other_stamps += unpack_stamp(image) != record.publish_time_ns


def read_repeats(log: LogFile, robot: str) -> dict[str, Repeats]:
    """Read every image of a robot once, in the order of the log.

    Args:
        log: of the robot.
        robot: its name.

    Returns:
        What repeats, by topic: color, depth and raw depth, those that have messages.
    """
    names = [row.of(robot) for row in (topic_table.COLOR, topic_table.DEPTH, topic_table.RAW_DEPTH)]
    found = {name: Repeats() for name in names if log.entries(name)}
    total = sum(len(log.entries(name)) for name in found)
    for record in track(log.records(sorted(found)), f"check {robot}", total):
        found[record.topic].add(record)
    return found


def check_repeats(robot: str, topic: str, repeats: Repeats, config: ImageChecks) -> Iterator[Finding]:
    """Findings about images that come again, and about empty ones.

    Args:
        robot: whose images they are.
        topic: of the images.
        repeats: of that topic.
        config: thresholds.
    """
    count = len(repeats.stamps_ns)
    if 0 < repeats.empty < count:
        yield Finding(
            Severity.WARNING if repeats.empty > FEW_FRAMES * count else Severity.NOTE,
            "depth",
            robot,
            f"{repeats.empty} of {count} images of {topic} have no depth at all",
            "some depth in every image",
            "what is nearer or farther than the sensor measures has none",
        )
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
        stuck = repeats.longest >= config.repeats_in_a_row or repeats.repeated > config.max_repeated * count
        yield Finding(
            Severity.WARNING if stuck else Severity.NOTE,
            "repeats",
            robot,
            f"{repeats.repeated} of {count} images of {topic} repeat the one before, {repeats.longest} in a row",
            "new images",
            "the camera stood still or its driver was stuck" if stuck else "",
        )


def check_copies(colors: Mapping[str, Repeats]) -> Iterator[Finding]:
    """Pairs of robots that have color images in common, byte for byte: one recording was given twice.

    Args:
        colors: color images by robot.
    """
    for robot, other, same in copies({name: repeats.digests for name, repeats in colors.items()}):
        yield Finding(
            Severity.ERROR,
            "copies",
            other,
            f"{same} of its color images are those of {robot}, byte for byte",
            "a recording of its own",
            "what one camera saw once would count twice",
        )


@dataclass(frozen=True)
class Sight:
    """What some frames of a robot show.

    Attributes:
        depth_m: percentiles 1, 50, 99 of the known depth, NaN if there is none.
        known: share of the pixels.
        saturated: share of the known depth.
        greatest_m: depth that is the greatest, and far beyond the next; 0: there is none such.
        depth_of_frames: [frames, 3], those percentiles of every frame that has depth.
        known_of_frames: [frames], share of the pixels of every frame.
        saturated_of_frames: [frames], share of the known depth of every frame.
        greatest_of_frames: [frames], share of the known depth of every frame that is exactly the greatest.
        unlit_of_frames: [frames], share of the pixels of every frame whose color is black or white.
        colors_of_frames: [frames, BINS, BINS, BINS], histogram of RGB of every frame, sums to 1.
        are_all: whether the robot has no other frames.
    """

    depth_m: tuple[float, float, float]
    known: float
    saturated: float
    greatest_m: float
    depth_of_frames: NDArray[np.float64]
    known_of_frames: NDArray[np.float64]
    saturated_of_frames: NDArray[np.float64]
    greatest_of_frames: NDArray[np.float64]
    unlit_of_frames: NDArray[np.float64]
    colors_of_frames: NDArray[np.float64]
    are_all: bool

    @property
    def colors(self) -> NDArray[np.float64]:
        """Histogram of RGB of all frames together, [BINS, BINS, BINS], sums to 1."""
        return np.asarray(self.colors_of_frames.mean(axis=0))

    def confidence(self, shown: NDArray[np.bool_], share: float = 0.5) -> float:
        """Probability that more than a share of the robot's frames shows what some of these do.

        Args:
            shown: [frames], whether each does.
            share: of all frames.
        """
        if self.are_all:
            return float(np.count_nonzero(shown) > share * len(shown))
        return share_above(int(np.count_nonzero(shown)), len(shown), share)

    @staticmethod
    def of(frames: Iterator[RgbdFrame], scale: float, of_frames: int) -> Sight:
        """From the usable pixels of frames, of which every 4th row and column counts.

        Args:
            frames: some of the robot's, or all.
            scale: meters per unit of depth.
            of_frames: how many frames the robot has.
        """
        depths, colors, unlit = [], [], []
        for frame in frames:
            usable = np.s_[:, :] if frame.mask is None else frame.mask[::4, ::4]
            depths.append(frame.depth[::4, ::4][usable].ravel())
            unlit.append(saturated_share_of(gray_of_color(frame.color[::4, ::4])[usable]))
            codes = (frame.color[::4, ::4][usable].reshape(-1, 3) // (256 // BINS)).astype(np.int64)
            counts = np.bincount(codes @ [BINS * BINS, BINS, 1], minlength=BINS**3)
            colors.append(counts / max(len(codes), 1))
        known = [depth[depth > 0] for depth in depths]
        together = np.concatenate(known)
        low, middle, high = _percentiles(together) if len(together) else (np.nan,) * 3
        largest_m = (SATURATED - 0.5) * scale
        greatest_m = greatest_apart(together)
        saturated = [float((k >= largest_m).sum() / max(len(k), 1)) for k in (together, *known)]
        return Sight(
            depth_m=(float(low), float(middle), float(high)),
            known=len(together) / max(sum(len(depth) for depth in depths), 1),
            saturated=saturated[0],
            greatest_m=greatest_m,
            depth_of_frames=np.array([_percentiles(depth) for depth in known if len(depth)]).reshape(-1, 3),
            known_of_frames=np.array(
                [len(k) / max(len(depth), 1) for k, depth in zip(known, depths, strict=True)]
            ),
            saturated_of_frames=np.array(saturated[1:]),
            greatest_of_frames=np.array([float((k == greatest_m).sum() / max(len(k), 1)) for k in known]),
            unlit_of_frames=np.array(unlit),
            colors_of_frames=np.array(colors).reshape(-1, BINS, BINS, BINS),
            are_all=len(depths) == of_frames,
        )


def _percentiles(depth: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.asarray(np.percentile(depth, (1, 50, 99)), dtype=np.float64)


def check_sight(robot: str, sight: Sight, config: ImageChecks) -> Iterator[Finding]:
    """Findings about missing and saturated depth.

    Args:
        robot: whose frames they are.
        sight: what some of them show.
        config: thresholds.
    """
    if sight.known == 0:
        yield Finding(
            Severity.ERROR,
            "depth",
            robot,
            "no pixel has depth",
            "some depth in every image",
            confidence=sight.confidence(sight.known_of_frames == 0),
        )
    elif sight.known < config.min_depth:
        yield Finding(
            Severity.WARNING,
            "depth",
            robot,
            f"{sight.known:.0%} of the pixels have depth",
            f"more than {config.min_depth:.0%}",
            "tracking and mapping use these alone",
            confidence=sight.confidence(sight.known_of_frames < config.min_depth),
        )
    if sight.saturated > config.max_saturated:
        yield Finding(
            Severity.WARNING,
            "depth",
            robot,
            f"{sight.saturated:.1%} of the known depth is the largest number, {SATURATED}",
            "0 where nothing was measured",
            TAKE_FOR_NONE,
            confidence=sight.confidence(sight.saturated_of_frames > config.max_saturated, FEW_FRAMES),
        )
    elif (shown := sight.greatest_of_frames > config.max_saturated).any():
        yield Finding(
            Severity.WARNING,
            "depth",
            robot,
            f"{np.median(sight.greatest_of_frames):.1%} of the known depth is exactly {sight.greatest_m:.3f} m, far "
            "beyond all other",
            "0 where nothing was measured",
            TAKE_FOR_NONE,
            confidence=sight.confidence(shown),
        )


def check_light(robot: str, sight: Sight, max_saturated: float) -> Iterator[Finding]:
    """Findings about color images that show nothing.

    Args:
        robot: its name.
        sight: what some of its frames show.
        max_saturated: share of black and white pixels above which the front end leaves a frame out.
    """
    unlit = sight.unlit_of_frames > max_saturated
    if unlit.any():
        yield Finding(
            Severity.ERROR if unlit.all() else Severity.WARNING,
            "light",
            robot,
            f"{np.count_nonzero(unlit)} of {len(unlit)} color images are black or white nearly everywhere",
            "images that show the scene",
            "see whether the lens is covered, and the exposure",
            confidence=sight.confidence(unlit),
        )


def check_colors(sights: Mapping[str, Sight], config: ImageChecks) -> Iterator[Finding]:
    """Robots whose colors agree far better with red and blue exchanged: one of them has them in the wrong order.

    Args:
        sights: what some frames show, by robot.
        config: thresholds.
    """
    for a, b in combinations(sorted(sights), 2):
        one, other = sights[a].colors, sights[b].colors
        as_is, swapped = _distance(one, other), _distance(one, other.transpose(2, 1, 0))
        if as_is > config.other_colors and swapped < config.swapped_ratio * as_is:
            yield Finding(
                Severity.WARNING,
                "color order",
                b,
                f"its colors are those of {a} with red and blue exchanged",
                "the same order in all logs",
                "see whether the source is RGB or BGR",
                confidence=_exchanged(one, sights[b].colors_of_frames),
            )


def _exchanged(colors: NDArray[np.float64], of_frames: NDArray[np.float64]) -> float:
    """Confidence that red and blue are exchanged, by how many frames agree better if they are."""
    votes = sum(_distance(colors, f.transpose(2, 1, 0)) < _distance(colors, f) for f in of_frames)
    return share_above(votes, len(of_frames))


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Squared Hellinger distance of two histograms, 0 to 1."""
    return float(1 - np.sqrt(a * b).sum())
