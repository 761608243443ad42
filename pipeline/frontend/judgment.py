"""Whether optimized keyframe poses can be true: features and depth judge every pair of keyframes again.

The joint optimization finds the poses that explain the images best, starting from tracking. Where tracking went wrong
it ends in a wrong minimum, and its residuals look as usual. Matched features and free space are other evidence: they
took no part in it. A pair is contradicted if features that agree on one motion are far from where the poses have them,
or if one view stands in space that the other saw to be free. Features may be of something that moves with the camera,
which depth does not show: where others agree with the poses, images must support the motion of those that do not. And
poses that features confirm may follow something that moves (`followed_things`). Where a place repeats itself, they may
agree on a motion that is none (`repeated_places`). What contradicted pairs cut off from the largest part of the path is
not where the poses have it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.disjoint_sets import join, root_of
from duagc.pipeline.config.frontend import FrontendConfig, JudgmentConfig
from duagc.pipeline.frontend.bundle import Images, KeyframeView
from duagc.pipeline.frontend.failure import Reason, free_space_violations
from duagc.pipeline.frontend.followed_things import (
    NO_WITNESSES,
    Ends,
    WeakerFeatures,
    Witnesses,
    much_of_them,
    spreads_much_wider,
)
from duagc.pipeline.frontend.repeated_places import of_repeated_places
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import Level, RegistrationConfig, RgbdPyramid, register
from duagc.pipeline.registration.feature_judgment import FeatureJudgment, judge_motion


class PairVerdict(Enum):
    """What features and depth say of the motion between two keyframes."""

    CONFIRMED = "confirmed"
    OPEN = "open"
    FEATURES = "features"
    DEPTH = "depth"
    MOVED = "moved"

    @property
    def contradicts(self) -> bool:
        """Whether the motion cannot be true."""
        return self in (PairVerdict.FEATURES, PairVerdict.DEPTH, PairVerdict.MOVED)


@dataclass(frozen=True)
class Judgment:
    """Verdicts on pairs of keyframes, and what follows for each keyframe.

    Attributes:
        verdicts: of every pair that was judged.
        parts: of every keyframe, the part of the path that it is connected with, by its lowest keyframe.
        by_features: the motions that features agree on, of the pairs that they contradict.
        contradicted: the keyframes whose poses were rejected, each with the reason.
        following: keyframes from which something that moves was followed, to the next one, or from the last one on.
    """

    verdicts: Mapping[Ends, PairVerdict]
    parts: Sequence[int]
    by_features: Sequence[RelativePose]
    contradicted: Mapping[int, Reason]
    following: frozenset[int] = frozenset()

    @property
    def believes_all(self) -> bool:
        """Whether no pose is doubted."""
        return not self.contradicted and not self.following

    @property
    def may_be_corrected(self) -> bool:
        """Whether something else than what moves contradicts: of that, another optimization follows the same."""
        return any(of.contradicts and of is not PairVerdict.MOVED for of in self.verdicts.values())

    def follows(self, frame: TrackedFrame, keyframe: TrackedKeyframe) -> bool:
        """Whether a frame may have followed something that moves, away from its keyframe.

        Args:
            frame: as it was tracked.
            keyframe: to which it is anchored.
        """
        anchored = frame.frame_index != keyframe.frame_index and frame.status is not Status.LOST
        return anchored and frame.keyframe_index in self.following

    def corrected(self, pairs: Sequence[RelativePose]) -> list[RelativePose]:
        """Pairs that may be true, and what features say instead of the others.

        Where features have two parts of the path elsewhere, no registration between the parts counts: those of which
        features say nothing were made from the same wrong poses, and state that they are exact.

        Args:
            pairs: registrations and loop closures.
        """
        elsewhere = {self._between(pair.i, pair.j) for pair in self.by_features} - {None}
        kept = [
            pair
            for pair in pairs
            if self._between(pair.i, pair.j) not in elsewhere
            and not self.verdicts.get((pair.i, pair.j), PairVerdict.OPEN).contradicts
        ]
        return [*kept, *self.by_features]

    def _between(self, first: int, second: int) -> Ends | None:
        """The parts of two keyframes, in order; None: they are in the same one."""
        low, high = sorted((self.parts[first], self.parts[second]))
        return None if low == high else (low, high)


def judge(
    T_map_keyframes: Array,
    views: Sequence[KeyframeView],
    factors: Sequence[RelativePose],
    config: FrontendConfig,
    *,
    images: Images,
    seed: int,
    robot: str,
    witnesses: Witnesses = NO_WITNESSES,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    part: str = "judgment",
) -> Judgment:
    """Judge the poses of all keyframes.

    Args:
        T_map_keyframes: [k, 4, 4], optimized.
        views: of the k keyframes.
        factors: which keyframes see each other.
        config: limits.
        images: reads the images of a keyframe.
        seed: of the random stream.
        robot: of the random stream.
        witnesses: frames between the keyframes, asked where keyframes do not tell what moves.
        checkpoints: of the stage.
        part: its name there.
    """
    found: dict[Ends, _Finding] = {}
    weaker = WeakerFeatures(views, images, config, witnesses)
    pairs = _judged(len(views), factors, config.keyframes.judgment)
    done = 0
    if (saved := checkpoints.resume(part)) is not None:
        done, found = saved
    for count, ends in enumerate(pairs[done:], done + 1):
        first, second = ends
        T_first_second = se3.inverse(T_map_keyframes[first]) @ T_map_keyframes[second]
        rng = random_streams.generator(seed, "frontend.judgment", robot=robot, first=first, second=second)
        finding = _judged_pair(ends, views, T_first_second, config, images=images, rng=rng)
        if not finding.verdict.contradicts:
            follows, place = weaker.follows_thing(ends, T_first_second, rng)
            finding = _Finding(PairVerdict.MOVED, place) if follows else finding
        found[ends] = finding
        checkpoints.at(part, count, len(pairs), lambda: found)
    found |= _without_repeated(found, T_map_keyframes, views, config.keyframes.judgment)
    verdicts = {ends: finding.verdict for ends, finding in found.items()}
    by_features = [
        RelativePose(*ends, finding.T_first_second, finding.information)
        for ends, finding in found.items()
        if finding.T_first_second is not None and finding.information is not None
    ]
    places = {
        ends: finding.T_first_second
        for ends, finding in found.items()
        if finding.verdict is PairVerdict.MOVED
    }
    if places:
        others = [ends for ends, verdict in verdicts.items() if not verdict.contradicts]
        also = much_of_them(places, others, T_map_keyframes, views=views, config=config.keyframes.judgment)
        verdicts |= dict.fromkeys(also, PairVerdict.MOVED)
    parts = _parts(len(views), verdicts)
    sizes = {part: parts.count(part) for part in set(parts)}
    main = max(sizes, key=lambda part: (sizes[part], -part))
    rejected = {k: _reason(k, verdicts) for k, part in enumerate(parts) if part != main}
    rng = random_streams.generator(seed, "frontend.judgment.last", robot=robot)
    following = _following(len(views) - 1, verdicts, weaker, rng)
    return Judgment(verdicts, parts, by_features, rejected, following)


@dataclass(frozen=True)
class _Finding:
    """What is said of one pair.

    Attributes:
        verdict: on the poses.
        T_first_second: [4, 4], the motion that features show instead.
        information: [6, 6] of it, of those that are corrected.
        off_rad: median angle by which features are off where they confirm the poses.
    """

    verdict: PairVerdict
    T_first_second: Array | None = None
    information: Array | None = None
    off_rad: float = 0.0


def _without_repeated(
    found: Mapping[Ends, _Finding],
    T_map_keyframes: Array,
    views: Sequence[KeyframeView],
    config: JudgmentConfig,
) -> dict[Ends, _Finding]:
    """The findings that say nothing, for they come of a place that repeats itself."""
    contradictions = {
        ends: finding.T_first_second
        for ends, finding in found.items()
        if finding.verdict.contradicts and finding.T_first_second is not None
    }
    confirmed = {
        ends: finding.off_rad for ends, finding in found.items() if finding.verdict is PairVerdict.CONFIRMED
    }
    repeated = of_repeated_places(contradictions, confirmed, T_map_keyframes, views=views, config=config)
    return dict.fromkeys(repeated, _Finding(PairVerdict.OPEN))


def _judged_pair(
    ends: Ends,
    views: Sequence[KeyframeView],
    T_first_second: Array,
    config: FrontendConfig,
    *,
    images: Images,
    rng: np.random.Generator,
) -> _Finding:
    """What the features that are kept of two keyframes say of a motion between them, or depth where they do not."""
    limits, (first, second) = config.keyframes.judgment, (views[k] for k in ends)
    found = judge_motion(first.features, second.features, T_first_second, config=limits, rng=rng)
    contradicted = found is not None and contradicts(found, limits)
    if found is not None and contradicted and found.with_given >= limits.min_inliers:
        pyramid = images(ends[1], len(first.reference.levels))
        registration = config.tracking.registration
        if not _images_support(found, first, pyramid, registration, T_given=T_first_second):
            motions = T_first_second, found.T_first_second
            if spreads_much_wider(first.features, second.features, motions, limits):
                return _Finding(PairVerdict.MOVED, found.T_first_second)
            found = None
    if found is None:
        return _Finding(_by_depth(first.coarsest, second.coarsest, T_first_second, config))
    if contradicted:
        return _Finding(PairVerdict.FEATURES, found.T_first_second, found.information)
    return _Finding(PairVerdict.CONFIRMED, off_rad=found.given_rad)


def _judged(count: int, factors: Sequence[RelativePose], config: JudgmentConfig) -> list[Ends]:
    """Of every keyframe the pairs with the two before it, so that a wrong one is stepped over, and the earliest others.

    Args:
        count: number of keyframes.
        factors: which of them see each other.
        config: how many others.
    """
    earlier: list[set[int]] = [set() for _ in range(count)]
    for factor in factors:
        earlier[factor.j].add(factor.i)
    chosen = []
    for second, firsts in enumerate(earlier):
        before = {first for first in (second - 2, second - 1) if first >= 0}
        chosen += [(first, second) for first in sorted(before)]
        chosen += [(first, second) for first in sorted(firsts - before)[: config.neighbors]]
    return chosen


def contradicts(found: FeatureJudgment, limits: JudgmentConfig) -> bool:
    """Whether features are so far from where a motion has them that it cannot be true.

    Args:
        found: what they say.
        limits: how far they may be.
    """
    return found.given_rad > max(limits.max_angle_rad, limits.max_angle_of_own * found.own_rad)


def _images_support(
    found: FeatureJudgment,
    view: KeyframeView,
    pyramid: RgbdPyramid,
    config: RegistrationConfig,
    *,
    T_given: Array,
) -> bool:
    """Whether a registration from the motion that features agree on ends nearer to it than to the given one, [4, 4]."""
    result = register(view.reference, pyramid, found.T_first_second, config)
    depth_m = float(np.median(view.features.points[:, 2]))

    def away_rad(T: Array) -> float:
        moved_m, turned_rad = se3.distance(result.T_reference_target, T)
        return float(moved_m / depth_m + turned_rad)

    return result.ok and away_rad(found.T_first_second) < away_rad(T_given)


def _by_depth(first: Level, second: Level, T_first_second: Array, config: FrontendConfig) -> PairVerdict:
    """What depth says of a pair: whether one view stands in space that the other saw to be free."""
    limits = config.keyframes.judgment
    ways = ((second, first, T_first_second), (first, second, se3.inverse(T_first_second)))
    for seen, other, T_other_seen in ways:
        violations, visible = free_space_violations(seen, other, T_other_seen, config.tracking.failure)
        enough = visible >= limits.min_visible * seen.inverse_depth.size
        if enough and violations > limits.max_free_space_violations * visible:
            return PairVerdict.DEPTH
    return PairVerdict.OPEN


def _parts(count: int, verdicts: Mapping[Ends, PairVerdict]) -> list[int]:
    """The part of the path, by its lowest keyframe, that each keyframe is connected with.

    Confirmed pairs connect. A pair that nothing can be said of connects two parts that no pair contradicts.
    """
    parent = list(range(count))

    def part(k: int) -> int:
        return root_of(parent, k)

    for (first, second), verdict in verdicts.items():
        if verdict is PairVerdict.CONFIRMED:
            join(parent, first, second)
    against = [ends for ends, verdict in verdicts.items() if verdict.contradicts]
    for (first, second), verdict in sorted(verdicts.items()):
        if verdict is PairVerdict.OPEN and part(first) != part(second):
            between = {part(first), part(second)}
            if not any({part(i), part(j)} == between for i, j in against):
                join(parent, first, second)
    return [part(k) for k in range(count)]


def _following(
    last: int, verdicts: Mapping[Ends, PairVerdict], weaker: WeakerFeatures, rng: np.random.Generator
) -> frozenset[int]:
    """Keyframes from which something that moves was followed, to the next one, or from the last one on."""
    moved = {first for first in range(last) if verdicts[first, first + 1] is PairVerdict.MOVED}
    ends = last - 1 in moved or weaker.witnessed(last, rng)
    return frozenset(moved | ({last} if ends else set()))


def _reason(keyframe: int, verdicts: Mapping[Ends, PairVerdict]) -> Reason:
    """What contradicts a keyframe's pose, or that of the part that it belongs to."""
    against = [verdict for ends, verdict in verdicts.items() if keyframe in ends and verdict.contradicts]
    if PairVerdict.MOVED in against:
        return Reason.SOMETHING_MOVED
    by_depth = against.count(PairVerdict.DEPTH) > against.count(PairVerdict.FEATURES)
    return Reason.CONTRADICTED_BY_DEPTH if by_depth else Reason.CONTRADICTED_BY_FEATURES
