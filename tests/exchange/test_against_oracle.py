"""On a wire that rounds nothing, what robots agree on is what one computer with everybody's data would say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.consensus import MapMatching, PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.evaluation.oracle import pose_gap, solve_component
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import OwnMap, fuse
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import HeldLoopClosures, LoopClosure, RelativePoses
from duagc.pipeline.runs.robot_data import RobotData, SessionResult

NAMES = ("alpha", "bravo", "charlie", "delta", "echo", "foxtrot", "golf", "hotel")
BURSTS = {"burst_gap_ns": 900_000_000, "burst_length_ns": 300_000_000}


def unrounded(**link: Any) -> ExchangeConfig:
    return ExchangeConfig(
        link=LinkConfig(**link),
        evidence_wire="float64",
        consensus=PoseConsensusConfig(wire="float64", tolerance=1e-12),
        max_rounds=20_000,
    )


def meet(data: list[RobotData], folder: Path, config: ExchangeConfig) -> dict[str, SessionResult]:
    results = run_session_of(
        data, config, seed=0, exchange_path=folder / "exchange.mcap", consensus_path=folder / "consensus.mcap"
    )
    assert all(result.converged for result in results.values())
    assert all(result.component == tuple(sorted(results)) for result in results.values())
    return results


def team(make_robot: Any, robots: int, link: dict[str, Any]) -> list[RobotData]:
    """Robots side by side, each of which sees a part of what the next one sees; eight in a ring stand all round."""
    turn = 2 * np.pi / robots if robots == 8 and link.get("topology") == "ring" else 0.6
    return [make_robot(name, turn * i, keyframes=4)[0] for i, name in enumerate(NAMES[:robots])]


def oracle_poses(
    data: list[RobotData], results: dict[str, SessionResult], config: PoseConsensusConfig
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The robots' poses, and the centralized answer to the same factors, closures and final weights."""
    poses = {d.robot: results[d.robot].T_world_keyframe for d in data}
    odometry = {d.robot: with_floor(RelativePoses.of(d.registrations), config) for d in data}
    closures = [
        HeldLoopClosures(
            c.robot,
            c.peer,
            (LoopClosure(c.own_keyframe, c.peer_keyframe, c.T_own_peer, c.information),),
            (c.weight,),
        )
        for result in results.values()
        for c in result.closures
        if c.weight is not None and c.T_own_peer is not None and c.information is not None
    ]
    rng = np.random.default_rng(0)
    start = {}
    for name, T in poses.items():  # another start, so that nobody is right by standing still
        start[name] = T @ se3.exp(0.003 * rng.normal(size=(len(T), 6)))
    start[min(start)][0] = poses[min(start)][0]  # which fixes the gauge
    central = solve_component(start, odometry, closures, config)
    assert isinstance(central, dict)
    return poses, central


