"""A camera that is lost where it has never been: a new submap, joined where loop closures verify it, and nowhere else.

A walk around a simulated room in large steps; the lens is covered while the camera is carried on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend.components import Component
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.relocalization import Relocalizer
from duagc.pipeline.frontend.stage import component_path, run_frontend
from duagc.pipeline.frontend.submap_joining import join_submaps
from duagc.pipeline.frontend.submaps import NO_SUBMAP, SubmapTracker, TrackedLog
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry.trajectory import ate_rmse_m
from duagc.pipeline.recording import read_log
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.runs.robot_data import registrations_of
from duagc.schemas import topics
from tests.fixtures.films import SMALL, walk_around
from tests.fixtures.frame_images import of_shot

CONFIG = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)), mapping_enabled=False)
COVERED = range(24, 48)
"""While the lens is covered the camera moves by 2.1 m and turns by 90 degrees."""


def covered(shots: Sequence[Shot], frames: range = COVERED) -> list[Shot]:
    """The same with a covered lens."""
    return [
        replace(s, color=np.zeros_like(s.color), depth=np.zeros_like(s.depth)) if s.index in frames else s
        for s in shots
    ]


def foreign_end(shots: Sequence[Shot], others: Sequence[Shot], begin: int) -> list[Shot]:
    """From a frame on the images of other shots."""
    return [
        s if s.index < begin else replace(s, color=o.color, depth=o.depth)
        for s, o in zip(shots, others, strict=True)
    ]


def tracked(shots: Sequence[Shot], config: FrontendConfig = CONFIG) -> TrackedLog:
    tracker = SubmapTracker(SMALL, config)
    for s in shots:
        tracker.track(of_shot(s))
    return tracker.finish()


def joined(shots: Sequence[Shot], log: TrackedLog) -> list[Component]:
    def images(frame: int, levels: int) -> RgbdPyramid:
        return RgbdPyramid.build(
            shots[frame].color.astype(np.float32) / 255, shots[frame].depth, SMALL, levels
        )

    return join_submaps(log.submaps, images, CONFIG, seed=0, robot="alpha")


def write(folder: Path, shots: Sequence[Shot]) -> Path:
    """The shots as a log."""
    with RecordingWriter(folder) as recording, recording.robot("alpha", SMALL, 0.0005) as robot:
        for s in shots:
            png = cv2.imencode(".png", s.color[..., ::-1])[1].tobytes()
            robot.add_frame(s.stamp_ns, png, "png", np.rint(s.depth / 0.0005).astype(np.uint16))
    return folder / "alpha.mcap"


def messages(path: Path, topic: topics.Topic, name: str = "alpha") -> list:
    return [record.message() for record in read_log(path, [topic.of(name)])]


def positions(odometry: Sequence) -> np.ndarray:
    return np.array([m.T_map_camera[:3, 3] for m in odometry])


@pytest.fixture(scope="module")
def walk() -> tuple[list[Shot], np.ndarray]:
    return walk_around(0)


@pytest.fixture(scope="module")
def frontend(
    walk: tuple[list[Shot], np.ndarray], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, Sequence[Shot]], Path]:
    """Makes frontend.mcap of shots, once by name."""
    made: dict[str, Path] = {}

    def make(name: str, shots: Sequence[Shot]) -> Path:
        if name not in made:
            folder = tmp_path_factory.mktemp("submaps")
            made[name] = folder / "frontend.mcap"
            run_frontend(write(folder / "recording", shots), made[name], CONFIG)
        return made[name]

    return make


def test_a_cut_recording_is_joined_and_as_exact_as_the_whole_one(walk, frontend) -> None:
    shots, truth = walk
    path = frontend("cut", covered(shots))
    odometry, keyframes = messages(path, topics.ODOMETRY), messages(path, topics.KEYFRAME)
    assert not component_path(path, "alpha-2").exists()
    assert {m.frame_index for m in odometry if m.status == "lost"} == set(COVERED)
    assert {m.reason for m in odometry if m.status == "lost"} == {Reason.NO_PIXEL.value}
    submaps = messages(path, topics.SUBMAP)
    assert [(m.submap, m.first_frame, m.last_frame) for m in submaps] == [
        (1, 0, COVERED.start - 1),
        (2, COVERED.stop, len(shots) - 1),
    ]
    assert all(m.loop_closures >= 2 for m in submaps)
    assert sum(m.keyframes for m in submaps) == len(keyframes)
    registrations_of(path, keyframes, messages(path, topics.KEYFRAME_FACTOR))  # one graph
    assert [m.keyframe_index for m in keyframes if m.previous_index < 0] == [0]
    posed = [m for m in odometry if m.status != "lost"]
    cut = ate_rmse_m(truth[[m.frame_index for m in posed], :3, 3], positions(posed))
    whole = messages(frontend("whole", shots), topics.ODOMETRY)
    assert cut < 1.2 * ate_rmse_m(truth[:, :3, 3], positions(whole)) + 2e-4


def test_a_place_that_is_never_seen_again_is_a_component_of_its_own(walk, frontend) -> None:
    shots, _ = walk
    other, truth = walk_around(5)
    cut = covered(foreign_end(shots, other, COVERED.stop))[: COVERED.stop + COVERED.start + 4]
    path = frontend("foreign", cut)
    rest = component_path(path, "alpha-1")
    largest, smaller = messages(path, topics.ODOMETRY), messages(rest, topics.ODOMETRY, "alpha-1")
    posed = [{m.frame_index for m in part if m.status != "lost"} for part in (largest, smaller)]
    assert posed == [set(range(COVERED.stop, len(cut))), set(range(COVERED.start))]
    for part, elsewhere in ((largest, posed[1]), (smaller, posed[0])):
        assert {m.frame_index for m in part if m.reason == Reason.OTHER_COMPONENT.value} == elsewhere
        assert [m.frame_index for m in part] == list(range(len(cut)))
    there = [m for m in largest if m.status != "lost"]
    assert ate_rmse_m(truth[[m.frame_index for m in there], :3, 3], positions(there)) < 3e-3
    alone = messages(frontend("first", cut[: COVERED.start]), topics.KEYFRAME)
    here = messages(rest, topics.KEYFRAME, "alpha-1")
    assert len(here) == len(alone)
    for one, same in zip(here, alone, strict=True):
        assert np.array_equal(one.T_map_camera, same.T_map_camera)


def test_a_camera_that_comes_back_is_relocalized_and_nothing_else_happens(walk) -> None:
    """Covered for longer than a submap needs, but in a known place."""
    shots = covered(walk[0][:40], range(20, 28))
    shots[28:40] = [
        replace(s, color=o.color, depth=o.depth) for s, o in zip(shots[28:], shots[7:19], strict=True)
    ]
    log, tracker = tracked(shots), Tracker(SMALL, CONFIG)
    assert len(log.submaps) == 1
    for s, frame in zip(shots, log.frames, strict=True):
        same = tracker.track(of_shot(s))
        assert (same.status, same.reason, same.keyframe_index) == (
            frame.status,
            frame.reason,
            frame.keyframe_index,
        )
        assert np.array_equal(same.T_keyframe_camera, frame.T_keyframe_camera)
    assert Status.RELOCALIZED in {frame.status for frame in log.frames}


def test_a_lost_submap_is_found_again(walk) -> None:
    """Two places in turn, A B A B: the second visits are relocalized, each in its own submap."""
    a, b = walk[0][:24], walk_around(5)[0][:24]
    visits = [*a[:18], *b[:18], *a[6:18], *b[6:18]]
    shots = [replace(s, color=v.color, depth=v.depth) for s, v in zip(walk[0], visits, strict=False)]
    log = tracked(shots)
    assert [submap.number for submap in log.submaps] == [1, 2]
    for at, number in ((17, 1), (35, 2), (47, 1), (59, 2)):
        assert (log.submap_of[at], log.frames[at].status) == (number, Status.OK)
    assert len(joined(shots, log)) == 2


def test_a_mirrored_room_joins_nothing(walk) -> None:
    """It has the same furniture and the same colors, but not the same places."""
    shots = walk[0][:24]
    mirrored = [
        replace(
            walk[0][24 + s.index],
            color=np.ascontiguousarray(s.color[:, ::-1]),
            depth=np.ascontiguousarray(s.depth[:, ::-1]),
        )
        for s in shots
    ]
    log = tracked([*shots, *mirrored])
    assert len(log.submaps) == 2
    assert [component.numbers for component in joined([*shots, *mirrored], log)] == [(1,), (2,)]


def test_a_bad_first_image_of_a_short_log_costs_itself(walk) -> None:
    """The log ends before the rest of it is long enough for a submap."""
    shots, path = walk
    dark = replace(shots[0], color=np.rint(0.05 * shots[0].color).astype(np.uint8))
    log = tracked([dark, *shots[1:9]])
    assert [frame.status is Status.LOST for frame in log.frames] == [True] + [False] * 8
    assert log.frames[0].reason is Reason.SMALL_SUBMAP
    assert log.submap_of == [NO_SUBMAP] + [log.submaps[0].number] * 8
    keyframes = log.submaps[0].keyframes
    T = [keyframes[f.keyframe_index].T_map_keyframe @ f.T_keyframe_camera for f in log.frames[1:]]
    assert ate_rmse_m(np.array(T)[:, :3, 3], path[1:9, :3, 3]) < 0.005


def test_without_submaps_such_frames_are_lost(walk) -> None:
    off = CONFIG.model_copy(update={"submaps": CONFIG.submaps.model_copy(update={"enabled": False})})
    log = tracked(covered(walk[0])[: COVERED.stop + 12], off)
    assert len(log.submaps) == 1
    assert all(frame.status is Status.LOST for frame in log.frames[COVERED.start :])


def test_what_moves_with_the_camera_is_no_submap(walk) -> None:
    """A pattern in front of the lens, always the same image: one keyframe, however long it is there."""
    rng = np.random.default_rng(0)
    board = cv2.resize(rng.integers(30, 220, (15, 20, 3), dtype=np.uint8), (SMALL.width, SMALL.height))
    near = np.full((SMALL.height, SMALL.width), 0.5, dtype=np.float32)
    shots = [
        s
        if s.index < 20
        else replace(
            s,
            color=np.clip(board + rng.integers(-2, 3, board.shape), 0, 255).astype(np.uint8),
            depth=near * (1 + np.float32(0.002) * rng.standard_normal(near.shape, dtype=np.float32)),
        )
        for s in walk[0][:45]
    ]
    log = tracked(shots)
    assert len(log.submaps) == 1
    assert all(frame.status is Status.LOST for frame in log.frames[21:])


def test_a_lost_frame_is_compared_with_few_keyframes_of_a_long_submap() -> None:
    rng = np.random.default_rng(0)
    views = [rng.integers(0, 256, (60, 128)).astype(np.uint8) for _ in range(150)]
    keyframes = [SimpleNamespace(features=SimpleNamespace(descriptors=v)) for v in views]
    frame = SimpleNamespace(features=SimpleNamespace(descriptors=views[97]))
    found = Relocalizer().alike(SimpleNamespace(keyframes=keyframes), frame)
    assert len(found) <= 64
    assert 97 in found
