"""Registration of views whose images have depth on less than half: features without depth say where they are, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import TrackingConfig
from duagc.pipeline.frontend.current_frame import CurrentFrame
from duagc.pipeline.registration import Reference, Registration, RegistrationConfig, RgbdPyramid, register
from duagc.pipeline.registration.bearing_judgment import bearings_contradict
from duagc.pipeline.registration.bearing_motion import BearingMatches, bearings_at, motion_from_bearings
from duagc.pipeline.registration.features import Features

MOST_SPREAD = 2.0
"""Standard deviation of matches at an accepted pose, in those at the motion that they agree on."""


class RegisteredView(Protocol):
    """What other views are registered to."""

    @property
    def reference(self) -> Reference:
        """Samples at all levels."""
        ...

    @property
    def features(self) -> Features:
        """Features with and without depth."""
        ...


def register_few_depths(
    view: RegisteredView, frame: CurrentFrame, guess: Array, config: TrackingConfig
) -> Registration | None:
    """`register_by_bearings` of two views, of which one has depth on less than half of its image, else None.

    Args:
        view: that the frame is registered to.
        frame: the current frame.
        guess: T_view_camera [4, 4].
        config: of tracking.
    """
    if not (frame.has_few_depths or view.features.bearings.few_depths):
        return None
    return register_by_bearings(
        view,
        frame.pyramid,
        frame.features,
        [guess],
        config=config.registration,
        ratio=config.relocalization.ratio,
    )


def register_by_bearings(
    view: RegisteredView,
    pyramid: RgbdPyramid,
    features: Features,
    starts: Sequence[Array],
    *,
    config: RegistrationConfig,
    ratio: float,
) -> Registration | None:
    """A registration from the motion that bearings agree on, which it does not leave; its information is of both.

    None: features with depth decide, too few bearings agree, or they do not agree with what was found, or those without
    depth contradict it.

    Args:
        view: that the other one is registered to.
        pyramid: of the other view.
        features: of the other view.
        starts: T_view_other [4, 4] each.
        config: of the registration.
        ratio: of the ratio test of matches.
    """
    matched = BearingMatches.of(view.features, features, ratio)
    if matched is None:
        return None
    motion = motion_from_bearings(matched, starts)
    if not motion.accepted:
        return None
    result = register(
        view.reference, pyramid, motion.T_first_second, config, prior_information=motion.information
    )
    there = bearings_at(matched, result.T_reference_target)
    spread = there.sigma_px > MOST_SPREAD * motion.sigma_px
    if not result.ok or spread or bearings_contradict(matched, result.T_reference_target):
        return None
    return replace(result, information=result.information + there.information)
