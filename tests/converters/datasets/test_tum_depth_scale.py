"""The depth scale of TUM's Kinect is warned of where the camera is another."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters import registry


@pytest.mark.parametrize(
    ("options", "count"), [([], 1), (["depth_scale=0.001"], 0), (["depth_scale=0.0002"], 0)]
)
def test_the_scale_of_another_camera(tmp_path: Path, options: list[str], count: int) -> None:
    src = tmp_path / "sequence"
    for kind, pixels in (
        ("rgb", np.zeros((48, 64, 3), np.uint8)),
        ("depth", np.full((48, 64), 9, np.uint16)),
    ):
        (src / kind).mkdir(parents=True)
        for k in range(3):
            assert cv2.imwrite(str(src / kind / f"{k}.png"), pixels)
        (src / f"{kind}.txt").write_text("".join(f"{1000 + k / 30:.6f} {kind}/{k}.png\n" for k in range(3)))
    (src / "calibration.txt").write_text("60 60 31.5 23.5")
    registry.convert("tum", src, tmp_path / "rec", options=options)
    warnings = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert sum("as of a Kinect; expected --set depth_scale" in text for text in warnings) == count
