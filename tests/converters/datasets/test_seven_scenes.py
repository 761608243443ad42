"""7-Scenes: a small sequence of a synthetic room in the dataset's own files, and the real one where it is there."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.datasets import seven_scenes
from duagc.converters.datasets.seven_scenes import Options, convert, list_frames
from duagc.converters.layouts.displaced_depth import DepthRegistration
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, content_digest, open_rgbd, read_log
from tests.fixtures.seven_scenes import FRAMES, T_DEPTH_COLOR, depth_pose, make_sequence, render, render_rays

REAL = Path(__file__).parents[4] / "shared" / "data" / "redkitchen"


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sequence(tmp_path_factory.mktemp("scene") / "seq-01")


@pytest.fixture
def broken(sequence: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    shutil.copytree(sequence, tmp_path / "seq-01")
    return tmp_path / "seq-01"


def poses_of(recording: Recording, robot: str) -> np.ndarray:
    path = recording.groundtruth(robot)
    assert path is not None
    return np.array([m.unpack_pose_in_frame(r.proto()) for r in read_log(path)])


# --- conversion -------------------------------------------------------------------------------------------------------


def test_one_sequence_becomes_two_robots(sequence: Path, tmp_path: Path) -> None:
    convert(sequence, tmp_path / "rec", robots=2)
    recording = Recording(tmp_path / "rec")
    assert recording.robots == ["alpha", "bravo"]
    cut = FRAMES // 2
    for robot, numbers in (("alpha", range(cut)), ("bravo", range(cut, FRAMES))):
        log = open_rgbd(recording.log(robot))
        assert (log.camera, log.depth_scale, len(log)) == (Options().color_camera(), 0.001, len(numbers))
        assert [f.stamp_ns for f in log.frames()] == [i * 10**9 // 30 for i in range(len(numbers))]
        for record, number in zip(
            read_log(recording.log(robot), [f"/{robot}/camera/color"]), numbers, strict=True
        ):
            assert record.proto().data == (sequence / f"frame-{number:06d}.color.jpg").read_bytes()
        expected = np.array([depth_pose(n) @ T_DEPTH_COLOR for n in numbers])
        found = poses_of(recording, robot)
        np.testing.assert_allclose(found, expected, atol=1e-3)  # the defect of the rotations above
        np.testing.assert_allclose(
            found[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2),
            np.eye(3)[None].repeat(len(found), 0),
            atol=1e-12,
        )
    description = json.loads((tmp_path / "rec" / "recording.json").read_text())
    assert description["parameters"]["baseline_m"] == 0.025
    assert description["source"] == {"dataset": "7-Scenes", "folder": "seq-01", "sequences": []}
    for check in description["checks"].values():
        assert check["reprojection_median_m"] < 0.001 * check["median_depth_m"]


def test_depth_is_registered_to_color(sequence: Path, tmp_path: Path) -> None:
    """Against the depth that the color camera would have measured."""
    convert(sequence, tmp_path / "rec")
    for frame in open_rgbd(Recording(tmp_path / "rec").log("alpha")).frames():
        _, exact = render(Options().color_camera(), depth_pose(frame.index) @ T_DEPTH_COLOR)
        seen = frame.depth > 0
        error = np.abs(frame.depth - exact)[seen]
        assert np.median(error) < 0.0005  # the millimeter of the source, twice rounded
        assert np.mean(error > 0.005) < 0.01  # borders of the box, one pixel wide
        assert seen[60:-60, 80:-80].mean() > 0.97  # the rest is hidden from the depth camera by the box
        v, u = 240, 560
        assert seen[v, u]
        assert frame.depth[v, u] == pytest.approx(exact[v, u], abs=0.002)


def test_conversions_are_the_same_every_time(sequence: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        convert(sequence, tmp_path / name / "rec", robots=2)
    for name in ("alpha.mcap", "bravo.mcap", "alpha.groundtruth.mcap"):
        assert content_digest(tmp_path / "a" / "rec" / name) == content_digest(tmp_path / "b" / "rec" / name)


def test_several_sequences_become_one_robot_each(sequence: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for number in (1, 3):
        shutil.copytree(sequence, scene / f"seq-{number:02d}")
    convert(scene, tmp_path / "both", robots=2)
    both = Recording(tmp_path / "both")
    assert [len(open_rgbd(both.log(robot))) for robot in both.robots] == [FRAMES, FRAMES]
    convert(scene, tmp_path / "one", sequences=3)
    assert Recording(tmp_path / "one").description["source"]["sequences"] == ["seq-03"]
    with pytest.raises(DuagError, match="found sequences seq-01, seq-03 for 1 robots"):
        convert(scene, tmp_path / "rec")
    with pytest.raises(DuagError, match="found sequences 1, 3, expected '2' among them"):
        convert(scene, tmp_path / "rec", sequences="2")


def test_missing_numbers_are_skipped_and_told(broken: Path, tmp_path: Path) -> None:
    for path in broken.glob("frame-000002.*"):
        path.unlink()
    convert(broken, tmp_path / "rec")
    recording = Recording(tmp_path / "rec")
    stamps = [f.stamp_ns for f in open_rgbd(recording.log("alpha")).frames()]
    assert stamps == [n * 10**9 // 30 for n in (0, 1, 3, 4, 5, 6)]
    assert "seq-01: 1 frame numbers are missing and were skipped: 2" in recording.description["warnings"]


def test_sequences_without_poses_have_no_ground_truth(broken: Path, tmp_path: Path) -> None:
    for path in broken.glob("*.pose.txt"):
        path.unlink()
    convert(broken, tmp_path / "rec")
    recording = Recording(tmp_path / "rec")
    assert recording.groundtruth("alpha") is None
    assert recording.description["checks"]["alpha"]["reprojection_median_m"] is None
    assert any("no ground truth" in w for w in recording.description["warnings"])


# --- broken sources ---------------------------------------------------------------------------------------------------


def rewrite_pose(change: Callable[[np.ndarray], object]) -> Callable[[Path], object]:
    def damage(folder: Path) -> None:
        path = folder / "frame-000003.pose.txt"
        T = np.loadtxt(path)
        change(T)
        np.savetxt(path, T)

    return damage


def write_image(name: str, array: np.ndarray) -> Callable[[Path], object]:
    return lambda folder: cv2.imwrite(str(folder / name), array)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda f: (f / "frame-000003.depth.png").unlink(),
            "frame-000003.color.jpg: has no depth in the same folder",
        ),
        (
            lambda f: (f / "frame-000003.color.jpg").unlink(),
            "frame-000003.depth.png: has no color in the same folder",
        ),
        (
            lambda f: (f / "frame-000003.pose.txt").unlink(),
            "frame-000003.color.jpg: has no pose in the same folder",
        ),
        (lambda f: (f / "frame-000003.color.png").touch(), "frame-000003.color.png: found together with"),
        (
            lambda f: (f / "frame-000003.color.jpg").write_bytes(b""),
            "frame-000003.color.jpg: 0 bytes that no decoder",
        ),
        (
            lambda f: (f / "frame-000003.depth.png").write_bytes(b"x"),
            "frame-000003.depth.png: 1 bytes that no decoder",
        ),
        (lambda f: (f / "frame-000003.pose.txt").write_text("1 2 3"), "frame-000003.pose.txt: "),
        (lambda f: (f / "frame-000003.pose.txt").write_bytes(b"\xff\xfe"), "frame-000003.pose.txt: "),
        (
            rewrite_pose(lambda T: T.__setitem__((0, 3), np.inf)),
            "frame-000003.pose.txt: found numbers that are not",
        ),
        (rewrite_pose(lambda T: T.__imul__(0)), "frame-000003.pose.txt: its rotation is off by"),
        (
            rewrite_pose(lambda T: T.__setitem__((slice(3), 0), -T[:3, 0])),
            "frame-000003.pose.txt: its rotation is off",
        ),
        (
            write_image("frame-000003.depth.png", np.zeros((480, 640), np.uint8)),
            "frame-000003.depth.png: is uint8",
        ),
        (
            write_image("frame-000003.depth.png", np.zeros((240, 320), np.uint16)),
            "is 320x240, expected 640x480",
        ),
        (
            write_image("frame-000003.color.jpg", np.zeros((240, 320, 3), np.uint8)),
            "is 320x240, expected 640x480",
        ),
    ],
)
def test_broken_files_are_named(
    broken: Path, tmp_path: Path, damage: Callable[[Path], object], words: str
) -> None:
    damage(broken)
    with pytest.raises(DuagError) as caught:
        convert(broken, tmp_path / "rec")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["seq-01"], "nothing is left behind"


def inverted(T: np.ndarray) -> np.ndarray:
    return se3.inverse(se3.from_rotation_translation(so3.project(T[:3, :3]), T[:3, 3]))


def upside_down(T: np.ndarray) -> np.ndarray:
    """Axes of OpenGL: y up, z backward."""
    return T @ np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize("wrong", [inverted, upside_down])
def test_other_conventions_of_poses_are_caught(
    broken: Path, tmp_path: Path, wrong: Callable[[np.ndarray], np.ndarray]
) -> None:
    for path in broken.glob("*.pose.txt"):
        np.savetxt(path, wrong(np.loadtxt(path)))
    with pytest.raises(DuagError, match="poses, intrinsics and depth do not belong together"):
        convert(broken, tmp_path / "rec")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"focal": 5}, "focal is no option"),
        ({"depth_focal_px": -1}, "depth_focal_px = -1"),
        ({"depth_focal_px": "wide"}, "depth_focal_px = 'wide'"),
        ({"robots": 0}, "0 robots, expected 1 to 26"),
        ({"robots": FRAMES + 1}, f"found {FRAMES} frames, expected at least {FRAMES + 1}"),
    ],
)
def test_options_are_checked(sequence: Path, tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(DuagError) as caught:
        convert(sequence, tmp_path / "rec", **options)
    assert words in str(caught.value)


def test_sources_that_are_none(sequence: Path, tmp_path: Path) -> None:
    with pytest.raises(DuagError, match="no such folder"):
        convert(tmp_path / "nothing", tmp_path / "rec")
    with pytest.raises(DuagError, match="expected a sequence of 7-Scenes"):
        convert(tmp_path, tmp_path / "rec")
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "file").touch()
    with pytest.raises(DuagError, match="exists already"):
        convert(sequence, tmp_path / "rec")


# --- registration -----------------------------------------------------------------------------------------------------


def slanted(camera: PinholeCamera, slope: float) -> np.ndarray:
    """Depth of the plane z = 1.2 + slope x."""
    return 1.2 / (1 - slope * camera.rays()[:, :, 0])


@pytest.mark.parametrize("slope", [0.0, 0.8, -0.8, 2.0])
def test_planes_stay_planes(slope: float) -> None:
    """No moiré, no holes: inside the common view a plane comes out exact and complete."""
    options = Options()
    depth = slanted(options.depth_camera(), slope)
    depth[(depth < 0.3) | (depth > 4)] = 0
    out = DepthRegistration(options.depth_camera(), options.color_camera(), options.baseline_m)(depth)
    # the plane in the color camera, which sits baseline_m further along x
    rays = options.color_camera().rays()[:, :, 0]
    exact = (1.2 + slope * options.baseline_m) / (1 - slope * rays)
    seen = out > 0
    interior = seen.copy()
    interior[:, 1:-1] &= seen[:, :-2] & seen[:, 2:]  # at a border the last pixel covers half its width
    np.testing.assert_allclose(out[interior], exact[interior], rtol=1e-9)
    inside = (exact > 0.35) & (exact < 3.8)
    inside[:50] = inside[-50:] = False
    inside[:, :70] = inside[:, -70:] = False
    assert seen[inside].all()


def test_the_nearest_surface_wins_and_edges_stay_sharp() -> None:
    options = Options()
    depth = np.full((480, 640), 2.0)
    depth[:, 300:340] = 0.8
    out = DepthRegistration(options.depth_camera(), options.color_camera(), options.baseline_m)(depth)
    values = np.unique(np.round(out, 9))
    assert values.tolist() == [0.0, 0.8, 2.0], "nothing is interpolated across the edge"
    columns = np.nonzero(out[240] == np.min(out[240][out[240] > 0]))[0]
    left = 320 + 525 * ((299.5 - 320) / 585 - 0.025 / 0.8)
    right = 320 + 525 * ((339.5 - 320) / 585 - 0.025 / 0.8)
    assert abs(columns[0] - left) <= 1
    assert abs(columns[-1] - right) <= 1
    shadow = np.nonzero(out[240, columns[-1] :] == 2.0)[0][0]  # what the bar hides from the depth camera
    assert shadow == pytest.approx(525 * 0.025 * (1 / 0.8 - 1 / 2.0), abs=2)


def test_no_depth_stays_none() -> None:
    options = Options()
    register = DepthRegistration(options.depth_camera(), options.color_camera(), options.baseline_m)
    assert not register(np.zeros((480, 640))).any()
    same = DepthRegistration(options.depth_camera(), options.depth_camera(), 0.0)
    depth = slanted(options.depth_camera(), 0.5)
    depth[100:110, 50:300] = 0
    np.testing.assert_allclose(same(depth), depth, rtol=1e-12)  # the identity keeps every hole


# --- a calibrated rig -------------------------------------------------------------------------------------------------

RIG: dict[str, Any] = {
    "color_focal_px": 515.0,
    "color_focal_y_px": 519.0,
    "color_cx_px": 327.0,
    "color_cy_px": 246.0,
    "color_distortion": "0.08 -0.37 0.001 -0.002 0.41",
    "color_rotation_rad": "0.012, -0.008, 0.02",
    "depth_correction_per_m": "0.015 -0.012 -0.005 -0.017 -0.004 0.001",
}


def make_rig_sequence(folder: Path) -> Path:
    """A sequence as cameras see it that are as `RIG` says, made without the code of the converter."""
    folder.mkdir(parents=True)
    v, u = np.mgrid[:480, :640].astype(np.float64)
    K = np.array([[515.0, 0, 327], [0, 519, 246], [0, 0, 1]])
    lens, steps = np.array([0.08, -0.37, 0.001, -0.002, 0.41]), (cv2.TERM_CRITERIA_COUNT, 50, 0)
    xy = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), K, lens, criteria=steps)
    turned = np.concatenate([xy[:, 0], np.ones((len(xy), 1))], axis=1) @ so3.exp(
        np.array([0.012, -0.008, 0.02])
    )
    rays = (turned / turned[:, 2:]).reshape(480, 640, 3)  # of the color pixels, as the depth camera is turned
    x, y = (u - 320) / 585, (v - 240) / 585
    for index in range(3):
        pose = depth_pose(index)
        color, _ = render_rays(rays, pose @ T_DEPTH_COLOR)
        _, depth = render(Options().depth_camera(), pose)
        error = 0.015 - 0.012 * x - 0.005 * y - 0.017 * x * x - 0.004 * x * y + 0.001 * y * y
        wrong = (1 - 2 * 0.015) / (1 / depth - error)
        stem = folder / f"frame-{index:06d}"
        cv2.imwrite(f"{stem}.color.png", color)
        cv2.imwrite(f"{stem}.depth.png", np.rint(wrong * 1000).astype(np.uint16))
        np.savetxt(f"{stem}.pose.txt", pose, delimiter="\t")
    return folder


def errors_of(recording: Path, camera: PinholeCamera) -> tuple[float, float]:
    """Share of pixels of another color than the room's, and median error of depth in meters, all frames."""
    colors, depths = [], []
    for frame in open_rgbd(Recording(recording).log("alpha")).frames():
        color, depth = render(camera, depth_pose(frame.index) @ T_DEPTH_COLOR)
        inside = np.s_[30:-30, 30:-30]  # what the color camera did not see is at the border
        off = np.abs(frame.color[inside].astype(float) - color[inside][..., ::-1]).max(axis=-1)
        colors.append(np.mean(off > 20))
        depths.append(np.abs(frame.depth - depth)[frame.depth > 0])
    return float(np.mean(colors)), float(np.median(np.concatenate(depths)))


