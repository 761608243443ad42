"""7-Scenes: poses that others computed of its frames are taken for the truth."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from duagc.converters.datasets.seven_scenes import Options, convert
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording import Recording, content_digest
from tests.fixtures.seven_scenes import FRAMES, RIG, T_DEPTH_COLOR, depth_pose, make_rig_sequence, poses_of


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
    T_color_camera = se3.from_rotation_translation(Options(**RIG).lens().rotation(), np.zeros(3))
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
