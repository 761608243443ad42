"""Folders of images in which a thing stands twice, is huge, or is in other units: named, or at least said."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from duagc.converters import registry
from duagc.converters.layouts.image_folder import stamps_of
from duagc.converters.layouts.tum_layout import Poses, nanoseconds
from duagc.pipeline.base.errors import DuagError
from tests.fixtures.image_folders import CASES

Spoil = Callable[[Path], object]
HUGE = "9" * 22


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The fixture of a dataset, made when it is first asked for."""
    found: dict[str, Path] = {}

    def of(name: str) -> Path:
        if name not in found:
            root = tmp_path_factory.mktemp(name.replace("-", "_"))
            found[name] = CASES[name][0](root / "data")
        return found[name]

    return of


def convert(name: str, source: Path, tmp_path: Path, spoil: Spoil) -> list[str]:
    """Warnings of the recording of a copy that was spoiled."""
    copy = tmp_path / "data" / source.name
    shutil.copytree(source.parent, copy.parent)
    spoil(copy)
    _, options, robots, _ = CASES[name]
    registry.convert(name, copy, tmp_path / "out", robots=robots, options=options)
    return list(json.loads((tmp_path / "out" / "recording.json").read_text())["warnings"])


def copied(old: str, new: str) -> Spoil:
    return lambda p: shutil.copy(p / old, p / new)


def added(file: str, text: str) -> Spoil:
    return lambda p: (p / file).write_text((p / file).read_text() + text)


def swapped(file: str, pattern: str, new: str) -> Spoil:
    return lambda p: (p / file).write_text(re.sub(pattern, new, (p / file).read_text(), count=1))


def of_times(p: Path) -> None:
    """Poses by time at 30 Hz instead of by number."""
    lines = [line.split() for line in (p / "traj0.gt.freiburg").read_text().splitlines()]
    text = "\n".join(" ".join([str(int(words[0]) / 30), *words[1:]]) for words in lines)
    (p / "traj0.gt.freiburg").write_text(text)


def renumbered(p: Path) -> None:
    for kind, end in (("color", "jpg"), ("depth", "png")):
        (p / kind / f"10.{end}").rename(p / kind / f"{HUGE}.{end}")


def photographed_twice(p: Path) -> None:
    (file,) = p.rglob("*.json")
    content = json.loads(file.read_text())
    content["test_frames"] += content["frames"][:1]
    file.write_text(json.dumps(content))


def stated(**values: object) -> Spoil:
    """Of the camera."""

    def state(p: Path) -> None:
        (file,) = p.rglob("*.json")
        file.write_text(json.dumps(json.loads(file.read_text()) | values))

    return state


def said_bad(word: object) -> Spoil:
    def say(p: Path) -> None:
        (file,) = p.rglob("*.json")
        content = json.loads(file.read_text())
        content["frames"][0]["is_bad"] = word
        file.write_text(json.dumps(content))

    return say


def of_open_loris(p: Path) -> None:
    (p / "rgb.txt").rename(p / "color.txt")
    (p / "depth.txt").unlink()


def nested(p: Path) -> None:
    next(p.rglob("*.json")).write_text("[" * 200_000)


