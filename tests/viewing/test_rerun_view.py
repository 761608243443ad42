"""What reaches Rerun: the content of the files, not how the viewer draws it."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters.robot_writer import RobotWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.viewing import rerun_view, run_rrd
from tests.fixtures.fake_run import FRAMES, KEYFRAMES, FakeRun, make, wall
from tests.fixtures.full_disks import no_file_larger_than


@pytest.fixture(scope="module")
def fake(tmp_path_factory) -> FakeRun:
    return make(tmp_path_factory.mktemp("fake"))


def content(chunks) -> dict[str, dict[str, int]]:
    """Entity -> component -> rows, without Rerun's own bookkeeping."""
    out: dict[str, dict[str, int]] = {}
    for chunk in chunks:
        components = out.setdefault(chunk.entity_path, {})
        for name in chunk.to_record_batch().schema.names:
            components[name] = components.get(name, 0) + chunk.num_rows
    return out


def of_rrd(path: Path) -> dict[str, dict[str, int]]:
    from rerun.chunk import RrdReader

    return content(RrdReader(path).stream().to_chunks())


def test_a_log_opens_in_rerun_as_it_is(fake):
    from rerun.chunk import McapReader

    found = content(McapReader(fake.recording / "alpha.mcap").stream().to_chunks())
    assert found["/alpha/camera/color"]["EncodedImage:blob"] == FRAMES
    assert found["/alpha/camera/depth"]["Image:buffer"] == FRAMES
    assert found["/alpha/camera/calibration"]["Pinhole:image_from_camera"] >= 1


def test_ground_truth_and_results_open_in_rerun_as_they_are(fake):
    from rerun.chunk import McapReader

    truth = content(McapReader(fake.recording / "alpha.groundtruth.mcap").stream().to_chunks())
    assert any("Transform3D" in c or "InstancePoses3D" in c for c in truth["/alpha/groundtruth/pose"])
    frontend = content(McapReader(fake.run / "robots" / "alpha" / "frontend.mcap").stream().to_chunks())
    assert frontend["/alpha/odometry"]["duagc.v1.Odometry:message"] == FRAMES


def test_a_recording_becomes_a_file_with_depth_in_meters(fake, tmp_path):
    rerun_view.view(fake.recording, save=tmp_path / "recording.rrd")
    found = of_rrd(tmp_path / "recording.rrd")
    for robot in ("alpha", "bravo"):
        depth = found[f"/{robot}/camera/depth"]
        assert depth["DepthImage:buffer"] == FRAMES
        assert depth["DepthImage:meter"] == 1
        assert "Image:buffer" not in depth
        assert found[f"/{robot}/camera/color"]["EncodedImage:blob"] == FRAMES
    assert [p.name for p in tmp_path.iterdir()] == ["recording.rrd"]


def test_color_of_a_lens_is_shown_as_the_pinhole_camera_sees_it(tmp_path):
    """Rerun shows images as they are, and depth next to them has no distortion."""
    from rerun.chunk import RrdReader

    camera = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
    u, v = np.meshgrid(np.arange(64.0), np.arange(48.0))
    waves = np.rint(127 + 100 * np.stack([np.sin(u / 4), np.cos(v / 4), np.sin((u + v) / 6)], axis=-1))
    _, data = cv2.imencode(".png", waves.astype(np.uint8))
    with RobotWriter(tmp_path, "alpha", camera, 0.001) as robot:
        robot.set_lens(Lens(camera, (0.4, 0.0, 0.0, 0.0, 0.0)))
        for k in range(3):
            robot.add_frame(k * 10**8, data.tobytes(), "png", np.full((48, 64), 1000, np.uint16))
    out = rerun_view.recording_to_rrd([tmp_path / "alpha.mcap"], tmp_path / "lens.rrd")
    assert of_rrd(out)["/alpha/camera/color"]["EncodedImage:blob"] == 3
    rows = [
        chunk.to_record_batch().to_pydict()
        for chunk in RrdReader(out).stream().to_chunks()
        if chunk.entity_path == "/alpha/camera/color"
    ]
    with open_rgbd(tmp_path / "alpha.mcap") as log:
        expected, seen = log.frame(1).color, log.valid
    assert seen is not None
    for row in rows:
        blob = bytes(row["EncodedImage:blob"][0][0])
        shown = cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
        assert np.abs(shown.astype(int) - expected)[seen].mean() < 4
    assert np.abs(waves[:, :, ::-1] - expected)[seen].mean() > 10


