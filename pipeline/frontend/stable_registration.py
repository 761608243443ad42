"""Registration from a poor guess, for frames that were not simply followed."""

from __future__ import annotations

from dataclasses import replace

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import TrackingConfig
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Outcome, Registration, RegistrationConfig, RgbdPyramid, register


def register_until_stable(
    keyframe: TrackedKeyframe,
    pyramid: RgbdPyramid,
    guess: Array,
    config: TrackingConfig,
    *,
    first: RegistrationConfig,
) -> Registration:
    """Register a view to a keyframe; OK only if the usual registration, started from the answer, stays there.

    Wide gates let wrong surfaces in, and from a start too far away a registration ends before the minimum. The
    brightness is brought to that of the keyframe first.

    Args:
        keyframe: the keyframe.
        pyramid: of the view.
        guess: T_keyframe_camera [4, 4].
        config: of tracking; its usual registration follows the first.
        first: settings of the first registration.
    """
    gain, offset = _equalizing(pyramid, keyframe, config.equalize_from_gain)
    if gain != 1:
        pyramid = pyramid.with_exposure(gain, offset)
    result = register(keyframe.reference, pyramid, guess, first)
    for _ in range(config.stable_rounds):
        if not result.ok:
            break
        before = result.T_reference_target
        result = register(keyframe.reference, pyramid, before, config.registration)
        moved_m, turned_rad = se3.distance(before, result.T_reference_target)
        if moved_m < config.stable_m and turned_rad < config.stable_rad:
            return _with_exposure(result, gain, offset)
    return replace(result, outcome=Outcome.JUMP) if result.ok else result


def _equalizing(pyramid: RgbdPyramid, keyframe: TrackedKeyframe, from_gain: float) -> tuple[float, float]:
    """Gain and offset that give a view the mean and spread of gray values of a keyframe; (1, 0) if nearly so.

    No more than fivefold: a black image does not become one that shows something.
    """
    there, here = keyframe.coarsest.gray, pyramid.levels[-1].gray
    gain = float(there.std()) / max(float(here.std()), 1e-3)
    if 1 / from_gain < gain < from_gain or not 0.2 < gain < 5:
        return 1.0, 0.0
    return gain, float(there.mean()) - gain * float(here.mean())


def _with_exposure(result: Registration, gain: float, offset: float) -> Registration:
    """A registration of an equalized view, gain * gray + offset, with the exposure of the view as it was."""
    if gain == 1:
        return result
    a, b = result.exposure
    return replace(result, exposure=(a / gain, (b - offset) / gain))
