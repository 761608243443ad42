"""The number of keyframes is estimated from some places of a log, without tracking it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.pipeline.checks.check import expected_size
from duagc.pipeline.checks.keyframe_count import KeyframeCount, count_keyframes
from duagc.pipeline.config.checks import KeyframeChecks
from duagc.pipeline.config.frontend import FrontendConfig, KeyframeConfig
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, RgbdFrame, open_rgbd

CAMERA = PinholeCamera(160, 120, 160.0, 160.0, 79.5, 59.5)
FRAMES, PLACES = 300, 12


class Wall:
    """A log of a camera that moves along a wall, 2 m away, by whole pixels.

    The share of a view that is lost is the distance in pixels over the width: a keyframe comes every 33 pixels.
    """

    def __init__(self, pixels: list[int], dark: range = range(0)) -> None:
        """Begin. pixels: of every frame, along the wall. dark: frames without depth."""
        noise = np.random.default_rng(0).random((CAMERA.height, max(pixels) + CAMERA.width))
        smooth = sum(size * cv2.GaussianBlur(noise, (0, 0), size) for size in (2, 8, 32))
        smooth = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)
        self._wall = np.repeat(smooth.astype(np.uint8)[..., None], 3, axis=2)
        self.camera, self._pixels, self._dark, self.reads = CAMERA, pixels, dark, 0

    def __len__(self) -> int:
        return len(self._pixels)

    def frame(self, index: int) -> RgbdFrame:
        self.reads += 1
        first = self._pixels[index]
        depth = np.full((CAMERA.height, CAMERA.width), 0 if index in self._dark else 2, np.float32)
        return RgbdFrame(index, index, self._wall[:, first : first + CAMERA.width].copy(), depth)

    def count(self) -> KeyframeCount:
        return count_keyframes(self, KeyframeChecks(places=PLACES), KeyframeConfig())  # type: ignore[arg-type]


@pytest.mark.parametrize("speed", [1, 3, 12])
def test_a_keyframe_comes_whenever_a_fifth_of_the_view_is_lost(speed: int) -> None:
    log = Wall([speed * k for k in range(FRAMES)])
    found, true = log.count(), 1 + (FRAMES - 1) / np.ceil(33 / speed)
    assert found.expected == pytest.approx(true, rel=0.1)
    assert found.low <= true <= found.high
    assert log.reads <= 8 * PLACES


def keyframes_of(pixels: list[int]) -> int:
    """As the rule has it: the next one where a fifth of the view of the last one is lost."""
    count, last = 1, pixels[0]
    for at in pixels:
        if abs(at - last) >= 33:
            count, last = count + 1, at
    return count


@pytest.mark.parametrize(
    ("half_px", "period", "true"),
    [(20, 60, 1), (30, 30, 1), (25, 23, 1), (40, 60, 20)],
    ids=["slow", "wide", "fast", "wider than a keyframe sees"],
)
def test_a_camera_that_turns_to_and_fro_keeps_the_keyframe_of_the_middle(
    half_px: int, period: int, true: int
) -> None:
    """From where it turns back, more than a fifth of the view is lost before it turns again."""
    phase = 2 * np.pi * np.arange(FRAMES) / period
    pixels = np.rint(half_px * (1 + np.sin(phase))).astype(int).tolist()
    assert keyframes_of(pixels) == true
    found = Wall(pixels).count()
    assert found.low <= true <= found.high
    assert found.expected == pytest.approx(true, rel=0.1)


def test_a_camera_that_stands_still_half_of_the_time_makes_half_as_many_less_certainly() -> None:
    moving, half = (
        Wall([3 * min(k, until) for k in range(FRAMES)]).count() for until in (FRAMES, FRAMES // 2)
    )
    assert half.low < 1 + FRAMES / 2 / 11 < half.high
    assert (half.high - half.low) / half.expected > 2 * (moving.high - moving.low) / moving.expected


def test_frames_without_depth_make_none_and_what_does_not_register_may_make_any() -> None:
    every = range(FRAMES)
    dark = Wall([3 * k for k in every], dark=range(FRAMES // 2, FRAMES)).count()
    assert dark.low < 1 + FRAMES / 2 / 11 < dark.high
    assert Wall([0] * 30, dark=range(30)).count() == KeyframeCount(1, 1, 1)
    jumping = Wall([101 * (k % 7) for k in range(60)]).count()
    assert jumping.low == 1
    assert jumping.high == 60


def test_of_a_recording(small_recording: Path) -> None:
    with open_rgbd(Recording(small_recording).log("bravo")) as log:
        found = count_keyframes(log, KeyframeChecks(), KeyframeConfig())
    assert found.low <= 2 <= found.high < 5  # as `run` makes
    size = expected_size(Recording(small_recording).log("bravo"), FrontendConfig())
    assert size == {"keyframes": found.expected, "exact": 1}
