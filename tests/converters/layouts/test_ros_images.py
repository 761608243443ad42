"""Images and cameras as ROS holds them: every encoding of color and depth, every lens, and broken ones."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters.layouts import ros_images
from duagc.converters.layouts.ros_camera import RosCamera
from duagc.converters.layouts.rvl import decoded_rvl
from duagc.converters.logs.foxglove import Fields
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.ros_bags import COLOR, Ros
from tests.fixtures.rvl_images import rvl


@pytest.mark.parametrize(
    ("model", "D", "message"),
    [
        ("double_sphere", [0.1, 0.2], "distortion model 'double_sphere', expected one of plumb_bob"),
        (
            "plumb_bob",
            [0.1, 0.2],
            r"distortion \[0.1, 0.2\] of 'plumb_bob', expected 4 or 5 or 8 or 12 or 14 numbers",
        ),
        ("equidistant", [0.1, 0, 0, 0, 0.01], "of 'equidistant', expected 4 numbers"),
        ("equidistant", [0.1, 0, 0], "of 'equidistant', expected 4 numbers"),
        ("plumb_bob", [float("nan"), 0, 0, 0, 0], "of 'plumb_bob', expected"),
        ("Ftheta", [0.1, 0, 0, 0, 0], "distortion model 'Ftheta'"),
    ],
)
def test_lenses_that_are_not_known_are_refused(model: str, D: list[float], message: str) -> None:
    info = Ros(2).info(1, "c", COLOR)
    object.__setattr__(info, "distortion_model", model)
    object.__setattr__(info, "d", np.array(D))
    with pytest.raises(DuagError, match=message):
        RosCamera.of(info, False, "here")
    object.__setattr__(info, "d", np.zeros(0))
    assert RosCamera.of(info, False, "here").maps() is None


def test_color_of_realsense_is_that_of_its_ros_driver_whatever_its_software_names_it() -> None:
    maps = []
    for model in ("plumb_bob", "Brown Conrady", "Modified Brown Conrady", "Inverse Brown Conrady"):
        info = Ros(2).info(1, "c", COLOR, (-0.0565, 0.0682, 0.0004, 0.0007, -0.0218))
        object.__setattr__(info, "distortion_model", model)
        maps.append(RosCamera.of(info, False, "here").maps())
    assert all(np.array_equal(maps[0], other) for other in maps[1:])


def test_one_fisheye_model_has_four_names() -> None:
    maps = []
    for model in ("equidistant", "fisheye", "kannala_brandt", "Kannala Brandt4"):
        info = Ros(2).info(1, "c", COLOR)
        object.__setattr__(info, "distortion_model", model)
        object.__setattr__(info, "d", np.array([0.05, -0.01, 0.002, 0.0]))
        maps.append(RosCamera.of(info, False, "here").maps())
    assert all(np.array_equal(maps[0], other) for other in maps[1:])


def test_drivers_may_send_a_fifth_number_of_a_fisheye_that_is_zero() -> None:
    cameras = []
    for D in ([-0.002, 0.037, -0.036, 0.006], [-0.002, 0.037, -0.036, 0.006, 0.0]):
        info = Ros(2).info(1, "c", COLOR)
        object.__setattr__(info, "distortion_model", "equidistant")
        object.__setattr__(info, "d", np.array(D))
        cameras.append(RosCamera.of(info, False, "here"))
    assert cameras[0] == cameras[1]


def test_a_fisheye_whose_numbers_are_zero_is_no_pinhole() -> None:
    info = Ros(2).info(1, "c", COLOR)
    object.__setattr__(info, "distortion_model", "equidistant")
    object.__setattr__(info, "d", np.zeros(4))
    camera = RosCamera.of(info, False, "here")
    maps = camera.maps()
    assert maps is not None
    assert not camera.is_straight
    x, y = COLOR.rays()[0, 0, :2]  # of a corner: its distance from the center is its angle
    angle = np.arctan(np.hypot(x, y))
    expected = COLOR.project(np.array([x, y, np.hypot(x, y) / angle]))
    np.testing.assert_allclose([maps[0][0, 0], maps[1][0, 0]], expected, atol=1e-3)
    assert RosCamera.of(info, True, "here").maps() is None


def gray_card() -> np.ndarray:
    rng = np.random.default_rng(0)
    return cv2.GaussianBlur(rng.integers(0, 256, (12, 16, 3)).astype(np.uint8), (5, 5), 0)


def decoded(message: Any) -> np.ndarray:
    data, _ = ros_images.color_bytes(message, "here")
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8"])
def test_color_encodings(encoding: str) -> None:
    card = gray_card()
    alpha = np.full((12, 16, 1), 255, np.uint8)
    pixels = {
        "rgb8": card,
        "bgr8": card[..., ::-1],
        "rgba8": np.concatenate([card, alpha], axis=2),
        "bgra8": np.concatenate([card[..., ::-1], alpha], axis=2),
        "mono8": card[..., 0],
    }[encoding]
    expected = np.repeat(card[..., :1], 3, axis=2) if encoding == "mono8" else card
    assert np.array_equal(
        decoded(Ros(2).image(1, "c", np.ascontiguousarray(pixels), encoding, pad=5)), expected
    )


def test_sizes_that_cannot_be_are_refused() -> None:
    """JSON holds any number; a padded row may claim any length."""
    image = Ros(2).image(1, "c", gray_card(), "rgb8")
    for width, height in ((0, 12), (16, 0), (16, -1)):
        bad = Fields(**vars(image) | {"width": width, "height": height})
        with pytest.raises(DuagError, match=f"is {width}x{height} pixels"):
            ros_images.color_bytes(bad, "here")
    one = Fields(**vars(image) | {"height": 1, "step": 1 << 40})
    assert np.array_equal(decoded(one), gray_card()[:1])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_have_the_right_red(pattern: str) -> None:
    """A red card stays red whatever the pattern."""
    tile = {"r": 200, "g": 30, "b": 10}
    pixels = np.tile(np.array([tile[c] for c in pattern], np.uint8).reshape(2, 2), (6, 8))
    rgb = decoded(Ros(1).image(1, "c", pixels, f"bayer_{pattern}8"))[3:-3, 3:-3]
    assert np.allclose(rgb.reshape(-1, 3).mean(axis=0), [200, 30, 10], atol=2)


def depth_image() -> np.ndarray:
    raw = (1000 + 37 * np.arange(12)[:, None] + 11 * np.arange(16)).astype(np.uint16)
    raw[2:4, 3:9] = 0
    return raw


@pytest.mark.parametrize("big", [False, True])
def test_depth_of_sixteen_bits_and_of_floats(big: bool) -> None:
    raw = depth_image()
    sixteen = Ros(1).image(1, "d", raw, "16UC1", pad=4, big=big)
    assert np.array_equal(
        ros_images.depth_m(sixteen, "here", 0.001), raw.astype(np.float32) * np.float32(0.001)
    )
    meters = raw.astype(np.float32) / 1000
    meters[0, :4] = [np.nan, np.inf, -1.0, 0.0]
    floats = Ros(2).image(1, "d", meters, "32FC1", big=big)
    got = ros_images.depth_m(floats, "here", 0.001)
    assert (got[0, :4] == 0).all()
    assert np.array_equal(got[1:], meters[1:])


def test_the_largest_number_is_no_depth() -> None:
    raw = depth_image()
    raw[0, :2] = 65535, 65534
    expected = np.where(raw == 65535, 0, raw)
    head, r = struct.pack("<iff", 0, 0.0, 0.0), Ros(2)
    png = r.compressed(1, "d", head + cv2.imencode(".png", raw)[1].tobytes(), "16UC1; compressedDepth png")
    packed = r.compressed(1, "d", head + rvl(raw), "16UC1; compressedDepth rvl")
    for message in (r.image(1, "d", raw, "16UC1"), png, packed):
        np.testing.assert_array_equal(ros_images.depth_values(message, "here"), expected)


def test_compressed_depth() -> None:
    raw = depth_image()
    r = Ros(2)
    head = struct.pack("<iff", 0, 0.0, 0.0)
    png = cv2.imencode(".png", raw)[1].tobytes()
    for text, data in (
        ("16UC1; compressedDepth png", head + png),
        ("16UC1; compressedDepth", head + png),
        ("16UC1; compressedDepth rvl", head + rvl(raw)),
        ("16UC1; compressedDepth png", png),
        ("16UC1; tiff compressed", cv2.imencode(".tif", raw)[1].tobytes()),
    ):
        got = ros_images.depth_m(r.compressed(1, "d", data, text), "here", 0.001)
        assert np.array_equal(got, raw.astype(np.float32) * np.float32(0.001)), text
    meters = raw / 1000.0
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0
    inverse = np.where(raw > 0, np.rint(a / np.where(raw > 0, meters, 1.0) + b), 0).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", inverse)[1].tobytes()
    got = ros_images.depth_m(r.compressed(1, "d", data, "32FC1; compressedDepth png"), "here", 0.001)
    assert np.abs(got - meters).max() < 3e-4
    jpeg = cv2.imencode(".jpg", (raw >> 8).astype(np.uint8))[1].tobytes()
    for data, message in ((jpeg, "depth as JPEG"), (head + b"\0" * 40, "broken RVL"), (b"123", "3 bytes")):
        with pytest.raises(DuagError, match=message):
            ros_images.depth_m(r.compressed(1, "d", data, "16UC1; compressedDepth png"), "here", 0.001)


@pytest.mark.parametrize("seed", range(20))
def test_broken_rvl_is_none_or_depth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(rvl(depth_image()))
    for _ in range(5):
        data[rng.integers(8, len(data))] = int(rng.integers(256))
    found = decoded_rvl(bytes(data[: rng.integers(8, len(data) + 1)]))
    assert found is None or found.shape == (12, 16)


@pytest.mark.parametrize("extension", [".jpg", ".png"])
@pytest.mark.parametrize(
    "quality", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]]
)
def test_the_size_of_an_encoded_image_is_told_without_decoding(extension: str, quality: list[int]) -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (30, 50, 3)).astype(np.uint8)
    data = cv2.imencode(extension, pixels, quality if extension == ".jpg" else [])[1].tobytes()
    assert ros_images.encoded_size(data) == (50, 30)
    assert ros_images.encoded_size(data[: len(data) // 2]) is None
    assert ros_images.encoded_size(b"") is None
    if extension == ".jpg":
        assert ros_images.encoded_size(data + b"\0" * 100 + b"more") == (50, 30)
        assert ros_images.encoded_size(data[:2] + b"\xff" + data[2:]) == (50, 30)  # a marker may be filled up


def test_inverse_depth_needs_its_header() -> None:
    png = cv2.imencode(".png", depth_image())[1].tobytes()
    with pytest.raises(DuagError, match="inverse depth without its header"):
        ros_images.depth_m(Ros(2).compressed(1, "d", png, "32FC1; compressedDepth png"), "here", 0.001)


@pytest.mark.parametrize(
    ("K", "message"),
    [
        ([0.0] * 9, r"focal length 0, 0 px .* expected those of a camera"),
        ([1e300, 0, 80, 0, 140, 60, 0, 0, 1], "expected those of a camera"),
        ([140, 0, float("nan"), 0, 140, 60, 0, 0, 1], "expected those of a camera"),
        ([140, 0, 80, 0, 1e-9, 60, 0, 0, 1], "expected those of a camera"),
        ([140, 0, 80], "K and P of 3 and 12 numbers"),
    ],
)
def test_cameras_that_cannot_be_are_refused(K: list[float], message: str) -> None:
    info = Ros(2).info(1, "c", COLOR)
    object.__setattr__(info, "k", np.array(K))
    with pytest.raises(DuagError, match=message):
        RosCamera.of(info, False, "here")


def test_the_orientation_in_a_jpeg_turns_no_image() -> None:
    """A camera that writes how it was held: intrinsics are those of the pixels as they are stored."""
    data = cv2.imencode(".jpg", np.zeros((30, 40, 3), np.uint8))[1].tobytes()
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0)  # a quarter turn
    tiff = b"MM\x00*" + struct.pack(">IH", 8, 1) + entry + bytes(4)
    body = b"Exif\x00\x00" + tiff
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (40, 30, 3)
    message = Ros(2).compressed(0, "camera", turned, "jpeg")
    assert ros_images.size_of(message, "here") == (40, 30)


@pytest.mark.parametrize("pattern", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_a_compressed_mosaic_has_colors(pattern: str, kind: str) -> None:
    """A red scene: only the pixels of the filter that is red are bright."""
    place = {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}[pattern[6:10]]
    mosaic = np.zeros((32, 48), np.uint8)
    mosaic[place[0] :: 2, place[1] :: 2] = 200
    data = cv2.imencode(f".{kind}", mosaic, [cv2.IMWRITE_JPEG_QUALITY, 100])[1]
    message = Fields(format=f"{pattern}; {kind} compressed ", data=data.tobytes())
    encoded, found = ros_images.color_bytes(message, "here")
    assert found == "png"
    blue, green, red = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)[4:-4, 4:-4].mean(
        axis=(0, 1)
    )
    assert red > 190
    assert max(blue, green) < 10


def test_colors_of_a_mosaic_that_were_compressed_stay_as_they_are() -> None:
    data = cv2.imencode(".jpg", np.full((16, 24, 3), (10, 90, 200), np.uint8))[1].tobytes()
    message = Fields(format="bayer_rggb8; jpeg compressed bgr8", data=data)
    assert ros_images.color_bytes(message, "here") == (data, "jpeg")


def test_a_compressed_mosaic_that_is_not_known_is_refused() -> None:
    data = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
    for pattern, content in (("bayer_rggb16", data), ("bayer_rggb8", b"\xff\xd8\xff")):
        with pytest.raises(DuagError, match=f"here: .*{pattern}, expected"):
            ros_images.color_bytes(Fields(format=f"{pattern}; png", data=content), "here")


def test_two_pixels_that_share_a_color_are_an_even_number() -> None:
    message = Ros(2).image(0, "camera", np.zeros((4, 7, 2), np.uint8), "uyvy")
    with pytest.raises(DuagError, match="here: uyvy is 7 pixels wide, expected an even number"):
        ros_images.color_bytes(message, "here")


def test_color_is_drawn_as_another_camera_at_its_place_sees_it() -> None:
    """Registered depth may belong to the rectified camera, whose focal length is another."""
    lens = RosCamera.of(Ros(2).info(0, "camera", COLOR, (-0.2, 0.03, 0.001, 0.0, 0.0)), False, "here")
    onto = PinholeCamera(
        COLOR.width, COLOR.height, 0.8 * COLOR.fx, 0.8 * COLOR.fy, COLOR.cx + 2, COLOR.cy - 1
    )
    own, other = lens.maps(), lens.maps(onto)
    assert own is not None
    assert other is not None
    assert np.hypot(own[0][60, 80] - 80, own[1][60, 80] - 60) < 1
    v, u = 40, 100
    x, y = (u - onto.cx) / onto.fx, (v - onto.cy) / onto.fy
    seen = own[0], own[1]
    at = np.array([[COLOR.fx * x + COLOR.cx]], np.float32), np.array([[COLOR.fy * y + COLOR.cy]], np.float32)
    wanted = [cv2.remap(image, *at, cv2.INTER_LINEAR)[0, 0] for image in seen]
    assert [image[v, u] for image in other] == pytest.approx(wanted, abs=0.05)