def fused_theta(
    data: list[RobotData], name: str, evidence: dict[str, Evidence], poses: dict[str, np.ndarray], pairs: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """theta of a robot's own Gaussians after fusion, roots of their information, and which were matched."""
    own = next(d for d in data if d.robot == name)
    splats = Evidence.from_rendering(own.robot, own.gaussians, own.information, own.T_map_keyframe)
    fused = fuse(
        OwnMap(name, own.gaussians, own.T_map_keyframe, poses[name]),
        {robot: e.in_world(poses[robot]) for robot, e in evidence.items()},
        pairs,
        MapContext(own.camera, FusionConfig(coverage="overlap"), MapMatching()),
        self_information=splats.in_world(poses[name]),
    )
    n = len(own.gaussians)
    whole = Evidence(name, own.gaussians.ids, own.gaussians.anchors, fused.theta[:n], fused.information[:n])
    return whole.theta, np.sqrt(Weights.of(whole).diagonal()), fused.members[:n] > 1


def gaps(
    data: list[RobotData], results: dict[str, SessionResult], config: ExchangeConfig
) -> tuple[float, float, np.ndarray]:
    """Meters and radians of poses, and of every matched Gaussian [m, 13] in standard deviations, from the oracle."""
    poses, central = oracle_poses(data, results, config.consensus)
    exact = {d.robot: Evidence.from_map(d.robot, d.gaussians, d.information, d.T_map_keyframe) for d in data}
    found = []
    for d in data:
        result = results[d.robot]
        heard = {d.robot: result.own_evidence, **result.evidence}
        theta, _, matched = fused_theta(data, d.robot, heard, result.T_world_keyframe_of, result.pairs)
        best, roots, _ = fused_theta(data, d.robot, exact, central, result.pairs)
        found.append((np.abs(theta - best) * roots)[matched])
    return *pose_gap(poses, central), np.concatenate(found)


@pytest.mark.parametrize(
    ("robots", "link"),
    [
        (3, {"topology": "chain", "loss_probability": 0.3}),
        pytest.param(2, {}, marks=pytest.mark.slow),
        pytest.param(2, {"loss_probability": 0.3, **BURSTS}, marks=pytest.mark.slow),
        pytest.param(4, {"topology": "ring", "loss_probability": 0.6}, marks=pytest.mark.slow),
        pytest.param(4, {"topology": "full", "loss_probability": 0.9}, marks=pytest.mark.slow),
        pytest.param(8, {"topology": "chain"}, marks=pytest.mark.slow),
        pytest.param(8, {"topology": "full", "loss_probability": 0.3, **BURSTS}, marks=pytest.mark.slow),
    ],
)
def test_the_team_is_at_the_oracle(
    make_robot: Any, tmp_path: Path, robots: int, link: dict[str, Any]
) -> None:
    data = team(make_robot, robots, link)
    config = unrounded(**link)
    results = meet(data, tmp_path, config)
    meters, radians, gap_sigma = gaps(data, results, config)
    rounds = max(r.rounds for r in results.values())
    print(f"{robots} robots, {link}: {rounds} rounds, {meters:.1e} m, {gap_sigma.max():.1e} sigma")
    assert meters < 1e-9
    assert radians < 1e-9
    assert len(gap_sigma) > 10
    assert gap_sigma.max() < 1e-6


@pytest.mark.parametrize(
    ("robots", "link"),
    [
        (3, {"topology": "chain", "loss_probability": 0.3}),
        pytest.param(2, {}, marks=pytest.mark.slow),
        pytest.param(2, {"loss_probability": 0.3, **BURSTS}, marks=pytest.mark.slow),
        pytest.param(2, {"loss_probability": 0.9}, marks=pytest.mark.slow),
        pytest.param(4, {"topology": "ring", "loss_probability": 0.6}, marks=pytest.mark.slow),
        pytest.param(4, {"topology": "ring", "loss_probability": 0.9}, marks=pytest.mark.slow),
        pytest.param(4, {"topology": "full", "loss_probability": 0.9}, marks=pytest.mark.slow),
        pytest.param(8, {"topology": "ring"}, marks=pytest.mark.slow),
        pytest.param(8, {"topology": "chain", "loss_probability": 0.6}, marks=pytest.mark.slow),
        pytest.param(8, {"topology": "full", "loss_probability": 0.3, **BURSTS}, marks=pytest.mark.slow),
    ],
)
def test_on_the_default_wire_the_team_is_near_the_oracle(
    make_robot: Any, tmp_path: Path, robots: int, link: dict[str, Any]
) -> None:
    """Rounded evidence, poses in float32, at the tolerance of runs."""
    data = team(make_robot, robots, link)
    config = ExchangeConfig(link=LinkConfig(**link), max_rounds=20_000)
    results = meet(data, tmp_path, config)
    meters, radians, gap_sigma = gaps(data, results, config)
    print(
        f"{robots} robots, {link}: {max(r.rounds_to_agreement or 0 for r in results.values())} rounds, "
        f"{meters:.1e} m, {radians:.1e} rad, {np.percentile(gap_sigma.max(axis=1), 99):.1e} sigma at 99 %"
    )
    assert meters < 1e-6
    assert radians < 1e-6
    assert np.percentile(gap_sigma.max(axis=1), 99) < 0.05
