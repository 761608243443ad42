"""Maps for other programs: tiles hold every Gaussian once, a point cloud says how good each point is."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.open3d_import import import_open3d
from duagc.pipeline.cli import app
from duagc.pipeline.evaluation.pixel_deviation import StatedMap
from duagc.pipeline.runs.folder import RobotRun, RunFolder, position_information
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import sigma_along
from duagc.pipeline.splat.ply import read_ply
from duagc.pipeline.viewing import map_export
from duagc.pipeline.viewing.map_export import ExportPlan, export, tiles
from tests.fixtures.fake_run import FakeRun, make
from tests.fixtures.full_disks import no_file_larger_than


@pytest.fixture(scope="module")
def fake(tmp_path_factory) -> FakeRun:
    return make(tmp_path_factory.mktemp("fake"))


def final_means(robot: RobotRun) -> np.ndarray:
    return (robot.refined_map or robot.fused_map).gaussians.means


def by_place(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def test_cubes_are_in_order_and_hold_their_rows():
    means = np.array([[0.1, 0, 0], [-0.1, 0, 0], [1.9, 0, 0], [2.0, 0, 0], [0.5, 0, 1.0]], np.float32)
    found = {place: rows.tolist() for place, rows in tiles(means, 2.0)}
    assert found == {(-1, 0, 0): [1], (0, 0, 0): [0, 2, 4], (1, 0, 0): [3]}
    assert list(found) == sorted(found)


def test_nothing_is_in_no_cube():
    assert list(tiles(np.zeros((0, 3), np.float32), 2.0)) == []


def test_a_whole_map_is_one_file_a_robot(fake, tmp_path):
    files = export(fake.run, tmp_path / "out", ExportPlan())
    assert [f.relative_to(tmp_path / "out").as_posix() for f in files] == ["alpha.ply", "bravo.ply"]
    for name, robot in RunFolder(fake.run).robots.items():
        np.testing.assert_array_equal(read_ply(tmp_path / "out" / f"{name}.ply").means, final_means(robot))


def test_tiles_together_are_the_map_and_boxes_hold_what_they_draw(fake, tmp_path):
    export(fake.run, tmp_path / "out", ExportPlan(tile_m=0.5, robots=("bravo", "bravo")))
    described = json.loads((tmp_path / "out" / "export.json").read_text())
    assert list(described["robots"]) == ["bravo"]
    files = described["robots"]["bravo"]["files"]
    assert len(files) > 1
    parts = [read_ply(tmp_path / "out" / f["file"]) for f in files]
    whole = final_means(RunFolder(fake.run).robots["bravo"])
    np.testing.assert_array_equal(by_place(np.concatenate([p.means for p in parts])), by_place(whole))
    for entry, part in zip(files, parts, strict=True):
        assert entry["gaussians"] == len(part)
        assert (np.floor(part.means.astype(np.float64) / 0.5) == entry["tile"]).all()
        assert (part.means > entry["low_m"]).all()
        assert (part.means < entry["high_m"]).all()


def test_a_point_cloud_has_normals_to_the_cameras_and_stated_deviations(fake, tmp_path):
    export(fake.run, tmp_path / "out", ExportPlan("points", robots=("alpha",), min_opacity=0.0))
    cloud = import_open3d().t.io.read_point_cloud(str(tmp_path / "out" / "alpha.ply")).point
    robot = RunFolder(fake.run).robots["alpha"]
    fused = robot.fused_map
    assert fused.information is not None
    sigma_m, _ = sigma_along(position_information(fused.information.geometry), fused.gaussians.normals())
    means = final_means(robot)
    np.testing.assert_array_equal(cloud.positions.numpy(), means)
    np.testing.assert_allclose(cloud["sigma_m"].numpy()[:, 0], sigma_m.astype(np.float32))
    normals = cloud.normals.numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    cameras = np.concatenate([r.trajectory.positions for r in RunFolder(fake.run).robots.values()])
    nearest = cameras[np.argmin(np.linalg.norm(means[:, None] - cameras[None], axis=2), axis=1)]
    assert (np.einsum("ij,ij->i", normals, nearest - means) >= -1e-6).all()
    assert cloud.colors.numpy().dtype == np.uint8


def test_a_gaussian_of_which_nothing_is_stated_has_no_deviation(fake, tmp_path, monkeypatch):
    """As those that a final map has from a peer in the place of own ones."""

    def stated(robot, shown):
        sigma_m = np.full(len(shown.gaussians), 0.004)
        sigma_m[3] = np.inf
        return StatedMap(shown.gaussians, sigma_m, shown.depth)

    monkeypatch.setattr(map_export, "stated_in_world", stated)
    export(fake.run, tmp_path / "out", ExportPlan("points", robots=("alpha",), min_opacity=0.0))
    cloud = import_open3d().t.io.read_point_cloud(str(tmp_path / "out" / "alpha.ply")).point
    sigma_m = cloud["sigma_m"].numpy()[:, 0]
    assert np.flatnonzero(np.isnan(sigma_m)).tolist() == [3]
    np.testing.assert_array_equal(cloud.positions.numpy(), final_means(RunFolder(fake.run).robots["alpha"]))


@pytest.mark.parametrize("kind", ["points", "splats"])
def test_a_map_that_finds_no_room_is_told(fake, tmp_path, capfd, kind):
    plan = ExportPlan(kind, min_opacity=0.0)
    capfd.readouterr()
    with no_file_larger_than(200), pytest.raises(DuagError, match=r"alpha\.ply: File too large, expected"):
        export(fake.run, tmp_path / "out", plan)
    said = [line for line in capfd.readouterr().err.splitlines() if "stay in memory" not in line]
    assert said == []
    assert list(tmp_path.iterdir()) == []


def test_faint_gaussians_are_no_points(fake, tmp_path):
    logits = RunFolder(fake.run).robots["alpha"].fused_map.gaussians.opacity_logits
    most = float(1.0 / (1.0 + np.exp(-logits.astype(np.float64).max())))
    export(fake.run, tmp_path / "out", ExportPlan("points", robots=("alpha",), min_opacity=most - 1e-6))
    cloud = import_open3d().t.io.read_point_cloud(str(tmp_path / "out" / "alpha.ply")).point
    assert cloud["opacity"].numpy().min() >= most - 1e-6
    with pytest.raises(DuagError, match=r"the most opaque of \d+ Gaussians has 0\.\d+, expected"):
        export(fake.run, tmp_path / "none", ExportPlan("points", min_opacity=(1.0 + most) / 2))


def test_a_map_without_a_gaussian_is_no_point_cloud(fake, tmp_path, monkeypatch):
    """As by `frontend.mapping_enabled=false`: no opacity helps."""
    found = RunFolder(fake.run).robots["alpha"].fused_map
    monkeypatch.setattr(RobotRun, "refined_map", None)
    monkeypatch.setattr(RobotRun, "fused_map", replace(found, gaussians=Gaussians.empty(), information=None))
    with pytest.raises(DuagError, match=r"alpha: its final map has no Gaussian, expected some for --points"):
        export(fake.run, tmp_path / "out", ExportPlan("points", min_opacity=0.0))
    export(fake.run, tmp_path / "out", ExportPlan())
    assert len(read_ply(tmp_path / "out" / "alpha.ply")) == 0


@pytest.mark.parametrize("tile_m", [0.0, -1.0, 0.01, float("nan"), float("inf")])
def test_an_edge_that_is_none_is_refused(fake, tmp_path, tile_m):
    with pytest.raises(DuagError, match=r"--tile: found .*, expected 0\.1 m or more"):
        export(fake.run, tmp_path / "out", ExportPlan(tile_m=tile_m))
    assert list(tmp_path.iterdir()) == []


def test_a_robot_that_is_not_there_is_refused(fake, tmp_path):
    with pytest.raises(DuagError, match="has no robot carol, expected one of alpha, bravo"):
        export(fake.run, tmp_path / "out", ExportPlan(robots=("carol",)))
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_an_export_and_replaces_nothing_else(fake, tmp_path: Path):
    out = tmp_path / "out"
    words = ["export", str(fake.run), "--points", "--tile", "1", "--out", str(out)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert re.search(r"^duagc: \d+ files, [\d.]+ kB$", result.output, re.MULTILINE)
    assert (out / "export.json").is_file()
    with pytest.raises(DuagError, match="exists already"):
        CliRunner().invoke(app, words, catch_exceptions=False)
    assert CliRunner().invoke(app, [*words, "--force"]).exit_code == 0
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("years of work")
    with pytest.raises(DuagError, match="is not an export"):
        CliRunner().invoke(
            app,
            ["export", str(fake.run), "--out", str(tmp_path / "other"), "--force"],
            catch_exceptions=False,
        )


def test_an_opacity_without_points_is_refused(fake, tmp_path):
    words = ["export", str(fake.run), "--out", str(tmp_path / "out"), "--min-opacity", "0.5"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "expected together with --points" in result.output
    assert not (tmp_path / "out").exists()
    assert CliRunner().invoke(app, [*words, "--points"]).exit_code == 0