NAMED = [
    ("replica", copied("results/frame000002.jpg", "results/frame1.jpg"), "found together with frame000001.jpg"),
    ("replica", copied("results/depth000002.png", "results/depth1.png"), "found together with depth000001.png"),
    ("replica", lambda p: nested(p.parent), "cam_params.json: not valid JSON"),
    ("replica", swapped("../cam_params.json", '"fx": ', '"fx": -'), "cam_params.json: camera PinholeCamera"),
    ("replica", swapped("../cam_params.json", '"scale": ', '"scale": -'), "cam_params.json: scale is -6553.5"),
    ("replica", swapped("traj.txt", r"^(\S+ \S+ \S+) \S+", r"\1 1e300"), "traj.txt:1: is 1e+300 m away"),
    ("aria-multiagent", lambda p: (p / "agent_0").rename(p / "agent_01"), "found together with agent_01"),
    ("icl-nuim", added("associations.txt", "1 depth/3.png 1 rgb/3.png\n"), "associations.txt:5: found image 1 again"),
    ("icl-nuim", of_times, "freiburg: 4 poses have 1 numbers, expected whole numbers of images"),
    ("icl-nuim", swapped("traj0.gt.freiburg", r"^(\S+) \S+", r"\1 1e300"), "freiburg:1: is 1e+300 m away"),
    ("scannet", copied("color/10.jpg", "color/01.jpg"), "1.jpg: found together with 01.jpg, expected one of them"),
    ("scannet", renumbered, f"frame {HUGE} at 30 Hz, expected one within 146 years"),
    ("scannet", swapped("intrinsic/intrinsic_depth.txt", r"^\S+", "nan"), "intrinsic_depth.txt: camera PinholeCamera"),
    ("scannetpp", photographed_twice, "json: found DSC00001.JPG 2 times, expected every image once"),
    ("scannetpp", stated(camera_model="OPENCV_FISHEYE"), "json: camera_model is 'OPENCV_FISHEYE', expected 'PINHOLE'"),
    ("scannetpp", stated(camera_model="OPENCV", k1=0.0, k2=-0.02), "json: k2 is -0.02, expected 0, as of undistorted"),
    ("scannetpp", stated(k1="x"), "json: k1 is 'x', expected 0, as of undistorted images"),
    ("scannetpp", said_bad("false"), "json: is_bad of DSC00001.JPG is 'false', expected true or false"),
    ("scannetpp", nested, "transforms_undistorted.json: not valid JSON"),
    ("tum", of_open_loris, "rgb.txt: No such file, but color.txt, groundtruth.txt; expected rgb.txt and depth.txt"),
    ("tum", added("rgb.txt", "1e999999 rgb/y.png\n"), "rgb.txt:10: '1e999999', expected a time in seconds before"),
    ("tum", added("rgb.txt", "-8694968547.95 rgb/y.png\n"), "expected a time in seconds after the year 1823"),
    ("tum", added("groundtruth.txt", "1e8 1e300 0 0 0 0 0 1\n"), "groundtruth.txt:35: is 1e+300 m away"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), NAMED, ids=[f"{n[0]}: {n[2]}" for n in NAMED])
def test_what_stands_twice_or_cannot_be_is_named(
    sources: Callable[[str], Path], tmp_path: Path, name: str, spoil: Spoil, message: str
) -> None:
    with pytest.raises(DuagError) as caught:
        convert(name, sources(name), tmp_path, spoil)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_poses_in_millimeters_are_not_passed_over(sources: Callable[[str], Path], tmp_path: Path) -> None:
    """Nothing is seen twice then, so that depth says nothing of the poses."""

    def in_millimeters(p: Path) -> None:
        rows = [[float(word) for word in line.split()] for line in (p / "traj.txt").read_text().splitlines()]
        for row in rows:
            row[3:12:4] = [1000 * value for value in row[3:12:4]]
        (p / "traj.txt").write_text("\n".join(" ".join(map(repr, row)) for row in rows))

    warnings = convert("replica", sources("replica"), tmp_path, in_millimeters)
    assert any("749 m apart and show too little of each other" in text for text in warnings)
    (tmp_path / "right").mkdir()
    assert not any(
        "apart" in text for text in convert("replica", sources("replica"), tmp_path / "right", str)
    )


def test_of_one_time_the_last_pose_counts(tmp_path: Path) -> None:
    """As in the tools of TUM, and as in trajectories that are read for evaluation."""
    file = tmp_path / "groundtruth.txt"
    file.write_text("1.0 1 0 0 0 0 0 1\n2.0 5 0 0 0 0 0 1\n1.0 3 0 0 0 0 0 1\n")
    poses = Poses.read(file)
    assert poses.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000]
    assert poses.T_world_body[:, 0, 3].tolist() == [3.0, 5.0]


@pytest.mark.parametrize("quaternion", ["0 1e200 0 1e200", "0 0 0 525", "0 0 0 0.01"])
def test_a_pose_whose_quaternion_is_none_counts_as_no_pose(tmp_path: Path, quaternion: str) -> None:
    """Its length would be infinite, and its rotation none."""
    file = tmp_path / "groundtruth.txt"
    file.write_text(f"1.0 1 0 0 0 0 0 1\n2.0 5 0 0 {quaternion}\n")
    poses = Poses.read(file)
    assert (poses.stamps_ns.tolist(), poses.unusable) == ([1_000_000_000], 1)
    file.write_text(f"2.0 5 0 0 {quaternion}\n")
    with pytest.raises(DuagError, match="found no pose"):
        Poses.read(file)


def test_numbers_of_frames_become_times_of_this_century() -> None:
    assert stamps_of([0, 1, 10], 30, "here") == [0, 33_333_333, 333_333_333]
    with pytest.raises(DuagError, match=r"^here: frame 999999999999 at 30 Hz"):
        stamps_of([0, 999_999_999_999], 30, "here")


def test_times_keep_their_nanoseconds_also_with_an_exponent() -> None:
    assert nanoseconds("1.305031102175304123e9", "here") == 1_305_031_102_175_304_123
    for text in ("nan", "snan", "inf", "x"):
        with pytest.raises(DuagError, match=r"^here: .* expected a time in seconds$"):
            nanoseconds(text, "here")
