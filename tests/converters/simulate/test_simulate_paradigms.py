"""Paths that draw a figure together, in the room and among meshes; depth rendered again from the recorded poses."""

import json
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedRoom, set_up
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories import figures, paradigms, walks
from duagc.converters.simulate.trajectories.loops import OVERLAP_IMAGE, shared_view
from duagc.converters.simulate.trajectories.paradigms import PARADIGMS
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.bench import paths
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording, open_rgbd
from tests.fixtures.mesh_scenes import HOUSE
from tests.fixtures.recordings import true_poses
from tests.fixtures.sampling import sampled

FRAMES = 80
FIGURES = PARADIGMS[1:]
CAMERA = camera_of((160, 120))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> SimulatedRoom:
    stage = set_up("room", "", 0, tmp_path_factory.mktemp("room"), as_meshes=False)
    assert isinstance(stage, SimulatedRoom)
    return stage


def planned(room: SimulatedRoom, paradigm: str, overlap: float, robots: int) -> list[np.ndarray]:
    return paradigms.plan(
        room, paradigm, robots=robots, frames=FRAMES, overlap=overlap, camera=CAMERA, seed=0
    )


ways_of = cache(planned)  # several tests look at the same ways


@pytest.mark.parametrize(
    ("paradigm", "robots", "overlap"),
    [
        pytest.param("concentric", 2, 0.6, marks=pytest.mark.slow),
        ("leader-follower", 4, 0.8),
        ("crossing", 3, 0.4),
        ("parallel", 3, 0.6),
        pytest.param("concentric", 8, 0.6, marks=pytest.mark.slow),
    ],
)
def test_paths_are_smooth_clear_and_overlap_as_asked(room, paradigm, robots, overlap):
    ways = ways_of(room, paradigm, overlap, robots)
    eye = room.renderer(CAMERA.scaled(*OVERLAP_IMAGE))
    shared = [shared_view(eye, a, b) for a, b in pairwise(ways)]
    assert np.mean(shared) == pytest.approx(overlap, abs=0.05)
    assert np.abs(np.array(shared) - overlap).max() < 0.15
    for way in ways:
        steps, turns = se3.distance(way[:-1], way[1:])
        assert steps.min() > 0.4 * room.step_m
        assert steps.max() < 1.05 * room.step_m
        assert np.ptp(steps) < 0.06 * room.step_m  # nobody pauses or hurries
        assert turns.max() < walks.MAX_TURN_RAD + 1e-3
        position = way[:, :3, 3]
        assert np.abs(np.diff(position, n=2, axis=0)).max() < 2e-3  # meters per frame^2: no corners
        assert room.clearance(position).min() > walks.MIN_CLEARANCE_M - 0.05
        assert np.abs(way[:, 2, 0]).max() < 1e-9  # upright
    assert paradigms.least_apart(ways) >= figures.APART_M


@pytest.mark.slow
def test_who_asks_for_too_many_is_told_how_many_fit(stage, monkeypatch):
    monkeypatch.setattr(paradigms, "DRAWS", 8)
    kind = {"frames": 60, "overlap": 0.5, "camera": CAMERA, "seed": 0}
    with pytest.raises(
        DuagError, match=r"no room for crossing paths of 8 robots.* expected at most \d$"
    ) as stated:
        paradigms.plan(stage, "crossing", robots=8, **kind)
    fit = int(str(stated.value)[-1])
    assert len(paradigms.plan(stage, "crossing", robots=fit, **kind)) == fit


def test_an_overlap_that_cannot_be_is_the_nearest_one_and_said(folder, tmp_path):
    """Two robots that cross never see exactly the same."""
    kind = {"frames": 4, "size": (32, 32), "overlap": 1.0, "paradigm": "crossing", "workers": 1}
    simulate(tmp_path / "rec", scene=str(folder), **kind)
    (warning,) = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert re.fullmatch(r"neighbors share 0\.\d\d of the view \(.*\), expected 1\.00", warning)


