import json
import re
from html import unescape
from itertools import pairwise

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.report import figures, labels, pictures, write_report
from duagc.pipeline.report.cards import cards
from tests.fixtures.fake_run import make


@pytest.fixture(scope="module")
def fake(tmp_path_factory):
    fake = make(tmp_path_factory.mktemp("fake"))
    evaluate(fake.run, fake.recording, progress=False)
    return fake


@pytest.fixture(scope="module")
def html(fake) -> str:
    return write_report(fake.run, fake.recording).read_text()


def test_the_page_needs_no_network(html):
    sources = re.findall(r"""(?:src|href)=["']([^"']{0,40})""", html)
    assert sources
    assert all(s.startswith(("data:", "#")) for s in sources)
    for word in ("<script", "@import", "url("):
        assert word not in html


def test_the_page_is_the_same_every_time(fake, html):
    assert write_report(fake.run, fake.recording).read_text() == html


def test_psnr_in_the_exposure_of_a_view_has_a_card_where_exposures_differ(fake):
    metrics = json.loads((fake.run / "metrics.json").read_text())
    labels_of = [card["label"] for card in cards(metrics, {})]
    assert "PSNR" in labels_of
    assert "PSNR, in exposure" not in labels_of
    for kind in ("own", "fused", "refined"):
        scores = metrics["rendering"][kind]["held_out"]
        scores["psnr_interpolated_db"] = None if scores["psnr_db"] is None else scores["psnr_db"] + 2.5
        scores["psnr_moved_db"] = scores["psnr_interpolated_db"]
    labels_of = [card["label"] for card in cards(metrics, {})]
    assert "PSNR, in exposure" in labels_of
    assert "PSNR, as moved" not in labels_of


def test_psnr_as_the_camera_moved_has_a_card_where_the_shutter_is_known(fake):
    metrics = json.loads((fake.run / "metrics.json").read_text())
    assert "PSNR, as moved" not in [card["label"] for card in cards(metrics, {})]
    for kind in ("own", "fused", "refined"):
        scores = metrics["rendering"][kind]["held_out"]
        scores["psnr_moved_db"] = None if scores["psnr_db"] is None else scores["psnr_db"] + 1.5
    assert "PSNR, as moved" in [card["label"] for card in cards(metrics, {})]


def test_the_page_shows_numbers_with_units_pictures_and_reasons(html):
    text = re.sub(r"<[^>]+>", " ", re.sub(r"(?s)<style>.*?</style>", "", html))
    for expected in (
        "wall: 2 robots",
        "Team ATE",
        "dB",
        "800 B",
        "alpha, frame 4",
        "bravo, frame 20",
        "LPIPS needs the weights of a trained network",
        "tolerance = 1e-5",
        "index % 8 == 4",
        "3.5 s",
        "210 MB",
        "few_matches",
        "predicted deviation, refined map",
        "refined (final), own held-out views",
    ):
        assert expected in text, expected
    assert html.count("data:image/jpeg") > 4 * 9  # nine pictures of each of four views, and more
    assert html.count("data:image/svg+xml") == 7
    assert "None" not in text
    assert "nan" not in text.lower().split()


def test_maps_stand_beside_each_other_for_all_and_for_each_robot(fake, html):
    metrics = json.loads((fake.run / "metrics.json").read_text())
    rows = labels.comparison_rows(metrics)
    assert [r["robot"] for r in rows if r["first"]] == ["all robots", "alpha", "bravo"]
    assert len(rows) == 3 * 3
    assert all(len(r["values"]) == 3 * 4 for r in rows)
    assert "Which map is better?" in html
    assert "own, trained longer" not in html  # it was not asked for
    lines = labels.comparison_text(metrics).splitlines()
    bravo = metrics["robots"]["bravo"]["rendering"]["own"]
    own = next(line for line in lines if line.startswith("bravo")).split()
    assert own[:2] == ["bravo", "own"]
    assert own[2:5] == [f"{bravo[s]['psnr_db']:.2f}" for s in ("held_out", "peers", "team")]
    assert own[5] == f"{1e3 * bravo['held_out']['depth_l1_common_m']:.1f}"
    assert own[-1] == f"{100 * bravo['team']['depth_completeness']:.1f}"


