"""A check is as sure as what it looked at allows, and says nothing of a scale that it cannot see."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.simulate.sensors import noise
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import set_up
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base import random_streams
from duagc.pipeline.checks import check, confidence, scale
from duagc.pipeline.checks.findings import Finding, Severity, judged
from duagc.pipeline.checks.geometry import DepthEdges, check_edges
from duagc.pipeline.checks.moves import Move
from duagc.pipeline.config.checks import ChecksConfig, MotionChecks
from duagc.pipeline.geometry import se3
from tests.fixtures.mesh_scenes import folder_of, some_poses

INTERVAL_NS = 150_000_000


def test_a_share_is_surer_the_more_was_looked_at() -> None:
    assert confidence.share_above(8, 8) == pytest.approx(1 - 0.5**9)
    assert confidence.share_above(0, 8) == pytest.approx(0.5**9)
    assert confidence.share_above(0, 0) == 0.5
    assert 0.999 < confidence.share_above(16, 16, 0.1) < 1
    for of in range(1, 17):
        values = [confidence.share_above(k, of) for k in range(of + 1)]
        assert values == sorted(values)
        assert values[of // 2] + values[of - of // 2] == pytest.approx(1)
    shares = np.random.default_rng(0).random(200_000)
    seen = np.random.default_rng(1).binomial(8, shares)
    for k in range(9):  # of all recordings that show so much, as many are so
        for share in (0.1, 0.5, 0.8):
            said = confidence.share_above(k, 8, share)
            assert (shares[seen == k] > share).mean() == pytest.approx(said, abs=0.01)


def test_a_number_is_above_a_limit_as_its_normal_error_says() -> None:
    assert confidence.above(1.0, 1.0, 0.3) == pytest.approx(0.5)
    assert confidence.above(1.6449, 0.0, 1.0) == pytest.approx(0.95, abs=1e-4)
    assert confidence.above(2.0, 1.0, 0.0) == 1.0
    assert confidence.above(1.0, 2.0, 0.0) == 0.0


@pytest.mark.parametrize(
    ("sure", "severity"),
    [(1.0, Severity.ERROR), (0.96, Severity.ERROR), (0.9, Severity.WARNING), (0.5, None)],
)
def test_what_is_only_likely_is_less_severe(sure: float, severity: Severity | None) -> None:
    found = list(judged([Finding(Severity.ERROR, "x", "alpha", "a", "b", confidence=sure)], 0.95, 0.7))
    assert [f.severity for f in found] == ([] if severity is None else [severity])
    for finding in found:
        assert finding.line().startswith(f"{severity} ({100 * sure:.3g} %): alpha: x: a, expected b")
    assert "(99.9 %)" in Finding(Severity.NOTE, "x", "", "a", "b", confidence=0.99999).line()


def moves(meters: float, turned_deg: float, count: int = 8, offset_ns: int = 0) -> list[Move]:
    return [
        Move(
            k * 10**9,
            k * 10**9 + INTERVAL_NS,
            se3.exp(np.array([meters, 0, 0, 0, np.deg2rad(turned_deg), 0])),
            residual=0.01,
            sigma_m=0.001,
            turned_rad=float(np.deg2rad(turned_deg)),
            depth_m=1.5,
            depth_offset_ns=offset_ns,
        )
        for k in range(count)
    ]


def judge(found: list[Move], true_m: float) -> list[Finding]:
    raw = scale.check_scale("alpha", found, "its true poses", lambda a, b: true_m, config=MotionChecks())
    return list(judged(raw, ChecksConfig().sure, ChecksConfig().likely))


@pytest.mark.parametrize(("factor", "errors"), [(1.0, 0), (1.4, 0), (2.0, 1), (0.4, 1), (5.0, 1), (0.2, 1)])
def test_a_camera_that_translates_knows_its_scale(factor: float, errors: int) -> None:
    found = judge(moves(0.06 * factor, 2.0), 0.06)
    assert [f.severity for f in found] == [Severity.ERROR] * errors
    assert all(f.confidence > 0.95 and f"{factor:.3g} times" in f.found for f in found)


def test_a_camera_that_turns_knows_nothing_of_scale() -> None:
    """What a fast rotation with a hardly moving camera gives: 1.67 times as far, of 9 mm in 7.5 degrees."""
    assert not [f for f in judge(moves(0.015, 7.5), 0.009) if f.severity is not Severity.NOTE]
    (note,) = judge(moves(0.004, 12.0), 0.002)
    assert note.severity is Severity.NOTE
    assert "hardly translates, 2.0 mm" in note.found
    assert judge(moves(0.06, 12.0), 0.02)[0].severity is Severity.ERROR  # beyond what the rotation explains


def test_depth_of_another_time_explains_more_of_a_rotation() -> None:
    sure, unsure = (judge(moves(0.08, 12.0, offset_ns=ns), 0.04) for ns in (0, 15_000_000))
    assert sure[0].severity is Severity.ERROR
    assert not [f for f in unsure if f.severity is Severity.ERROR]


def test_pairs_without_another_length_say_nothing() -> None:
    unknown = scale.check_scale("alpha", moves(0.1, 0.0), "x", lambda a, b: None, config=MotionChecks())
    assert list(unknown) == []
    assert judge([], 0.1) == []
    failed = [Move(0, 1, None), Move(1, 2, None)]
    assert judge(failed, 0.1) == []


def test_a_recording_of_a_pure_rotation_is_no_error(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "scene", "obj")
    (tmp_path / "cache").mkdir()
    stage = set_up(str(folder), "y", 0, tmp_path / "cache", as_meshes=True)
    camera = camera_of((160, 120))
    eye = stage.renderer(camera)
    with (
        RecordingWriter(tmp_path / "rec", "turning", {"made": "by the tests"}, "tests") as recording,
        recording.robot("alpha", camera, 1e-3, {"depth_noise": "kinect"}) as robot,
    ):
        for k in range(24):
            swing = 0.5 * np.sin(2 * np.pi * k / 24)
            T = some_poses()[0] @ se3.exp(np.array([0.002 * np.sin(k), 0, 0, 0.3 * swing, swing, 0]))
            rng = random_streams.generator(0, "test", frame=k)
            view = eye.render(T)
            depth = np.rint(1000 * noise.kinect_depth(view.depth, camera, rng)).astype(np.uint16)
            png = cv2.imencode(".png", view.color[..., ::-1])[1].tobytes()
            robot.add_frame(k * 33_333_333, png, "png", depth, T_world_camera=T)
    report = check.check(tmp_path / "rec")
    assert report.sound, check.format_report(report)
    of_scale = [f for f in report.findings if f.check == "depth scale"]
    assert [f.severity for f in of_scale] == [Severity.NOTE], check.format_report(report)
    assert "hardly translates" in of_scale[0].found


@pytest.mark.parametrize(
    ("fits", "said"),
    [
        ((1.30, 1.36, 1.41, 1.55, 1.86, 2.58, 1.89, 1.69, 1.54), ["depth in time"]),  # a frame late
        (
            (0.78, 0.89, 1.10, 1.53, 1.69, 1.49, 1.53, 1.49, 2.10),
            [],
        ),  # smoothed: the few edges left fit anywhere
    ],
)
def test_late_depth_is_told_from_smoothed_depth(fits: tuple[float, ...], said: list[str]) -> None:
    config = ChecksConfig().edges
    edges = DepthEdges(np.tile(fits, (8, 1)), np.ones((8, 2 * config.shift_px + 1)))
    assert [finding.check for finding in check_edges("alpha", edges, config)] == said
