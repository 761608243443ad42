"""Whether depth counts as seen from the color camera: by frames and cameras, and by names only with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.layouts.ros_camera import RosCamera
from duagc.converters.logs.choice import Chooser
from duagc.converters.logs.files import open_log
from duagc.converters.logs.registration import is_named_registered
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.read import LogFile
from tests.fixtures.ros_bags import SMALL, START_NS, STEP_NS, Ros, still

COLOR_FRAME, DEPTH_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame"
LENS = (0.3, -0.2, 0.0, 0.0, 0.0)
RAW = "/camera/depth/image_rect_raw"


def tied(r: Ros, a: str, b: str, offset: tuple[float, float, float]) -> tuple[str, int, Any]:
    T = se3.from_rotation_translation(np.eye(3), offset)
    rows = [
        r.transform(START_NS, "base_link", b, np.eye(4)),
        r.transform(START_NS, "base_link", a, T),
    ]
    return "/tf_static", START_NS, r.tf(*rows)


def described(recording: Path) -> dict[str, Any]:
    return json.loads((recording / "recording.json").read_text())


@pytest.mark.parametrize(
    ("info", "frame", "lost", "option"),
    [
        ("/camera/color/camera_info", COLOR_FRAME, RAW, "depth"),
        ("/camera/depth/camera_info", DEPTH_FRAME, "/camera/color/image_raw", "color"),
    ],
)
def test_one_camera_info_is_not_that_of_two_cameras(
    tmp_path: Path, info: str, frame: str, lost: str, option: str
) -> None:
    r = Ros(2)
    infos = {info: r.info(START_NS, frame, SMALL)}
    rows = still(r, ("/camera/color/image_raw", COLOR_FRAME), (RAW, DEPTH_FRAME), infos)
    bag = r.write(tmp_path / "bag", [tied(r, COLOR_FRAME, DEPTH_FRAME, (0.06, 0, 0)), *rows], "sqlite3")
    with pytest.raises(
        DuagError, match=f"{lost} of .* no CameraInfo of its own, .*--set {option}_info=TOPIC"
    ):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=[f"{option}_camera=42 42 31.5 23.5"])
    assert described(tmp_path / "rec")["robots"]["alpha"]["sensors"]["depth"].endswith("by the converter")


@pytest.mark.parametrize("slash", ["", "/"])
def test_the_cameras_of_one_frame_may_share_their_camera_info(tmp_path: Path, slash: str) -> None:
    """Drivers of ROS 1 may put a slash before a frame; it is the same one."""
    r = Ros(2)
    infos = {"/camera/color/camera_info": r.info(START_NS, "c", SMALL)}
    color = "/camera/color/image_raw", f"{slash}c"
    bag = r.write(tmp_path / "bag", still(r, color, (RAW, "c"), infos), "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec")
    assert described(tmp_path / "rec")["robots"]["alpha"]["sensors"]["depth"] == "registered"


def test_depth_aligned_to_another_camera_is_registered(tmp_path: Path) -> None:
    r, infrared = Ros(2), PinholeCamera(64, 48, 42.0, 42.0, 31.5, 23.5)
    infos = {
        "/camera/color/camera_info": r.info(START_NS, COLOR_FRAME, SMALL),
        "/camera/aligned_depth_to_infra1/camera_info": r.info(START_NS, "infra1_optical", infrared),
    }
    depth = "/camera/aligned_depth_to_infra1/image_raw", "infra1_optical"
    rows = still(r, ("/camera/color/image_raw", COLOR_FRAME), depth, infos)
    bag = r.write(tmp_path / "bag", [tied(r, COLOR_FRAME, "infra1_optical", (0.06, 0, 0)), *rows], "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec")
    assert described(tmp_path / "rec")["robots"]["alpha"]["sensors"]["depth"].endswith("by the converter")
    assert described(tmp_path / "rec")["warnings"] == []


@pytest.mark.parametrize(("focal", "count"), [(60.3, 1), (66.0, 0)])
def test_a_name_counts_with_the_camera_of_color(tmp_path: Path, focal: float, count: int) -> None:
    """Older drivers give aligned depth a frame of its own that nothing ties."""
    r = Ros(2)
    infos = {
        "/camera/color/camera_info": r.info(START_NS, COLOR_FRAME, SMALL),
        "/camera/aligned_depth_to_color/camera_info": r.info(
            START_NS, "aligned", PinholeCamera(64, 48, focal, focal, 31.5, 23.5)
        ),
    }
    depth = "/camera/aligned_depth_to_color/image_raw", "aligned"
    bag = r.write(
        tmp_path / "bag", still(r, ("/camera/color/image_raw", COLOR_FRAME), depth, infos), "sqlite3"
    )
    if not count:
        with pytest.raises(DuagError, match="/tf_static does not tie them"):
            registry.convert("ros", bag, tmp_path / "rec")
        return
    registry.convert("ros", bag, tmp_path / "rec")
    assert described(tmp_path / "rec")["robots"]["alpha"]["sensors"]["depth"] == "registered"


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/camera/aligned_depth_to_color/image_raw", True),
        ("/camera/depth_registered/sw_registered/image_rect_raw", True),
        ("/camera/depth/aligned/image", True),
        ("/camera/aligned_depth_to_infra1/image_raw", False),
        ("/camera/unregistered/image_raw", False),
        ("/misaligned/depth/image_raw", False),
    ],
)
def test_names_of_registered_depth(topic: str, expected: bool) -> None:
    assert is_named_registered(topic) == expected


def test_unregistered_depth_is_not_chosen_for_its_name(tmp_path: Path) -> None:
    r = Ros(2)
    rows = still(r, depth=("/camera/unregistered/depth", "c"))
    rows += [row for row in still(r, depth=("/camera/depth/image_raw", "c")) if "depth/image" in row[0]]
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda row: row[1]), "sqlite3")
    with open_log([bag]) as log:
        choice = Chooser(log).depth()
    assert choice.topic == ""
    assert len(choice.candidates) == 2


def test_each_camera_has_its_own_depth(tmp_path: Path) -> None:
    """A ZED in front and a RealSense on the arm, whose words are before those of the ZED where depth is chosen."""
    r = Ros(2)
    front = ("/robot/zed/rgb/image_rect_color", "z"), ("/robot/zed/depth/depth_registered", "z")
    arm = ("/robot/arm/color/image_raw", "a"), ("/robot/arm/aligned_depth_to_color/image_raw", "a")
    rows = sorted(still(r, *front) + still(r, *arm), key=lambda row: row[1])
    with open_log([r.write(tmp_path / "bag", rows, "sqlite3")]) as log:
        assert Chooser(log).color().topic == front[0][0]
        assert Chooser(log).depth().topic == front[1][0]
        assert Chooser(log, wanted={"color": arm[0][0]}).depth().topic == arm[1][0]


def test_depth_of_another_size_in_the_frame_of_color_is_registered_to_it(tmp_path: Path) -> None:
    r, half = Ros(2), PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
    topics = "/camera/rgb/image_raw", "/camera/depth_registered/image_raw"
    rows = [row for row in still(r, (topics[0], "c")) if "depth" not in row[0]]
    rows.append(("/camera/depth_registered/camera_info", START_NS, r.info(START_NS, "c", half)))
    for k in range(3):
        at = START_NS + (k + 1) * STEP_NS
        rows.append((topics[1], at, r.image(at, "c", np.full((24, 32), 1500, np.uint16), "16UC1")))
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda row: row[1]), "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec")
    assert described(tmp_path / "rec")["robots"]["alpha"]["sensors"]["depth"].endswith("by the converter")
    depth = first(tmp_path / "rec")[0]
    assert depth.shape == (SMALL.height, SMALL.width)
    assert (np.abs(depth - 1.5) < 1e-3).mean() > 0.9
    with pytest.raises(DuagError, match=r"is 32x24, expected 64x48 of color .*, or registered=no"):
        registry.convert("ros", bag, tmp_path / "rec2", options=["registered=yes"])


@pytest.mark.parametrize(
    ("color", "depth", "found"),
    [
        ("/depth_cam/rgb/image_raw", "/depth_cam/depth_registered/image_raw", True),
        ("/robot/depth_camera/color", "/robot/depth_camera/depth", True),
        ("/camera/depth/image_preview", "/camera/depth/image_raw", False),
        ("/depth_cam/depth_preview/image_raw", "/depth_cam/depth/image_raw", False),
    ],
)
def test_a_sensor_named_for_its_depth_has_color(tmp_path: Path, color: str, depth: str, found: bool) -> None:
    r = Ros(2)
    with open_log([r.write(tmp_path / "bag", still(r, (color, "c"), (depth, "c")), "sqlite3")]) as log:
        chooser = Chooser(log)
        assert chooser.depth().topic == depth
        assert chooser.color().topic == (color if found else "")


def test_a_camera_info_without_a_frame_has_that_of_its_images(tmp_path: Path) -> None:
    r, T = Ros(2), se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 0.5])
    infos = {
        "/rgb/camera_info": r.info(START_NS, "c", SMALL),
        "/depth/camera_info": r.info(START_NS, "", SMALL),
    }
    rows = still(r, ("/rgb/image_raw", "c"), ("/depth/image_raw", "d"), infos)
    tie = "/tf_static", START_NS, r.tf(r.transform(START_NS, "c", "d", T))
    registry.convert("ros", r.write(tmp_path / "bag", [tie, *rows], "sqlite3"), tmp_path / "rec")
    depth, _ = first(tmp_path / "rec")
    assert set(np.round(np.unique(depth[depth > 0]), 3)) == {1.5, 2.5}


def test_depth_with_a_lens_of_its_own_fits_rectified_color(tmp_path: Path) -> None:
    """Color is rectified by name; the CameraInfo of the registered depth says that it is not."""
    r = Ros(2)
    for name, lens in (("bent", LENS), ("straight", ())):
        infos = {
            "/rgb/camera_info": r.info(START_NS, "rgb", SMALL, LENS),
            "/depth_to_rgb/camera_info": r.info(START_NS, "rgb", SMALL, lens),
        }
        rows = still(r, ("/rgb/image_rect_color", "rgb"), ("/depth_to_rgb/image_raw", "rgb"), infos)
        registry.convert("ros", r.write(tmp_path / name, rows, "sqlite3"), tmp_path / f"rec_{name}")
    (bent, color), (straight, same) = (first(tmp_path / f"rec_{name}") for name in ("bent", "straight"))
    np.testing.assert_array_equal(color, same)
    maps = RosCamera(SMALL, LENS, False, "rgb").maps()
    assert maps is not None
    np.testing.assert_array_equal(bent, cv2.remap(straight, *maps, cv2.INTER_NEAREST))
    assert (bent != straight).any()


@pytest.mark.parametrize("topic", ["image_raw", "image_rect_color"])
def test_rectified_color_is_turned_by_its_rectification(tmp_path: Path, topic: str) -> None:
    """Transforms name the frame of the camera, not of the images that R turned."""
    r, R = Ros(2), so3.exp([0.0, np.radians(4.0), 0.0])
    color = r.info(START_NS, "rgb", SMALL)
    color.r = R.ravel()
    infos = {"/rgb/camera_info": color, "/depth/camera_info": r.info(START_NS, "d", SMALL)}
    rows = still(r, (f"/rgb/{topic}", "rgb"), ("/depth/image_raw", "d"), infos)
    tie = "/tf_static", START_NS, r.tf(r.transform(START_NS, "rgb", "d", np.eye(4)))
    registry.convert("ros", r.write(tmp_path / "bag", [tie, *rows], "sqlite3"), tmp_path / "rec")
    depth, _ = first(tmp_path / "rec")
    border = SMALL.rays()[SMALL.height // 2, SMALL.width // 2] - [0.5 / SMALL.fx, 0.0, 0.0]
    column, row = SMALL.project((R if topic == "image_rect_color" else np.eye(3)) @ border)
    line = depth[round(float(row))]
    near, far = np.flatnonzero((line > 0) & (line < 1.5)), np.flatnonzero(line > 1.5)
    assert near.max() < far.min()
    assert abs((near.max() + far.min()) / 2 - column) < 1.0


def test_an_odd_rotation_of_rectified_color_is_refused(tmp_path: Path) -> None:
    r = Ros(2)
    for number, R in enumerate([np.full(9, 0.5), np.diag([1.0, 1.0, -1.0]).ravel()]):
        color = r.info(START_NS, "rgb", SMALL)
        color.r = R
        infos = {"/rgb/camera_info": color, "/depth_to_rgb/camera_info": r.info(START_NS, "rgb", SMALL)}
        rows = still(r, ("/rgb/image_rect_color", "rgb"), ("/depth_to_rgb/image_raw", "rgb"), infos)
        log = r.write(tmp_path / f"bag{number}", rows, "sqlite3")
        with pytest.raises(DuagError, match=r"R is \[.*, expected a rotation"):
            registry.convert("ros", log, tmp_path / "rec")


def test_depth_that_says_it_has_no_distortion_is_not_undistorted(tmp_path: Path) -> None:
    r = Ros(2)
    infos = {
        "/oak/rgb/camera_info": r.info(START_NS, "rgb", SMALL, LENS),
        "/oak/stereo/camera_info": r.info(START_NS, "rgb", SMALL),
    }
    rows = still(r, ("/oak/rgb/image_raw", "rgb"), ("/oak/stereo/image_raw", "rgb"), infos)
    registry.convert("ros", r.write(tmp_path / "bag", rows, "sqlite3"), tmp_path / "rec")
    depth, _ = first(tmp_path / "rec")
    expected = np.full((48, 64), 2.0)
    expected[:, :32] = 1.0
    np.testing.assert_allclose(depth[depth > 0], expected[depth > 0], atol=1e-6)
    assert (depth > 0).mean() > 0.8


def first(recording: Path) -> tuple[np.ndarray, np.ndarray]:
    """Depth and color of the first frame."""
    with open_rgbd(recording / "alpha.mcap") as log:
        frame = log.frame(0)
        return frame.depth, frame.color


@pytest.mark.parametrize(
    ("frames", "offset", "count"),
    [
        (("rgb_link", "depth_link"), (0.0, 0.05, 0.0), 1),
        (("rgb_link", "depth_link"), (0.032, 0.002, -0.004), 0),
        (("rgb_optical", "depth_optical"), (0.0, 0.05, 0.0), 0),
    ],
)
def test_frames_that_may_have_x_forward_are_warned_of(
    tmp_path: Path, frames: tuple[str, str], offset: tuple[float, float, float], count: int
) -> None:
    """Cameras lie side by side: along x of optical frames, along y of bodies."""
    r = Ros(2)
    rows = still(r, ("/rgb/image", frames[0]), ("/depth/image", frames[1]))
    bag = r.write(tmp_path / "bag", [tied(r, *frames, offset), *rows], "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec")
    warnings = described(tmp_path / "rec")["warnings"]
    assert sum("taken as optical frames (z forward)" in text for text in warnings) == count
    with LogFile(tmp_path / "rec" / "alpha.mcap") as log:
        assert "/alpha/camera/depth" in log.channels
