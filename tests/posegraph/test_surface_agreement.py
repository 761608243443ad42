"""Depth images of one robot judge where another one's samples are placed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.surface_agreement import coarse_depth, surface_agreement
from duagc.pipeline.runs.robot_data import RobotData


def judged(own: RobotData, T_own: np.ndarray, peer: RobotData, T_peer: np.ndarray, off: np.ndarray) -> float:
    """Agreement of two robots of the box world whose cameras are known, the peer's map moved by `off`."""
    samples = []
    for k in range(peer.keyframes):
        points = peer.camera.rays() * peer.images(k).depth_m[..., None]
        samples.append(points[::9, ::9].reshape(-1, 3))
    depths = [coarse_depth(own.images(k).depth_m) for k in range(own.keyframes)]
    return surface_agreement(depths, own.camera, samples, T_ownmap_keyframe=T_own, T_ownmap_peer=T_peer @ off)


def test_maps_agree_where_they_lie_and_nowhere_else(make_robot: Any) -> None:
    (own, T_own), (peer, T_peer) = make_robot("alpha", 0.0), make_robot("bravo", 0.6)
    assert judged(own, T_own, peer, T_peer, np.eye(4)) > 0.95
    # an odometry of centimeters is no contradiction
    assert judged(own, T_own, peer, T_peer, se3.exp([0.03, 0.0, 0.02, 0.0, 0.01, 0.0])) > 0.9
    for off in ([0.5, 0, 0, 0, 0, 0], [0, 0, 1.0, 0, 0, 0], [0, 0.6, 0, 0.4, 0, 0]):
        assert judged(own, T_own, peer, T_peer, se3.exp(np.array(off, float))) < 0.5


@pytest.mark.parametrize("blind", ["no depth", "behind", "no samples"])
def test_who_sees_nothing_of_it_says_nothing(make_robot: Any, blind: str) -> None:
    own, T_own = make_robot("alpha", 0.0)
    depths = [coarse_depth(own.images(k).depth_m) for k in range(own.keyframes)]
    ahead = np.tile([0.0, 0.0, 2.0], (500, 1)) + 0.1 * np.random.default_rng(0).normal(size=(500, 3))
    samples, T_sample = [ahead], T_own[:1]
    if blind == "no depth":
        depths = [np.zeros_like(depth) for depth in depths]
    elif blind == "behind":
        T_sample = T_own[:1] @ se3.exp([0.0, 0.0, -6.0, 0.0, 0.0, 0.0])
    else:
        samples, T_sample = [], np.zeros((0, 4, 4))
    assert (
        surface_agreement(depths, own.camera, samples, T_ownmap_keyframe=T_own, T_ownmap_peer=T_sample) == 0.0
    )
