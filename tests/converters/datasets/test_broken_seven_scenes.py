"""7-Scenes: files that are missing or broken, and options that cannot be, are named."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters.datasets.seven_scenes import convert
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from tests.fixtures.seven_scenes import FRAMES


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
        (lambda f: (f / "frame-99999999999999999999.color.png").touch(), "frame numbers from 0 to 9999"),
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


def test_the_cameras_of_bundle_fusion_must_be_stated(broken: Path, tmp_path: Path) -> None:
    """Its frames have the same names; with other cameras depth would move by centimeters, without a word."""
    (broken / "info.txt").write_text(
        "m_calibrationColorIntrinsic = 583 0 320 0 0 583 240 0 0 0 1 0 0 0 0 1\n"
    )
    with pytest.raises(
        DuagError, match=r"info.txt: found, as in BundleFusion, .*--set depth_focal_px=, color_focal"
    ):
        convert(broken, tmp_path / "rec", depth_focal_px=585.0)
    convert(broken, tmp_path / "rec", depth_focal_px=585.0, color_focal_px=525.0)


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
