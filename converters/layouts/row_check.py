"""Whether a stereo pair is rectified, measured on its images: matched features must lie in one row."""

from __future__ import annotations

from typing import Any

import numpy as np

from duagc.converters.layouts.stereo import Image
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError

MAX_ROW_PX = 1.0  # largest median row difference of matched features
MIN_MATCHES = 50
MATCH_RATIO = 0.8  # Lowe's, of the two best distances of descriptors


class RowCheck:
    """Measures a rectification on the images themselves: matched features must lie in one row, and to the left."""

    def __init__(self) -> None:
        self._differences: list[Array] = [np.zeros((0, 2))]

    def add(self, left: Image, right: Image) -> None:
        """Match the features of a pair of rectified gray images, wherever in the image they are.

        Args:
            left: gray, [h, w].
            right: gray, [h, w].
        """
        import cv2

        sift = cv2.SIFT.create(nfeatures=1000)
        (points, ours), (others, theirs) = (sift.detectAndCompute(image, None) for image in (left, right))
        if ours is None or theirs is None or len(others) < 2:
            return
        found = []
        for best, second in cv2.BFMatcher().knnMatch(ours, theirs, k=2):
            if best.distance < MATCH_RATIO * second.distance:
                found.append(np.subtract(points[best.queryIdx].pt, others[best.trainIdx].pt))
        self._differences.append(np.array(found).reshape(-1, 2))

    def result(self, where: str) -> dict[str, Any]:
        """Medians of the row difference (absolute, in pixels of the rectified image) and of the disparity.

        Args:
            where: begins the line of an error.

        Raises:
            DuagError: too few matches to judge, or rows or the order of the cameras do not fit.
        """
        columns, rows = np.concatenate(self._differences).T
        if len(rows) < MIN_MATCHES:
            raise DuagError(
                f"{where}: {len(rows)} features of the left images found in the right ones, expected at least "
                f"{MIN_MATCHES} to test the rectification"
            )
        row, disparity = float(np.median(np.abs(rows))), float(np.median(columns))
        if row > MAX_ROW_PX:
            raise DuagError(
                f"{where}: matched features lie {row:.1f} px apart in rows (median of {len(rows)}), expected less than "
                f"{MAX_ROW_PX:g}: the calibration is not that of these images"
            )
        if disparity <= 0:
            raise DuagError(
                f"{where}: matched features lie {-disparity:.1f} px to the right in the right images (median of "
                f"{len(rows)}), expected to the left: the cameras are swapped"
            )
        return {"row_difference_px": row, "disparity_px": disparity, "matched_features": len(rows)}
