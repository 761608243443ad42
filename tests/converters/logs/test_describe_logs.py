"""What `duagc info` says about logs of other programs, and the TOML files that choose what is converted."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters import registry
from duagc.converters.logs import describe
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from duagc.pipeline.recording import read_log
from tests.fixtures.box_room import path
from tests.fixtures.foreign_mcap import digests, write
from tests.fixtures.kimera_multi import imu
from tests.fixtures.ros_bags import FRAMES, REAL, START_NS, Ros, scene, still
from tests.fixtures.ros_clocks import both

run = CliRunner()


def test_topics_rates_and_choices_are_shown(tmp_path: Path) -> None:
    r = Ros(1)
    rows = scene(r)
    rows += [
        ("/imu/data", START_NS + k * 10_000_000, imu(r, START_NS + k * 10_000_000, "i", [0, 0, 1]))
        for k in range(9)
    ]
    bag = r.write(tmp_path / "kitchen", sorted(rows, key=lambda x: x[1]), "bz2")
    content = describe.describe(bag)
    (log,) = content["logs"].values()
    assert log["time_sources"] == ["header", "log"]
    color = log["topics"]["/camera/color/image_raw"]
    assert color["messages"] == FRAMES
    assert color["rate_hz"] == pytest.approx(20)
    assert color["recorded_after_header_s"] == pytest.approx(0.005)
    assert color["type"] == "sensor_msgs/msg/Image"
    assert log["topics"]["/tf_static"]["recorded_after_header_s"] is None
    robot = content["robots"]["alpha"]
    assert robot["problem"] is None
    assert robot["frames"] == FRAMES
    assert robot["depth"] == "moved into the color camera"
    assert robot["choices"]["color_info"]["topic"] == "/camera/color/camera_info"
    assert robot["choices"]["depth"]["why"] == "the only images that are depth"
    assert robot["others"]["imu"] == ["/imu/data"]
    assert robot["others"]["truth"] == ["/odom"]
    shown = run.invoke(app, ["info", str(bag)])
    assert shown.exit_code == 0
    assert "  color       /camera/color/image_raw: the only images that are color" in shown.stdout
    assert "20.00 Hz  sensor_msgs/msg/Image  recorded 0.005 s after its header" in shown.stdout
    assert re.search(r"^log \S+: [\d.]+ kB, ", shown.stdout, re.MULTILINE)
    assert json.loads(run.invoke(app, ["info", str(bag), "--json"]).stdout)["robots"].keys() == {"alpha"}


def test_the_toml_file_converts_as_the_log_itself(tmp_path: Path) -> None:
    r = Ros(2)
    log = write(tmp_path / "logs" / "a.mcap", scene(r), "protobuf", r)
    text = run.invoke(app, ["info", str(log), "--toml"]).stdout
    (tmp_path / "a.toml").write_text(text)
    registry.convert("ros", log, tmp_path / "rec")
    registry.convert("ros", tmp_path / "a.toml", tmp_path / "rec2")
    assert digests(tmp_path / "rec") == digests(tmp_path / "rec2")
    moved = tmp_path / "logs" / "b.toml"
    moved.write_text(text.replace(str(log.resolve()), "a.mcap").replace("# truth", "truth"))
    os.rename(tmp_path / "logs", tmp_path / "elsewhere")
    registry.convert("ros", tmp_path / "elsewhere" / "b.toml", tmp_path / "rec3")
    assert set(digests(tmp_path / "rec3")) == {"alpha.mcap", "alpha.groundtruth.mcap"}
    assert digests(tmp_path / "rec3")["alpha.mcap"] == digests(tmp_path / "rec")["alpha.mcap"]
    assert str(tmp_path) not in (tmp_path / "rec3" / "recording.json").read_text()


def test_namespaces_that_decide_become_robots(tmp_path: Path) -> None:
    """Two robots in one log: separated, their clocks compared, and both converted by the TOML file."""
    r = Ros(2)
    jackal, husky = both(r)
    log = r.write(tmp_path / "bag", sorted(jackal + husky, key=lambda x: x[1]), "mcap")
    shown = run.invoke(app, ["info", str(log)]).stdout
    assert "robot husky" in shown
    assert "convert by --set namespaces=/husky,/jackal" in shown
    assert "clock       add -3.250000 s (one recorder)" in shown  # jackal's, on the clock of husky
    assert "warning: jackal: its times" in shown
    (tmp_path / "team.toml").write_text(run.invoke(app, ["info", str(log), "--toml"]).stdout)
    registry.convert("ros", tmp_path / "team.toml", tmp_path / "rec")
    robots = json.loads((tmp_path / "rec" / "recording.json").read_text())["robots"]
    assert list(robots) == ["husky", "jackal"]
    same = describe.describe(tmp_path / "team.toml")["robots"]
    assert [row["namespace"] for row in same.values()] == ["/husky", "/jackal"]


def test_robots_with_unlike_cameras_are_several(tmp_path: Path) -> None:
    """Words of one robot's topics would decide for it, and the other would be left out."""
    r = Ros(2)
    realsense = (
        ("/jackal/camera/color/image_raw", "c"),
        ("/jackal/camera/aligned_depth_to_color/image_raw", "c"),
    )
    openni = ("/husky/camera/rgb/image_raw", "c"), ("/husky/camera/depth_registered/image_raw", "c")
    rows = sorted(still(r, *realsense) + still(r, *openni), key=lambda row: row[1])
    bag = r.write(tmp_path / "bag", rows, "mcap")
    assert sorted(describe.describe(bag)["robots"]) == ["husky", "jackal"]
    with pytest.raises(
        DuagError, match=r"below /husky, /jackal, expected --set namespaces=/husky,/jackal if each"
    ):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=["color=/husky/camera/rgb/image_raw"])
    content = json.loads((tmp_path / "rec" / "recording.json").read_text())
    assert content["robots"]["alpha"]["sensors"]["depth_topic"] == openni[1][0]