def test_the_page_says_how_cameras_differ(html, tmp_path):
    dark = make(tmp_path, gain=0.6)
    evaluate(dark.run, dark.recording, progress=False)
    page = write_report(dark.run, dark.recording).read_text()
    assert "bravo's camera has 0.600 ± 0.010, 0.600 ± 0.010, 0.600 ± 0.010 times" in unescape(page)
    assert "'s camera has" not in unescape(html)


def test_a_run_without_truth_and_without_agreement_has_a_page(tmp_path):
    fake = make(tmp_path, truth=False, joined=False)
    evaluate(fake.run, fake.recording, progress=False)
    (fake.run / "timing.json").unlink()
    html = write_report(fake.run, fake.recording).read_text()
    assert "No two robots share a world" in html
    assert "Not in that world, so not shown: bravo" in html
    assert "The recording has no ground truth of the paths" in html
    assert "The run has no timing.json" in html


def test_a_run_that_was_not_evaluated_is_an_error(tmp_path):
    fake = make(tmp_path)
    with pytest.raises(DuagError, match="duagc evaluate"):
        write_report(fake.run, fake.recording)
    assert not (fake.run / "report").exists()


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("ate_rmse_m", 0.01234, "12.3 mm"),
        ("ate_rmse_m", 0.00056789, "0.568 mm"),
        ("ate_rmse_m", 1.5, "1.500 m"),
        ("ate_rmse_m", 1e-12, "< 0.001 mm"),
        ("rpe_rot_rad", np.pi / 180, "1°"),
        ("psnr_db", 27.123, "27.12 dB"),
        ("bytes_sent", 2_100_000, "2.1 MB"),
        ("bytes_sent", 512, "512 B"),
        ("ssim", 0.9, "0.900"),
        ("depth_completeness", 0.987, "98.7 %"),
        ("converged", True, "yes"),
        ("gap_to_oracle_sigma", 0.05, "0.050 σ"),
        ("rounds", 12345, "12\u202f345"),
        ("lpips", None, "–"),
    ],
)
def test_values_are_written_with_their_unit(name, value, text):
    assert labels.text(name, value) == text


def test_figures_stay_the_same_and_leave_the_settings_alone():
    import matplotlib as mpl

    before = mpl.rcParams["svg.hashsalt"]
    series = {"alpha": (np.arange(5), np.array([1.0, 0.1, 0.0, np.inf, 1e-3]))}
    first = figures.lines(series, "round", "m", log=True, level=1e-2)
    assert first == figures.lines(series, "round", "m", log=True, level=1e-2)
    assert "<dc:date>" not in first
    assert mpl.rcParams["svg.hashsalt"] == before


def test_colors_of_a_scalar_image():
    values = np.array([[0.0, 1.0, 2.0, 5.0]])
    rgb = pictures.colored(values, 0.0, 2.0, valid=values < 4)
    assert rgb.shape == (1, 4, 3)
    assert tuple(rgb[0, 3]) == pictures.NOTHING
    assert rgb[0, 0].tolist() == [68, 1, 84]  # the ends of viridis
    assert rgb[0, 2].tolist() == [253, 231, 37]


def test_the_charts_name_what_they_show(html):
    import base64

    charts = [base64.b64decode(c).decode() for c in re.findall(r"data:image/svg\+xml;base64,([^\"]+)", html)]
    for expected in (
        "ground truth",
        "tolerance 1e-05",
        "alpha to bravo",
        "set-up",
        "right prediction",
        "frontend, alpha",
    ):
        assert any(expected in chart for chart in charts), expected


def test_maps_that_no_view_compares_are_said_to_be_none(fake):
    metrics = json.loads((fake.run / "metrics.json").read_text())
    for kind in labels.COMPARED:
        for found in metrics["rendering"][kind].values():
            found["views"] = 0
    metrics["rendering"]["own"]["training"] = {"views": 2}
    assert labels.comparison_text(metrics) == (
        "no map was compared: no frame was held out, and no two robots met"
    )


