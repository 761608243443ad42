"""Parts of the evaluation on small arrays: views, surfaces, ways, the logs of the exchange."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from duagc import schemas
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.ply_points import write_points
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation import rendering, views
from duagc.pipeline.evaluation.groundtruth import Surface, surface
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.paths import _put_at_start, top_view_axes
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.views import ComparedImage
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.kernels import Render
from duagc.pipeline.recording import LogWriter, Recording, open_rgbd
from duagc.pipeline.report.renders import _compared
from duagc.pipeline.runs.digest import digest_file
from duagc.pipeline.runs.folder import RunFolder, position_information
from duagc.pipeline.splat.information import sigma_along
from duagc.schemas import topics
from tests.fixtures.fake_run import make


def a_render(value: float = 0.5, depth_m: float = 2.0, alpha: float = 1.0) -> Render:
    full = np.full((12, 14), alpha, dtype=np.float32)
    return Render(np.full((12, 14, 3), value, dtype=np.float32), depth_m * full, full)


def test_a_view_is_scored_against_image_and_both_depths():
    color = np.full((12, 14, 3), 102, dtype=np.uint8)  # 0.4 of white
    recorded = np.full((12, 14), 2.01, dtype=np.float32)
    recorded[0] = 0.0
    score = views.score_view(
        a_render(alpha=0.8), ComparedImage(color), recorded, np.full((12, 14), 1.95, dtype=np.float32)
    )
    assert score.psnr_db == pytest.approx(20.0, abs=1e-4)
    assert score.depth_l1_m == pytest.approx(0.01, abs=1e-6)
    assert score.depth_l1_exact_m == pytest.approx(0.05, abs=1e-6)
    assert score.depth_completeness == 1.0
    assert isinstance(score.ms_ssim, Absent)
    assert "12 px" in score.ms_ssim.reason


def test_an_equal_image_scores_a_finite_psnr():
    image = np.full((12, 14, 3), 255, dtype=np.uint8)
    score = views.score_view(
        a_render(1.0), ComparedImage(image), np.zeros((12, 14), dtype=np.float32), Absent("none")
    )
    assert score.psnr_db == views.PSNR_CEILING_DB
    assert isinstance(score.depth_l1_m, Absent)
    assert isinstance(score.depth_completeness, Absent)


def test_depth_that_is_not_covered_is_incomplete_not_wrong():
    depth = np.full((12, 14), 2.0, dtype=np.float32)
    score = views.score_view(
        a_render(alpha=0.3), ComparedImage(np.zeros((12, 14, 3), dtype=np.uint8)), depth, Absent("none")
    )
    assert isinstance(score.depth_l1_m, Absent)
    assert score.depth_completeness == 0.0
    assert not views.surface_depth(a_render(alpha=0.3)).any()
    assert views.surface_depth(a_render(alpha=0.7)) == pytest.approx(2.0)


def test_the_depth_of_one_layer_is_a_figure_of_its_own():
    image = ComparedImage(np.zeros((12, 14, 3), dtype=np.uint8))
    recorded = np.full((12, 14), 2.0, dtype=np.float32)
    layer = np.full((12, 14), 2.03, dtype=np.float32)
    recorded[0], layer[1] = 0.0, 0.0
    score = views.score_view(a_render(), image, recorded, Absent("none"), layer_m=layer)
    assert score.depth_l1_layer_m == pytest.approx(0.03, abs=1e-6)
    assert score.depth_l1_m == pytest.approx(0.0, abs=1e-6)
    without = views.score_view(a_render(), image, recorded, Absent("none"), layer_m=np.zeros_like(layer))
    assert isinstance(without.depth_l1_layer_m, Absent)
    assert views.score_view(a_render(), image, recorded, Absent("none")).depth_l1_layer_m == views.NO_LAYER


def test_what_moves_by_the_truth_counts_in_no_view(tmp_path, monkeypatch):
    made = make(tmp_path)
    recording, robot = Recording(made.recording), RunFolder(made.run).robots["alpha"]
    with open_rgbd(recording.log("alpha")) as log:
        shape = log.frame(0).depth.shape
        left = np.zeros(shape, bool)
        left[:, : shape[1] // 2] = True
        static = {robot.frames[1].stamp_ns: left}
        monkeypatch.setattr(rendering.groundtruth, "static_masks", lambda *of: static)
        seen = [view.frame.mask for view in rendering.scored_frames(log, [0, 1], recording, robot)]
    assert seen[0] is None
    assert np.array_equal(seen[1], left)


def test_depth_that_is_degraded_without_noise_is_not_the_truth(tmp_path):
    made = make(tmp_path, depth_noise="kinect")  # with true depth apart, written 10 mm off
    path = made.recording / "recording.json"
    path.write_text(path.read_text().replace('"kinect"', '"none"'))
    recording, robot = Recording(made.recording), RunFolder(made.run).robots["alpha"]
    with open_rgbd(recording.log("alpha")) as log:
        seen = list(rendering.scored_frames(log, [0, 1], recording, robot))
    assert len(seen) == 2
    pictured = _compared([view.frame for view in seen], recording, "alpha")
    for view in (*seen, *pictured):
        off_m = (view.exact_depth_m - view.frame.depth)[view.frame.depth > 0]
        assert off_m == pytest.approx(0.010, abs=1e-4)


def test_a_summary_counts_views_without_pose_apart():
    score = views.score_view(
        a_render(),
        ComparedImage(np.zeros((12, 14, 3), dtype=np.uint8)),
        np.full((12, 14), 2.0, dtype=np.float32),
        Absent("none"),
    )
    summary = views.summary([score, Absent("no pose")], "none")
    assert summary["views"] == 1
    assert summary["views_without_pose"] == 1
    assert summary["psnr_db"] == score.psnr_db
    assert summary["depth_l1_exact_m"] == Absent("none")
    assert views.summary([], "there is no view")["psnr_db"] == Absent("there is no view")


def test_distance_from_a_sampled_corner_does_not_feel_the_sampling():
    """Two walls that meet, sampled every 2 cm: the distance must be right within a small part of that."""
    rng = np.random.default_rng(0)
    u, v = (0.02 * a.ravel() for a in np.meshgrid(np.arange(1, 60), np.arange(60)))
    floor, side = np.stack([u, v, 0 * u], axis=1), np.stack([0 * u, v, u], axis=1)
    normals = np.repeat([[0.0, 0, 1], [1, 0, 0]], len(u), axis=0)
    cloud = Surface(np.concatenate([floor, side]), normals)
    points = np.stack(
        [rng.uniform(0.003, 1, 500), rng.uniform(0.1, 1, 500), rng.uniform(0.001, 0.3, 500)], axis=1
    )
    distance, direction = cloud.closest(points)
    true = np.minimum(points[:, 0], points[:, 2])
    assert np.abs(distance - true).max() < 1e-6
    assert np.array_equal(np.argmax(np.abs(direction), axis=1) == 2, points[:, 2] <= points[:, 0])
    beyond = np.array([[1.5, 0.5, 0.0]])
    assert cloud.closest(beyond)[0] == pytest.approx(1.5 - 1.18, abs=0.021)
    distance, direction = cloud.closest(np.zeros((0, 3)))  # of a map without Gaussians
    assert (distance.shape, direction.shape) == ((0,), (0, 3))


@pytest.mark.parametrize("damage", ["cut", "ascii", "not finite", "no normals", "empty", "digits"])
def test_damaged_geometry_is_one_line(tmp_path, damage):
    path = tmp_path / "groundtruth.ply"
    points = np.random.default_rng(0).normal(size=(50, 3))
    write_points(path, points, np.tile([0.0, 0, 1], (50, 1)), np.zeros((50, 3), np.uint8))
    whole = path.read_bytes()
    damaged = {
        "cut": whole[:-7],
        "ascii": whole.replace(b"binary_little_endian", b"ascii"),
        "not finite": whole[:-27] + np.full(6, np.nan, "<f4").tobytes() + whole[-3:],
        "no normals": whole.replace(b" nx", b" ax"),
        "empty": b"",
        "digits": whole.replace(b"vertex 50", b"vertex " + b"5" * 5000),
    }
    recording = SimpleNamespace(geometry=lambda: path)
    assert len(surface(recording).points) == 50
    path.write_bytes(damaged[damage])
    with pytest.raises(DuagError, match=r"groundtruth\.ply") as caught:
        surface(recording)
    assert "\n" not in str(caught.value)


def test_a_changed_configuration_is_noticed(tmp_path):
    path = tmp_path / "config.toml"
    with pytest.raises(DuagError, match=r"config\.toml: no such file"):
        _ = RunFolder(tmp_path).config
    path.write_text("seed = 3\n")
    (tmp_path / "manifest.json").write_text(json.dumps({"config": digest_file(path)}))
    assert RunFolder(tmp_path).config == RunConfig(seed=3)
    path.write_text("seed = 4\n")
    with pytest.raises(DuagError, match="as in manifest"):
        _ = RunFolder(tmp_path).config


def test_position_information_comes_from_the_right_places():
    F = np.arange(81.0).reshape(9, 9)
    F = F + F.T
    packed = F[np.triu_indices(9)][None].astype(np.float32)
    assert np.array_equal(position_information(packed)[0], F[:3, :3])


def test_sigma_is_that_along_the_normal(tmp_path):
    fused = RunFolder(make(tmp_path).run).robots["alpha"].fused_map
    along_z = np.tile([0.0, 0.0, 1.0], (len(fused.gaussians), 1))
    along_x = np.tile([1.0, 0.0, 0.0], (len(fused.gaussians), 1))
    F = position_information(fused.information.geometry)
    sigma_z, determined = sigma_along(F, along_z)
    sigma_x, _ = sigma_along(F, along_x)
    assert determined.all()
    assert sigma_x == pytest.approx(10.0 * sigma_z, rel=1e-5)  # float32 information


def test_the_top_view_looks_along_the_vertical_of_the_cameras():
    """Level cameras that turn and drive on a floor: their down axis must vanish from the picture."""
    angles = np.linspace(0.0, 3.0, 20)
    poses = se3.exp(np.stack([0 * angles, 0 * angles, 0 * angles, 0 * angles, angles, 0 * angles], axis=1))
    poses[:, 0, 3], poses[:, 2, 3] = 3 * np.cos(angles), np.sin(angles)
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))
    axes = top_view_axes(T @ poses)
    assert axes @ axes.T == pytest.approx(np.eye(2), abs=1e-12)
    assert axes @ T[:3, 1] == pytest.approx(np.zeros(2), abs=1e-9)
    assert abs(axes[0] @ T[:3, 0]) > 0.99  # the longer way lies to the right
    np.testing.assert_allclose(
        np.cross(*axes), -T[:3, 1], atol=1e-9
    )  # from above; y of the cameras points down


def test_a_way_before_consensus_begins_where_the_one_after_it_begins_and_keeps_its_form():
    T = se3.exp(np.random.default_rng(0).normal(size=(2, 4, 6)))
    before, after = (Trajectory(np.arange(4), poses) for poses in T)
    put = _put_at_start(before, after)
    np.testing.assert_allclose(put.poses[0], after.poses[0], atol=1e-12)
    steps = [se3.inverse(way.poses[:-1]) @ way.poses[1:] for way in (before, put)]
    np.testing.assert_allclose(steps[1], steps[0], atol=1e-12)


def test_held_out_is_what_the_log_says(tmp_path):
    robot = RunFolder(make(tmp_path).run).robots["alpha"]
    assert robot.held_out == {4, 12, 20}


def test_the_largest_component_needs_everybodys_agreement(tmp_path):
    run = RunFolder(make(tmp_path / "joined_all").run)
    assert run.largest_component == ("alpha", "bravo")
    alone = RunFolder(make(tmp_path / "apart", joined=False).run)
    assert alone.largest_component == ("alpha",)


def test_a_packet_without_its_message_is_an_error(tmp_path):
    fake = make(tmp_path)
    with LogWriter(fake.run / "exchange.mcap") as log:
        packet = schemas.new("PeerPacket", robot="alpha", receiver="bravo", message=77, sequence=5)
        log.write(topics.PEER_PACKET.of("alpha"), packet, 0)
    session = Session(RunFolder(fake.run))
    with pytest.raises(DuagError, match="packet 5 of alpha is cut from no message"):
        _ = session.packets
    with pytest.raises(DuagError, match="finished session"):
        _ = session.summary


def test_a_folder_that_is_no_run_is_an_error(tmp_path):
    with pytest.raises(DuagError, match="expected a run"):
        _ = RunFolder(tmp_path).robots