def test_a_topic_that_is_said_is_of_one_robot(tmp_path: Path) -> None:
    """Of several robots in one log each gets its own: nobody's odometry becomes another's truth."""
    r = Ros(2)
    rows = scene(r, prefix="/jackal") + scene(r, prefix="/husky", poses=path(FRAMES, 0.2))
    log = r.write(tmp_path / "bag", sorted(rows, key=lambda x: x[1]), "mcap")
    options = ["namespaces=/jackal,/husky"]
    for option in ("truth=/jackal/odom", "odometry=/jackal/odom", "truth_file=gt.tum"):
        with pytest.raises(DuagError, match=r"for several robots, expected .* a TOML file that says whose"):
            registry.convert("ros", log, tmp_path / "rec", options=[*options, option])
    registry.convert("ros", log, tmp_path / "rec", options=[*options, "truth={namespace}/odom"])
    for robot, start in (("jackal", 0.0), ("husky", 0.2)):
        records = read_log(tmp_path / "rec" / f"{robot}.groundtruth.mcap")
        assert np.allclose(
            [m.unpack_pose_in_frame(e.proto()) for e in records], path(FRAMES, start), atol=1e-9
        )


def test_a_file_of_true_poses_is_of_one_robot(tmp_path: Path) -> None:
    r = Ros(2)
    for name in ("a", "b"):
        write(tmp_path / f"{name}.mcap", scene(r), "protobuf", r)
    rows = "".join(f'[robots.{name}]\nlogs = ["{name}.mcap"]\n' for name in ("a", "b"))
    (tmp_path / "team.toml").write_text(rows)
    (tmp_path / "said.toml").write_text(f'truth_file = "gt.tum"\n{rows}')
    for listed, options in ((tmp_path / "said.toml", []), (tmp_path / "team.toml", ["truth_file=gt.tum"])):
        with pytest.raises(
            DuagError, match=r"truth_file is said for several robots, expected it in \[robots"
        ):
            registry.convert("ros", listed, tmp_path / "rec", options=options)
    (tmp_path / "one.toml").write_text('truth_file = "gt.tum"\n[robots.a]\nlogs = ["a.mcap"]\n')
    with pytest.raises(DuagError, match=f"{tmp_path / 'gt.tum'}: No such file"):  # next to the TOML file
        registry.convert("ros", tmp_path / "one.toml", tmp_path / "rec")


