"""The frame that is being tracked, and where it may be."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.hidden_pixels import HiddenPixels
from duagc.pipeline.registration import Level, Registration, RgbdPyramid
from duagc.pipeline.registration.features import Features, extract_from_pyramid, has_few_depths
from duagc.pipeline.registration.keypoints import KeptKeypoints


@dataclass(frozen=True)
class CurrentFrame:
    """The frame that is being tracked.

    Attributes:
        frame_index: in the log.
        stamp_ns: its time.
        pyramid: its images.
        relocalization: how its features are extracted.
        depth_offset_ns: how much later its depth was taken, wherever that was moved to.
        hidden: what an object in front of the camera hides, which the images are without; None: nothing known.
        whole: its coarsest image before.
        suspected: what an object may hide, of a frame with whole images; None: nothing.
        keypoints: of its images, for the frame without some pixels, too.
    """

    frame_index: int
    stamp_ns: int
    pyramid: RgbdPyramid
    relocalization: RelocalizationConfig
    depth_offset_ns: int = 0
    hidden: HiddenPixels | None = None
    whole: Level | None = None
    suspected: HiddenPixels | None = None
    keypoints: KeptKeypoints = field(default_factory=KeptKeypoints)

    @property
    def seen(self) -> Level:
        """Its coarsest image, without what is, or may be, an object in front of the camera."""
        coarsest = self.pyramid.levels[-1]
        if self.suspected is None:
            return coarsest
        depth = np.where(self.suspected.mask, np.float32(0), coarsest.inverse_depth)
        return replace(coarsest, inverse_depth=depth)

    def without(self, hidden: HiddenPixels) -> CurrentFrame:
        """The frame without what an object hides.

        Args:
            hidden: by its coarsest image.
        """
        scale, finest = 2 ** (len(self.pyramid.levels) - 1), self.pyramid.levels[0].gray.shape
        whole = hidden.mask.repeat(scale, axis=0).repeat(scale, axis=1)
        # a last odd row or column is in no coarse pixel
        whole = np.pad(
            whole, [(0, full - part) for full, part in zip(finest, whole.shape, strict=True)], mode="edge"
        )
        coarsest = self.whole or self.pyramid.levels[-1]
        return replace(self, pyramid=self.pyramid.masked(~whole), hidden=hidden, whole=coarsest)

    @cached_property
    def features(self) -> Features:
        """Its features; computed when first needed."""
        return features_of(self.pyramid, self.relocalization, self.keypoints)

    @cached_property
    def has_few_depths(self) -> bool:
        """Whether less than half of its image has depth."""
        return has_few_depths(self.pyramid)


def features_of(
    pyramid: RgbdPyramid, config: RelocalizationConfig, before: KeptKeypoints | None = None
) -> Features:
    """The features by which a frame is relocalized, and to which it is compared as a keyframe.

    Args:
        pyramid: images of the frame.
        config: number of features and size of the image.
        before: what was found in images of the frame; None: nothing.
    """
    return extract_from_pyramid(pyramid, config.max_width_px, config.features, before=before)


@dataclass(frozen=True)
class PoseCandidate:
    """A registration of the current frame to a keyframe that is not accepted yet.

    Attributes:
        keyframe_index: the keyframe.
        result: the registration.
        without: why only its color, or only its depth, was used.
        unlike: whether it looked unlike the keyframe, and color alone confirmed it.
        by_bearings: whether features confirm it, most of them without depth.
    """

    keyframe_index: int
    result: Registration
    without: Reason = Reason.NONE
    unlike: bool = False
    by_bearings: bool = False
