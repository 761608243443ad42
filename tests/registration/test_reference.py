"""How many samples a view is sent with."""

import numpy as np
import pytest

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration import Reference, RgbdPyramid


@pytest.mark.parametrize(("width", "most"), [(640, 1.05), (320, 1.2), (160, 1.45), (82, 3.0), (48, 3.0)])
def test_samples_are_about_as_many_as_asked_for(width: int, most: float) -> None:
    """A plane with texture and depth everywhere."""
    height = 3 * width // 4
    camera = PinholeCamera(width, height, width, width, width / 2, height / 2)
    color = np.random.default_rng(0).random((height, width, 3)).astype(np.float32)
    pyramid = RgbdPyramid.build(color, np.full((height, width), 2.0, np.float32), camera, levels=2)
    found = len(Reference.sample(pyramid, 2000).levels[0])
    assert min(0.9 * 2000, 0.75 * width * height) < found <= most * 2000
