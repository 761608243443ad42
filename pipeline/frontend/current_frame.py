"""The frame that is being tracked, and where it may be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.registration import Registration, RgbdPyramid
from duagc.pipeline.registration.features import Features, extract_from_pyramid


@dataclass(frozen=True)
class CurrentFrame:
    """The frame that is being tracked.

    Attributes:
        frame_index: in the log.
        stamp_ns: its time.
        pyramid: its images.
        relocalization: how its features are extracted.
        depth_offset_ns: how much later its depth was taken, wherever that was moved to.
    """

    frame_index: int
    stamp_ns: int
    pyramid: RgbdPyramid
    relocalization: RelocalizationConfig
    depth_offset_ns: int = 0

    @cached_property
    def features(self) -> Features:
        """Its features; computed when first needed."""
        return features_of(self.pyramid, self.relocalization)


def features_of(pyramid: RgbdPyramid, config: RelocalizationConfig) -> Features:
    """The features by which a frame is relocalized, and to which it is compared as a keyframe.

    Args:
        pyramid: images of the frame.
        config: number of features and size of the image.
    """
    return extract_from_pyramid(pyramid, config.max_width_px, config.features)


@dataclass(frozen=True)
class PoseCandidate:
    """A registration of the current frame to a keyframe that is not accepted yet.

    Attributes:
        keyframe_index: the keyframe.
        result: the registration.
        without: why only its color, or only its depth, was used.
        unlike: whether it looked unlike the keyframe, and color alone confirmed it.
    """

    keyframe_index: int
    result: Registration
    without: Reason = Reason.NONE
    unlike: bool = False
