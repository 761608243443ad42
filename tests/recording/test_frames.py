"""Color, depth and masks, frame by frame."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duagc.converters.writer import RecordingWriter
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, seen_by_source
from duagc.pipeline.recording import LogWriter, info, open_rgbd
from duagc.pipeline.recording.pairing import TOLERANCE_NS, pair
from duagc.schemas import topics
from tests.fixtures.recording_logs import (
    CALIBRATION,
    CAMERA,
    COLOR,
    DEPTH,
    FRAME_NS,
    depth,
    image,
    png,
    write_camera,
)


def test_frames_come_back_in_any_order(tmp_path: Path) -> None:
    with open_rgbd(write_camera(tmp_path / "alpha.mcap", frames=9)) as log:
        assert (log.robot, log.camera, log.depth_scale, len(log)) == ("alpha", CAMERA, 0.001, 9)
        for frame in [*log.frames(), log.frame(7), log.frame(0)]:
            assert frame.stamp_ns == frame.index * FRAME_NS
            assert np.array_equal(frame.color, image(frame.index)[:, :, ::-1])  # OpenCV encodes BGR
            assert np.array_equal(frame.depth, depth(frame.index) * np.float32(0.001))
            assert frame.depth.dtype == np.float32
        with pytest.raises(IndexError):
            log.frame(9)


def usable(index: int) -> np.ndarray:
    return np.random.default_rng(2000 + index).random((CAMERA.height, CAMERA.width)) < 0.6


def test_masks_come_with_their_images(tmp_path: Path) -> None:
    """Some frames have one; a masked pixel keeps its depth, but not its usable depth."""
    masks = {k: m.pack_mask(k * FRAME_NS, "alpha", usable(k)) for k in (1, 4, 5)}
    with open_rgbd(write_camera(tmp_path / "alpha.mcap", frames=7, masks=masks)) as log:
        for frame in [*log.frames(), log.frame(4)]:
            if frame.index in masks:
                assert frame.mask is not None
                assert np.array_equal(frame.mask, usable(frame.index))
                assert np.array_equal(frame.usable_depth, frame.depth * usable(frame.index))
            else:
                assert frame.mask is None
                assert frame.usable_depth is frame.depth


def test_masks_can_be_recorded(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        for k in range(3):
            robot.add_frame(k * FRAME_NS, png(image(k)), "png", depth(k), mask=usable(k) if k else None)
        with pytest.raises(ValueError, match="an image is"):
            robot.add_frame(3 * FRAME_NS, png(image(3)), "png", depth(3), mask=usable(3).T)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert [frame.mask is None for frame in log.frames()] == [True, False, False]


def odd_mask(**fields: Any) -> Any:
    message = m.pack_mask(0, "alpha", usable(0))
    for name, value in fields.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (odd_mask(encoding="mono8"), "at 0 ns is mono8, expected 8UC1"),
        (odd_mask(step=15), "has rows of 15 bytes for 16x12 pixels"),
        (odd_mask(data=b"x"), "has 1 bytes, expected 192"),
        (
            odd_mask(data=bytes([255] * 191 + [7])),
            "has the value 7, expected 0 (ignore) and 255 (usable) only",
        ),
        (odd_mask(width=8, height=24, step=8), "is 8x24, expected 16x12"),
    ],
)
def test_unsound_masks_are_one_line(tmp_path: Path, mask: Any, words: str) -> None:
    path = write_camera(tmp_path / "alpha.mcap", masks={0: mask})
    with pytest.raises(DuagError) as caught:
        list(open_rgbd(path).frames())
    assert str(caught.value).startswith(f"{path}: /alpha/camera/mask")
    assert words in str(caught.value)


def test_a_mask_of_no_image_is_an_error(tmp_path: Path) -> None:
    skipped = {"skip_color": (2,), "skip_depth": (2,)}
    masks = {2: m.pack_mask(2 * FRAME_NS, "alpha", usable(2))}
    with pytest.raises(DuagError, match="has a mask at 66666666 ns, expected one in /alpha/camera/color"):
        open_rgbd(write_camera(tmp_path / "alpha.mcap", masks=masks, **skipped))


def test_frames_stream(tmp_path: Path) -> None:
    """Only a few chunks are in memory, however long the log."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 2**16, (480, 640), dtype=np.uint16)
    camera = PinholeCamera(640, 480, 500, 500, 320, 240)
    picture = png(np.zeros((480, 640, 3), np.uint8))
    path = write_camera(
        tmp_path / "a.mcap", 12, cameras={0: camera}, color=lambda _: picture, depth=lambda _: noise
    )
    log = open_rgbd(path)
    for frame in log.frames():
        assert frame.depth[0, 0] == np.float32(noise[0, 0]) * np.float32(0.001)
        assert sum(len(chunk) for chunk in log._log._chunks.values()) < 6_000_000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"frames": 9, "skip_color": (0, 1, 2, 3, 4), "skip_depth": tuple(range(2, 9))},
            "none of them within 100 ms",
        ),
        ({"skip_depth": (0, 1, 2, 3)}, "has a message, expected depth from one of them"),
        ({"frames": 0}, "expected exactly one robot"),
        ({"cameras": {}}, f"{CALIBRATION} has no message"),
        ({"cameras": {1: CAMERA}}, f"{CALIBRATION} begins at 33333333 ns"),
        ({"cameras": {0: CAMERA, 2: CAMERA.halved()}}, f"{CALIBRATION} changes at 66666666 ns"),
        ({"cameras": {0: CAMERA.halved()}}, f"{COLOR} at 0 ns is 16x12, expected 8x6"),
        ({"cameras": {0: PinholeCamera(16, 12, np.nan, 1, 1, 1)}}, f"{CALIBRATION}: K is"),
        (
            {"cameras": {0: PinholeCamera(64, 3, 60, 60, 31.5, 1)}},
            f"{CALIBRATION} says 64 x 3 px, expected sides of 4 to 16384",
        ),
        ({"scale": None}, f"{DEPTH}: channel metadata depth_scale is None"),
        ({"scale": "-1"}, f"{DEPTH}: channel metadata depth_scale is '-1'"),
        ({"scale": "nan"}, "depth_scale is 'nan'"),
        ({"color": lambda _: b"no image"}, f"{COLOR} at 0 ns has 8 bytes that no decoder reads"),
        ({"color": lambda _: b""}, f"{COLOR} at 0 ns has 0 bytes"),
        ({"depth": lambda _: np.zeros((3, 4), np.uint16)}, f"{DEPTH} at 0 ns is 4x3, expected 16x12"),
    ],
)
def test_unsound_cameras_are_one_line(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = write_camera(tmp_path / "alpha.mcap", **change)
    with pytest.raises(DuagError) as caught:
        list(open_rgbd(path).frames())
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


def test_images_without_a_partner(tmp_path: Path) -> None:
    """Without depth of its own a color image has that of the next one, and none where no depth is near."""
    path = write_camera(tmp_path / "alpha.mcap", 12, skip_color=(1,), skip_depth=(2, *range(4, 12)))
    with open_rgbd(path) as log:
        frames = list(log.frames())
        assert [f.stamp_ns // FRAME_NS for f in frames] == [0, *range(2, 12)]
        assert [f.index for f in frames] == list(range(11))
        of = {0: 0, 2: 1, 3: 3, 4: 3, 5: 3, 6: 3}
        for frame in frames:
            assert np.array_equal(log.usable_depth(frame.index), frame.usable_depth)
            k = frame.stamp_ns // FRAME_NS
            expected = depth(of[k]) * np.float32(0.001) if k in of else np.zeros_like(depth(0), np.float32)
            assert np.array_equal(frame.depth, expected)
            assert frame.depth_offset_ns == ((of[k] - k) * FRAME_NS if k in of else 0)
        assert log.pairing.color_alone == tuple(k * FRAME_NS for k in range(7, 12))
        assert log.pairing.depth_alone == ()
    warnings = info(path)["warnings"]
    assert f"{COLOR}: 5 images have none of {DEPTH} within 100 ms: no depth" in warnings


def test_a_log_may_ask_for_nearer_depth(tmp_path: Path) -> None:
    path = write_camera(
        tmp_path / "alpha.mcap", 9, skip_depth=tuple(range(1, 9)), metadata={"depth_tolerance_s": "0.05"}
    )
    with open_rgbd(path) as log:
        assert log.pairing.color_alone == tuple(k * FRAME_NS for k in range(2, 9))
        log.delay_depth(-FRAME_NS)
        assert log.pairing.color_alone == tuple(k * FRAME_NS for k in range(3, 9))
    assert f"{COLOR}: 7 images have none of {DEPTH} within 50 ms: no depth" in info(path)["warnings"]
    for text in ("-1", "near", "nan", "5"):
        write_camera(path, metadata={"depth_tolerance_s": text})
        with pytest.raises(
            DuagError, match=rf"alpha\.mcap: depth_tolerance_s is '{text}', expected 0 to 0\.1 s"
        ):
            open_rgbd(path)


def test_color_of_a_lens_is_seen_by_the_pinhole_camera_that_the_log_states(tmp_path: Path) -> None:
    """The log holds the camera's own bytes; depth and masks are of the pinhole camera already."""
    lens = Lens(CAMERA, (0.3, -0.1, 0.01, 0.0, 0.0))
    path = tmp_path / "alpha.mcap"
    with LogWriter(path, "alpha") as log:
        log.channel(DEPTH, topics.DEPTH.schema, {"depth_scale": "0.001"})
        log.write(CALIBRATION, m.pack_calibration(0, "alpha", CAMERA, lens), 0)
        log.write(COLOR, m.pack_color(0, "alpha", png(image(0)), "png"), 0)
        log.write(DEPTH, m.pack_depth(0, "alpha", depth(0)), 0)
    with open_rgbd(path) as log:
        assert (log.camera, log.lens) == (CAMERA, lens)
        frame = log.frame(0)
    K, size = CAMERA.matrix(), (CAMERA.width, CAMERA.height)
    maps = cv2.initUndistortRectifyMap(K, np.array(lens.distortion), np.eye(3), K, size, cv2.CV_32FC1)
    straight = cv2.remap(image(0), *maps, cv2.INTER_LINEAR)
    inside = seen_by_source(lens.maps(CAMERA), CAMERA.width, CAMERA.height)
    assert 0.3 < inside.mean() < 1
    assert np.abs(frame.color[inside].astype(int) - straight[inside][:, ::-1]).max() <= 2
    assert not np.array_equal(frame.color, image(0)[:, :, ::-1])
    assert np.array_equal(frame.depth, depth(0) * np.float32(0.001))


def test_color_and_depth_may_come_at_their_own_rates(tmp_path: Path) -> None:
    """Color at 30 Hz, depth at 10 Hz and 7 ms late: every color image has its nearest depth."""
    path = tmp_path / "alpha.mcap"
    events = [(k * FRAME_NS, topics.COLOR, k) for k in range(9)]
    events += [(3 * k * FRAME_NS + 7_000_000, topics.DEPTH, k) for k in range(3)]
    with LogWriter(path, "alpha") as log:
        log.channel(DEPTH, topics.DEPTH.schema, {"depth_scale": "0.001"})
        log.write(CALIBRATION, m.pack_calibration(0, "alpha", CAMERA), 0)
        for stamp, topic, k in sorted(events, key=lambda event: event[0]):
            color = topic is topics.COLOR
            message = (
                m.pack_color(stamp, "alpha", png(image(k)), "png")
                if color
                else m.pack_depth(stamp, "alpha", depth(k))
            )
            log.write(topic.of("alpha"), message, stamp)
    with open_rgbd(path) as log:
        frames = list(log.frames())
    assert [f.stamp_ns // FRAME_NS for f in frames] == list(range(9))
    nearest = [0, 0, 1, 1, 1, 2, 2, 2, 2]
    for k, frame in enumerate(frames):
        assert frame.depth_offset_ns == (3 * nearest[k] - k) * FRAME_NS + 7_000_000
        assert np.array_equal(frame.color, image(k)[:, :, ::-1])
        assert np.array_equal(frame.depth, depth(nearest[k]) * np.float32(0.001))
    assert f"{DEPTH}: up to 59.7 ms from {COLOR}" in info(path)["warnings"]


@settings(max_examples=50, deadline=None)
@given(
    color=st.lists(st.integers(0, 10**9), unique=True, min_size=1, max_size=20),
    depth_times=st.lists(st.integers(0, 10**9), unique=True, min_size=1, max_size=20),
)
def test_every_color_image_has_the_nearest_depth(color: list[int], depth_times: list[int]) -> None:
    found = pair(color, depth_times)
    assert [c for c, _ in found.pairs] == sorted(color)
    for c, d in found.pairs:
        least = min(abs(c - other) for other in depth_times)
        if d is None:
            assert least > TOLERANCE_NS
        else:
            assert abs(c - d) == least <= TOLERANCE_NS
    assert found.color_alone == tuple(c for c, d in found.pairs if d is None)
    used = {d for _, d in found.pairs if d is not None}
    assert sorted([*used, *found.depth_alone]) == sorted(depth_times)
    assert found.largest_offset_ns == max((abs(d - c) for c, d in found.pairs if d is not None), default=0)


def test_a_mask_of_all_images_holds_with_those_of_single_ones(tmp_path: Path) -> None:
    """What is under either mask is gone from the color; where no image shows the scene there is no depth either."""
    valid = np.ones((12, 16), bool)
    valid[:, :3] = False
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.set_valid(valid)
        for k in range(2):
            robot.add_frame(k * FRAME_NS, png(image(k)), "png", depth(k), mask=usable(k) if k else None)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert np.array_equal(log.valid, valid)
        first, second = log.frame(0), log.frame(1)
        without_color = [log.usable_depth(k) for k in range(2)]
    assert np.array_equal(first.mask, valid)
    assert np.array_equal(second.mask, valid & usable(1))
    for k, frame in enumerate((first, second)):
        assert frame.mask is not None
        assert np.array_equal(frame.color[frame.mask], image(k)[:, :, ::-1][frame.mask])
        assert not frame.depth[~valid].any()
        assert np.array_equal(frame.depth[valid] > 0, depth(k)[valid] > 0)
        assert np.array_equal(without_color[k], frame.usable_depth)


@pytest.mark.parametrize(
    ("valid", "words"),
    [
        (np.ones((4, 5), bool), "is 5x4, expected 16x12"),
        (np.zeros((12, 16), bool), "leaves no pixel that shows the scene"),
    ],
)
def test_a_mask_of_all_images_that_cannot_be_used(tmp_path: Path, valid: np.ndarray, words: str) -> None:
    log = write_camera(tmp_path / "alpha.mcap", frames=2, valid=m.pack_valid(0, "alpha", valid))
    with pytest.raises(DuagError, match=words), open_rgbd(log):
        pass


def test_the_bytes_of_a_mask_of_all_images_are_a_png(tmp_path: Path) -> None:
    message = m.pack_valid(0, "alpha", np.ones((12, 16), bool))
    message.data = message.data[:20]
    log = write_camera(tmp_path / "alpha.mcap", frames=2, valid=message)
    with pytest.raises(DuagError, match="expected a PNG of 8 bits and one channel"), open_rgbd(log):
        pass
    message = m.pack_color(0, "alpha", png(np.full((12, 16), 7, np.uint8)), "png")
    log = write_camera(tmp_path / "alpha.mcap", frames=2, valid=message)
    with pytest.raises(DuagError, match="has the value 7, expected 0"), open_rgbd(log):
        pass