def test_a_run_of_one_robot_shows_no_columns_of_dashes(tmp_path):
    fake = make(tmp_path, joined=False)
    metrics = evaluate(fake.run, fake.recording, progress=False)
    text = labels.comparison_text(metrics)
    assert "peers" not in text
    assert "team" not in text
    assert labels.NONE not in text.split()
    assert labels.compared_sets(metrics) == ["held_out"]
    for row in labels.comparison_rows(metrics):
        assert labels.NONE not in row["values"]
    page = write_report(fake.run, fake.recording).read_text()
    table = page[
        page.index("<h3>All scores</h3>") : page.index("</table>", page.index("<h3>All scores</h3>"))
    ]
    assert f">{labels.NONE}<" not in table
    assert "peers" not in table


def test_the_page_says_why_every_loop_closure_was_kept_or_rejected(html):
    text = re.sub(r"<[^>]+>", " ", html)
    assert "Every candidate and why it was kept or rejected (4)" in text
    assert "few_matches" in text


def test_long_names_leave_room_for_the_axes():
    """Else Matplotlib warns that it laid nothing out, and draws over the edge."""
    names = [f"robot_{'of_the_upper_floor_' * 3}{i}" for i in range(4)]
    x, line = np.arange(4.0), np.random.default_rng(0).normal(size=(4, 2))
    ways = [
        {"robot": name, "index": i, "before": line, "after": line, "true": line}
        for i, name in enumerate(names)
    ]
    links = [f"{a} to {b}" for a in names for b in names if a != b]
    drawn = [
        figures.top_view(ways),
        figures.lines(dict.fromkeys(names, (x, x + 1)), "round", "m", log=True, level=0.1),
        figures.bars(links, {"delivered": [1] * len(links), "lost": [0] * len(links)}, "packets"),
        figures.bars([f"frontend, {name}" for name in names], {"wall": [1] * 4}, "seconds"),
        figures.reliability({name: [(1e-3, 2e-3)] for name in names}),
    ]
    for svg in drawn:
        assert all(f">{name}<" not in svg for name in names)
        assert "robot_…oor_3" in svg


def test_a_robot_keeps_its_color_where_another_has_no_curve():
    """That of its place in the team, as in the paths and in the table of the robots."""
    x, team = np.arange(4.0), ["alpha", "bravo", "charlie"]
    svg = figures.lines({"bravo": (x, x + 1)}, "round", "m", robots=team)
    other = figures.reliability({"charlie": [(1e-3, 2e-3), (2e-3, 2e-3)]}, team)
    for drawn, place in ((svg, 1), (other, 2)):
        assert [figures.color_of(i) in drawn.upper() for i in range(3)] == [i == place for i in range(3)]


@pytest.mark.parametrize("largest_m", [1e-2, 0.2, 0.4, 6.0, 900.0])
def test_labels_of_predicted_errors_stay_apart(largest_m):
    """One Gaussian that nothing determines makes the axes long."""
    svg = figures.reliability({"alpha": [(3e-4, 1e-3), (largest_m, 7e-3)]})
    labels = re.findall(r'text-anchor: middle[^>]* x="([\d.]+)" [^>]*>([\d.e+-]+)</text>', svg)
    ends = sorted(
        (float(x) - 3.2 * len(text), float(x) + 3.2 * len(text)) for x, text in labels
    )  # 10 px high
    assert len(ends) >= 3
    assert all(end + 3.0 < start for (_, end), (start, _) in pairwise(ends)), labels


def test_bars_of_names_that_look_alike_stay_apart():
    alike = [f"robot_{'x' * 20}{i}{'y' * 20}" for i in range(3)]
    svg = figures.bars(alike, {"wall": [1, 2, 3]}, "seconds")
    assert svg.count("robot_…yyyyy<") == 3


def test_names_of_a_few_letters_are_drawn_whole():
    for label in ("alpha", "november and charlie", "kitchen_robot_12", "frontend, november-2"):
        assert figures.shortened(label) == label
