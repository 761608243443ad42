"""Names of topics as recorders of ROS 1 may write them: without the slash before them."""

from __future__ import annotations

from pathlib import Path

import pytest

from duagc.converters import registry
from duagc.converters.logs import open_log
from duagc.converters.logs.cameras import is_rectified
from duagc.converters.logs.choice import Chooser, info_parts
from duagc.converters.logs.files import is_below
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import info
from tests.fixtures.ros_bags import SMALL, START_NS, Ros, still


def test_topics_without_a_leading_slash_are_found(tmp_path: Path) -> None:
    r = Ros(1)
    rows = [(topic.lstrip("/"), at, message) for topic, at, message in still(r)]
    registry.convert("ros", r.write(tmp_path / "bag", rows, "plain"), tmp_path / "rec")
    assert info(tmp_path / "rec")["robots"]["alpha"]["frames"] > 0


def test_namespaces_may_be_given_without_a_slash(tmp_path: Path) -> None:
    r = Ros(2)
    rows = [(f"/{robot}{topic}", at, message) for robot in ("r1", "r2") for topic, at, message in still(r)]
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda row: row[1]), "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec", options=["namespaces=r1, /r2"])
    assert sorted(info(tmp_path / "rec")["robots"]) == ["r1", "r2"]


def test_a_namespace_is_no_beginning_of_a_word() -> None:
    assert is_below("/jackal/color", "/jackal")
    assert is_below("jackal/color", "/jackal/")
    assert not is_below("/jackal2/color", "/jackal")
    assert is_below("/color", "")


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/rgb/image_rect_color", True),
        ("/camera/rgb/image_rect_color/ffmpeg", True),
        ("/camera/depth/image_rect_raw/compressedDepth", True),
        ("/kinect2/qhd/image_color_rect/compressed", True),
        ("/camera/left_rectified", True),
        ("/camera/rgb/image_raw", False),
        ("/camera/rgb/image_raw/compressed", False),
        ("/image_rect/raw", False),
        ("/camera/correct", False),
    ],
)
def test_names_of_rectified_images(topic: str, rectified: bool) -> None:
    assert is_rectified(topic) == rectified


@pytest.mark.parametrize(
    ("color", "depth", "infos"),
    [
        ("/rgb", "/depth", ("/camera_info", "/camera_info")),  # Isaac Sim
        ("/cam/image_raw", "/cam/depth/image_raw", ("/cam/camera_info", "/cam/depth/camera_info")),  # Gazebo
        ("/a_rgb_image", "/a_depth_image", ("/a_rgb_camera_info", "/a_depth_camera_info")),
        ("/cam/image", "/cam/depth_image", ("/cam/camera_info", "/cam/camera_info")),
    ],
)
def test_camera_info_lies_next_to_its_images(
    color: str, depth: str, infos: tuple[str, str], tmp_path: Path
) -> None:
    r = Ros(2)
    rows = still(r, (color, "c"), (depth, "c"), {t: r.info(START_NS, "c", SMALL) for t in infos}, frames=1)
    with open_log([r.write(tmp_path / "bag", rows, "mcap")]) as log:
        chooser = Chooser(log)
        found = [
            chooser.info(f"{name}_info", topic).topic for name, topic in (("color", color), ("depth", depth))
        ]
    assert found == list(infos)


@pytest.mark.parametrize("name", ["", "/", ".", "//"])
def test_images_on_a_topic_without_a_name_are_looked_at_too(name: str) -> None:
    assert info_parts(name)[-1] == ("camera_info",)


def test_images_without_camera_info_of_their_own_are_said_with_what_mends_them(tmp_path: Path) -> None:
    """As of Azure Kinect's driver where only the color camera's was recorded."""
    r = Ros(2)
    rows = still(
        r,
        ("/rgb/image_raw", "c"),
        ("/depth_to_rgb/image_raw", "c"),
        {"/rgb/camera_info": r.info(START_NS, "c", SMALL)},
    )
    bag = r.write(tmp_path / "bag", rows, "mcap")
    said = "/depth_to_rgb/image_raw has CameraInfo of its own on none of /rgb/camera_info"
    remedy = "expected --set depth_info=TOPIC if one is of its camera, or depth_camera='fx fy cx cy'"
    with pytest.raises(DuagError, match=f"{said}; {remedy}"):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=["depth_info=/rgb/camera_info"])
    assert info(tmp_path / "rec")["robots"]["alpha"]["frames"] > 0
