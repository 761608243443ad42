"""The benchmark measures what it says; how long things take is never asserted."""

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.pipeline import cli
from duagc.pipeline.bench import made_room, raster, raster_tables, raster_work, torch_tiles
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer, _raster, available_isas

TINY = raster.RasterPlan(sizes=((40, 30), (20, 16)), gaussians=(500,), threads=(1, 2), rounds=1)


@pytest.fixture(scope="module")
def result():
    return json.loads(json.dumps(raster.run(TINY)))


def test_the_torch_rasterizer_draws_the_same_room():
    room, camera = made_room.make_room(2000), PinholeCamera(50, 40, 25.0, 25.0, 24.5, 19.5)
    render = Rasterizer().forward(room, camera, made_room.view_of_room())
    image = torch_tiles.draw(torch_tiles.tensors_of(room), camera, made_room.view_of_room()).detach().numpy()
    assert render.alpha.mean() > 0.9  # the room fills the view
    # float32 on both sides: a pair at a threshold may be drawn by one of them only
    assert np.abs(image[..., :3] - render.color).mean() < 1e-5
    assert np.abs(image[..., 3] - render.depth).mean() < 1e-4


def test_a_row_per_scene_and_candidate(result):
    fast = [isa for isa in available_isas() if isa != "portable"] or ["portable"]
    wanted = {(w, isa, threads) for w in (20, 40) for isa in fast for threads in (1, 2)} | {
        (20, "portable", 1)
    }
    assert {(row["width"], row["isa"], row["threads"]) for row in result["rows"]} == wanted
    for row in result["rows"]:
        times = [row[f"{name}_ms"] for name in raster_work.TITLES] + [
            row["torch_forward_ms"],
            row["torch_backward_ms"],
        ]
        assert all(time >= 0 for time in times)
        assert 0 < row["contributing_pairs"] <= row["evaluated_pairs"]
        assert 0 < row["visible"] <= row["gaussians"] == 500
        assert row["scratch_mb"] > 0


def test_work_is_the_same_for_every_candidate(result):
    for name in ("visible", "intersections", "evaluated_pairs", "contributing_pairs"):
        assert len({(row["width"], row[name]) for row in result["rows"]}) == 2


def test_drawn_pairs_are_the_pixels_that_gaussians_count():
    view = raster_work.RasterView((40, 30), 500)
    rasterizer = Rasterizer()
    rasterizer.forward(view.room, view.camera, view.T_camera_map)
    assert raster_work.RasterWork("auto", view).seen.blended_pairs == rasterizer.contributions()[1].sum()


def test_fraction_of_peak_is_work_over_time_over_rate(result):
    for row in result["rows"]:
        rate = 1e9 * result["machine"]["fma_gflops"][row["isa"]][str(row["threads"])]
        flops = raster_work.FLOPS["backward"] * row["contributing_pairs"]
        assert row["backward_fraction_of_peak"] == pytest.approx(flops / (1e-3 * row["backward_ms"]) / rate)


def test_tables_show_every_row(result):
    text = raster_tables.format_tables(result)
    assert result["machine"]["cpu"] in text
    for isa in available_isas():
        assert f" {isa} |" in text
    for title in raster_work.TITLES.values():
        assert f" {title} |" in text
    blocks = text.split("\n\n")
    times = blocks[2].splitlines()
    assert len(times) == 2 + len(result["rows"])
    for table in blocks[2::2]:
        assert len({line.count("|") for line in table.splitlines()}) == 1


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("threads", [1, 2])
def test_machine_has_a_rate_of_multiply_adds(isa, threads):
    rate = _raster.fma_rate(isa, threads, 0.005)
    assert 0.01 < rate < 1e4 * threads  # GFLOP/s; a loop that the compiler left out would show millions


@pytest.mark.parametrize("threads", [1, 2])
def test_machine_has_a_bandwidth(threads):
    for rate in _raster.bandwidth(threads, 0.01):
        assert 0.01 < rate < 1e5
    with pytest.raises(ValueError, match="isa: vax is not available"):
        _raster.fma_rate("vax", 1, 0.01)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_room_is_flat_along_its_walls(axis):
    room = made_room.make_room(3000)
    on_wall = room.log_scales.argmin(axis=1) == axis
    assert on_wall.mean() > 0.1


def test_command_prints_json_alone():
    arguments = [
        "bench",
        "raster",
        "--sizes",
        "20x16",
        "--gaussians",
        "300",
        "--threads",
        "1",
        "--rounds",
        "1",
    ]
    run = CliRunner().invoke(cli.app, [*arguments, "--isa", "portable", "--no-torch", "--json"])
    assert run.exit_code == 0, run.output
    (row,) = json.loads(run.stdout)["rows"]
    assert (row["width"], row["height"], row["gaussians"], row["threads"]) == (20, 16, 300, 1)
    assert row["torch_forward_ms"] is None
    assert math.isfinite(row["forward_fraction_of_peak"])


@pytest.mark.parametrize(
    ("option", "value", "complaint"),
    [
        ("--sizes", "640", "not an image size"),
        ("--sizes", "0x480", "not an image size"),
        ("--gaussians", "60x", "not a positive number"),
        ("--threads", "0", "not a positive number"),
        ("--isa", "vax", "not one of"),
    ],
)
def test_command_refuses_by_option(option, value, complaint):
    run = CliRunner().invoke(cli.app, ["bench", "raster", option, value])
    assert run.exit_code == 2
    assert option in run.stderr
    assert complaint in " ".join(run.stderr.replace("│", " ").split())


def test_counts_with_units():
    assert cli.bench.counts("--gaussians", "60k,1M,7") == [60_000, 1_000_000, 7]