def test_what_is_not_decided_lists_its_candidates(tmp_path: Path) -> None:
    r = Ros(1)
    rows = scene(r) + [
        (t.replace("/camera/color", "/back/rgb"), ns, m) for t, ns, m in scene(r) if "/camera/color" in t
    ]
    rows += [
        (t.replace("/camera/color", "/left/gray"), ns, m) for t, ns, m in scene(r) if "/camera/color" in t
    ]
    rows = [(t.replace("/camera/color", "/front/rgb"), ns, m) for t, ns, m in rows]
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda x: x[1]), "plain")
    robot = describe.describe(bag)["robots"]["alpha"]
    assert robot["choices"]["color"]["topic"] == ""
    assert "expected --set color=TOPIC" in robot["problem"]
    text = run.invoke(app, ["info", str(bag), "--toml"]).stdout
    assert '# color = "/back/rgb/image_raw"\n# color = "/front/rgb/image_raw"\n' in text
    (tmp_path / "a.toml").write_text(text.replace('# color = "/front', 'color = "/front'))
    registry.convert("ros", tmp_path / "a.toml", tmp_path / "rec")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"found no \[robots.NAME\]"),
        ("[robots]\n", r"found no \[robots.NAME\]"),
        ("x = ", "not valid TOML"),
        ('colo = "/a"\n[robots.a]\nlogs = ["a.mcap"]\n', "colo is no option; expected perhaps color"),
        (
            '[robots.a]\nlogs = ["a.mcap"]\ndept = "/a"\n',
            r"\[robots.a\] dept is no option; expected perhaps depth",
        ),
        ('[robots.a]\nlog = ["a.mcap"]\n', r"\[robots.a\] logs = None, expected a list"),
        ("[robots.a]\nlogs = []\n", r"logs = \[\], expected a list"),
        ("[robots.a]\nlogs = [3]\n", r"logs = \[3\], expected a list"),
        ('[robots.A]\nlogs = ["a.mcap"]\n', "named with lower-case letters"),
        ('[robots.a]\nlogs = ["b.mcap"]\n', "b.mcap: no such file"),
        (
            '[robots.a]\nlogs = ["a.mcap"]\nnamespace = "jackal"\n',
            "namespace = 'jackal', expected text that begins",
        ),
        (
            '[robots.a]\nlogs = ["a.mcap"]\ndepth_scale = -1\n',
            r"\[robots.a\]: depth_scale = -1: expected a number greater than 0",
        ),
        ('time_source = "hedaer"\n[robots.a]\nlogs = ["a.mcap"]\n', "time_source = 'hedaer'"),
        ('pieces = true\n[robots.a]\nlogs = ["a.mcap"]\n', "pieces is said, expected `logs`"),
        (
            '[robots.a]\nlogs = ["a.mcap"]\ncolor = "/camera/color/image"\n',
            "color topic /camera/color/image not found, expected perhaps /camera/color/image_raw",
        ),
        (
            '[robots.a]\nlogs = ["a.mcap"]\nimu = "/imu"\n',
            "imu topic /imu not found, expected an IMU, and there is none",
        ),
    ],
)
def test_mistakes_in_a_toml_file_are_one_line(tmp_path: Path, text: str, message: str) -> None:
    r = Ros(2)
    write(tmp_path / "a.mcap", scene(r), "cdr", r)
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(DuagError, match=message) as caught:
        registry.convert("ros", tmp_path / "a.toml", tmp_path / "rec")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "rec").exists()