def test_lens_rotation_and_depth_error_are_undone(tmp_path: Path) -> None:
    source = make_rig_sequence(tmp_path / "seq-01")
    convert(source, tmp_path / "rec", **RIG)
    convert(source, tmp_path / "again", **RIG)
    convert(source, tmp_path / "as_if_ideal", color_focal_px=515.0)
    assert content_digest(tmp_path / "rec" / "alpha.mcap") == content_digest(
        tmp_path / "again" / "alpha.mcap"
    )
    camera = Options(**RIG).color_camera()
    assert open_rgbd(Recording(tmp_path / "rec").log("alpha")).camera == camera
    assert camera.fx == camera.fy == 515
    colors, depths = errors_of(tmp_path / "rec", camera)
    assert colors < 0.04, "edges of the pattern, blurred by half a pixel"
    assert depths < 0.0005, "the millimeter of the source, rounded twice"
    colors, depths = errors_of(tmp_path / "as_if_ideal", camera)
    assert colors > 0.1
    assert depths > 0.005


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("color_distortion", "0.1 0.2"),
        ("color_distortion", "0.1 0.2 0 nan"),
        ("color_rotation_rad", "1 2 three"),
        ("depth_correction_per_m", "0 0 0 0 0"),
    ],
)
def test_lists_of_numbers_are_checked(sequence: Path, tmp_path: Path, name: str, value: str) -> None:
    with pytest.raises(DuagError, match=f"7scenes: {name} = '{value}'"):
        convert(sequence, tmp_path / "rec", 1, False, **{name: value})
    assert not (tmp_path / "rec").exists()


