"""Datasets that are folders of images: fixtures in their own files, true to the last bit where they are lossless."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.datasets import bonn, icl_nuim, tum
from duagc.converters.layouts import tum_layout
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd, read_log
from duagc.pipeline.recording.rolling_shutter import Readout
from duagc.schemas import topics
from tests.fixtures.box_room import path, render, save
from tests.fixtures.image_folders import CASES, FRAMES, smooth, traj_line, tum_line

REAL = Path(__file__).parents[4] / "shared" / "data" / "replica_office0" / "office0"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path]]:
    """Dataset -> its fixture and the recording made of it."""
    out = {}
    for name, (make, options, _, _) in CASES.items():
        root = tmp_path_factory.mktemp(name.replace("-", "_"))
        src = make(root / "data")
        registry.convert(name, src, root / "recording", options=options)
        out[name] = src, root / "recording"
    return out


def true_poses(recording: Path, robot: str) -> list[np.ndarray]:
    topic = topics.GROUNDTRUTH_POSE.of(robot)
    records = read_log(recording / f"{robot}.groundtruth.mcap", topics=[topic])
    return [m.unpack_pose_in_frame(record.proto()) for record in records]


@pytest.mark.parametrize("name", CASES)
def test_what_is_in_the_recording_is_what_was_rendered(made: dict[str, tuple[Path, Path]], name: str) -> None:
    _, _, robots, poses = CASES[name]
    _, recording = made[name]
    description = json.loads((recording / "recording.json").read_text())
    assert len(description["robots"]) == robots
    found = true_poses(recording, "alpha")
    assert len(found) == len(poses)
    for T, expected in zip(found, poses, strict=True):
        assert np.allclose(T, expected, atol=2e-5)
    with open_rgbd(recording / "alpha.mcap") as log:
        frame = log.frame(0)
        color, z = render(log.camera, poses[0])
        seen = frame.depth > 0
        assert seen.mean() > 0.85
        error = np.abs(frame.depth - z)[seen]
        assert np.median(error) < 2e-3
        assert np.median(np.abs(frame.color[seen].astype(int) - color[seen])) <= 3
        assert log.frame(1).stamp_ns > frame.stamp_ns == 0
    check = description["checks"]["alpha"]
    assert check["reprojection_median_m"] < 0.01


@pytest.mark.parametrize("name", ["bonn", "icl-nuim", "replica", "scannet", "scannetpp", "tum"])
def test_a_limit_takes_the_first_frames(
    made: dict[str, tuple[Path, Path]], tmp_path: Path, name: str
) -> None:
    src, whole = made[name]
    registry.convert(name, src, tmp_path / "few", options=[*CASES[name][1], "frame_limit=2"], robots=1)
    with open_rgbd(tmp_path / "few" / "alpha.mcap") as few, open_rgbd(whole / "alpha.mcap") as log:
        assert len(few) == 2 < len(log)
        assert few.frame(1).stamp_ns == log.frame(1).stamp_ns
        assert np.array_equal(few.frame(1).color, log.frame(1).color)


@pytest.mark.parametrize("name", ["replica", "replica-multiagent", "icl-nuim", "scannetpp"])
def test_lossless_is_lossless(made: dict[str, tuple[Path, Path]], name: str) -> None:
    """Where nothing has to be resampled, color is the file's bytes and depth its numbers."""
    src, recording = made[name]
    color_file = sorted([*src.rglob("frame*.jpg"), *src.rglob("rgb/*.png"), *src.rglob("*.JPG")])[0]
    depth_file = sorted([*src.rglob("depth0*.png"), *src.rglob("depth/*.png"), *src.rglob("*depths/*.png")])[
        0
    ]
    color = next(iter(read_log(recording / "alpha.mcap", topics=[topics.COLOR.of("alpha")]))).proto()
    depth = next(iter(read_log(recording / "alpha.mcap", topics=[topics.DEPTH.of("alpha")]))).proto()
    assert color.data == color_file.read_bytes()
    stored = m.unpack_depth(depth, "depth")
    assert np.array_equal(stored, cv2.imread(str(depth_file), cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize("name", ["tum", "bonn"])
def test_images_with_distortion_are_kept_and_seen_without_it(
    made: dict[str, tuple[Path, Path]], name: str
) -> None:
    src, recording = made[name]
    files = sorted(src.rglob("rgb/*.png"))
    stored = [r.proto() for r in read_log(recording / "alpha.mcap", topics=[topics.COLOR.of("alpha")])]
    assert [image.data for image in stored] == [file.read_bytes() for file in files[: len(stored)]]
    with open_rgbd(recording / "alpha.mcap") as log:
        assert log.lens is not None
        assert log.valid is not None
        K, lens, frame = log.camera.matrix(), np.array(log.lens.distortion), log.frame(0)
        size = log.camera.width, log.camera.height
        maps = cv2.initUndistortRectifyMap(K, lens, np.eye(3), K, size, cv2.CV_32FC1)
        straight = cv2.remap(cv2.imread(str(files[0])), *maps, cv2.INTER_LINEAR)[:, :, ::-1]
        assert np.abs(frame.color.astype(int) - straight)[log.valid].max() <= 1


def test_times_and_warnings(made: dict[str, tuple[Path, Path]]) -> None:
    def stated(name: str) -> str:
        return " ".join(json.loads((made[name][1] / "recording.json").read_text())["warnings"])

    with open_rgbd(made["tum"][1] / "alpha.mcap") as log:
        assert len(log) == 6
        assert log.frame(1).stamp_ns == 33_333_000
        offsets_ms = [frame.depth_offset_ns / 1e6 for frame in log.frames()]
        assert offsets_ms == pytest.approx([15, 15, 15, 15, 15, -18.333], abs=0.01)
        assert np.array_equal(log.frame(5).depth, log.frame(4).depth), "the last depth is 50 ms late"
    assert "have no depth" not in stated("tum")
    assert "1 lines of groundtruth.txt hold no pose" in stated("tum")
    with open_rgbd(made["scannet"][1] / "alpha.mcap") as log:
        assert log.frame(3).stamp_ns == 10 * 10**9 // 30
    assert "1 of 4 frames have no true pose" in stated("scannet")
    assert "1 images are marked as bad" in stated("scannetpp")
    assert "not recorded at the same time" in stated("aria-multiagent")
    assert "poses count from 1" in stated("icl-nuim")
    assert "5 poses for frames up to 3" in stated("replica")


@pytest.mark.parametrize("first", [0, 1])
def test_the_first_image_of_icl_nuim_may_have_no_pose(
    first: int, made: dict[str, tuple[Path, Path]], tmp_path: Path
) -> None:
    """As of the first living room, whose images count from 0, and of the offices, whose images count from 1."""
    copy, last = tmp_path / "icl", first + FRAMES - 1
    shutil.copytree(made["icl-nuim"][0], copy)
    lines = [f"{first + i} depth/{i}.png {first + i} rgb/{i}.png" for i in range(FRAMES)]
    (copy / "associations.txt").write_text("\n".join(lines))
    poses = [
        tum_line(n, icl_nuim.S @ path(FRAMES)[n - first] @ icl_nuim.S) for n in range(first + 1, last + 1)
    ]
    (copy / "traj0.gt.freiburg").write_text("\n".join(text.replace(".0000", "", 1) for text in poses))
    registry.convert("icl-nuim", copy, tmp_path / "rec")
    found = true_poses(tmp_path / "rec", "alpha")
    assert np.allclose(found, path(FRAMES)[1:], atol=2e-5)
    stated = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert "alpha: 1 of 4 frames have no true pose" in stated


def test_association_policies(made: dict[str, tuple[Path, Path]], tmp_path: Path) -> None:
    src, _ = made["tum"]
    registry.convert("tum", src, tmp_path / "near", options=["association=nearest"])
    with open_rgbd(tmp_path / "near" / "alpha.mcap") as log:
        assert len(log) == 6
        assert log.pairing.largest_offset_ns == 0, "as of the time of color"
    registry.convert("tum", src, tmp_path / "official", options=["association=official"])
    with open_rgbd(tmp_path / "official" / "alpha.mcap") as log:
        assert len(log) == 5
    stated = json.loads((tmp_path / "official" / "recording.json").read_text())["warnings"]
    assert any("1 of 6 color images have no depth" in text for text in stated)
    listed = [tum_layout.Listed(t * 10**6, Path(str(t))) for t in (0, 10, 30)]
    other = [tum_layout.Listed(t * 10**6, Path(str(t))) for t in (8, 12, 100)]
    options = tum_layout.AssociationOptions(association="official")
    official = tum_layout.associate(listed, other, options)
    pairs = [(int(a.path.name), int(b.path.name)) for a, b in official]
    assert pairs == [(0, 12), (10, 8)]  # each image once: what is taken is taken
    nearest = tum_layout.AssociationOptions(association="nearest")
    pairs = [(int(a.path.name), int(b.path.name)) for a, b in tum_layout.associate(listed, other, nearest)]
    assert pairs == [(0, 8), (10, 8), (30, 12)]


@pytest.mark.parametrize(
    ("option", "expected_ms"),
    [
        ("max_difference_s=0.1", [None, 81.7, 48.3, 15, -18.3, -51.7]),
        ("max_difference_s=0.05", [None, None, 48.3, 15, -18.3, None]),
        ("max_difference_s=0.016", [None, None, None, 15, None, None]),
    ],
)
def test_depth_is_read_as_near_as_it_was_asked_for(
    made: dict[str, tuple[Path, Path]], tmp_path: Path, option: str, expected_ms: list[float | None]
) -> None:
    src = tmp_path / made["tum"][0].name
    shutil.copytree(made["tum"][0], src)
    edit(src / "depth.txt", lambda text: text.splitlines()[6] + "\n")
    registry.convert("tum", src, tmp_path / "rec", options=[option])
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        found_ms = [None if depth is None else (depth - color) / 1e6 for color, depth in log.pairing.pairs]
    assert found_ms == [None if ms is None else pytest.approx(ms, abs=0.1) for ms in expected_ms]


def test_depth_too_far_to_be_moved_is_taken_as_of_the_time_of_color(
    made: dict[str, tuple[Path, Path]], tmp_path: Path
) -> None:
    src = tmp_path / made["tum"][0].name
    shutil.copytree(made["tum"][0], src)
    edit(src / "depth.txt", lambda text: text.splitlines()[6] + "\n")
    options = ["max_difference_s=1"]
    with pytest.raises(
        DuagError, match=r"max_difference_s = 1 with association=all, expected at most 0\.1, or"
    ):
        registry.convert("tum", src, tmp_path / "rec", options=options)
    (src / "groundtruth.txt").unlink()  # or the self-check sees that the times were right
    registry.convert("tum", src, tmp_path / "rec", options=[*options, "association=nearest"])
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert len(log) == 6
        assert set(log.pairing.offsets_ns.tolist()) == {0}


def test_poses_are_interpolated_and_never_extrapolated() -> None:
    T = np.array([se3.exp(np.array([s, 0, 0, 0, 0, s])) for s in (0.0, 0.2)])
    poses = tum_layout.Poses(np.array([0, 100_000_000]), T, 0)
    between = poses.at(50_000_000, 0.2)
    assert between is not None
    assert np.allclose(between[:3, :3], so3.exp([0, 0, 0.1]))
    assert np.allclose(between[:3, 3], T[1, :3, 3] / 2)
    assert poses.at(50_000_000, 0.05) is None
    assert poses.at(-1, 1.0) is None
    assert poses.at(100_000_001, 1.0) is None
    assert np.array_equal(poses.at(100_000_000, 0.01), T[1])  # type: ignore[arg-type]


def test_distortion_matters(made: dict[str, tuple[Path, Path]], tmp_path: Path) -> None:
    """Left in, it shows in the depth along a wall."""
    src, recording = made["tum"]
    registry.convert("tum", src, tmp_path / "raw", options=["undistort=false", "rolling_shutter=none"])
    errors = []
    for folder in (recording, tmp_path / "raw"):
        with open_rgbd(folder / "alpha.mcap") as log:
            frame = log.frame(0)
            _, z = render(log.camera, smooth(0.05))
            assert log.readout.rolls == (folder == recording)
        seen = frame.depth > 0
        errors.append(np.percentile(np.abs(frame.depth - z)[seen], 90))
    assert errors[0] < 0.01
    assert errors[1] > 3 * errors[0]


def edit(path: Path, change: Callable[[str], str]) -> None:
    path.write_text(change(path.read_text()))


def swap(path: Path, pattern: str, new: str) -> None:
    edit(path, lambda text: re.sub(pattern, new, text, count=1))


def tear(path: Path) -> None:
    """Let the second chunk of a PNG claim 2 GB."""
    data = bytearray(path.read_bytes())
    data[33] |= 0x80
    path.write_bytes(data)


def halve(folder: Path) -> None:
    """Images of half the size with the intrinsics of whole ones."""
    for file in folder.iterdir():
        image = cv2.imread(str(file))
        save(file, cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2))[..., ::-1])


