"""Which balls a view may see."""

import numpy as np
import pytest

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.view_extent import ViewExtent


@pytest.mark.parametrize(("fx", "fy"), [(100.0, 100.0), (100.0, 300.0), (300.0, 100.0)])
def test_a_ball_that_reaches_into_the_image_is_seen(fx: float, fy: float) -> None:
    camera = PinholeCamera(160, 120, fx, fy, 79.5, 59.5)
    extent = ViewExtent.of(np.full((120, 160), 4.0, np.float32), camera)
    radius_m, depth_m = 0.6, 2.0
    above = (60 / fy + 0.5 * radius_m / depth_m) * depth_m  # half of its radius above the border
    left = (80 / fx + 0.5 * radius_m / depth_m) * depth_m
    means = np.array([[0, -above, depth_m], [-left, 0, depth_m], [0, -20, depth_m]], np.float32)
    seen = extent.sees(means, np.full(3, radius_m, np.float32), np.eye(4))
    assert seen.tolist() == [True, True, False]
