"""Lost frames are looked for again between their neighbors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.frontend import reach
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.lost_frames import found_afterwards, registered_again, without_jumps
from duagc.pipeline.frontend.submaps import lost
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import RgbdPyramid
from tests.fixtures.films import CAMERA
from tests.frontend.conftest import CONFIG, STARTS

END = STARTS[-1]
LOST = 30


def looked_for(run: Undisturbed, frames: list[TrackedFrame], shown: dict[int, int]) -> list[TrackedFrame]:
    """The frames after another look; `shown` names frames that show what another one does."""

    def images(frame_index: int, levels: int) -> RgbdPyramid:
        shot = run.shots[shown.get(frame_index, frame_index)]
        return RgbdPyramid.build(shot.color / np.float32(255), shot.depth, CAMERA, levels)

    keyframes = run.tracker(END).keyframes
    T = np.array([keyframe.T_map_keyframe for keyframe in keyframes])
    return found_afterwards(frames, keyframes, T, images, config=CONFIG)


def with_loss(run: Undisturbed, at: int, reason: Reason) -> list[TrackedFrame]:
    frames = list(run.frames[:END])
    before = frames[at - 1]
    frames[at] = replace(
        lost(frames[at], reason),
        keyframe_index=before.keyframe_index,
        T_keyframe_camera=before.T_keyframe_camera,
    )
    return frames


def test_a_lost_frame_is_found_between_its_neighbors(run: Undisturbed) -> None:
    frames = with_loss(run, LOST, Reason.UNCONFIRMED)
    found = looked_for(run, frames, {})
    assert [k for k, (a, b) in enumerate(zip(found, frames, strict=True)) if a is not b] == [LOST]
    assert found[LOST].status is Status.RELOCALIZED
    T_map_keyframe = run.tracker(END).keyframes[found[LOST].keyframe_index].T_map_keyframe
    moved_m, turned_rad = se3.distance(T_map_keyframe @ found[LOST].T_keyframe_camera, run.poses[LOST])
    assert moved_m < 0.003
    assert turned_rad < 0.002


def test_a_lost_frame_of_a_vehicle_is_found_between_its_neighbors(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every twelfth frame of a film ten times as fast: 30 cm from one to the next, at 8 m/s."""
    frames = [
        replace(f, stamp_ns=f.stamp_ns // 10)
        for f in with_loss(run, LOST, Reason.UNCONFIRMED)[LOST % 12 :: 12]
    ]
    assert looked_for(run, frames, {})[LOST // 12].status is Status.RELOCALIZED
    monkeypatch.setattr(reach, "FASTER", 0.0)
    assert looked_for(run, frames, {}) == frames, "of what is carried by hand"


def test_a_frame_that_jumps_away_and_back_is_lost(run: Undisturbed) -> None:
    keyframes = run.tracker(END).keyframes
    T = np.array([keyframe.T_map_keyframe for keyframe in keyframes])
    frames = list(run.frames[:END])
    assert without_jumps(frames, keyframes, T, CONFIG) == frames
    away = np.eye(4)
    away[0, 3] = 0.25  # within 33 ms
    frames[LOST] = replace(frames[LOST], T_keyframe_camera=frames[LOST].T_keyframe_camera @ away)
    jumped = without_jumps(frames, keyframes, T, CONFIG)
    assert [k for k, (a, b) in enumerate(zip(jumped, frames, strict=True)) if a is not b] == [LOST]
    assert (jumped[LOST].status, jumped[LOST].reason) == (Status.LOST, Reason.JUMP)
    for k in range(LOST + 1, END):  # a camera that is carried off does not come back
        frames[k] = replace(frames[k], T_keyframe_camera=frames[k].T_keyframe_camera @ away)
    assert without_jumps(frames, keyframes, T, CONFIG) == frames


def test_what_cannot_be_between_its_neighbors_stays_lost(run: Undisturbed) -> None:
    frames = with_loss(run, LOST, Reason.UNCONFIRMED)
    assert looked_for(run, frames, {LOST: LOST - 18}) == frames  # 40 cm away within 33 ms


def test_frames_whose_images_cannot_be_used_stay_lost(run: Undisturbed) -> None:
    for reason in (Reason.FROZEN_DEPTH, Reason.CONTRADICTION, Reason.OTHER_COMPONENT):
        frames = with_loss(run, LOST, reason)
        assert looked_for(run, frames, {}) == frames


def test_a_loss_at_the_end_has_no_second_neighbor(run: Undisturbed) -> None:
    frames = with_loss(run, END - 1, Reason.RESIDUAL)
    assert looked_for(run, frames, {}) == frames


@pytest.mark.parametrize("late", [0, 6])
def test_what_was_followed_by_color_is_registered_again_where_its_depth_fits(
    run: Undisturbed, late: int
) -> None:
    """Depth that is moved now; or that of six frames before, still."""
    keyframes = run.tracker(END).keyframes
    frames = list(run.frames[:END])
    off = se3.exp(np.array([0.03, 0.0, 0.0, 0.0, 0.01, 0.0]))
    frames[LOST] = replace(
        frames[LOST],
        reason=Reason.CONTRADICTION,
        T_keyframe_camera=frames[LOST].T_keyframe_camera @ off,
    )

    def images(frame_index: int, levels: int) -> RgbdPyramid:
        color, depth = run.shots[frame_index].color, run.shots[frame_index - late].depth
        return RgbdPyramid.build(color / np.float32(255), depth, CAMERA, levels)

    found = registered_again(frames, frames, keyframes, images, config=CONFIG)
    changed = [k for k, (a, b) in enumerate(zip(found, frames, strict=True)) if a is not b]
    assert changed == ([] if late else [LOST])
    if not late:
        assert found[LOST].reason is Reason.NONE
        T_map_keyframe = keyframes[found[LOST].keyframe_index].T_map_keyframe
        moved_m, turned_rad = se3.distance(T_map_keyframe @ found[LOST].T_keyframe_camera, run.poses[LOST])
        assert moved_m < 0.003
        assert turned_rad < 0.002
