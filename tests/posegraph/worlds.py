"""Small teams with known structure, benchmark graphs, and a network that loses packets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.consensus.pose_admm import PoseAgent, PoseConsensusConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.files import read_team_graph
from duagc.pipeline.posegraph.initialization import chordal
from duagc.pipeline.posegraph.loop_closures import holder, robust_frame
from duagc.pipeline.posegraph.pose_graph import PoseGraph, PoseGraphSolution, solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import HeldLoopClosures, LoopClosure, RelativePoses
from duagc.pipeline.posegraph.spanning_tree import chain_frames

Array = NDArray[np.float64]
EXACT = LoopClosureConfig(sigma_floor_m=0, sigma_floor_rad=0, min_support=1, frame_sigma_m=1.0)
POSE_GRAPHS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pose_graphs"


def random_poses(rng: np.random.Generator, n: int, meters: float = 1.0) -> Array:
    """Poses [n, 4, 4] with any rotation."""
    quats = rng.normal(size=(n, 4))
    return se3.from_quat_translation(quats, meters * rng.normal(size=(n, 3)))


def random_information(rng: np.random.Generator, n: int) -> Array:
    """Full, correlated information [n, 6, 6]: standard deviations from 0.3 to 3 cm or hundredths of a radian."""
    axes = np.linalg.qr(rng.normal(size=(n, 6, 6)))[0]
    sigma = 10 ** rng.uniform(-2.5, -1.5, size=(n, 1, 6))
    return axes / sigma**2 @ np.swapaxes(axes, -1, -2)


@dataclass
class TeamWorld:
    """What the robots of a small team know: maps in frames of their own, odometry, closures by pair (a < b)."""

    maps: dict[str, Array]
    odometry: dict[str, RelativePoses]
    closures: dict[tuple[str, str], list[LoopClosure]]

    def agents(
        self, config: PoseConsensusConfig, keep: dict[tuple[str, str], Sequence[bool]] | None = None
    ) -> dict[str, PoseAgent]:
        """Agents with frames chained from their closures, and links."""
        frames = {}
        for (a, b), held in self.closures.items():
            proposals = [
                self.maps[a][c.own_keyframe] @ c.T_own_peer @ se3.inverse(self.maps[b][c.peer_keyframe])
                for k, c in enumerate(held)
                if keep is None or keep[a, b][k]
            ]
            frames[a, b] = (robust_frame(np.array(proposals), config.closures), len(proposals))
        T_world_map = chain_frames(frames, sorted(self.maps))
        agents = {r: PoseAgent(r, self.maps[r], self.odometry[r], config) for r in sorted(self.maps)}
        for robot, agent in agents.items():
            agent.set_frame(T_world_map[robot])
        for (a, b), held in self.closures.items():
            start = None if keep is None else keep[a, b]
            if holder(a, b, held) == a:
                agents[b].add_link(a, shared=agents[a].add_link(b, held, keep=start))
            else:
                turned = [c.reversed() for c in held]
                agents[a].add_link(b, shared=agents[b].add_link(a, turned, keep=start))
        return agents

    def optimum(self, agents: dict[str, PoseAgent]) -> tuple[RelativePoses, PoseGraphSolution]:
        """The same factors in one graph, and their minimum from the same start."""
        closures = [
            HeldLoopClosures(a, b, held, np.ones(len(held))) for (a, b), held in self.closures.items()
        ]
        config = next(iter(agents.values())).config.closures
        starts = {r: agent.T_world_keyframe for r, agent in agents.items()}
        team = PoseGraph.of_team(starts, {r: agent.odometry for r, agent in agents.items()}, closures, config)
        return team.relative_poses, solve_pose_graph(team.relative_poses, team.T_start)


def make_team(
    seed: int, robots: int = 3, keyframes: int = 8, closures: int = 3, ring: bool = False
) -> TeamWorld:
    """Robots on one looping path, with noise of centimeters, each map in an arbitrary frame of its own."""
    rng = np.random.default_rng(seed)
    names = ["alpha", "bravo", "charlie", "delta", "echo"][:robots]
    truth = {name: random_poses(rng, keyframes) for name in names}
    maps, odometry = {}, {}
    for name in names:
        information = random_information(rng, keyframes - 1)
        noise = np.linalg.solve(
            np.linalg.cholesky(information).swapaxes(-1, -2), rng.normal(size=(keyframes - 1, 6, 1))
        )
        steps = se3.inverse(truth[name][:-1]) @ truth[name][1:] @ se3.exp(noise[..., 0])
        chain = [random_poses(rng, 1, 5.0)[0]]
        for step in steps:
            chain.append(chain[-1] @ step)
        maps[name] = np.array(chain)
        odometry[name] = RelativePoses(np.arange(keyframes - 1), np.arange(1, keyframes), steps, information)
    pairs = [(names[k], names[k + 1]) for k in range(robots - 1)]
    if ring and robots > 2:
        pairs.append((names[0], names[-1]))
    found = {}
    for a, b in pairs:
        held = []
        for _ in range(closures):
            i, j = int(rng.integers(keyframes)), int(rng.integers(keyframes))
            information = random_information(rng, 1)[0]
            noise_ij = np.linalg.solve(np.linalg.cholesky(information).T, rng.normal(size=6))
            T = se3.inverse(truth[a][i]) @ truth[b][j] @ se3.exp(noise_ij)
            held.append(LoopClosure(i, j, T, information))
        found[a, b] = held
    return TeamWorld(maps, odometry, found)


def talk(agents: dict[str, PoseAgent], rounds: int, loss: float = 0.0, seed: int = 0, **faults: float) -> int:
    """Run rounds until all agree; returns how many. Faults: `twice`, chance that a packet is delivered again later;
    `cut`, chance that it arrives as two halves of which one may be lost."""
    rng = np.random.default_rng(seed)
    late = []
    for k in range(rounds):
        sent = []
        for robot, agent in agents.items():
            agent.step()
            sent += [(robot, peer, agent.outgoing(peer)) for peer in agent.links]
        sent, late = sent + late, []
        for robot, peer, packet in sent:
            parts = [packet]
            if rng.random() < faults.get("cut", 0.0):
                half = len(packet.keyframes) // 2
                parts = [packet.part(slice(0, half)), packet.part(slice(half, None))]
            for part in parts:
                if len(part.keyframes) and rng.random() >= loss:
                    agents[peer].receive(robot, part)
                if rng.random() < faults.get("twice", 0.0):
                    late.append((robot, peer, part))
        if all(agent.agreed for agent in agents.values()):
            return k + 1
    return rounds


def in_root_frame(agents: dict[str, PoseAgent]) -> dict[str, Array]:
    """Keyframes by robot in the map frame of the lowest name, whose first keyframe stays where its own map has it."""
    root = agents[min(agents)]
    T = root.T_map_keyframe[0] @ se3.inverse(root.T_world_keyframe[0])
    return {robot: T @ agents[robot].T_world_keyframe for robot in sorted(agents)}


def team_poses(agents: dict[str, PoseAgent]) -> Array:
    """All keyframes one after the other, in order of name, in the root's map frame."""
    return np.concatenate(list(in_root_frame(agents).values()))


def from_first(poses: Array) -> Array:
    """Poses as seen from the first: what does not depend on the gauge."""
    return se3.inverse(poses[0]) @ poses


# ---- benchmark graphs ----


def benchmark(name: str, robots: int | None = None) -> TeamWorld:
    """A public graph cut into robots, each with its own optimum in its own frame; skips the test if not there."""
    path = POSE_GRAPHS / name
    if not path.exists():
        pytest.skip(f"needs {name} in ../shared/data/pose_graphs, which is not distributed with the project")
    team = read_team_graph(path, robots)
    odometry = {r: RelativePoses.concatenate([g.odometry, g.loops]) for r, g in team.robots.items()}
    maps = {
        r: solve_pose_graph(odometry[r], chordal(odometry[r], g.keyframes)).poses
        for r, g in team.robots.items()
    }
    return TeamWorld(maps, odometry, {(a, b): team.robots[a].closures[b] for a, b in team.pairs})


def team_cost(factors: RelativePoses, agents: dict[str, PoseAgent]) -> float:
    """The central cost at the agents' own estimates."""
    return least_squares.cost(factors, np.concatenate([agents[r].T_world_keyframe for r in sorted(agents)]))
