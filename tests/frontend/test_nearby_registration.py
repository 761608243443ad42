"""Registrations near the last pose: each is stated with the keyframe that it is to."""

import numpy as np
import pytest

from duagc.pipeline.experiments.disturbances import Undisturbed
from duagc.pipeline.frontend import nearby_registration
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.geometry import se3
from tests.frontend.conftest import START_OF_COMPARISONS as START


def test_wide_gates_are_of_the_latest_keyframe_whatever_features_find(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker, shot = run.tracker(START), run.shots[START]
    image = shot.color.astype(np.float32) / 255
    frame = tracker.prepared(
        RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=image, depth_m=shot.depth)
    )
    state = tracker.state
    T_first_latest = se3.inverse(state.keyframes[0].T_map_keyframe) @ state.keyframe.T_map_keyframe
    elsewhere = [(0, T_first_latest @ state.T_keyframe_camera)]
    monkeypatch.setattr(nearby_registration, "initial_motions", lambda state, frame: iter(elsewhere))
    found = [candidate for candidate, _ in nearby_registration._attempts(state, frame)]
    assert state.keyframe_index > 0
    *_, by_features, _, wide = found
    assert by_features.keyframe_index == 0
    assert wide.keyframe_index == state.keyframe_index
    T_map_camera = state.keyframe.T_map_keyframe @ wide.result.T_reference_target
    assert se3.distance(T_map_camera, run.poses[START])[0] < 2e-3