BROKEN = [
    ("replica", lambda p: (p.parent / "cam_params.json").unlink(), "cam_params.json: not found"),
    ("replica", lambda p: (p / "results" / "depth000001.png").unlink(), "has no partner, expected depth000001"),
    ("replica", lambda p: edit(p / "traj.txt", lambda t: "\n".join(t.splitlines()[:2])), "has 2 poses"),
    ("replica", lambda p: edit(p / "traj.txt", lambda t: t.replace("e", "x", 1)), "traj.txt:1"),
    ("replica", lambda p: save(p / "results" / "frame000000.jpg", np.zeros((9, 9, 3), np.uint8)), "is 9x9"),
    ("replica", lambda p: swap(p.parent / "cam_params.json", '"fx": ', '"fx": "x", "f": '), "expected camera with"),
    ("replica", lambda p: swap(p.parent / "cam_params.json", '"w": ', '"w": Infinity, "f": '), "OverflowError"),
    ("replica", lambda p: swap(p.parent / "cam_params.json", '"scale": ', '"scale": -'), "a positive number"),
    ("replica", lambda p: tear(p / "results" / "depth000001.png"), "that no decoder reads"),
    ("replica", lambda p: swap(p / "traj.txt", r"^(\S+ \S+ \S+) \S+", r"\1 1e300"), "m away, expected less than"),
    ("replica-multiagent", lambda p: shutil.rmtree(p / "office_0_part2"), "for 2 robots, expected --robots 1"),
    ("aria-multiagent", lambda p: [shutil.rmtree(a) for a in p.iterdir()], "found no folder agent_"),
    ("tum", lambda p: (p / "depth.txt").unlink(), "depth.txt: No such file"),
    ("tum", lambda p: edit(p / "rgb.txt", lambda t: t + "x rgb/y.png\n"), "expected a time in seconds"),
    ("tum", lambda p: edit(p / "groundtruth.txt", lambda t: t + "1 2 3\n"), "expected eight numbers"),
    ("tum", lambda p: edit(p / "rgb.txt", lambda t: t + "1e99 rgb/y.png\n"), "before the year 2116"),
    ("tum", lambda p: edit(p / "groundtruth.txt", lambda t: t + "9" * 30 + " 0 0 0 0 0 0 1\n"), "before the year 2116"),
    ("bonn", lambda p: edit(p / "groundtruth.txt", lambda t: "# nothing\n"), "found no pose"),
    ("icl-nuim", lambda p: (p / "traj0.gt.freiburg").unlink(), "found 0 files *.gt.freiburg"),
    ("icl-nuim", lambda p: edit(p / "traj0.gt.freiburg", lambda t: t[: len(t) // 2].rsplit("\n", 1)[0]), "has no pose"),
    ("scannet", lambda p: (p / "intrinsic" / "intrinsic_depth.txt").write_text("1 2"), "expected 4x4 numbers"),
    ("scannet", lambda p: halve(p / "color"), "_color.txt: center 161.6, 122.5 px, expected that of images"),
    ("scannet", lambda p: shutil.rmtree(p / "depth"), "depth: no such folder"),
    ("scannetpp", lambda p: shutil.rmtree(p / "dslr" / "undistorted_depths"), "are not shipped"),
    ("scannetpp", lambda p: edit(next(p.rglob("*.json")), lambda t: t.replace("fl_x", "f")), "KeyError 'fl_x'"),
    ("scannetpp", lambda p: swap(next(p.rglob("*.json")), '"fl_x": ', '"fl_x": "x", "f": '), "expected w, h, fl_x"),
    ("scannetpp", lambda p: swap(next(p.rglob("*.json")), r"\[\[.*?\]\]", "3"), "cannot reshape"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), BROKEN, ids=[f"{b[0]}: {b[2]}" for b in BROKEN])
def test_broken_data_is_named_and_leaves_nothing(
    made: dict[str, tuple[Path, Path]],
    tmp_path: Path,
    name: str,
    spoil: Callable[[Path], object],
    message: str,
) -> None:
    src, _ = made[name]
    copy = tmp_path / src.parent.name / src.name
    shutil.copytree(src.parent, copy.parent)
    spoil(copy)
    _, options, robots, _ = CASES[name]
    with pytest.raises(DuagError) as caught:
        registry.convert(name, copy, tmp_path / "out", robots=robots, options=options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == [copy.parent.name]


@pytest.mark.parametrize(
    ("name", "convention"),
    [
        ("replica", lambda T: np.linalg.inv(T)),
        ("replica", lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0])),
        ("icl-nuim", lambda T: icl_nuim.S @ T @ icl_nuim.S),
    ],
)
def test_a_wrong_convention_is_found_out(
    made: dict[str, tuple[Path, Path]],
    tmp_path: Path,
    name: str,
    convention: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Inverted poses, OpenGL axes, or poses that were not reflected: depth does not fit."""
    src, _ = made[name]
    copy = tmp_path / src.parent.name / src.name
    shutil.copytree(src.parent, copy.parent)
    if name == "replica":
        edit(copy / "traj.txt", lambda _: "\n".join(traj_line(convention(T)) for T in path(FRAMES)))
    else:
        poses = [tum_line(i + 1, T).replace(".0000", "", 1) for i, T in enumerate(path(FRAMES))]
        edit(copy / "traj0.gt.freiburg", lambda _: "\n".join(poses))
    with pytest.raises(DuagError, match="do not belong together"):
        registry.convert(name, copy, tmp_path / "out")


def test_other_cameras_in_the_layout_of_tum(made: dict[str, tuple[Path, Path]], tmp_path: Path) -> None:
    """By an option with its distortion as with the camera's name; by a calibration.txt; or it says what is missing."""
    src, recording = made["tum"]
    camera, distortion = tum.CAMERAS["freiburg1"]
    other = tmp_path / "kitchen"
    shutil.copytree(src, other)
    with pytest.raises(DuagError, match="expected --set intrinsics="):
        registry.convert("tum", other, tmp_path / "none")
    numbers = " ".join(repr(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy, *distortion))
    registry.convert(
        "tum", other, tmp_path / "stated", options=[f"intrinsics={numbers}", "depth_scale=0.0002"]
    )
    (other / "calibration.txt").write_text("530 531 320.5 239.5\n")
    registry.convert("tum", other, tmp_path / "filed")
    with (
        open_rgbd(recording / "alpha.mcap") as log,
        open_rgbd(tmp_path / "stated" / "alpha.mcap") as stated,
        open_rgbd(tmp_path / "filed" / "alpha.mcap") as filed,
    ):
        assert stated.camera == log.camera
        assert (log.readout, stated.readout) == (Readout(0.026, 0.0305), Readout())  # of a first Kinect alone
        np.testing.assert_array_equal(stated.frame(1).depth, log.frame(1).depth)
        np.testing.assert_array_equal(stated.frame(1).color, log.frame(1).color)
        assert filed.camera == PinholeCamera(640, 480, 530.0, 531.0, 320.5, 239.5)
    named = tmp_path / "kitchen_fr1"  # as a first Kinect's recordings are, by chance
    shutil.copytree(other, named)
    registry.convert("tum", named, tmp_path / "named")
    with open_rgbd(tmp_path / "named" / "alpha.mcap") as log:
        assert log.camera == PinholeCamera(640, 480, 530.0, 531.0, 320.5, 239.5)
        assert log.readout == Readout()
    (other / "calibration.txt").unlink()
    for name in ("kitchen_fr101", "infr1"):  # of no sequence of TUM
        other = other.rename(tmp_path / name)
        with pytest.raises(DuagError, match="expected --set intrinsics="):
            registry.convert("tum", other, tmp_path / "none")
    for text in ("530 531 320", "530 531 320 x", "0 531 320 240"):
        with pytest.raises(DuagError, match="intrinsics"):
            registry.convert("tum", other, tmp_path / "bad", options=[f"intrinsics={text}"])


def test_the_rotation_of_bonn_is_one() -> None:
    R = bonn.T_MARKER_CAMERA[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real Replica scene is not there")
def test_the_real_replica_scene(tmp_path: Path) -> None:
    registry.convert("replica", REAL, tmp_path / "office0")
    check = json.loads((tmp_path / "office0" / "recording.json").read_text())["checks"]["alpha"]
    assert check["reprojection_median_m"] < 0.002
    with open_rgbd(tmp_path / "office0" / "alpha.mcap") as log:
        assert (log.camera.width, len(log)) == (1200, 4)
