"""Tracking of one RGB-D camera, frame to keyframe, without rendering.

Every frame is registered to the latest keyframe from a constant-velocity guess. If that fails, it is tried again from
other starts and with wider gates. If all fail the frame is `lost`: the log says so and why, and nothing is made of it.
A lost camera is looked for where it was last, and among all keyframes by features. What is found so counts only when
the next frame agrees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend.color_only import SoundFrame
from duagc.pipeline.frontend.failure import (
    Obstruction,
    Pace,
    Reason,
    SeenFrom,
    StuckImages,
    has_enough_depth,
    intruders,
    saturated_share,
)
from duagc.pipeline.frontend.keyframe_graph import KeyframePair, becomes_keyframe, predicted_overlap
from duagc.pipeline.frontend.relocalization import features_of, guesses
from duagc.pipeline.frontend.stable_registration import settle
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import MotionPrior
from duagc.pipeline.registration import Reference, Registration, RgbdPyramid, register
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.geometric_verification import features_agree

Array = NDArray[np.float64]
Image = NDArray[np.floating]
USUAL_FRAMES = 50  # whose residuals are the usual ones
GAP_INTERVALS = 3  # usual times between frames that make a gap
FEATURES_TO_SAY = 3  # times the inliers needed: a keyframe with fewer features cannot say where a view is


@dataclass(frozen=True)
class _Found:
    """A registration of a frame to a keyframe. without: why only its color, or only its depth, was used.

    doubted: it looked unlike the keyframe, and color alone was asked, which agrees.
    """

    keyframe_index: int
    result: Registration
    without: Reason = Reason.NONE
    doubted: bool = False

    def why_not(self) -> Reason:
        """Why it is not believed: the registration failed, or it ended well in a place that cannot be."""
        return Reason.OBSTRUCTED if self.result.ok else Reason(self.result.outcome.value)


@dataclass(frozen=True)
class _Unconfirmed:
    """A place where a lost camera may be, as of a time, and how many later frames agreed."""

    found: _Found
    stamp_ns: int
    agreed: int


class Tracker:
    """Tracks one camera. Feed it the frames in order."""

    def __init__(
        self, camera: PinholeCamera, config: FrontendConfig, motion: MotionPrior | None = None
    ) -> None:
        """Args:
        motion: how the camera moved by other sensors, where the log has any.
        """
        self.camera, self.config, self.motion = camera, config, motion
        self.keyframes: list[TrackedKeyframe] = []
        self.pairs: list[KeyframePair] = []
        """Registrations between keyframes, for `keyframes.refine`."""
        self._stuck = StuckImages(config.tracking.failure)
        self._current = 0  # keyframe that frames are tracked against
        self._T_keyframe_camera = np.eye(4)  # of the last frame that was tracked
        self._stamp_ns = 0  # of the same
        self._pace = Pace()
        self._velocity = np.zeros(6)  # right tangent per second, of the two frames before; zero after a loss
        self._lost = False
        self._unconfirmed: _Unconfirmed | None = None
        self._gray_rms: list[float] = []  # of the last frames that were followed
        self._obstruction = Obstruction(config.tracking.failure)
        self._contradiction = False  # of depth and color, which nothing has cleared up
        self._without_depth = self._without_color = 0  # frames in a row without a usable image
        self._sound: SoundFrame | None = None  # the last frame with both, nothing before it

    def track(
        self,
        frame_index: int,
        stamp_ns: int,
        image: Image,
        depth_m: Image,
        *,
        mask: NDArray[np.bool_] | None = None,
        depth_sigma_m: Image | None = None,
    ) -> TrackedFrame:
        """Track one frame; the first that can be used becomes keyframe 0 and the origin of the map.

        Args:
            stamp_ns: time of the frame, increasing.
            image: color [h, w, 3] or gray [h, w], 0..1. depth_m: [h, w], meters, 0 = unknown.
            mask: bool [h, w], False where a pixel must not be used; its depth counts as unknown. None = all may.
            depth_sigma_m: [h, w], standard deviation of the depth, meters; None: that of the sensor model.
        """
        if mask is not None:
            depth_m = np.where(mask, depth_m, 0)
        self._pace.look(stamp_ns)
        self._lost = self._lost or self._after_gap(stamp_ns)
        levels = len(self.config.tracking.strides)
        pyramid = RgbdPyramid.build(image, depth_m, self.camera, levels, depth_sigma_m)
        found = self._examine(frame_index, stamp_ns, pyramid)
        if found is None:
            return self._begin(frame_index, stamp_ns, pyramid)
        if isinstance(found, Reason):
            return self._lose(frame_index, stamp_ns, found)
        return self._accept(frame_index, stamp_ns, pyramid, found)

    def _examine(self, frame_index: int, stamp_ns: int, pyramid: RgbdPyramid) -> _Found | Reason | None:
        """Where a frame is, or why that is not known; None if it may become the first keyframe."""
        stuck = self._stuck.look(pyramid)
        if stuck is Reason.STUCK_COLOR:
            return self._follow_by_depth(stamp_ns, pyramid)
        self._without_color, without = 0, stuck
        if not has_enough_depth(pyramid, self.config.tracking.registration):
            without = Reason.NO_DEPTH
        if without is Reason.NONE:
            self._without_depth = 0
            return self._find(frame_index, stamp_ns, pyramid) if self.keyframes else None
        self._without_depth += 1
        return self._follow_by_color(stamp_ns, pyramid, without)

    def _follow_by_color(self, stamp_ns: int, pyramid: RgbdPyramid, without: Reason) -> _Found | Reason:
        """Follow a frame without depth by its color alone, for a while, if it looks as frames did before."""
        tracking = self.config.tracking
        enough = self._without_depth > tracking.failure.max_frames_without_depth
        if enough or self._lost or self._obstruction.standing or self._sound is None:
            return without
        predicted, known = self._predicted(stamp_ns)
        result = self._sound.follow(pyramid, predicted, tracking.registration, tracking.failure, known)
        found = _Found(self._current, result, without)
        return found if result.ok and self._looks_as_usual(result) else without

    def _follow_by_depth(self, stamp_ns: int, pyramid: RgbdPyramid) -> _Found | Reason:
        """Follow a frame whose color is stuck by its depth alone, for a few frames: walls do not hold it long."""
        self._without_color += 1
        tracking = self.config.tracking
        if (
            self._lost
            or not self.keyframes
            or self._without_color > tracking.failure.max_frames_without_color
        ):
            return Reason.STUCK_COLOR
        predicted, known = self._predicted(stamp_ns)
        by_depth = tracking.registration.model_copy(update={"residuals": "depth"})
        reference = self.keyframes[self._current].reference
        found = _Found(
            self._current, register(reference, pyramid, predicted, by_depth, known), Reason.STUCK_COLOR
        )
        return found if found.result.ok else Reason.STUCK_COLOR

    def _begin(self, frame_index: int, stamp_ns: int, pyramid: RgbdPyramid) -> TrackedFrame:
        """Make the first keyframe, unless the frame is held out or shows too little surface."""
        reference = Reference.from_pyramid(pyramid, self.config.tracking.strides)
        limits = self.config.tracking.registration
        used = reference.levels[: len(limits.iterations)]
        if is_held_out(frame_index) or any(len(level) < limits.min_samples for level in used):
            return self._lose(frame_index, stamp_ns, Reason.NO_DEPTH)
        self._add_keyframe(frame_index, stamp_ns, pyramid, -1, np.eye(4), None)
        self._stamp_ns, self._lost = stamp_ns, False
        self._sound = SoundFrame(pyramid, self.config.tracking.strides, np.eye(4), None)
        nothing = np.zeros((6, 6))
        return TrackedFrame(frame_index, stamp_ns, 0, np.eye(4), nothing, Status.OK, 1.0, 0.0, 0.0)

    def _accept(self, frame_index: int, stamp_ns: int, pyramid: RgbdPyramid, found: _Found) -> TrackedFrame:
        """Take over the pose of a frame; it becomes a keyframe if it sees much that is new."""
        keyframe_index, result = found.keyframe_index, found.result
        status = Status.RELOCALIZED if self._lost else Status.OK
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        followed = keyframe_index == self._current and not self._lost and elapsed_s > 0
        step = se3.inverse(self._T_keyframe_camera) @ result.T_reference_target
        # a stamp that came late makes the next interval too short
        elapsed_s = max(elapsed_s, 0.5 * self._pace.usual_s())
        self._velocity = se3.log(step) / elapsed_s if followed else np.zeros(6)
        if keyframe_index != self._current:
            self._sound = None
        self._current, self._T_keyframe_camera, self._lost = keyframe_index, result.T_reference_target, False
        self._stamp_ns, self._unconfirmed = stamp_ns, None
        if followed and found.without is Reason.NONE:
            self._gray_rms = [*self._gray_rms[1 - USUAL_FRAMES :], result.rms_gray]
        if found.without is Reason.NONE:
            self._contradiction = False
            self._obstruction.look(pyramid.levels[-1], self._seen_before(found))
            if not (found.doubted or self._obstruction.standing):
                T, strides = result.T_reference_target, self.config.tracking.strides
                self._sound = SoundFrame(pyramid, strides, T, result.information)
        if (
            not is_held_out(frame_index)
            and found.without is Reason.NONE
            and becomes_keyframe(result, pyramid, self.config.keyframes)
            and self._well_exposed(pyramid, result)
            and not self._obstruction.standing
        ):
            return self._promote(frame_index, stamp_ns, pyramid, keyframe_index, result, status)
        return TrackedFrame.by(frame_index, stamp_ns, keyframe_index, result, status, found.without)

    def _lose(self, frame_index: int, stamp_ns: int, reason: Reason) -> TrackedFrame:
        """A frame without a pose: it keeps the last known one, and says that it means nothing."""
        self._lost = True
        T, nothing = self._T_keyframe_camera, np.zeros((6, 6))
        return TrackedFrame(
            frame_index, stamp_ns, self._current, T, nothing, Status.LOST, 0.0, 0.0, 0.0, reason
        )

    # --- one frame ------------------------------------------------------------------------------------------------

    def _find(self, frame_index: int, stamp_ns: int, pyramid: RgbdPyramid) -> _Found | Reason:
        """Where a frame is, or why that is not known.

        Long lost, a camera is found when one frame and then as many as must confirm it are tracked from one place.
        """
        tracking = self.config.tracking
        if not self._long_lost(stamp_ns):
            return self._find_near(stamp_ns, pyramid)
        view = features_of(pyramid, tracking.relocalization)
        if self._unconfirmed is not None:
            found = self._confirm(stamp_ns, pyramid, view)
            if found is not None:
                return found
        near = self._find_near(stamp_ns, pyramid, view)
        place = near if isinstance(near, _Found) else self._find_place(frame_index, stamp_ns, pyramid, view)
        if place is None:
            return near if isinstance(near, Reason) else Reason.UNCONFIRMED
        if tracking.relocalization.confirmations == 0:
            return place
        self._unconfirmed = _Unconfirmed(place, stamp_ns, 0)
        return Reason.UNCONFIRMED

    def _long_lost(self, stamp_ns: int) -> bool:
        """Whether the camera is lost for so long that its last velocity says nothing any more."""
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        return self._lost and elapsed_s > self.config.tracking.max_extrapolation_s

    def _after_gap(self, stamp_ns: int) -> bool:
        """Whether no frame came for so long that the camera can be anywhere near; odometry bridges a gap."""
        usual_s, elapsed_s = self._pace.usual_s(), (stamp_ns - self._stamp_ns) * 1e-9
        longest_s = max(self.config.tracking.max_extrapolation_s, GAP_INTERVALS * usual_s)
        if not self.keyframes or elapsed_s <= longest_s:
            return False
        motion = self.motion.between(self._stamp_ns, stamp_ns) if self.motion is not None else None
        return motion is None or not motion.knows_translation

    def _find_near(
        self, stamp_ns: int, pyramid: RgbdPyramid, view: Features | None = None
    ) -> _Found | Reason:
        """The first registration that is OK from where the camera was last, or why the first one failed."""
        tracking, keyframe = self.config.tracking, self.keyframes[self._current]
        last, predicted, known = self._T_keyframe_camera, *self._predicted(stamp_ns)
        starts = [last] if predicted is last else [predicted, last]
        reason = Reason.NONE
        if not self._lost:
            for guess in starts:
                information = known if guess is predicted else None
                result = register(keyframe.reference, pyramid, guess, tracking.registration, information)
                found = _Found(self._current, result)
                why_not = found.why_not()
                if result.ok and self._tells_enough(pyramid, found) and self._followed(predicted, result):
                    undisputed = self._undisputed(stamp_ns, pyramid, found)
                    if isinstance(undisputed, _Found):
                        return undisputed
                    why_not = undisputed
                reason = reason if reason is not Reason.NONE else why_not
        view = features_of(pyramid, tracking.relocalization) if view is None else view
        for guess in starts:
            found = _Found(self._current, settle(keyframe, pyramid, guess, tracking, tracking.recovery))
            if found.result.ok and self._believable(stamp_ns, pyramid, found, view):
                undisputed = self._undisputed(stamp_ns, pyramid, found)
                if isinstance(undisputed, _Found):
                    return undisputed
            reason = reason if reason is not Reason.NONE else found.why_not()
        return reason

    def _undisputed(self, stamp_ns: int, pyramid: RgbdPyramid, found: _Found) -> _Found | Reason:
        """The same, if it looks as usual or color alone, where that can tell, puts the camera there too.

        If the two contradict each other, depth of another time holds the camera back: then color alone is believed,
        unless it says that the camera moved less, or something stands before it.
        """
        tracking = self.config.tracking
        largest = tracking.failure.doubtful_gray_of_usual * self._usual_gray_rms()
        if self._sound is None or not self._gray_rms or found.result.rms_gray <= largest:
            return found
        predicted, known = self._predicted(stamp_ns)
        by_color = self._sound.follow(pyramid, predicted, tracking.registration, tracking.failure, known)
        if not by_color.ok or by_color.rms_gray > largest:
            return Reason.CONTRADICTION if self._contradiction else found
        T, T_by_color = found.result.T_reference_target, by_color.T_reference_target
        if self._sound.agrees(T, T_by_color, tracking.failure, self._contradiction):
            return replace(found, doubted=True)
        self._contradiction = True
        obstructed = (
            self._obstruction.standing
            or (self._obstruction.intruded(pyramid.levels[-1], self._seen_before(found))[0])
        )
        held_back = self._sound.way_m(T) < self._sound.way_m(T_by_color)
        if self._lost or obstructed or not held_back or not self._looks_as_usual(by_color):
            return Reason.CONTRADICTION
        return _Found(self._current, by_color, Reason.CONTRADICTION)

    def _find_place(
        self, frame_index: int, stamp_ns: int, pyramid: RgbdPyramid, view: Features
    ) -> _Found | None:
        """The first keyframe, in the order of matching features, that the frame can be registered to."""
        config = self.config.tracking
        features = [keyframe.features for keyframe in self.keyframes]
        for index, guess in guesses(view, features, frame_index, config.relocalization):
            found = _Found(index, settle(self.keyframes[index], pyramid, guess, config, config.registration))
            if found.result.ok and self._believable(stamp_ns, pyramid, found, view):
                return self._by_latest(stamp_ns, pyramid, view, found)
        return None

    def _by_latest(self, stamp_ns: int, pyramid: RgbdPyramid, view: Features, found: _Found) -> _Found | None:
        """A place that was found, by the latest keyframe that shows enough of it; None if one contradicts.

        Between keyframes long apart lies what tracking erred on the way from one to the other. The way goes on from
        its end: by an early keyframe the camera would jump by all of that (5 cm in RedKitchen). A later keyframe that
        is not believed, but has the camera elsewhere, leaves it open where the camera is.
        """
        config, limits = self.config.tracking, self.config.tracking.relocalization
        T_map_camera = self.keyframes[found.keyframe_index].T_map_keyframe @ found.result.T_reference_target
        tried = 0
        for keyframe in reversed(self.keyframes[found.keyframe_index + 1 :]):
            guess = se3.inverse(keyframe.T_map_keyframe) @ T_map_camera
            if predicted_overlap(keyframe.reference, pyramid, guess) < limits.min_overlap:
                continue
            result = settle(keyframe, pyramid, guess, config, config.registration)
            later = _Found(keyframe.keyframe_index, result)
            if result.ok and self._believable(stamp_ns, pyramid, later, view):
                return later
            if result.ok and se3.distance(guess, result.T_reference_target)[0] > limits.max_contradiction_m:
                return None
            tried += 1
            if tried == limits.candidates:
                break
        return found

    def _confirm(self, stamp_ns: int, pyramid: RgbdPyramid, view: Features) -> _Found | Reason | None:
        """Track on from a place that was found; None if the frame does not agree with it."""
        assert self._unconfirmed is not None
        before, self._unconfirmed = self._unconfirmed, None
        index, last = before.found.keyframe_index, before.found.result.T_reference_target
        tracking = self.config.tracking
        result = settle(self.keyframes[index], pyramid, last, tracking, tracking.registration)
        found = _Found(index, result)
        moved_m, _ = se3.distance(last, result.T_reference_target)
        reach_m = self.config.tracking.failure.max_speed_m_s * (stamp_ns - before.stamp_ns) * 1e-9
        if not result.ok or moved_m > reach_m or not self._believable(stamp_ns, pyramid, found, view):
            return None
        if before.agreed + 1 >= self.config.tracking.relocalization.confirmations:
            return found
        self._unconfirmed = _Unconfirmed(found, stamp_ns, before.agreed + 1)
        return Reason.UNCONFIRMED

    def _followed(self, predicted: Array, result: Registration) -> bool:
        """Whether a frame that looks unlike its keyframe at least sees much of it, where it was expected, and
        contradicts no depth.

        Exposure that jumps makes frames look unlike, and a hand; another place that looks somewhat alike is also
        elsewhere: in RedKitchen a mirrored room would be followed 11 cm and 14 degrees beside the way. Burnt out
        images, of which half a keyframe is seen, are 11 cm off there.
        """
        tracking = self.config.tracking
        moved_m, turned_rad = se3.distance(predicted, result.T_reference_target)
        return result.rms_gray <= self._largest_gray_rms() or bool(
            min(result.overlap, result.view) >= tracking.failure.min_overlap_unlike
            and moved_m <= tracking.failure.slack_m
            and turned_rad <= tracking.failure.slack_rad
            and result.conflict <= tracking.relocalization.max_conflict
        )

    def _tells_enough(self, pyramid: RgbdPyramid, found: _Found) -> bool:
        """Whether what something before the camera leaves to be seen still says well where the camera is."""
        failure = self.config.tracking.failure
        # along weak directions a prior knows the pose, or the outcome would not be OK
        covariance = np.linalg.pinv(found.result.information, rcond=1e-12, hermitian=True)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if sigma_m <= failure.max_sigma_obstructed_m:
            return True
        return not self._obstruction.intruded(pyramid.levels[-1], self._seen_before(found))[0]

    def _believable(self, stamp_ns: int, pyramid: RgbdPyramid, found: _Found, view: Features) -> bool:
        """Whether a pose that was not simply followed can be true.

        It must be near enough, look much like the keyframe, intrude on no free space, and the features of the frame
        (`view`) must be where the keyframe has them. Where a keyframe has too few features to say, only a camera that
        was lost for a moment and is where it was expected is believed.
        """
        failure, relocalization = self.config.tracking.failure, self.config.tracking.relocalization
        keyframe, T = self.keyframes[found.keyframe_index], found.result.T_reference_target
        T_map_expected = self.keyframes[self._current].T_map_keyframe @ self._predicted(stamp_ns)[0]
        moved_m, turned_rad = se3.distance(T_map_expected, keyframe.T_map_keyframe @ T)
        elapsed_s = max((stamp_ns - self._stamp_ns) * 1e-9, 0.0)
        intruding, told = intruders(pyramid.levels[-1], keyframe.coarsest, T, failure)
        if (
            found.result.overlap < relocalization.min_overlap
            or found.result.conflict > relocalization.max_conflict
            or found.result.rms_gray > self._largest_gray_rms()
            or intruding > failure.max_intruders * told
            or moved_m > failure.max_speed_m_s * elapsed_s + failure.slack_m
        ):
            return False
        if len(keyframe.features) >= FEATURES_TO_SAY * relocalization.min_inliers:
            return features_agree(keyframe.features, view, T, relocalization)
        expected = moved_m <= failure.slack_m and turned_rad <= failure.slack_rad
        return bool(expected) and not self._long_lost(stamp_ns)

    def _largest_gray_rms(self) -> float:
        config = self.config.tracking.relocalization
        # depth of another time looks 2.5 times as bad as usual where it is 4 cm off: then nothing is added
        added = 0.0 if self._contradiction else config.max_gray_rms
        return added + config.max_gray_rms_of_usual * self._usual_gray_rms()

    def _usual_gray_rms(self) -> float:
        return float(np.median(self._gray_rms)) if self._gray_rms else 0.0

    def _predicted(self, stamp_ns: int) -> tuple[Array, Array | None]:
        """Where the camera should be in its keyframe, T_keyframe_camera [4, 4], and the information [6, 6] of that.

        By the motion prior of the log, else by the last velocity if that is not too old, which is no measurement
        (None), else where it was.
        """
        last, elapsed_s = self._T_keyframe_camera, (stamp_ns - self._stamp_ns) * 1e-9
        fresh = elapsed_s <= self.config.tracking.max_extrapolation_s
        followed = last @ se3.exp(self._velocity * elapsed_s) if fresh else last
        motion = self.motion.between(self._stamp_ns, stamp_ns) if self.motion is not None else None
        if motion is None:
            return followed, None
        config, T = self.config.tracking.prior, motion.T_start_stop
        path_m, angle_rad = se3.distance(np.eye(4), T)
        if motion.knows_translation:
            sigma_m = config.odometry_sigma_m + config.odometry_sigma_of_path * float(path_m)
            sigma_rad = config.odometry_sigma_rad + config.odometry_sigma_of_angle * float(angle_rad)
            return last @ T, np.diag([sigma_m**-2.0] * 3 + [sigma_rad**-2.0] * 3)
        sigma_rad = config.gyro_sigma_rad + config.gyro_sigma_rad_per_s * elapsed_s
        predicted = last @ T
        predicted[:3, 3] = followed[:3, 3]
        return predicted, np.diag([0.0] * 3 + [sigma_rad**-2.0] * 3)

    def _well_exposed(self, pyramid: RgbdPyramid, result: Registration) -> bool:
        """Whether a frame looks as its keyframe does, or that must be left and the frame is not burnt out.

        Where the exposure jumps, too dark and too bright images pass. They make poor keyframes.
        """
        if self._looks_as_usual(result):
            return True
        config = self.config.tracking
        leaving = min(result.overlap, result.view) < config.relocalization.min_overlap
        return leaving and saturated_share(pyramid.levels[0]) <= config.max_saturated

    def _looks_as_usual(self, result: Registration) -> bool:
        """Whether a frame is exposed as what it was registered to, and its gray values fit as usual."""
        largest = self.config.tracking.max_keyframe_gain
        return 1 / largest < result.exposure[0] < largest and result.rms_gray <= self._largest_gray_rms()

    def _seen_before(self, found: _Found) -> SeenFrom:
        """The keyframe that a frame was registered to, as its obstruction is judged by it."""
        keyframe = self.keyframes[found.keyframe_index]
        return SeenFrom(keyframe.coarsest, keyframe.T_map_keyframe, found.result.T_reference_target)

    # --- keyframes ------------------------------------------------------------------------------------------------

    def _promote(
        self,
        frame_index: int,
        stamp_ns: int,
        pyramid: RgbdPyramid,
        previous: int,
        result: Registration,
        status: Status,
    ) -> TrackedFrame:
        """Make a tracked frame the next keyframe; it then hangs on itself, with the information of its tracking."""
        T_map_keyframe = self.keyframes[previous].T_map_keyframe @ result.T_reference_target
        new = len(self.keyframes)
        self.pairs.append(KeyframePair(previous, new, result.T_reference_target, result.information))
        self._register_to_neighbors(pyramid, previous, T_map_keyframe, new)
        self._add_keyframe(frame_index, stamp_ns, pyramid, previous, T_map_keyframe, result)
        self._current, self._T_keyframe_camera = new, np.eye(4)
        self._sound = SoundFrame(pyramid, self.config.tracking.strides, np.eye(4), None)
        return replace(
            TrackedFrame.by(frame_index, stamp_ns, new, result, status), T_keyframe_camera=np.eye(4)
        )

    def _register_to_neighbors(
        self, pyramid: RgbdPyramid, previous: int, T_map_keyframe: Array, new: int
    ) -> None:
        """Register a new keyframe to the earlier ones that see most of it, the one it was tracked from excepted."""
        limits = self.config.keyframes
        # where it was tracked from looks at nearly the same place
        centers = np.array([keyframe.center_map for keyframe in self.keyframes])
        distance = np.linalg.norm(centers - centers[previous], axis=1)
        nearest = np.sort(np.argsort(distance, kind="stable")[: limits.optimization_candidates])
        candidates = []
        for keyframe in (self.keyframes[k] for k in nearest):
            T_keyframe_new = se3.inverse(keyframe.T_map_keyframe) @ T_map_keyframe
            overlap = predicted_overlap(keyframe.reference, pyramid, T_keyframe_new)
            if keyframe.keyframe_index != previous and overlap >= limits.neighbor_overlap:
                candidates.append((-overlap, -keyframe.keyframe_index, T_keyframe_new))
        candidates.sort(key=lambda candidate: candidate[:2])
        for _, negative_index, guess in candidates[: limits.neighbors]:
            result = register(
                self.keyframes[-negative_index].reference, pyramid, guess, self.config.tracking.registration
            )
            if result.ok and result.overlap >= limits.neighbor_overlap:
                self.pairs.append(
                    KeyframePair(-negative_index, new, result.T_reference_target, result.information)
                )

    def _add_keyframe(
        self,
        frame_index: int,
        stamp_ns: int,
        pyramid: RgbdPyramid,
        previous: int,
        T_map_keyframe: Array,
        result: Registration | None,
    ) -> None:
        gain, offset = 1.0, 0.0
        if result is not None:
            gain_before, offset_before = self.keyframes[previous].exposure
            gain, offset = (
                result.exposure[0] * gain_before,
                result.exposure[0] * offset_before + result.exposure[1],
            )
        self.keyframes.append(
            TrackedKeyframe(
                len(self.keyframes),
                frame_index,
                stamp_ns,
                previous,
                T_map_keyframe,
                Reference.from_pyramid(pyramid, self.config.tracking.strides),
                features_of(pyramid, self.config.tracking.relocalization),
                pyramid.levels[-1],
                (gain, offset),
            )
        )