@pytest.mark.slow
def test_a_survey_plans_the_same_figure_again_and_says_what_was_reached(room, monkeypatch):
    again: list[list[np.ndarray]] = []

    def plan(*arguments, **settings):
        again.append(paradigms.plan(*arguments, **settings))
        return again[-1]

    monkeypatch.setattr(paths, "set_up", lambda *_, **__: room)
    monkeypatch.setattr(paths, "paradigms", SimpleNamespace(plan=plan, least_apart=paradigms.least_apart))
    rows = paths.run(["room"], ["crossing"], [3], [0.4], frames=FRAMES, seed=0, up="auto")
    ways = ways_of(room, "crossing", 0.4, 3)
    assert all(np.array_equal(a, b) for a, b in zip(ways, again[0], strict=True))
    assert rows[0]["robots_apart_m"] == paradigms.least_apart(ways)
    eye = room.renderer(camera_of((480, 360)).scaled(*OVERLAP_IMAGE))
    assert rows[0]["shared"] == np.mean([shared_view(eye, a, b) for a, b in pairwise(ways)])
    rows.append({"scene": "room", "paradigm": "parallel", "robots": 8, "cpu_s": 1.0, "refused": "too many"})
    table = " ".join(paths.format_table(rows).split())
    assert "| room | crossing | 0.4: 0." in table
    assert "| no room |" in table
    assert table.endswith("too many")


def test_a_short_curve_that_gives_way_keeps_its_length(room):
    ground = figures.Ground(room, 80, 0)
    short = np.linspace(0, 0.12, 12)[:, None] * [1.0, 0.0]
    free = room.free_space()
    places = free.low + np.argwhere(~free.inside)[::7] * free.cell_m
    bent = [way for place in places if (way := ground.bent(place + short)) is not None]
    assert len(bent) > 10
    for way in bent:
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() > 0.7 * 0.12 - 1e-9


@pytest.mark.parametrize("robots", [2, 5, 8])
def test_circles_have_one_middle_and_different_radii(robots):
    """Before they give way to furniture."""
    middle = np.array([3.0, -2.0])
    figure = figures.Figure(middle, 0.4, length_m=3.0, reach_m=1.8, frames=160)
    curves = [figures.circle(figure, robots, [0.3] * (k + 1))[0] for k in range(robots)]
    radii = [np.linalg.norm(curve - middle, axis=1) for curve in curves]
    assert all(np.ptp(radius) < 1e-9 for radius in radii)
    assert (np.diff([radius[0] for radius in radii]) > 0.1).all()
    assert radii[-1][0] == pytest.approx(1.8)


def test_followers_go_where_the_one_before_went(room):
    for leader, follower in pairwise(ways_of(room, "leader-follower", 0.8, 4)):
        gaps = np.linalg.norm(follower[:, None, :2, 3] - leader[None, :, :2, 3], axis=2).min(axis=1)
        assert gaps[-1] < 0.02  # it ends on that one's way, and came along it
        assert (np.diff(gaps[gaps > 0.05]) < 0).all()


def nearest(one: np.ndarray, other: np.ndarray) -> float:
    """Least distance (m) on the floor between two paths, whenever."""
    return float(np.linalg.norm(one[:, None, :2, 3] - other[None, :, :2, 3], axis=2).min())


def test_lines_cross_or_run_side_by_side(room):
    def heading(way: np.ndarray) -> float:
        ahead = way[-1, :2, 3] - way[0, :2, 3]
        return float(np.arctan2(ahead[1], ahead[0]))

    ways = ways_of(room, "crossing", 0.4, 3)
    gaps = [nearest(a, b) for a, b in pairwise(ways)]
    assert max(gaps) < 0.1
    headings = np.unwrap([heading(way) for way in ways])
    assert np.abs(np.diff(headings)).min() > np.deg2rad(8)
    ways = ways_of(room, "parallel", 0.6, 3)
    headings = np.unwrap([heading(way) for way in ways])
    assert np.ptp(headings) < np.deg2rad(20)  # they give way to furniture
    gaps = [nearest(a, b) for a, b in pairwise(ways)]
    assert min(gaps) > 0.2


