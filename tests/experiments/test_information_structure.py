"""The information of single Gaussians with its cross terms: sums, measures, verdicts."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M
from duagc.pipeline.experiments import information_measures as m
from duagc.pipeline.experiments import information_structure, information_tables
from duagc.pipeline.experiments.information_blocks import BlockSums, sum_blocks
from duagc.pipeline.experiments.information_structure import ShareRule, _verdict, thirds, wilson
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.information.noise import ImageNoise
from duagc.pipeline.information.stage import run_information
from duagc.pipeline.information.sums import sum_information, without_thickness
from duagc.pipeline.information.views import MapViews
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.splat.information import unpack_geometry
from tests.fixtures.fake_run import make
from tests.fixtures.full_disks import no_file_larger_than
from tests.fixtures.noisy_wall import CAMERA, NOISE, SENSOR, views_of, wall

ROWS = np.array([5, 40, 111, 222, 333, 444, 599])
WINDOWS = (1, 3, 4)
WALL = wall()


def summed(views: list[PosedRgbd], rows: np.ndarray = ROWS, noise: ImageNoise = NOISE) -> BlockSums:
    return sum_blocks(
        MapViews(WALL, CAMERA, views), noise, rows, WINDOWS, thickness_floor_m=THICKNESS_FLOOR_M
    )


@pytest.mark.parametrize("window", ["all", "rolling", "per_gaussian"])
def test_the_blocks_are_those_of_the_stage_in_every_window(window: str) -> None:
    views, noise = views_of(WALL, 0.02, 1.0), replace(NOISE, color_pixels=3.0, depth_pixels=2.0)
    mine, K = summed(views, noise=noise), 3
    config = InformationConfig(window=window, window_length=K)
    theirs = sum_information(MapViews(WALL, CAMERA, views), noise, config)
    geometry = unpack_geometry(without_thickness(theirs.geometry, WALL, THICKNESS_FLOOR_M))[ROWS]
    chart = {"all": mine.chart, "rolling": mine.rolling[K], "per_gaussian": mine.latest[K]}[window]
    diagonal = np.diagonal(chart, axis1=1, axis2=2)
    np.testing.assert_allclose(chart[:, :9, :9], geometry, atol=1e-4 * np.abs(geometry).max())
    np.testing.assert_allclose(diagonal[:, 9:12], theirs.color[ROWS], rtol=1e-3)
    np.testing.assert_allclose(diagonal[:, 12], theirs.opacity[ROWS], rtol=1e-3)
    if window == "all":
        np.testing.assert_array_equal(mine.views, theirs.observations[ROWS])
        assert mine.views[-1] == 0  # behind the camera
        assert not mine.chart[-1].any()


def test_squared_gradients_are_the_information_if_the_noise_is_right() -> None:
    """And a quarter of it if the images have half of the noise."""
    means = {}
    for share in (1.0, 0.5):
        noise = ImageNoise(0.05, SENSOR)
        sums = summed(views_of(WALL, 0.05 * share, share), np.arange(0, 590, 12), noise)
        values = m.generalized_eigenvalues(sums.squared, sums.covered)
        mean, least, most = values[~np.isnan(values[:, 0])].T
        assert len(mean) > 20
        assert (least <= mean).all()
        assert (mean <= most).all()
        means[share] = np.median(mean)
    assert means[1.0] == pytest.approx(1.0, rel=0.15)
    assert means[0.5] == pytest.approx(0.25, rel=0.15)


def test_measures_of_a_matrix_that_is_known() -> None:
    """Correlation 0.8 between one entry of the mean and one of the shape, none elsewhere; in other units the same."""
    F = np.eye(13)[None].copy()
    F[0, 2, 5] = F[0, 5, 2] = 0.8
    units = np.geomspace(1e-3, 1e3, 13)
    scaled = F * np.outer(units, units)
    mean, shape, color = (m.OF_CHART[name] for name in ("mean", "shape", "color"))
    assert m.canonical_correlation(scaled, mean, shape)[0] == pytest.approx(0.8)
    assert m.canonical_correlation(scaled, mean, color)[0] == pytest.approx(0.0, abs=1e-12)
    assert m.off_diagonal(m.unit_diagonal(scaled), m.OF_CHART)[0] == pytest.approx(
        np.sqrt(2 * 0.64 / (13 + 2 * 0.64))
    )
    marginal = m.marginal_information(scaled, mean)[0]
    np.testing.assert_allclose(marginal, np.diag(units[:3] ** 2 * [1, 1, 1 - 0.64]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.inv(marginal), np.linalg.inv(scaled[0])[:3, :3], rtol=1e-8, atol=1e-8
    )
    eigenvalues = m.generalized_eigenvalues(3.0 * scaled, scaled)
    np.testing.assert_allclose(eigenvalues, 3.0, rtol=1e-8)
    assert np.isnan(m.generalized_eigenvalues(scaled, 0 * scaled)).all()


def test_a_share_holds_fails_or_is_open() -> None:
    assert wilson(5_000, 10_000) == pytest.approx((0.4902, 0.5098), abs=1e-4)

    def word(good: int, count: int, measure: str = "x") -> str:
        rule = ShareRule(name="", claim="", measure=measure, most=1.0, share=0.9, reason="")
        values = np.where(np.arange(count) < good, 1.0, np.inf)
        return _verdict(rule, {"x": np.append(values, np.nan)})["verdict"]

    assert word(99, 100) == "holds"
    assert word(80, 100) == "fails"
    assert word(92, 100) == "open"
    assert word(0, 0) == "not testable"
    assert word(99, 100, "y") == "not testable"


def test_thirds_keep_equal_values_together() -> None:
    parts = thirds(np.array([1.0, 1, 1, 1, 2, 3]))
    assert [(low, high, int(part.sum())) for low, high, part in parts] == [(1, 1, 4), (2, 3, 2)]


def test_the_information_of_a_runs_gaussians(tmp_path: Path) -> None:
    """The sums are those that the stage wrote, and tables, plot and rows are made of them."""
    made = make(tmp_path)
    run, source = RunFolder(made.run), Recording(made.recording)
    folder = run.robots["alpha"].folder
    run_information(
        source.log("alpha"),
        folder / "frontend.mcap",
        folder / "information.mcap",
        config=run.config.information,
        moving=run.config.frontend.moving,
        thickness_floor_m=run.config.frontend.mapping.seeding.thickness_m,
    )
    plan = information_structure.StructurePlan(30, (1, 50), robots=("alpha",))
    found = information_structure.run(run, source, plan)
    facts = found.summary["robots"]["alpha"]
    assert max(facts["difference_from_stage"].values()) < 2e-3
    assert facts["views_that_differ"] == 0
    assert len(found.columns["id"]) == facts["seen"] > 6
    verdicts = {v["name"]: v["verdict"] for v in found.summary["verdicts"]}
    assert verdicts["turned"] == "fails"
    assert verdicts["last_ten_keyframes"] == "not testable"
    assert (found.columns["sigma_normal"] >= 1 - 1e-6).all()
    assert (found.columns["stated_normal"] >= 1 - 1e-3).all()
    code = 64 * "a"
    numbers = json.loads(json.dumps(information_tables.numbers(found, code), allow_nan=False))
    assert numbers["measures"]["rolling_50"]["50"] is None
    assert numbers["measures"]["rolling_1"]["50"] is None or numbers["measures"]["rolling_1"]["50"] >= 1
    assert "mean, shape |" in information_tables.page(found, code)
    assert information_tables.plot(found).count("</svg>") == 1
    information_structure.write_gaussians(found.columns, tmp_path / "gaussians.parquet")
    assert (tmp_path / "gaussians.parquet").stat().st_size > 1000
    with pytest.raises(DuagError, match="has no robot zulu"):
        information_structure.run(run, source, information_structure.StructurePlan(robots=("zulu",)))


def test_a_disk_without_room_is_told_and_leaves_no_half_folder(tmp_path: Path) -> None:
    fake = make(tmp_path / "fake")
    words = ["bench", "information", str(fake.run), "--recording", str(fake.recording), "--sample", "3"]
    with no_file_larger_than(20_000):  # room for all but the plot
        result = CliRunner().invoke(app, [*words, "--windows", "1", "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, DuagError)
    assert re.search(r"r_k\.svg: File too large, expected", str(result.exception))
    assert [path.name for path in tmp_path.iterdir()] == ["fake"]
