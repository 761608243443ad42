"""The contract of metrics.json, and its numbers on a run whose every number is known."""

import json
import math
import shutil
from functools import partial

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial import cKDTree

from duagc.pipeline.base import checkpoints
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.worker_reports import Step
from duagc.pipeline.evaluation import evaluate, robot_measures, trajectory_errors
from duagc.pipeline.evaluation import views as scored_views
from duagc.pipeline.evaluation.matching_truth import matching_section
from duagc.pipeline.evaluation.oracle import NO_LISTS
from duagc.pipeline.evaluation.results import reason_of
from duagc.pipeline.evaluation.true_paths import TruePaths
from duagc.pipeline.experiments.own_longer import own_longer
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import LogWriter, Recording, read_log
from duagc.pipeline.runs.folder import RunFolder
from duagc.schemas import topics
from tests.evaluation.contract import check_against_schema
from tests.fixtures.fake_run import DRIFT_M, FRAMES, KEYFRAMES, FakeRun, make


@pytest.fixture(scope="module")
def fake(tmp_path_factory) -> FakeRun:
    return make(tmp_path_factory.mktemp("fake"))


@pytest.fixture(scope="module")
def metrics(fake) -> dict:
    return evaluate(fake.run, fake.recording, progress=False)


def test_peers_views_are_compared_in_the_colors_of_their_camera(metrics, tmp_path):
    dark = make(tmp_path, gain=0.6)
    seen = evaluate(dark.run, dark.recording, progress=False)
    for kind in ("own", "fused", "refined"):
        for views in ("held_out", "peers"):
            expected = metrics["rendering"][kind][views]["psnr_db"]
            assert seen["rendering"][kind][views]["psnr_db"] == pytest.approx(expected, abs=3)
    assert seen["robots"]["bravo"]["camera"]["gain_green"] == pytest.approx(0.6)
    assert seen["robots"]["bravo"]["camera"]["matches"] == 500
    assert seen["robots"]["alpha"]["camera"]["gain_green"] is None
    assert "compared with" in reason_of(seen["reasons"], "robots.alpha.camera.gain_green")
    for robot in ("alpha", "bravo"):  # as if nobody had found out
        log = dark.run / "robots" / robot / "fused.mcap"
        records = [(r.topic, r.message(), r.log_time_ns) for r in read_log(log)]
        with LogWriter(log, robot) as again:
            for topic, message, time_ns in records:
                if topic != topics.PEER_COLORS.of(robot):
                    again.write(topic, message, time_ns)
    blind = evaluate(dark.run, dark.recording, progress=False)
    assert (
        blind["rendering"]["fused"]["peers"]["psnr_db"] < seen["rendering"]["fused"]["peers"]["psnr_db"] - 10
    )


def test_metrics_json_keeps_its_contract(fake, metrics):
    written = json.loads((fake.run / "metrics.json").read_text())
    assert written == metrics
    check_against_schema(written)
    assert written["schema"] == 2
    assert written["protocol"]["alignment"] == "se3"
    assert written["protocol"]["held_out"] == "index % 8 == 4"
    assert written["protocol"]["initial_relative_poses"] == "unknown"


def test_trajectories_are_measured(metrics):
    for robot in metrics["robots"].values():
        assert robot["frames"] == robot["frames_with_truth"] == FRAMES
        assert robot["tracked"] == FRAMES - 1  # one frame is marked lost
        assert robot["keyframes"] == len(KEYFRAMES)
        assert robot["ate_rmse_m"] < 1e-12  # written with 17 digits, aligned in float64
        assert robot["ate_rmse_m_joint"] < 1e-12
        assert (
            0.05 * DRIFT_M < robot["ate_rmse_m_before_consensus"] < 0.3 * DRIFT_M
        )  # alignment takes up most of it
    assert metrics["team"]["ate_rmse_m"] < 1e-12
    assert metrics["team"]["robots_in_largest_component"] == 2