def check_depth(out: Path, scene: str, cache: Path) -> None:
    """Depth rendered from the poses of the ground truth is the depth of the logs."""
    recording = Recording(out)
    stage = set_up(scene, "y", 0, cache, as_meshes=False)
    for robot in recording.robots:
        poses = true_poses(recording, robot)
        with open_rgbd(recording.log(robot)) as log:
            eye = stage.renderer(log.camera)
            for frame, pose in zip(log.frames(), poses, strict=True):
                depth, _ = eye.depth(pose)
                exact = np.where(depth < 65535 * stage.depth_scale_m, depth, 0)
                assert np.abs(frame.depth - exact).max() <= 0.51 * stage.depth_scale_m


@pytest.mark.parametrize("paradigm", sampled(FIGURES))
def test_depth_is_that_of_the_recorded_pose(folder, tmp_path, paradigm):
    out, sheet = tmp_path / "rec", tmp_path / "sheet.png"
    kind = {"robots": 2, "frames": 12, "size": (64, 48), "paradigm": paradigm, "workers": 1}
    simulate(out, scene=str(folder), preview=sheet, **kind)
    (tmp_path / "cache").mkdir()
    check_depth(out, str(folder), tmp_path / "cache")
    picture = cv2.imread(str(sheet))
    assert picture is not None
    assert picture.std() > 20


@pytest.mark.slow
@pytest.mark.skipif(not HOUSE.is_dir(), reason="the scanned house is not on this machine")
@pytest.mark.parametrize("paradigm", FIGURES)
def test_depth_in_a_real_scan_is_that_of_the_recorded_pose(tmp_path, paradigm):
    out = tmp_path / "rec"
    kind = {"robots": 3, "frames": 30, "size": (160, 120), "paradigm": paradigm, "workers": 1}
    simulate(out, scene=str(HOUSE), **kind)
    (tmp_path / "cache").mkdir()
    check_depth(out, str(HOUSE), tmp_path / "cache")


@pytest.mark.parametrize(
    "bad",
    [
        {"paradigm": "spiral"},
        {"preview": Path("nowhere/sheet.png")},
        {"preview": Path("a.jpg")},
        {"up": "x"},
    ],
)
def test_arguments_out_of_range_are_refused(tmp_path, bad):
    with pytest.raises(DuagError, match="expected"):
        simulate(tmp_path / "rec", **bad)
    assert not (tmp_path / "rec").exists()


def test_a_picture_inside_the_recording_that_is_replaced_is_refused(folder, tmp_path):
    kind = {"scene": str(folder), "robots": 1, "frames": 2, "size": (32, 32), "workers": 1}
    simulate(tmp_path / "rec", **kind)
    with pytest.raises(DuagError, match=r"p\.png: is inside the recording that is replaced, expected"):
        simulate(tmp_path / "rec", force=True, preview=tmp_path / "rec" / "p.png", **kind)


def test_the_same_again_by_force_replaces_the_picture_too(folder, tmp_path):
    kind = {"scene": str(folder), "robots": 1, "frames": 2, "size": (32, 32), "workers": 1}
    out, sheet = tmp_path / "rec", tmp_path / "p.png"
    simulate(out, preview=sheet, **kind)
    first = sheet.read_bytes()
    sheet.write_bytes(b"of another recording")
    with pytest.raises(DuagError, match=r"p\.png: exists already, expected .* or --force"):
        simulate(tmp_path / "other", preview=sheet, **kind)
    simulate(out, preview=sheet, force=True, **kind)
    assert sheet.read_bytes() == first


def test_where_a_figure_fits_nowhere_is_said(room, monkeypatch):
    """Of the free floor a patch of half a meter is left."""
    space = room.free_space()
    patch = np.zeros_like(space.inside)
    row, column = np.argwhere(space.inside)[space.inside.sum() // 2]
    side = int(0.5 / space.cell_m)
    patch[row : row + side, column : column + side] = True
    small = replace(space, inside=space.inside & patch)
    monkeypatch.setattr(room, "free_space", lambda: small)
    with pytest.raises(
        DuagError, match=r"no room for crossing paths of 3 robots, .* m\^2 of free floor, expect"
    ):
        planned(room, "crossing", 0.6, 3)
