"""Whether the poses of a path follow something that moves: a robot that drives ahead, a belt, the camera's own legs.

Registration and the strongest features follow what is near and rich in texture, even if it fills less than half of a
view. What moves is small, though, next to the place around it. So where the features that agree with two poses spread
less than the views do, weaker features are asked: if others agree on another motion, and spread wider, that is the
camera's.

Where a thing fills much of the views, keyframes are rare, and two of them may share little of the place: then frames
between them are asked. Two views may also differ too little to tell. What is known of a thing by one pair of views
holds in others: a pair that shows much of such things may follow them, too.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FrontendConfig, JudgmentConfig
from duagc.pipeline.frontend.bundle import Images, KeyframeView
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.bearing_judgment import bearings_contradict
from duagc.pipeline.registration.bearing_motion import BearingMatches
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.feature_motion import (
    agreeing,
    matched_features,
    motion_spread_wider,
    spread_m,
)
from duagc.pipeline.registration.features import Features, extract_from_pyramid

NARROW = 0.75
"""Spread of features, in that of the points of a view, below which weaker ones are asked."""
VERY_NARROW = 0.5
"""The same, below which frames between keyframes are asked, too."""
WEAKER = 4
"""How many times as many features are then looked for."""
KEPT = 16  # views whose weaker features are kept in memory
MUCH = 0.25  # of the features that agree with two poses

WITNESSES = (1 / 2, 1 / 4, 1, 1 / 8)
"""Which frames of a keyframe are asked, by their place among all of them, in this order."""
MUCH_WIDER = 2.0
"""Spread of features of the place, in that of those on what moves, where both are known by their motions alone."""

Ends = tuple[int, int]  # of a pair: the earlier keyframe, the later one


@dataclass(frozen=True)
class Witnesses:
    """Frames that became no keyframes, but may be asked.

    Attributes:
        frames: of the path, anchored to its keyframes.
        images: reads the images of a frame of the log, by its index; None: none may be asked.
    """

    frames: Sequence[TrackedFrame] = ()
    images: Images | None = None

    def of(self, keyframe: int) -> list[TrackedFrame]:
        """Some of the frames that were followed from a keyframe by color and depth, each once.

        Args:
            keyframe: of the path.
        """
        followed = [
            frame
            for frame in self.frames
            if frame.keyframe_index == keyframe
            and frame.status is not Status.LOST
            and frame.reason is Reason.NONE
            and not np.array_equal(frame.T_keyframe_camera, np.eye(4))
        ]
        last = len(followed) - 1
        chosen = dict.fromkeys(round(last * at) for at in WITNESSES) if followed else {}
        return [followed[k] for k in chosen]


NO_WITNESSES = Witnesses()


class WeakerFeatures:
    """Asks more features of keyframes than are kept of them, where those show little of the view."""

    def __init__(
        self,
        views: Sequence[KeyframeView],
        images: Images,
        config: FrontendConfig,
        witnesses: Witnesses = NO_WITNESSES,
    ) -> None:
        """Begin without having looked at an image.

        Args:
            views: of the keyframes.
            images: reads the images of a keyframe.
            config: of the front end.
            witnesses: frames between the keyframes.
        """
        self._views, self._images, self._config, self._witnesses = views, images, config, witnesses
        self._known: dict[int, Features] = {}

    def follows_thing(
        self, ends: Ends, T_first_second: Array, rng: np.random.Generator
    ) -> tuple[bool, Array | None]:
        """Whether a motion is that of something that moves in the place, and the one of the place, if it is known.

        Args:
            ends: two keyframes.
            T_first_second: [4, 4], the given motion.
            rng: draws the samples of RANSAC.

        Returns:
            Whether it is, and [4, 4]; None: two frames that are nearer to each other show it.
        """
        limits, (first, second) = self._config.keyframes.judgment, (self._views[k] for k in ends)
        share = _share_of_views(first, second, T_first_second, limits)
        if share is None or share >= NARROW:
            return False, None
        ours, theirs = (self._of(k) for k in ends)
        found = motion_spread_wider(ours, theirs, T_first_second, config=limits, rng=rng)
        if found is not None:
            return True, found.T_first_second
        very = share < VERY_NARROW and ends[1] == ends[0] + 1
        return very and self.witnessed(ends[0], rng), None

    def witnessed(self, keyframe: int, rng: np.random.Generator) -> bool:
        """Whether a frame between a keyframe and the next one shows that something that moves was followed.

        Args:
            keyframe: from which it was followed.
            rng: draws the samples of RANSAC.
        """
        limits, images = self._config.keyframes.judgment, self._witnesses.images
        if images is None:
            return False
        for frame in self._witnesses.of(keyframe):
            theirs = self._extracted(images(frame.frame_index, self._levels(keyframe)))
            ours, T = self._of(keyframe), frame.T_keyframe_camera
            agree = agreeing(*matched_features(ours, theirs, limits), T, limits)
            enough = np.count_nonzero(agree) >= limits.min_inliers
            if enough and motion_spread_wider(ours, theirs, T, config=limits, rng=rng) is not None:
                return True
            matched = BearingMatches.of(ours, theirs, limits.ratio, whatever_has_depth=True)
            if matched is not None and bearings_contradict(matched, T):
                return True
        return False

    def _levels(self, keyframe: int) -> int:
        return len(self._views[keyframe].reference.levels)

    def _of(self, keyframe: int) -> Features:
        """The features of a keyframe, the weaker ones included."""
        if keyframe not in self._known:
            while len(self._known) >= KEPT:
                del self._known[next(iter(self._known))]
            self._known[keyframe] = self._extracted(self._images(keyframe, self._levels(keyframe)))
        return self._known[keyframe]

    def _extracted(self, pyramid: RgbdPyramid) -> Features:
        limits = self._config.tracking.relocalization
        return extract_from_pyramid(pyramid, limits.max_width_px, WEAKER * limits.features)


def fills_views(
    first: KeyframeView, second: KeyframeView, T_first_second: Array, config: JudgmentConfig
) -> bool:
    """Whether the features that agree with a motion spread about as wide as the views do.

    Args:
        first: one keyframe.
        second: another.
        T_first_second: [4, 4], the motion.
        config: when a match agrees with a motion, and how many must.
    """
    share = _share_of_views(first, second, T_first_second, config)
    return share is not None and share >= NARROW


def _share_of_views(
    first: KeyframeView, second: KeyframeView, T_first_second: Array, config: JudgmentConfig
) -> float | None:
    """Spread of the features that agree with a motion, in that of the views.

    None if these are too few, or the coarsest image of a view has too little depth to know.
    """
    points = matched_features(first.features, second.features, config)
    agree = agreeing(*points, T_first_second, config)
    if np.count_nonzero(agree) < config.min_inliers:
        return None
    view_m = min(spread_m(view.coarsest.points) for view in (first, second))
    return spread_m(points[1][agree]) / view_m if view_m > 0 else None


def spreads_much_wider(
    first: Features, second: Features, motions: tuple[Array, Array], config: JudgmentConfig
) -> bool:
    """Whether of two motions that features of two views agree on, those of the other one alone spread much wider.

    Images follow what is near, as registration does: that they support the given motion says nothing then.

    Args:
        first: features of the first view.
        second: features of the second view.
        motions: T_first_second [4, 4] each, the given one and another.
        config: when a match agrees with a motion.
    """
    points = matched_features(first, second, config)
    given, other = (agreeing(*points, T, config) for T in motions)
    return spread_m(points[1][other & ~given]) > MUCH_WIDER * spread_m(points[1][given & ~other])


def much_of_them(
    places: Mapping[Ends, Array | None],
    pairs: Collection[Ends],
    T_map_keyframes: Array,
    *,
    views: Sequence[KeyframeView],
    config: JudgmentConfig,
) -> set[Ends]:
    """Pairs of whose features that agree with the poses many are of things that other pairs know to move.

    Args:
        places: pairs that follow such a thing, with the motion [4, 4] that the place shows, if it is known.
        pairs: others.
        T_map_keyframes: [k, 4, 4].
        views: of the k keyframes.
        config: when a match agrees with a motion.
    """

    def agree(ends: Ends) -> tuple[NDArray[np.int64], Callable[[Array], NDArray[np.bool_]]]:
        first, second = (views[k].features for k in ends)
        matched = matches(first.descriptors, second.descriptors, config.ratio)
        points = (of.points[at].astype(np.float64) for of, at in zip((first, second), matched.T, strict=True))
        ours, theirs = points
        return matched, lambda T: agreeing(ours, theirs, T, config)

    moves = [np.zeros(len(view.features), dtype=bool) for view in views]
    same: dict[Ends, NDArray[np.int64]] = {}
    for ends in sorted({*places, *pairs}):
        first, second = ends
        matched, by = agree(ends)
        with_poses = by(se3.inverse(T_map_keyframes[first]) @ T_map_keyframes[second])
        same[ends] = matched[with_poses]
        if ends in places:
            place = places[ends]
            thing = matched[with_poses if place is None else with_poses & ~by(place)]
            moves[first][thing[:, 0]] = moves[second][thing[:, 1]] = True
    known = -1
    while known != (known := sum(int(np.count_nonzero(of)) for of in moves)):
        for (first, second), matched in same.items():
            either = moves[first][matched[:, 0]] | moves[second][matched[:, 1]]
            moves[first][matched[:, 0]] = moves[second][matched[:, 1]] = either
    return {
        (first, second)
        for first, second in pairs
        if np.count_nonzero(moves[first][same[first, second][:, 0]]) > MUCH * len(same[first, second])
    }