def test_the_command_line_has_the_last_word(tmp_path: Path) -> None:
    r = Ros(2)
    write(tmp_path / "a.mcap", scene(r), "cdr", r)
    (tmp_path / "a.toml").write_text('time_source = "header"\n[robots.a]\nlogs = ["a.mcap"]\n')
    out = run.invoke(
        app,
        ["convert", "ros", str(tmp_path / "a.toml"), "--time-source", "log", "--out", str(tmp_path / "rec")],
    )
    assert out.exit_code == 0
    row = json.loads((tmp_path / "rec" / "recording.json").read_text())["robots"]["a"]
    assert row["start_ns"] == next(ns for t, ns, _ in scene(r) if t == "/camera/color/image_raw")
    with pytest.raises(DuagError, match="ros: time_sorce is no option; expected perhaps time_source"):
        registry.convert("ros", tmp_path / "a.mcap", tmp_path / "rec2", options=["time_sorce=log"])


def test_our_own_files_are_not_foreign(tmp_path: Path) -> None:
    r = Ros(2)
    log = write(tmp_path / "logs" / "a.mcap", scene(r, poses=path(FRAMES)), "cdr", r)
    registry.convert("ros", log, tmp_path / "rec")
    assert describe.is_foreign(log)
    assert describe.is_foreign(tmp_path / "logs")
    for own in (
        tmp_path / "rec",
        tmp_path / "rec" / "alpha.mcap",
        tmp_path / "rec" / "recording.json",
        tmp_path / "no",
    ):
        assert not describe.is_foreign(own)
    out = run.invoke(app, ["info", str(tmp_path / "rec"), "--toml"])
    assert isinstance(out.exception, DuagError)


def test_what_a_cut_log_holds_can_be_saved_and_converted(tmp_path: Path) -> None:
    r = Ros(2)
    log = write(tmp_path / "a.mcap", scene(r), "protobuf", r)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-3000])
    assert "duagc recover" in str(run.invoke(app, ["info", str(cut)]).exception)
    saved = run.invoke(app, ["recover", str(cut), "--out", str(tmp_path / "saved.mcap")])
    assert saved.exit_code == 3, saved.exception  # the end is lost
    assert "robot alpha: " in run.invoke(app, ["info", str(tmp_path / "saved.mcap")]).stdout
    registry.convert("ros", tmp_path / "saved.mcap", tmp_path / "rec")
    frames = json.loads((tmp_path / "rec" / "recording.json").read_text())["robots"]["alpha"]["frames"]
    assert 0 < frames <= FRAMES


def test_depth_that_is_aligned_goes_before_raw_depth(tmp_path: Path) -> None:
    """As a RealSense publishes: both, and infrared; aligned depth is taken and not moved."""
    r = Ros(2)
    rows = []
    for topic, ns, message in scene(r):
        rows.append((topic, ns, message))
        if topic.endswith("color/camera_info"):
            rows.append(("/camera/aligned_depth_to_color/camera_info", ns, message))
        if topic.endswith("image_rect_raw"):
            time = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            aligned = np.full((120, 160), 1500, np.uint16)
            rows.append(
                ("/camera/aligned_depth_to_color/image_raw", ns, r.image(time, "_color", aligned, "16UC1"))
            )
            gray = r.image(time, "_infra", np.zeros((90, 120), np.uint8), "mono8")
            rows += [(f"/camera/infra{k}/image_rect_raw", ns, gray) for k in (1, 2)]
    robot = describe.describe(r.write(tmp_path / "bag", rows, "mcap"))["robots"]["alpha"]
    assert robot["choices"]["depth"]["topic"] == "/camera/aligned_depth_to_color/image_raw"
    assert robot["choices"]["depth_info"]["topic"] == "/camera/aligned_depth_to_color/camera_info"
    assert robot["choices"]["color"]["topic"] == "/camera/color/image_raw"
    assert robot["depth"] == "registered to color already"
    assert robot["problem"] is None


@pytest.mark.skipif(not REAL.is_dir(), reason="the real bags are not there")
@pytest.mark.parametrize("name", sorted(p.name for p in REAL.glob("*")) if REAL.is_dir() else [])
def test_real_logs_are_described(name: str) -> None:
    content = describe.describe(REAL / name)
    (log,) = content["logs"].values()
    assert sum(t["messages"] for t in log["topics"].values()) > 20
    assert content["robots"]["alpha"]["problem"].startswith(str(REAL / name))
    assert describe.toml_text(content)
