"""What is in a log, a recording or a run."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.recording import format_info, info, open_rgbd, preview, write_preview_of
from tests.fixtures.recording_logs import (
    CAMERA,
    COLOR,
    DEPTH,
    FRAME_NS,
    depth,
    image,
    png,
    write_camera,
    write_recording,
    write_updates,
)


def test_info_of_a_recording(tmp_path: Path) -> None:
    content = info(write_recording(tmp_path / "rec", frames=4))
    alpha = content["robots"]["alpha"]
    assert (content["kind"], alpha["frames"], alpha["messages"]) == ("recording", 4, 9)
    assert alpha["topics"][COLOR]["rate_hz"] == pytest.approx(30, rel=1e-6)
    assert alpha["topics"][DEPTH]["metadata"] == {"depth_scale": "0.001"}
    assert alpha["path"]["high_m"][0] == pytest.approx(0.3, rel=1e-3)  # the path is slightly bent
    assert content["warnings"] == []
    assert json.loads(json.dumps(content)) == content
    assert alpha["depth_m"][0] < alpha["depth_m"][1] < alpha["depth_m"][2] < 5
    assert re.search(r"alpha +4 +0\.10 +30\.00 +0 +[\d.]+ kB +100%", format_info(content))


def test_info_of_images_with_a_lens(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.set_lens(Lens(CAMERA, (-0.3, 0.1, 0.0, 0.0, 0.0)))
        for k in range(3):
            robot.add_frame(k * FRAME_NS, png(image(k)), "png", depth(k))
    content = info(tmp_path / "rec")
    assert content["robots"]["alpha"]["lens"]["distortion"] == [-0.3, 0.1, 0.0, 0.0, 0.0]
    assert json.loads(json.dumps(content)) == content
    line = "color images as the lens took them, distortion -0.3 0.1 0 0 0: reading rectifies them"
    assert line in format_info(content)
    assert "lens" not in format_info(info(write_recording(tmp_path / "straight")))


def test_a_preview_shows_every_robot(tmp_path: Path) -> None:
    out = write_recording(tmp_path / "rec", frames=4)
    picture = tmp_path / "preview.png"
    write_preview_of(out, picture)
    image = cv2.imread(str(picture))
    tile = preview.TILE_PX * CAMERA.height // CAMERA.width
    assert image.shape == (2 * (preview.LINE_PX + 2 * tile), 4 * preview.TILE_PX, 3)
    first = cv2.resize(image[preview.LINE_PX : preview.LINE_PX + tile, : preview.TILE_PX], (16, 12))
    with open_rgbd(out / "alpha.mcap") as log:
        shown = log.frame(0).color[:, :, ::-1]
    assert np.abs(first.astype(int) - shown).mean() < 30
    with pytest.raises(DuagError, match="exists already"):
        write_preview_of(out, picture)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["preview.png", "rec"]


def test_info_tells_gaps_and_exchanged_logs(tmp_path: Path) -> None:
    out = write_recording(tmp_path / "rec", robots=1)
    write_camera(out / "alpha.mcap", 9, skip_color=(4, 5), skip_depth=(4, 5))
    (out / "alpha.groundtruth.mcap").unlink()
    content = info(out)
    text = format_info(content)
    assert f"{COLOR}: 1 gaps, the longest 0.100 s" in text
    assert "alpha.mcap has digest" in text
    assert content["robots"]["alpha"]["groundtruth"] is None


def test_info_of_logs_and_runs(tmp_path: Path) -> None:
    (tmp_path / "robots").mkdir()
    digest = write_updates(tmp_path / "robots" / "frontend.mcap", "alpha", [0, 10**9, 2 * 10**9])
    log = info(tmp_path / "robots" / "frontend.mcap")
    assert (log["kind"], log["robot"], log["messages"], log["digest"]) == ("log", "alpha", 3, digest)
    assert log["topics"]["/alpha/map_update"]["rate_hz"] == pytest.approx(1.0)
    run = info(tmp_path)
    assert (run["kind"], list(run["logs"])) == ("run", ["robots/frontend.mcap"])
    assert digest in format_info(log)
    assert digest in format_info(run)
    with pytest.raises(DuagError, match="no such file"):
        info(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DuagError, match="a folder without logs"):
        info(tmp_path / "empty")
