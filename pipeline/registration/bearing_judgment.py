"""What matches without depth say of a motion that was found in another way.

Ground of equal pieces looks the same a piece further on, and what has depth may be nothing else: a camera that moves by
one of them a frame seems to stand. What is too far away to have depth shows that it does not.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.registration.bearing_motion import (
    MIN_INLIERS,
    SHARED_SIGMA_PX,
    BearingMatches,
    distances_px,
)

MORE = 3.0
"""By which more matches must agree on another motion alone than on the given one alone."""
FARTHER = 2.0
"""Distance within which matches agree with the given motion, in that within which they agree with another one: that
fits what is far away, and some things that pass by, more easily."""
CONFIDENCE = 0.999  # of RANSAC


def bearings_contradict(matched: BearingMatches, T_first_second: Array) -> bool:
    """Whether matches without depth agree on a motion, and many of them not on the given one.

    Args:
        matched: of two views.
        T_first_second: [4, 4], the given motion.
    """
    import cv2

    unknown, near = np.isnan(matched.inverse_depth), SHARED_SIGMA_PX * matched.pixel_width
    with_given = distances_px(matched, T_first_second)[unknown] < FARTHER * SHARED_SIGMA_PX
    if np.count_nonzero(~with_given) < MIN_INLIERS:
        return False
    given, sought = matched.given[unknown, :2], matched.sought[unknown]
    found, mask = cv2.findEssentialMat(given, sought, np.eye(3), cv2.RANSAC, CONFIDENCE, near)
    if found is None:
        return False
    with_other = mask.ravel().astype(bool)
    only_other, only_given = (
        int(np.count_nonzero(one & ~another))
        for one, another in ((with_other, with_given), (with_given, with_other))
    )
    return only_other >= max(MIN_INLIERS, MORE * only_given)