@pytest.mark.parametrize("shown", ["run", "recording"])
def test_a_disk_that_fills_is_one_error_and_leaves_nothing(fake, tmp_path, shown):
    out, logs = tmp_path / "shown.rrd", [fake.recording / "alpha.mcap"]
    write = {
        "run": lambda: run_rrd.write_rrd(fake.run, fake.recording, out),
        "recording": lambda: rerun_view.recording_to_rrd(logs, out),
    }[shown]
    with no_file_larger_than(1 << 14), pytest.raises(DuagError, match=r"shown.rrd: .*expected to write a"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_run_becomes_a_file_with_everything_in_it(fake, tmp_path):
    evaluate(fake.run, fake.recording, progress=False)
    found = of_rrd(run_rrd.write_rrd(fake.run, fake.recording, tmp_path / "run.rrd"))
    for robot in ("alpha", "bravo"):
        for path in ("before_consensus", "after_consensus", "ground_truth"):
            assert found[f"/world/paths/{robot}/{path}"]["LineStrips3D:strips"] == 1
        for coloring in ("final", "fused", "uncertainty"):
            assert found[f"/world/maps/{robot}/{coloring}"]["GaussianSplats3D:centers"] == 1
        camera = found[f"/world/cameras/{robot}"]
        assert camera["Pinhole:image_from_camera"] == 1
        assert camera["Transform3D:translation"] == len(KEYFRAMES)
        assert found[f"/world/cameras/{robot}/image"]["EncodedImage:blob"] == len(KEYFRAMES)
        assert found[f"/world/cameras/{robot}/depth"]["DepthImage:buffer"] == len(KEYFRAMES)
        assert found[f"/rounds/change/{robot}"]["round"] == 9
    assert found["/rounds/bytes/Gaussians"]["Scalars:scalars"] == 10
    assert found["/network"]["GraphEdges:edges"] == 1
    assert found["/summary"]["TextDocument:text"] == 1
    assert not (tmp_path / "run.rrd.part").exists()


def test_a_robot_has_one_color_in_paths_plots_and_network(fake, tmp_path):
    from rerun.chunk import RrdReader

    found: dict[tuple[str, str], list] = {}
    reader = RrdReader(run_rrd.write_rrd(fake.run, fake.recording, tmp_path / "run.rrd"))
    for chunk in reader.stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith(":colors"):
                found[chunk.entity_path, name] = batch.column(name).to_pylist()[0]
    nodes = found["/network", "GraphNodes:colors"]
    for i, robot in enumerate(("alpha", "bravo")):
        assert found[f"/world/paths/{robot}/after_consensus", "LineStrips3D:colors"] == [nodes[i]]
        assert found[f"/rounds/change/{robot}", "SeriesLines:colors"] == [nodes[i]]
    drawn = [tuple(colors) for (entity, _), colors in found.items() if entity.startswith("/rounds/bytes/")]
    assert len(set(drawn)) == len(drawn) >= 2


def test_gaussians_are_colored_by_the_decade_of_sigma_and_gray_where_it_is_not_determined():
    colors = run_rrd.sigma_colors(np.array([0.001, 0.01, 0.1, np.inf]))
    assert colors[3].tolist() == [0.75] * 3
    middle = run_rrd.sigma_colors(np.array([1.0, 10.0, 100.0]))[1]
    assert np.array_equal(colors[1], middle)
    assert run_rrd.sigma_colors(np.array([np.inf])).tolist() == [[0.75] * 3]


def test_robots_that_never_met_share_no_world(tmp_path):
    fake = make(tmp_path, joined=False, truth=False)
    found = of_rrd(run_rrd.write_rrd(fake.run, fake.recording, tmp_path / "run.rrd"))
    assert "/world/maps/alpha/fused" in found
    assert run_rrd._maps_shown(RunFolder(fake.run))[-1] == ("alpha", "uncertainty", "σ along the normal")
    assert "/world_of_bravo/maps/bravo/fused" in found
    assert "/world/paths/alpha/ground_truth" not in found


def test_thinning_keeps_what_covers_most():
    gaussians = wall()
    large = gaussians.log_scales.copy()
    large[::7] += 1.0
    chosen = run_rrd.thinned(gaussians.replace(log_scales=large), len(large[::7]))
    assert np.array_equal(chosen, np.arange(len(gaussians))[::7])
    assert np.array_equal(run_rrd.thinned(gaussians, 10**6), np.arange(len(gaussians)))


def test_a_made_file_is_copied_not_made_again(fake, tmp_path):
    made = fake.run / "run.rrd"
    made.write_bytes(b"made before")
    rerun_view.view(fake.run, save=tmp_path / "copy.rrd")
    made.unlink()
    assert (tmp_path / "copy.rrd").read_bytes() == b"made before"


def test_the_command_names_the_file_that_it_wrote(fake, tmp_path):
    saved = tmp_path / "saved.rrd"
    done = CliRunner().invoke(
        app, ["view", str(fake.run), "--recording", str(fake.recording), "--save", str(saved)]
    )
    assert done.stdout == f"{saved}\n"
    assert saved.is_file()


def test_what_is_neither_a_run_nor_a_recording_is_an_error(tmp_path):
    with pytest.raises(DuagError, match="expected a run"):
        rerun_view.view(tmp_path, save=tmp_path / "out.rrd")


def is_running(process: int) -> bool:
    """Whether a process has not ended."""
    try:
        return (Path("/proc") / str(process) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_machine_that_cannot_draw_says_so(fake, tmp_path, monkeypatch, capfd):
    """What the viewer says by itself is not shown, but for why it ended."""
    viewer = tmp_path / "viewer"
    viewer.write_text(
        "#!/bin/sh\necho $* > $0.arguments\necho INFO\nsleep 600 &\necho $! > $0.child\n"
        "printf \"\\nthread 'main' panicked at 'No graphics adapter was found'\\n6: panic\\n\" >&2\nexit 134\n"
    )
    viewer.chmod(0o755)
    monkeypatch.setattr(rerun_view, "_executable", lambda: str(viewer))
    with pytest.raises(
        DuagError, match=r"panicked at 'No graphics adapter was found'\); .*mesa-vulkan-drivers"
    ):
        rerun_view.view(fake.recording, screenshot=tmp_path / "out.png")
    assert capfd.readouterr() == ("", "")
    assert "--bind 127.0.0.1 --port" in (tmp_path / "viewer.arguments").read_text()
    assert not (tmp_path / "out.png").exists()
    child = int((tmp_path / "viewer.child").read_text())
    end_s = time.monotonic() + 60  # a process that was killed may take a moment to end
    while is_running(child):
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_a_viewer_that_is_silent_is_named_by_how_it_ended(fake, tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_view, "_executable", lambda: "/bin/false")
    with pytest.raises(DuagError, match=r"drew no picture \(it ended with 1\)"):
        rerun_view.view(fake.recording, screenshot=tmp_path / "out.png")


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("", "OSError"),
        (" \n", "OSError"),
        ("\n no port \nat all", "no port"),
    ],
)
def test_an_error_of_the_client_is_named_by_its_first_word_or_its_kind(
    fake, tmp_path, monkeypatch, said, words
):
    def fail(*_):
        raise OSError(said)

    monkeypatch.setattr(rerun_view, "_executable", lambda: "/bin/true")
    monkeypatch.setattr(rerun_view, "_picture", fail)
    with pytest.raises(DuagError, match=rf"drew no picture \({words}\)"):
        rerun_view.take_screenshot(fake.recording, tmp_path / "out.png")


def test_a_viewer_whose_words_are_no_text_is_an_error_all_the_same(fake, tmp_path, monkeypatch):
    viewer = tmp_path / "viewer"
    viewer.write_text("#!/bin/sh\nprintf 'no display \\377\\n' >&2\nexit 1\n")
    viewer.chmod(0o755)
    monkeypatch.setattr(rerun_view, "_executable", lambda: str(viewer))
    with pytest.raises(DuagError, match=r"the viewer ended with 1 \(no display .*--save"):
        rerun_view.view(fake.recording)


def test_a_window_that_does_not_open_is_an_error(fake, monkeypatch):
    import subprocess

    def no_display(command, **_):
        assert "127.0.0.1" in command
        return subprocess.CompletedProcess(
            command, 1, stderr="info\nneither WAYLAND_DISPLAY nor DISPLAY is set\n"
        )

    monkeypatch.setattr(subprocess, "run", no_display)
    with pytest.raises(DuagError, match=r"DISPLAY is set.*--save"):
        rerun_view.view(fake.recording)
