"""Pixels that show the scene: rims of resampled images, black borders, masks that users give."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from duagc.converters import registry
from duagc.converters.datasets import tum
from duagc.converters.layouts import validity
from duagc.converters.layouts.stereo import RawCamera, StereoOptions, StereoRig
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import seen_by_source
from duagc.pipeline.recording import open_rgbd, read_log
from duagc.schemas import topics
from tests.fixtures.image_folders import make_tum_files

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)


@given(st.integers(0, 1000), st.floats(-0.4, 0.4))
@example(225, 0.11624502557856675)  # pixels lie 7e-5 px beyond the border
@settings(deadline=None, max_examples=40)
def test_a_valid_pixel_does_not_depend_on_what_is_beyond_the_border(seed: int, k1: float) -> None:
    """Exact by the interpolation itself: with two borders it gives one value."""
    rays = CAMERA.rays().reshape(-1, 3)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), CAMERA.matrix(), np.array([k1, 0, 0, 0]))
    u, v = pixels.reshape(48, 64, 2).astype(np.float32).transpose(2, 0, 1)
    maps = np.ascontiguousarray(u), np.ascontiguousarray(v)
    image = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    black, white = (cv2.remap(image, *maps, cv2.INTER_LINEAR, borderValue=(c, c, c)) for c in (0, 255))
    valid = seen_by_source(maps, 64, 48)
    assert np.abs(black[valid].astype(int) - white[valid]).max() <= (1 if abs(k1) < 1e-4 else 0)
    # and hardly a pixel is left out that does not depend on it, because its share is less than one gray value
    if abs(k1) > 0.01:
        assert np.count_nonzero(~valid & (black == white).all(axis=2)) <= 0.01 * valid.size


def test_blocks_are_valid_as_a_whole() -> None:
    mask = np.ones((4, 6), bool)
    mask[1, 3] = False
    assert np.array_equal(validity.shrunk(mask, 2), [[True, False, True], [True, True, True]])


def images(count: int, black: np.ndarray, level: int = 120) -> validity.BlackBorder:
    found = validity.BlackBorder()
    rng = np.random.default_rng(0)
    for _ in range(count):
        blocks = rng.integers(level, level + 20, (6, 8, 3), dtype=np.uint8)
        image = blocks.repeat(8, axis=0).repeat(8, axis=1)
        image[black] = rng.integers(0, 6, (np.count_nonzero(black), 3), dtype=np.uint8)
        found.add(image.max(axis=2))
    return found


def vignette() -> np.ndarray:
    v, u = np.mgrid[:48, :64]
    return np.asarray(np.hypot(u - 31.5, v - 23.5) > 34)


def test_a_black_vignette_is_found_with_a_margin() -> None:
    black = vignette()
    shown = images(8, black).result(None)
    assert shown is not None
    assert not shown[black].any()
    assert 0 < np.count_nonzero(~shown & ~black) < 0.25 * black.size


@pytest.mark.parametrize("gain", [0.0, 0.3])
def test_what_is_dark_before_a_camera_that_stands_still_is_no_vignette(gain: float) -> None:
    """Whatever its exposure does."""
    rng, found = np.random.default_rng(0), validity.BlackBorder()
    scene = cv2.resize(rng.uniform(60, 180, (6, 8, 3)), (64, 48), interpolation=cv2.INTER_CUBIC)
    scene[30:, :20] = 2
    for k in range(30):
        image = scene * (1 + gain * np.sin(k / 3)) + rng.normal(0, 2, scene.shape)
        image[30:, :20] = 2
        found.add(np.clip(image, 0, 255).astype(np.uint8).max(axis=2))
    assert found.result(None) is None


def test_bars_that_leave_little_of_an_image_are_found() -> None:
    bars = np.ones((48, 64), bool)
    bars[14:30] = False
    shown = images(8, bars).result(None)
    assert shown is not None
    assert not shown[bars].any()
    assert shown[20:24].all()


def test_a_camera_of_few_images_a_second_is_looked_at_as_often(tmp_path: Path) -> None:
    """At 4 Hz every image shows, at 40 Hz every tenth: 12 images are enough, or too few."""
    rows = np.random.default_rng(0).integers(100, 200, (12, 64, 3), dtype=np.uint8)
    colors = np.repeat(rows[:, None], 48, axis=1)
    colors[:, :10] = 0
    images = [cv2.imencode(".png", color)[1].tobytes() for color in colors]
    for rate, found in ((4, True), (40, False)):
        camera = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
        recording = RecordingWriter(tmp_path / str(rate))
        with recording, recording.robot("alpha", camera, 0.001) as robot:
            for k, data in enumerate(images):
                robot.add_frame(k * 10**9 // rate, data, "png", np.full((48, 64), 1000, np.uint16))
        assert any("black in all images" in text for text in recording.warnings) == found


def test_black_inside_dark_images_and_few_images_are_no_vignette() -> None:
    inside = np.zeros((48, 64), bool)
    inside[20:30, 20:30] = True
    assert images(8, inside).result(None) is None
    assert images(7, vignette()).result(None) is None
    assert images(20, vignette(), level=12).result(None) is None
    speck = np.zeros((48, 64), bool)
    speck[0, :4] = True
    assert images(8, speck).result(None) is None


def test_black_next_to_a_rim_counts() -> None:
    valid = np.ones((48, 64), bool)
    valid[:3] = False
    black = np.zeros((48, 64), bool)
    black[:6] = True
    shown = images(8, black).result(valid)
    assert shown is not None
    assert not shown[3:6].any()
    only_rim = images(8, ~valid).result(valid)
    assert only_rim is None


def test_the_rim_of_tum_is_masked_and_kept_from_depth(tmp_path: Path) -> None:
    camera, distortion = tum.CAMERAS["freiburg1"]
    small = camera.scaled(160, 120)
    src = make_tum_files(tmp_path / "rgbd_dataset_freiburg1_x", camera, distortion)
    assert small.width == 160
    registry.convert("tum", src, tmp_path / "rec")
    registry.convert("tum", src, tmp_path / "raw", options=["undistort=false"])
    described = json.loads((tmp_path / "rec" / "recording.json").read_text())["robots"]["alpha"]
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        frame = log.frame(0)
        assert log.valid is not None
        assert described["masked_share"] == pytest.approx(float(np.mean(~log.valid)))
        assert 0.001 < described["masked_share"] < 0.2
        assert np.array_equal(frame.mask, log.valid)
        assert not frame.depth[~log.valid].any()
        assert not (frame.color == 0).all(axis=2).any(), "no black rim is left"
    with open_rgbd(tmp_path / "raw" / "alpha.mcap") as log:
        assert log.valid is None
        assert log.frame(0).mask is None
    assert (
        "masked_share" not in json.loads((tmp_path / "raw" / "recording.json").read_text())["robots"]["alpha"]
    )


def test_a_rectified_pair_has_a_rim_unless_it_was_rectified_before() -> None:
    raw = RawCamera(CAMERA.matrix(), (0.2, 0.0, 0.0, 0.0), 64, 48)
    T_right_left = se3.from_rotation_translation(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    rig = StereoRig.of(raw, raw, T_right_left, "x", options=StereoOptions(shrink=2))
    assert rig.valid is not None
    assert rig.valid.shape == (24, 32)
    white = np.full((48, 64, 3), 255, np.uint8)
    assert (rig.rectify_left(white)[rig.valid] == 255).all()
    assert StereoRig.rectified(CAMERA, CAMERA, 0.1, "x").valid is None


# --- masks of users -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("freiburg3")
    return make_tum_files(root / "rgbd_dataset_freiburg3_x", *tum.CAMERAS["freiburg3"])


def write_mask(path: Path, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    mask = np.full(shape, 255, np.uint8)
    mask[-shape[0] // 4 :, : shape[1] // 3] = 0
    cv2.imwrite(str(path), mask)
    return mask > 0


def valid_of(recording: Path, robot: str) -> np.ndarray | None:
    with open_rgbd(recording / f"{robot}.mcap") as log:
        return log.valid


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["convert", *map(str, arguments)])
    return result.exit_code, str(result.exception or result.output)


def test_masks_of_all_robots_of_one_and_polygons(sequence: Path, tmp_path: Path) -> None:
    mask = write_mask(tmp_path / "body.png")
    out = tmp_path / "all"
    code, _ = run("tum", sequence, "--robots", 2, "--mask", tmp_path / "body.png", "--out", out)
    assert code == 0
    assert np.array_equal(valid_of(out, "alpha"), mask)
    assert np.array_equal(valid_of(out, "bravo"), mask)
    text = '[[masks]]\nrobot = "bravo"\npolygon = [[0, 0], [639, 0], [639, 99], [0, 99]]\n'
    (tmp_path / "options.toml").write_text("undistort = false\n\n" + text)
    out = tmp_path / "polygon"
    said = "--robots", 2, "--options", tmp_path / "options.toml", "--mask", f"alpha={tmp_path / 'body.png'}"
    code, _ = run("tum", sequence, *said, "--out", out)
    assert code == 0
    assert np.array_equal(valid_of(out, "alpha"), mask)
    polygon = np.ones((480, 640), bool)
    polygon[:100] = False
    assert np.array_equal(valid_of(out, "bravo"), polygon)
    again = tmp_path / "none"
    assert run("tum", sequence, "--out", again)[0] == 0
    assert valid_of(again, "alpha") is None, "masks of one conversion are not those of the next"
    assert not list(read_log(again / "alpha.mcap", [topics.VALID.of("alpha")]))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: write_mask(p, (240, 320)), "is 320x240, expected 640x480"),
        (lambda p: p.write_bytes(b"no"), "no decoder reads it, expected a mask"),
        (lambda p: cv2.imwrite(str(p), np.zeros((480, 640), np.uint8)), "is 0 everywhere, expected a pixel"),
        (lambda p: cv2.imwrite(str(p), np.zeros((480, 640, 3), np.uint8)), "with 3 axes, expected a mask"),
        (lambda p: None, "expected a mask as PNG"),
    ],
)
def test_a_mask_that_cannot_be_used_is_one_line(sequence: Path, tmp_path: Path, make, words: str) -> None:
    make(tmp_path / "mask.png")
    with pytest.raises(DuagError) as error:
        registry.convert("tum", sequence, tmp_path / "rec", masks=[str(tmp_path / "mask.png")])
    assert words in str(error.value)
    assert str(tmp_path / "mask.png") in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("masks = 3", "masks = 3, expected tables"),
        ("[[masks]]\nfile = 'a.png'\npolygon = [[0, 0], [1, 0], [1, 1]]", "expected either file or polygon"),
        ("[[masks]]\npolygon = [[0, 0], [1, 0]]", "expected at least three corners"),
        ("[[masks]]\npolygon = [[0, 0], [1, 0], [nan, 1]]", "expected at least three corners"),
        ("[[masks]]\nside = 3", "expected robot, file, polygon"),
        ("[[masks]]\npolygon = [[640, 0], [900, 0], [900, 400]]", "covers no pixel of 640x480 images"),
        (
            "[[masks]]\nrobot = 'zulu'\npolygon = [[0, 0], [9, 0], [9, 9]]",
            "is of robot 'zulu', expected one of alpha",
        ),
        ("[[masks]]\npolygon = [[-9, -9], [999, -9], [999, 999], [-9, 999]]", "the masks leave no pixel"),
    ],
)
def test_tables_that_mean_nothing_are_one_line(sequence: Path, tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "options.toml").write_text(text)
    with pytest.raises(DuagError) as error:
        registry.convert("tum", sequence, tmp_path / "rec", options_file=tmp_path / "options.toml")
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "rec").exists()


def test_a_vignette_of_a_recording_is_left_out_and_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    black = vignette()
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        for k in range(60):
            image = rng.integers(100, 200, (48, 64, 3), dtype=np.uint8)
            image[black] = 0
            png = cv2.imencode(".png", image)[1].tobytes()
            robot.add_frame(k * 10**7, png, "png", np.full((48, 64), 1000, np.uint16))
    description = json.loads((tmp_path / "rec" / "recording.json").read_text())
    valid = valid_of(tmp_path / "rec", "alpha")
    assert valid is not None
    assert not valid[black].any()
    assert description["robots"]["alpha"]["masked_share"] == pytest.approx(float(np.mean(~valid)))
    assert "at the border, are black in all images; left out" in description["warnings"][0]


def test_the_mask_comes_before_the_first_frame(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        png = cv2.imencode(".png", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
        robot.set_valid(np.ones((48, 64), bool))
        robot.add_frame(0, png, "png", np.full((48, 64), 1000, np.uint16))
        with pytest.raises(ValueError, match="after the first frame"):
            robot.set_valid(np.ones((48, 64), bool))
    assert valid_of(tmp_path / "rec", "alpha") is None, "a mask that allows everything is none"
