"""Which frames decide the regions of images that do not show the scene."""

import cv2
import numpy as np
import pytest

from duagc.converters.layouts.found_regions import FoundRegions
from duagc.pipeline.base.held_out import is_held_out


@pytest.mark.parametrize("rate_hz", [30.0, 4.0, 1.0])
def test_frames_that_are_held_out_decide_nothing(monkeypatch: pytest.MonkeyPatch, rate_hz: float) -> None:
    regions, looked_at = FoundRegions(), list[int]()
    monkeypatch.setattr(regions._black, "add", lambda value: looked_at.append(int(value[0, 0])))
    monkeypatch.setattr(regions._body, "add", lambda depth: looked_at.append(int(depth[0, 0])))
    for index in range(200):
        depth = np.full((2, 2), index, np.uint16)
        color = cv2.imencode(".png", np.full((2, 2, 3), index, np.uint8))[1].tobytes()
        regions.add(index, round(index / rate_hz * 1e9), color, depth)
    assert not [index for index in looked_at if is_held_out(index)]
    assert len(looked_at) >= 2 * 200 // 8
    assert len([index for index in set(looked_at) if index < 32]) >= 8
