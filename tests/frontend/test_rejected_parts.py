"""What the rest of a path contradicts, but nothing in itself, is a component of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.config.frontend import SubmapConfig
from duagc.pipeline.frontend import stage
from duagc.pipeline.frontend.components import Component, whole
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.rejected_parts import RejectedPart, separated
from duagc.pipeline.frontend.stage import component_path, run_frontend
from duagc.pipeline.frontend.submaps import TrackedLog
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import ate_rmse_m
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import read_log
from duagc.pipeline.registration.features import Features
from duagc.schemas import topics
from tests.fixtures.films import walk_around
from tests.frontend.test_submaps import CONFIG, write
from tests.frontend.test_submaps import tracked as tracked_in_submaps

FRAMES = 48
NO_FEATURES = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
AHEAD = se3.exp(np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def walk():
    return walk_around(0)


@pytest.fixture(scope="module")
def tracked(walk) -> TrackedLog:
    return tracked_in_submaps(walk[0][:FRAMES])


@pytest.fixture(scope="module")
def at(tracked: TrackedLog) -> int:
    """The keyframe from which on a path is wrong: some 15 frames are left."""
    return next(f.keyframe_index for f in tracked.frames if f.frame_index == FRAMES - 15) + 1


def broken(log: TrackedLog, at: int) -> TrackedLog:
    """Tracking went wrong at a keyframe, by a registration that says it is exact; no view has features."""
    (submap,) = log.submaps
    T = submap.keyframes[at].T_map_keyframe
    moved = T @ AHEAD @ se3.inverse(T)
    keyframes = [
        replace(
            k,
            features=NO_FEATURES,
            T_map_keyframe=moved @ k.T_map_keyframe if k.keyframe_index >= at else k.T_map_keyframe,
        )
        for k in submap.keyframes
    ]
    pairs = [pair for pair in submap.pairs if (pair.i < at) == (pair.j < at)]
    T_wrong = se3.inverse(keyframes[at - 1].T_map_keyframe) @ keyframes[at].T_map_keyframe
    pairs.append(RelativePose(at - 1, at, T_wrong, 1e8 * np.eye(6)))
    return replace(log, submaps=[replace(submap, keyframes=keyframes, pairs=pairs)])


def test_a_part_that_depth_contradicts_goes_on_as_a_component(
    walk, tracked: TrackedLog, at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots, truth = walk
    monkeypatch.setattr(stage.LogTracking, "run", lambda _: broken(tracked, at))
    path = tmp_path / "frontend.mcap"
    run_frontend(write(tmp_path / "recording", shots[:FRAMES]), path, CONFIG)
    names = {"alpha": path, "alpha-2": component_path(path, "alpha-2")}
    frames = {
        name: [r.message() for r in read_log(log, [topics.ODOMETRY.of(name)])] for name, log in names.items()
    }
    posed = {name: [m for m in of if m.status != "lost"] for name, of in frames.items()}
    later = {f.frame_index for f in tracked.frames if f.keyframe_index >= at}
    assert {m.frame_index for m in posed["alpha-2"]} == later
    assert {m.frame_index for m in posed["alpha"]} == set(range(FRAMES)) - later
    for name, other in (("alpha", "alpha-2"), ("alpha-2", "alpha")):
        elsewhere = {m.frame_index for m in frames[name] if m.reason == Reason.OTHER_COMPONENT.value}
        assert elsewhere == {m.frame_index for m in posed[other]}
        (submap,) = [r.message() for r in read_log(names[name], [topics.SUBMAP.of(name)])]
        keyframes = [r.message() for r in read_log(names[name], [topics.KEYFRAME.of(name)])]
        assert (submap.frames, submap.keyframes) == (len(posed[name]), len(keyframes))
        positions = np.array([m.T_map_camera[:3, 3] for m in posed[name]])
        assert ate_rmse_m(truth[[m.frame_index for m in posed[name]], :3, 3], positions) < 3e-3


def rejected(component: Component, begin: int, end: int) -> RejectedPart:
    part = range(begin, end)
    return RejectedPart(
        part,
        np.array([component.keyframes[k].T_map_keyframe for k in part]),
        [pair for pair in component.pairs if pair.i in part and pair.j in part],
    )


def test_two_parts_are_two_components_and_every_frame_is_in_one(tracked: TrackedLog) -> None:
    component, limits = whole(tracked.submaps[0]), SubmapConfig(min_frames=1, min_keyframes=1)
    count = len(component.keyframes)
    parts = [rejected(component, 0, 2), rejected(component, count - 2, count)]
    now = separated(tracked, component, parts, limits)
    assert [(c.numbers, len(c.keyframes)) for c in (now.own, *now.others)] == [
        ((1,), count),
        ((2,), 2),
        ((3,), 2),
    ]
    assert sorted(now.own.index_of.values()) == list(range(2, count - 2))
    of = [c.frames(now.log) for c in (now.own, *now.others)]
    for before, *frames in zip(tracked.frames, *of, strict=True):
        placed = [k for k, frame in enumerate(frames) if frame.status is not Status.LOST]
        assert len(placed) == 1
        of_component = (now.own, *now.others)[placed[0]]
        frame = frames[placed[0]]
        assert np.array_equal(frame.T_keyframe_camera, before.T_keyframe_camera)
        anchor = of_component.keyframes[frame.keyframe_index]
        assert anchor.frame_index == component.keyframes[before.keyframe_index].frame_index
    for other, part in zip(now.others, parts, strict=True):
        assert [k.keyframe_index for k in other.keyframes] == [0, 1]
        assert [k.previous_index for k in other.keyframes] == [-1, 0]
        assert {(p.i, p.j) for p in other.pairs} == {(0, 1)}
        assert np.array_equal([k.T_map_keyframe for k in other.keyframes], part.T_map_keyframe)


@pytest.mark.parametrize(
    "limits",
    [
        SubmapConfig(min_frames=FRAMES),
        SubmapConfig(min_frames=1, min_keyframes=3),
        SubmapConfig(enabled=False, min_frames=1, min_keyframes=1),
    ],
)
def test_what_is_too_small_for_a_submap_stays_lost(tracked: TrackedLog, limits: SubmapConfig) -> None:
    component = whole(tracked.submaps[0])
    now = separated(tracked, component, [rejected(component, 0, 2)], limits)
    assert (now.log, now.own, now.others) == (tracked, component, [])
    assert now.frames(tracked.frames) == tracked.frames