# --- poses of others -------------------------------------------------------------------------------------------------


def reference_line(sequence: str, number: int, T_world_color: np.ndarray) -> str:
    T_color_world = se3.inverse(T_world_color)
    values = [*so3.to_quat_wxyz(T_color_world[:3, :3]), *T_color_world[:3, 3], 525.505]
    return f"{sequence}/frame-{number:06d}.color.png " + " ".join(f"{value:.7f}" for value in values)


def reference_file(path: Path, sequences: tuple[str, ...] = ("seq-01", "seq-02"), skip: int = 4) -> Path:
    """Backwards, one frame not found, and the other sequences a meter away."""
    lines = []
    for sequence in sequences:
        offset = se3.from_rotation_translation(np.eye(3), [int(sequence[-1]) - 1.0, 0, 0])
        lines += [
            reference_line(sequence, n, offset @ depth_pose(n) @ T_DEPTH_COLOR)
            for n in reversed(range(FRAMES))
            if n != skip
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_poses_of_others_are_the_truth(sequence: Path, tmp_path: Path) -> None:
    path = reference_file(tmp_path / "sfm.txt")
    convert(sequence, tmp_path / "rec", robots=2, reference_poses=str(path))
    convert(sequence, tmp_path / "own", robots=2)
    recording, own = Recording(tmp_path / "rec"), Recording(tmp_path / "own")
    for robot in recording.robots:  # the estimator sees no difference
        assert content_digest(recording.log(robot)) == content_digest(own.log(robot))
    np.testing.assert_allclose(
        poses_of(recording, "alpha"), [depth_pose(n) @ T_DEPTH_COLOR for n in range(3)], atol=1e-6
    )
    np.testing.assert_allclose(
        poses_of(recording, "bravo"), [depth_pose(n) @ T_DEPTH_COLOR for n in (3, 5, 6)], atol=1e-6
    )
    assert "bravo: reference poses of 3 of 4 frames" in recording.description["warnings"]
    assert recording.description["parameters"]["reference_poses"] == "sfm.txt"


def test_poses_of_others_are_those_of_the_camera_of_the_recording(tmp_path: Path) -> None:
    """They are the color camera's as it is; the recording's camera is turned as the depth camera is."""
    source = make_rig_sequence(tmp_path / "seq-01")
    T_color_camera = se3.from_rotation_translation(Options(**RIG).lens().turned()[:3, :3], np.zeros(3))
    assert np.abs(T_color_camera - np.eye(4)).max() > 0.005
    lines = [
        reference_line("seq-01", n, depth_pose(n) @ T_DEPTH_COLOR @ se3.inverse(T_color_camera))
        for n in range(3)
    ]
    path = tmp_path / "sfm.txt"
    path.write_text("\n".join(lines))
    convert(source, tmp_path / "rec", reference_poses=str(path), **RIG)
    expected = [depth_pose(n) @ T_DEPTH_COLOR for n in range(3)]
    np.testing.assert_allclose(poses_of(Recording(tmp_path / "rec"), "alpha"), expected, atol=1e-6)


def test_the_sequence_of_other_poses_is_named_by_the_folder_or_the_user(
    sequence: Path, tmp_path: Path
) -> None:
    path = reference_file(tmp_path / "sfm.txt")
    kitchen = tmp_path / "kitchen"
    shutil.copytree(sequence, kitchen)
    with pytest.raises(DuagError, match="found poses of seq-01, seq-02, expected the choice of one"):
        convert(kitchen, tmp_path / "rec", reference_poses=str(path))
    with pytest.raises(DuagError, match="found poses of seq-01, seq-02, expected some of seq-03"):
        convert(kitchen, tmp_path / "rec", reference_poses=str(path), reference_sequence="seq-03")
    with pytest.raises(DuagError, match="found reference_sequence alone"):
        convert(kitchen, tmp_path / "rec", reference_sequence="seq-03")
    convert(kitchen, tmp_path / "rec", reference_poses=str(path), reference_sequence="seq-02")
    assert abs(poses_of(Recording(tmp_path / "rec"), "alpha")[0, 0, 3] - 0.7) < 0.3, "a meter along x"
    reference_file(path, ("seq-01",))
    convert(kitchen, tmp_path / "only", reference_poses=str(path))
    assert len(poses_of(Recording(tmp_path / "only"), "alpha")) == FRAMES - 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "sfm.txt: found no pose"),
        ("frame-000000.pose.txt 1 0 0 0 0 0 0 525\n", "sfm.txt: line 1: found 'frame-000000.pose.txt'"),
        ("seq-01/frame-000000.color.png 1 0 0 0 0 0 0\n", "line 1: found 7 numbers"),
        ("seq-01/frame-000000.color.png 1 0 0 0 0 0 x 525\n", "line 1: could not convert"),
        ("seq-01/frame-000000.color.png 1 0 0 0 0 0 nan 525\n", "all finite"),
        ("seq-01/frame-000000.color.png 1 1 0 0 0 0 0 525\n", "quaternion of length 1.4142"),
        (2 * "seq-01/frame-000000.color.png 1 0 0 0 0 0 0 525\n", "line 2: found seq-01/frame-000000"),
        ("seq-01/frame-000999.color.png 1 0 0 0 0 0 0 525\n", "found none of frames 0 to 6"),
        (
            "".join(f"seq-01/frame-{n:06d}.color.png 1 0 0 0 0 0 {n / 20} 525\n" for n in range(FRAMES)),
            "do not belong together",
        ),
    ],
)
def test_broken_files_of_other_poses_are_named(sequence: Path, tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "sfm.txt"
    path.write_text(text)
    with pytest.raises(DuagError, match=words):
        convert(sequence, tmp_path / "rec", reference_poses=str(path))
    assert not (tmp_path / "rec").exists()


# --- the table of converters ------------------------------------------------------------------------------------------


def test_the_command_finds_the_converter(sequence: Path, tmp_path: Path) -> None:
    registry.convert(
        "7scenes", sequence, tmp_path / "rec", options=["color_focal_px=520", "baseline_m = 0.03"]
    )
    parameters = Recording(tmp_path / "rec").description["parameters"]
    assert (parameters["color_focal_px"], parameters["baseline_m"]) == (520, 0.03)
    text = registry.describe()
    assert "7scenes: Microsoft 7-Scenes" in text
    assert "--set baseline_m=0.025" in text
    with pytest.raises(DuagError, match="dataset '8scenes', expected perhaps 7scenes"):
        registry.convert("8scenes", sequence, tmp_path / "other")
    with pytest.raises(DuagError, match="expected NAME=VALUE"):
        registry.convert("7scenes", sequence, tmp_path / "other", options=["baseline_m"])


def test_every_option_is_documented() -> None:
    assert all(field.description for field in seven_scenes.Options.model_fields.values())


# --- the real thing ---------------------------------------------------------------------------------------------------


def test_real_sequence(tmp_path: Path) -> None:
    """RedKitchen, 24 of its frames: the poses agree with the registered depth to 1 % of it."""
    if not REAL.is_dir():
        pytest.skip("needs ../shared/data/redkitchen")
    source = tmp_path / "redkitchen"
    source.mkdir()
    for number in range(24):
        for path in REAL.glob(f"frame-{number:06d}.*"):
            shutil.copy(path, source)
    frames, missing = list_frames(source)
    assert (len(frames), missing) == (24, [])
    convert(source, tmp_path / "rec", robots=2)
    recording = Recording(tmp_path / "rec")
    for check in recording.description["checks"].values():
        assert check["reprojection_median_m"] < 0.01 * check["median_depth_m"]
        assert check["registered_holes"] < 0.005
    poses = poses_of(recording, "alpha")
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-12)
