"""A robot whose path broke into two components that one peer joined: it counts once, and its camera is no peer's."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.evaluation import evaluate, pixel_errors
from duagc.pipeline.evaluation.network import Link, Packets, Session
from duagc.pipeline.evaluation.oracle import NO_LISTS
from duagc.pipeline.evaluation.rendering import RenderTask, mates
from duagc.pipeline.geometry.trajectory import Trajectory, read_tum, write_tum
from duagc.pipeline.report.page import write_report
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures import fake_run

NAMES = ["alpha", "alpha-2", "bravo"]


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> fake_run.FakeRun:
    made = fake_run.make(tmp_path_factory.mktemp("fake"))
    for name, way in zip(NAMES, (0, 0, 1), strict=True):
        folder = made.run / "robots" / name
        if folder.is_dir():
            for path in folder.iterdir():
                path.unlink()
            folder.rmdir()
        fake_run._write_robot(folder, name, way, NAMES, True, dict.fromkeys(NAMES, 1.0))
    path = made.run / "robots" / "alpha-2" / "trajectory.tum"
    exact = read_tum(path)
    poses = exact.poses.copy()
    poses[::2, 1, 3] += 0.1
    write_tum(path, Trajectory(exact.stamps_ns, poses))
    return made


@pytest.fixture(scope="module")
def metrics(fake: fake_run.FakeRun) -> dict:
    return evaluate(fake.run, fake.recording, progress=False)


def test_a_robot_is_no_peer_of_its_own_components(fake: fake_run.FakeRun, metrics: dict) -> None:
    run = RunFolder(fake.run)
    found = {name: [mate.robot for mate in mates(run, robot)] for name, robot in run.robots.items()}
    assert found == {"alpha": ["bravo"], "alpha-2": ["bravo"], "bravo": ["alpha", "alpha-2"]}
    views = {name: metrics["robots"][name]["rendering"]["fused"]["peers"]["views"] for name in NAMES}
    assert views == {"alpha": 3, "alpha-2": 3, "bravo": 6}


def test_a_robot_counts_once(metrics: dict) -> None:
    assert [metrics["robots"][name]["robots_in_component"] for name in NAMES] == [2, 2, 2]
    assert metrics["robots"]["alpha-2"]["ate_rmse_m"] > 0.01
    assert metrics["team"]["ate_rmse_m_mean_of_robots"] < 1e-12


def test_the_report_counts_a_robot_and_its_frames_once(fake: fake_run.FakeRun, metrics: dict) -> None:
    page = write_report(fake.run, fake.recording).read_text()
    assert "wall: 2 robots" in page
    assert f"{2 * fake_run.FRAMES} frames of alpha, bravo ·" in page


def robot_with_frames(reasons: dict[int, str]) -> SimpleNamespace:
    """Every fourth frame is held out."""
    frames = [SimpleNamespace(frame_index=k, stamp_ns=k, reason=reasons.get(k, "")) for k in range(32)]
    held_out = frozenset(range(0, 32, 4))
    return SimpleNamespace(robot="alpha", keyframes=[], frames=frames, held_out=held_out)


ELSEWHERE = dict.fromkeys(range(16, 32), "other_component")
LOST = {8: "low_overlap"}


def test_frames_of_other_components_are_scored_there() -> None:
    robot = robot_with_frames(ELSEWHERE | LOST)
    assert RenderTask({}, robot, "held_out", "center", 40).chosen() == [0, 4, 8, 12]
    assert RenderTask({}, robot, "held_out", "center", 2).chosen() == [4, 12]
    whole = RenderTask({}, robot_with_frames(LOST), "held_out", "center", 40)
    assert whole.chosen() == list(range(0, 32, 4))


def test_pixels_are_of_frames_of_the_component(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    robot, asked = robot_with_frames(ELSEWHERE | LOST), []
    robot.folder = tmp_path
    log = SimpleNamespace(camera=fake_run.CAMERA, move_depth_by=lambda path: None)
    monkeypatch.setattr(pixel_errors, "open_rgbd", lambda path: nullcontext(log))
    monkeypatch.setattr(pixel_errors, "scored_frames", lambda log, chosen, *of: asked.extend(chosen) or [])
    source = SimpleNamespace(log=lambda name: tmp_path)
    assert list(pixel_errors._Views({}, robot, 6, None).errors(source, 1)) == []
    assert asked == [0, 4, 8, 12]


def test_what_joins_components_of_one_robot_is_not_counted_between_robots() -> None:
    def decision(robot: str, peer: str, weight: float) -> SimpleNamespace:
        return SimpleNamespace(robot=robot, peer=peer, verdict="", weight=weight, measured=True, inliers=9)

    ids = np.array([[1, 2], [3, 4], [5, 6]])
    robots = {name: SimpleNamespace(component=tuple(NAMES), rejected_matches={}) for name in NAMES}
    robots["alpha"].rejected_matches["alpha", "alpha-2"] = ids[:2]
    session = Session(SimpleNamespace(robots=robots))
    ends = (("alpha", "alpha-2"), ("alpha", "bravo"), ("bravo", "alpha-2"))
    session.__dict__ |= {
        "loop_closures": [decision(*pair, weight) for pair in ends for weight in (1.0, 0.1)],
        "pairs": {("alpha", "alpha-2"): ids, ("alpha", "bravo"): ids[:1], ("alpha-2", "bravo"): ids[:1]},
    }
    assert list(session.loop_closure_counts().values()) == [2, 2]
    assert session.matched_pairs() == 2
    assert session.rejected_matches_share() == 2 / 15  # three robots, five matches each
    for unlisted, found in ((("alpha", "alpha-2"), 2), (("alpha", "bravo"), NO_LISTS)):
        less = Session(SimpleNamespace(robots=robots))
        less.__dict__["pairs"] = {pair: ids for pair, ids in session.pairs.items() if pair != unlisted}
        assert less.matched_pairs() == found
        assert less.rejected_matches_share() == NO_LISTS


def test_components_of_a_robot_and_a_peer_are_one_pair() -> None:
    session = Session(SimpleNamespace(robots={name: SimpleNamespace(component=(name,)) for name in NAMES}))
    text, number = np.array(["x", "x"]), np.array([0, 1])
    session.__dict__ |= {
        "packets": Packets(number, text, text, text, np.array([300, 500]), number > 1, np.ones(2, int), 2),
        "links": [Link("alpha", "bravo", 1, 0, 300), Link("bravo", "alpha-2", 1, 0, 500)],
        "summary": SimpleNamespace(
            rounds=2, bytes_raw_alternative=0, bytes_raw_alternative_maps_only=0, converged=True
        ),
        "pairs": {},
    }
    assert session.exchange_section()["bytes_per_round_per_robot_pair"] == 400