def test_maps_are_rendered_from_held_out_and_training_views(metrics):
    fused, own = metrics["rendering"]["fused"], metrics["rendering"]["own"]
    unrefined = metrics["rendering"]["own_unrefined"]["held_out"]
    assert unrefined["views"] == own["held_out"]["views"]
    assert unrefined["psnr_db"] < own["held_out"]["psnr_db"]  # the same map, a tenth darker
    assert unrefined["depth_l1_m"] == own["held_out"]["depth_l1_m"]
    assert fused["held_out"]["views"] == 2 * 3  # frames 4, 12 and 20 of two robots
    assert fused["training"]["views"] == 2 * len(KEYFRAMES)
    for view_set in ("held_out", "training"):
        assert fused[view_set]["psnr_db"] > 55  # rounding to 8 bits: 20 log10(255 sqrt 12) = 58.9 dB
        assert fused[view_set]["ssim"] > 0.999
        assert fused[view_set]["depth_l1_m"] == pytest.approx(
            0.00025, abs=0.00005
        )  # rounding to 1 mm: 0.25 mm
        assert fused[view_set]["depth_completeness"] == 1.0
        assert own[view_set]["psnr_db"] < fused[view_set]["psnr_db"] - 5  # seen from poses that drift


def test_an_evaluation_that_was_killed_goes_on_with_what_is_done(metrics, tmp_path, monkeypatch):
    fake, saved = make(tmp_path), tmp_path / "saved"
    monkeypatch.setattr(checkpoints, "WORTH_S", 0.0)

    def killed(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(robot_measures.map_agreement, "section", killed)  # the last part of the first robot
        with pytest.raises(KeyboardInterrupt):
            evaluate(fake.run, fake.recording, progress=False, saved=saved)
    done = sorted(path.relative_to(saved).as_posix() for path in saved.rglob("*.done"))
    assert [name.split()[0] for name in done] == [
        "alpha/calibration.done", "alpha/held_out", "alpha/peers", "alpha/pixels.done", "alpha/training",
    ]  # fmt: skip
    drawn = []
    score_maps = scored_views.score_maps
    monkeypatch.setattr(scored_views, "score_maps", lambda *a, **k: drawn.append(0) or score_maps(*a, **k))
    assert evaluate(fake.run, fake.recording, progress=False, saved=saved) == metrics
    assert len(drawn) == 3  # bravo's


def test_a_set_of_views_goes_on_where_it_was_killed(metrics, tmp_path, monkeypatch):
    fake, saved = make(tmp_path), tmp_path / "saved"
    every_view = partial(checkpoints.Checkpoints, every_s=0.0, largest_share=math.inf)
    monkeypatch.setattr(robot_measures, "Checkpoints", every_view)
    score_view, scored = scored_views.score_view, []

    def killed_at_the_third(*args, **kwargs):
        if len(scored) == 9:
            raise KeyboardInterrupt
        scored.append(0)
        return score_view(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(scored_views, "score_view", killed_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            evaluate(fake.run, fake.recording, threads=1, progress=False, saved=saved)
    (state,) = (saved / "alpha").glob("*.state")
    done, rows = checkpoints.Checkpoints(saved / "alpha").resume(state.stem)
    kept = sum(map(len, rows))
    assert done == len(rows) > 0
    assert 0 < kept <= len(scored)
    counted = []
    monkeypatch.setattr(scored_views, "score_view", lambda *a, **k: counted.append(0) or score_view(*a, **k))
    assert evaluate(fake.run, fake.recording, threads=1, progress=False, saved=saved) == metrics
    views = sum(
        metrics["rendering"][kind][s]["views"]
        for kind in metrics["rendering"]
        for s in metrics["rendering"][kind]
        if s != "team"
    )
    assert len(counted) + kept == views


def test_a_fused_map_shows_what_a_peer_sees(metrics):
    fused = metrics["rendering"]["fused"]["peers"]
    assert fused["views"] == 2 * 3
    assert fused["psnr_db"] > metrics["rendering"]["own"]["peers"]["psnr_db"]


def test_a_noise_free_sensor_is_its_own_exact_depth(metrics):
    held_out = metrics["rendering"]["fused"]["held_out"]
    assert held_out["depth_l1_exact_m"] == held_out["depth_l1_m"]


def test_calibration_finds_that_the_information_is_right(metrics):
    calibration = metrics["calibration"]
    assert calibration["gaussians"] == 2 * 7400
    assert calibration["coverage_95"] == pytest.approx(0.95, abs=0.01)  # 4 standard errors of 7400 draws
    assert calibration["sigma_scale"] == pytest.approx(1.0, abs=0.04)
    assert calibration["spearman"] > 0.5
    assert calibration["ece_rank"] < 0.15 < 0.22 < calibration["ece_rank_shuffled"]
    assert calibration["ece_rank"] == pytest.approx(calibration["ece_rank_if_right"], abs=0.01)


def test_pixels_are_judged_against_exact_depth_alone(metrics):
    found = metrics["pixel_calibration"]["refined"]
    for view_set in ("held_out", "peers"):
        # the images are renders of the map: nothing is left but their rounding to a millimeter
        assert found[view_set]["median_error_m"] < 5e-4
        assert (
            1e-3 < found[view_set]["median_sigma_m"] < 1e-2
        )  # as the information says; no noise of a sensor
        assert found[view_set]["coverage_95"] > 0.99
    assert found["held_out"]["pixels"] == 2 * 3 * 48  # robots, views, pixels of 64 x 48


def test_the_exchange_is_counted(metrics):
    assert metrics["exchange"] == {
        "sessions": 1,
        "rounds": 10,
        "messages": 6,
        "packets_sent": 8,
        "packets_dropped": 2,
        "bytes_sent": 800,
        "bytes_delivered": 600,
        "bytes_setup": 400,  # descriptors and pair lists of both, one packet each
        "bytes_per_round_per_robot_pair": 80.0,
        "bytes_raw_alternative": 123456,
        "bytes_raw_alternative_maps_only": 45678,
        "bytes_paper_accounting": 3 * 224 * 10,
        "matched_pairs": 3,
    }
    assert metrics["consensus"]["converged"] is True
    assert metrics["consensus"]["rounds_to_tolerance"] == 8
    assert (
        1e-4 < metrics["consensus"]["gap_to_oracle_m"] < 0.05
    )  # what the outvoted closure's weight of 0.1 pulls
    assert metrics["consensus"]["gap_to_oracle_rad"] < 0.05
    assert metrics["team"]["inter_robot_loop_closures"] == 1
    assert (
        metrics["team"]["inter_robot_loop_closures_rejected"] == 2
    )  # outvoted, inconsistent; one was not measured


def test_the_table_says_what_the_json_says_and_has_every_view(fake, metrics):
    rows = pq.read_table(fake.run / "metrics.parquet").to_pylist()

    def values(**where):
        return [r["value"] for r in rows if all(r[k] == v for k, v in where.items())]

    assert values(scope="team", name="ate_rmse_m") == [metrics["team"]["ate_rmse_m"]]
    assert values(scope="robot", robot="bravo", name="ate_rmse_m_before_consensus") == [
        metrics["robots"]["bravo"]["ate_rmse_m_before_consensus"]
    ]
    per_view = values(scope="view", view_set="fused/held_out", name="psnr_db")
    assert len(per_view) == 6
    assert np.mean(per_view) == pytest.approx(metrics["rendering"]["fused"]["held_out"]["psnr_db"], abs=1e-9)
    absent = [r for r in rows if r["value"] is None]
    assert absent
    assert all(r["reason"] for r in absent)
    assert {r["unit"] for r in rows} <= {"m", "rad", "px", "dB", "B", "nat", "sigma", "1"}


def test_threads_change_no_bit(fake, metrics, tmp_path):
    before = {name: (fake.run / name).read_bytes() for name in ("metrics.json", "metrics.parquet")}
    evaluate(fake.run, fake.recording, threads=1, progress=False)
    assert {name: (fake.run / name).read_bytes() for name in before} == before


def test_it_says_how_far_it_is_with_every_robot(fake, metrics):
    steps = list[Step]()
    assert evaluate(fake.run, fake.recording, progress=False, workers=2, hear=steps.append) == metrics
    for robot in metrics["robots"]:
        parts = [part for name, part, done, total in steps if name == robot and done == total]
        peers = [f"peers of {other}" for other in metrics["robots"] if other != robot]
        assert parts == [f"held_out of {robot}", f"training of {robot}", *peers, "agreement"]


def test_own_maps_are_trained_longer_only_if_asked(metrics, tmp_path):
    fake = make(tmp_path)
    longer = own_longer(RunFolder(fake.run), Recording(fake.recording), threads=2)
    asked = evaluate(fake.run, fake.recording, progress=False, own_longer=longer)
    check_against_schema(asked)
    assert asked["rendering"]["own_longer"]["held_out"]["views"] > 0
    assert metrics["rendering"]["own_longer"]["held_out"]["views"] == 0
    assert "--own-longer" in reason_of(metrics["reasons"], "rendering.own_longer.held_out.psnr_db")
    none = evaluate(fake.run, fake.recording, progress=False, own_longer={})  # no robot met another
    assert "no final map" in reason_of(none["reasons"], "rendering.own_longer.held_out.psnr_db")
    others = ("own", "own_unrefined", "fused", "refined")
    assert {k: asked["rendering"][k] for k in others} == {k: metrics["rendering"][k] for k in others}


def test_one_map_of_all_images_and_true_matches_are_scored_only_if_asked(metrics, tmp_path):
    fake = make(tmp_path)
    settings = fake.run / "config.toml"
    settings.write_text(settings.read_text() + "\n[evaluation]\ncentral_map = true\nmatching = true\n")
    asked = evaluate(fake.run, fake.recording, progress=False)
    of_matches = {name: asked["consensus"].pop(name) for name in ("matching_precision", "matching_recall")}
    assert of_matches == dict.fromkeys(of_matches, 0.0)  # the pairs of this run are made up
    assert asked["consensus"] == metrics["consensus"]
    assert "central" not in metrics["rendering"]
    central, own = asked["rendering"].pop("central"), asked["rendering"]["own"]
    assert central["team"]["views"] == own["team"]["views"] > 0
    alpha, bravo = (asked["robots"][robot]["rendering"].pop("central") for robot in ("alpha", "bravo"))
    assert alpha["peers"] == bravo["held_out"] != alpha["held_out"]  # it is one map
    assert central["held_out"]["psnr_db"] != own["held_out"]["psnr_db"]
    assert asked["rendering"] == metrics["rendering"]


def test_matches_are_right_where_both_means_are_of_one_true_place(fake):
    run, source = RunFolder(fake.run), Recording(fake.recording)
    truth = TruePaths.of(run, source)
    alpha, bravo = (
        se3.transform(
            trajectory_errors.alignment([truth.before[name]]),
            run.robots[name].own_map.gaussians.means.astype(float),
        )
        for name in ("alpha", "bravo")
    )
    distance, index = cKDTree(bravo).query(alpha)
    near = np.flatnonzero(distance < 0.01)
    ids = [run.robots[name].own_map.gaussians.ids for name in ("alpha", "bravo")]
    good = np.stack([ids[0][near], ids[1][index[near]]], axis=1)
    half = good[::2]

    def score(matched: np.ndarray) -> tuple[float, float]:
        return tuple(matching_section(run, source, truth, {("alpha", "bravo"): matched}).values())

    assert score(good)[0] == score(half)[0] == 1.0
    assert score(half)[1] == pytest.approx(score(good)[1] / 2, rel=0.01)
    assert 0 < score(half)[1] <= 0.5
    wrong = np.stack([half[:, 0], np.roll(half[:, 1], len(half) // 2)], axis=1)
    assert max(score(wrong)) < 0.1
    assert set(matching_section(run, source, truth, {}).values()) == {NO_LISTS}


def test_without_ground_truth_there_are_reasons_not_numbers(tmp_path):
    fake = make(tmp_path, truth=False)
    metrics = evaluate(fake.run, fake.recording, progress=False)
    check_against_schema(metrics)
    assert metrics["team"]["ate_rmse_m"] is None
    assert reason_of(metrics["reasons"], "team.ate_rmse_m") == "the recording has no ground truth of alpha"
    assert "groundtruth.ply" in reason_of(metrics["reasons"], "calibration.spearman")
    assert metrics["robots"]["alpha"]["ate_rmse_m_before_consensus"] is None
    assert metrics["rendering"]["fused"]["held_out"]["psnr_db"] > 55


def test_a_listed_ground_truth_may_be_gone(tmp_path):
    fake = make(tmp_path)
    (fake.recording / "bravo.groundtruth.mcap").unlink()
    metrics = evaluate(fake.run, fake.recording, progress=False)
    check_against_schema(metrics)
    assert metrics["robots"]["alpha"]["ate_rmse_m"] < 1e-12
    assert (
        reason_of(metrics["reasons"], "robots.bravo.ate_rmse_m")
        == "the recording has no ground truth of bravo"
    )
    assert reason_of(metrics["reasons"], "team.ate_rmse_m") == "the recording has no ground truth of bravo"


def test_robots_that_never_met_have_no_team_error(tmp_path):
    fake = make(tmp_path, joined=False)
    metrics = evaluate(fake.run, fake.recording, progress=False)
    check_against_schema(metrics)
    assert metrics["team"]["robots_in_largest_component"] == 1
    assert "only alpha" in reason_of(metrics["reasons"], "team.ate_rmse_m")
    assert metrics["robots"]["bravo"]["ate_rmse_m"] < 1e-12
    assert (
        "bravo" in reason_of(metrics["reasons"], "robots.bravo.ate_rmse_m_joint")
        or metrics["team"]["ate_rmse_m"] is None
    )
    assert metrics["exchange"]["bytes_sent"] == 0
    assert (
        reason_of(metrics["reasons"], "exchange.bytes_per_round_per_robot_pair")
        == "the robots exchanged nothing"
    )
    assert reason_of(metrics["reasons"], "consensus.rounds_to_tolerance") == "no two robots share a world"
    assert "full position information" in reason_of(metrics["reasons"], "calibration.nll")
    assert metrics["calibration"]["gaussians_without_information"] == 2 * 7400


def test_a_noisy_sensor_is_compared_with_exact_depth_where_there_is_some(tmp_path):
    fake = make(tmp_path, depth_noise="kinect")
    held_out = evaluate(fake.run, fake.recording, progress=False)["rendering"]["fused"]["held_out"]
    assert held_out["depth_l1_exact_m"] == pytest.approx(0.010, abs=2e-3)  # written 10 mm off


def test_what_is_missing_is_named(tmp_path):
    fake = make(tmp_path)
    (fake.run / "exchange.mcap").rename(tmp_path / "aside")
    with pytest.raises(DuagError, match=r"exchange\.mcap"):
        evaluate(fake.run, fake.recording, progress=False)
    (tmp_path / "aside").rename(fake.run / "exchange.mcap")
    (fake.run / "robots" / "bravo" / "trajectory.tum").unlink()
    with pytest.raises(DuagError, match=r"trajectory\.tum"):
        evaluate(fake.run, fake.recording, progress=False)
    shutil.move(fake.run / "robots" / "bravo", fake.run / "robots" / "zulu")
    with pytest.raises(DuagError, match="zulu"):
        evaluate(fake.run, fake.recording, progress=False)
    assert not (fake.run / "metrics.json").exists()
