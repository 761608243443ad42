"""`duagc posegraph`: let a team solve its graph, and compare with the graph solved in one place.

The centralized optimum is computed here, for the comparison; no agent sees it, nor another robot's factors.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.exchange.wire.state_wire import MAX_TEAM
from duagc.pipeline.network.packets import HEADER_BYTES, MAX_PAYLOAD_BYTES
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.certificate import is_global_minimum
from duagc.pipeline.posegraph.files import TeamGraph, read_team_graph
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT
from duagc.pipeline.posegraph.initialization import chordal
from duagc.pipeline.posegraph.pose_graph import PoseGraph, PoseGraphSolution, solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import HeldLoopClosures, RelativePoses
from duagc.pipeline.team_posegraph.agent import PoseGraphAgent
from duagc.pipeline.team_posegraph.team import Traffic, meet

GAPS = {"1e-2": 1e-2, "1e-4": 1e-4, "1e-6": 1e-6}
RAW_FACTOR_BYTES = 40  # two keys, rotation vector, translation, kappa, tau
_TRUNCATIONS = 30
_LEAST_COST = 1e-9  # of a factor: a lower optimum is rounding and tolerances


@dataclass
class _Component:
    """One group of connected robots: its whole graph in one place, and what was seen of its agents.

    Attributes:
        robots: their names.
        graph: odometry and loops by robot, then loop closures by pair.
        trusted: bool per relative pose.
        true: bool per relative pose that may be false, whether the reference has it; None without reference.
        closures: number of loop closures.
        optimum: the solution in one place.
        trace: round, cost, and bytes by these robots.
        setup: last round before all of them iterated, and bytes until then.
    """

    robots: tuple[str, ...]
    graph: PoseGraph
    trusted: NDArray[np.bool_]
    true: NDArray[np.bool_] | None
    closures: int
    optimum: PoseGraphSolution | None = None
    trace: list[tuple[int, float, int]] = field(default_factory=list)  # round, cost, bytes by these robots
    setup: tuple[int, int] = (0, 0)  # last round before all of them iterated, bytes until then

    def cost(self, T: Array, c2: float | None) -> float:
        """Sum of |r|^2, truncated at c2 for what is not trusted."""
        squared = least_squares.squared_residuals(self.graph.relative_poses, T)
        if c2 is not None:
            squared = np.where(self.trusted, squared, np.minimum(squared, c2))
        return float(squared.sum())


def solve(
    path: Path, config: PoseGraphConfig, robots: int | None = None, *, only_reference: bool = False
) -> dict[str, Any]:
    """Read, cut, let the team solve it, compare; see `docs/howto/pose-graph.md` for the result.

    Args:
        path: a graph, or a folder of a team's graphs, as `read_team_graph` takes it.
        config: the same at all robots.
        robots: cut a single graph among so many, 4 if None; for a team's own files, at most a check.
        only_reference: leave out loops and loop closures that the reference next to the graph does not name
            as true.

    Raises:
        DuagError: the graph cannot be read or solved for, or has too many robots.
    """
    graph = read_team_graph(path, robots, only_reference=only_reference)
    if len(graph.robots) > MAX_TEAM:
        raise DuagError(f"{path}: found {len(graph.robots)} robots, expected at most {MAX_TEAM}")
    try:
        return _solved(graph, path, config)
    except DuagError as error:
        raise DuagError(f"{path}: {error}") from error


def _solved(graph: TeamGraph, path: Path, config: PoseGraphConfig) -> dict[str, Any]:
    c2 = config.consensus.truncation**2 if config.consensus.robust else None
    components = [_component(graph, members, config) for members in graph.components()]
    if c2 is None:
        for component in components:
            component.optimum = _central(component)
    began = time.perf_counter()
    agents, traffic, rounds = meet(graph, config, lambda k, a, t: _watch(components, k, a, t, c2=c2))
    seconds = time.perf_counter() - began
    results = [_result(component, agents, c2) for component in components]
    return _summary(
        graph, path, config, results, agents=agents, traffic=traffic, rounds=rounds, seconds=seconds
    )


# --- the graph in one place


def _component(graph: TeamGraph, members: tuple[str, ...], config: PoseGraphConfig) -> _Component:
    robots = [graph.robots[name] for name in members]
    own = {r.name: RelativePoses.concatenate([r.odometry, r.loops]) for r in robots}
    pairs = [pair for pair in graph.pairs if pair[0] in members]
    closures = [_held(graph, a, b) for a, b in pairs]
    starts = {r.name: np.tile(np.eye(4), (r.keyframes, 1, 1)) for r in robots}
    whole = PoseGraph.of_team(starts, own, closures, config.consensus.closures)
    between = sum(len(held.loop_closures) for held in closures)
    trusted = [np.arange(len(r.odometry) + len(r.loops)) < len(r.odometry) for r in robots]
    true = None
    if graph.loops_true is not None and graph.closures_true is not None:
        true = np.concatenate(
            [*(graph.loops_true[name] for name in members), *(graph.closures_true[pair] for pair in pairs)]
        )
    return _Component(members, whole, np.concatenate([*trusted, np.zeros(between, bool)]), true, between)


def _held(graph: TeamGraph, a: str, b: str) -> HeldLoopClosures:
    """The loop closures of a pair from the side of a, each with weight one."""
    closures = graph.robots[a].closures[b]
    return HeldLoopClosures(a, b, closures, [1.0] * len(closures))


def _central(component: _Component) -> PoseGraphSolution:
    """The optimum from a chordal start of the whole graph."""
    n = len(component.graph.T_start)
    start = chordal(component.graph.relative_poses, n) if n > 1 else component.graph.T_start
    return solve_pose_graph(component.graph.relative_poses, start)


def _solve_counted(component: _Component, T: Array, weights: Array) -> PoseGraphSolution:
    """A minimum of what has weight: the rest would only fill the factorization."""
    counts = weights != 0.0
    return solve_pose_graph(component.graph.relative_poses.select(counts), T, weights[counts])


def _truncated(component: _Component, T: Array, kept: NDArray[np.bool_], c2: float) -> PoseGraphSolution:
    """Truncated least squares in one place, from poses and a selection of what may be false: solve, select, repeat."""
    weights = component.trusted.astype(np.float64)
    best = None
    for _ in range(_TRUNCATIONS):
        weights[~component.trusted] = kept
        found = _solve_counted(component, T, weights)
        T = found.poses
        cost = component.cost(T, c2)
        if best is None or cost < best.cost:
            best = PoseGraphSolution(T, cost, found.iterations, found.converged)
        again = least_squares.squared_residuals(component.graph.relative_poses, T)[~component.trusted] <= c2
        if np.array_equal(again, kept):
            break
        kept = again
    assert best is not None
    return best


# --- what is seen of the agents


def _watch(
    components: list[_Component],
    k: int,
    agents: dict[str, PoseGraphAgent],
    traffic: Traffic,
    *,
    c2: float | None,
) -> None:
    """After round k: costs of all components that are past their set-up."""
    for component in components:
        members = [agents[name] for name in component.robots]
        sent = sum(traffic.sent[name] for name in component.robots)
        if any(agent.first_pose_round is None for agent in members):
            component.setup = (k, sent)
            continue
        T = np.concatenate([agent.T_world_keyframe for agent in members])
        component.trace.append((k, component.cost(T, c2), sent))


def _result(component: _Component, agents: dict[str, PoseGraphAgent], c2: float | None) -> dict[str, Any]:
    """What one component reached."""
    members = [agents[name] for name in component.robots]
    T = np.concatenate([agent.T_world_keyframe for agent in members])
    kept = _kept(component, agents)
    optimum = component.optimum or _truncated(component, T, kept, c2 or np.inf)
    cost = component.cost(T, c2)
    squared = least_squares.squared_residuals(component.graph.relative_poses, T)
    counted = component.trusted.copy()
    counted[~component.trusted] = kept
    first, bytes_before = component.setup
    trace = component.trace
    if not trace and len(members) == 1:  # nobody to iterate with: it is where it ends before any round
        trace = [(first, cost, bytes_before)]
    reached: dict[str, tuple[int, int] | None] = {}
    factors = len(component.graph.relative_poses)
    for name, gap in GAPS.items():
        limit = optimum.cost + gap * _cost_scale(optimum.cost, factors)
        hit = next((t for t in trace if t[1] <= limit), None)
        reached[name] = (hit[0] - first, hit[2]) if hit else None
    exchanges = max((a.exchanges for a in members if a.exchanges is not None), default=None)
    return {
        "robots": list(component.robots),
        "keyframes": len(T),
        "factors": factors,
        "closures": component.closures,
        "cost": cost,
        "inlier_cost": float(squared[counted].sum()),
        "optimum": optimum.cost,
        "optimum_converged": optimum.converged,
        "gap": _gap(cost, optimum.cost, factors),
        "distance_rms_m": _distance(T, optimum.poses),
        "rounds": trace[-1][0] - first if trace else 0,
        "rounds_setup": first,
        "bytes": trace[-1][2] if trace else bytes_before,
        "bytes_setup": bytes_before,
        "exchanges": exchanges,
        "rounds_to": {name: hit and hit[0] for name, hit in reached.items()},
        "bytes_to": {name: hit and hit[1] for name, hit in reached.items()},
        "bytes_raw_alternative": _raw_bytes(members),
        "converged": all(agent.done for agent in members),
        "kept": int(kept.sum()),
        "reference": None if component.true is None else _against_reference(component, kept, T, c2),
    }


def _kept(component: _Component, agents: dict[str, PoseGraphAgent]) -> NDArray[np.bool_]:
    """Which of the factors that may be false count, in the order of the graph; loop closures not yet held do not."""
    members = [agents[name] for name in component.robots]
    pairs = [
        (agent.part.name, peer, len(closures))
        for agent in members
        for peer, closures in agent.part.closures.items()
    ]
    held = {(a, b): np.zeros(count) for a, b, count in pairs if a < b}
    loops = []
    for name in component.robots:
        weights, by_peer = agents[name].kept()
        loops.append(weights)
        held.update({(min(name, peer), max(name, peer)): w for peer, w in by_peer.items()})
    return np.concatenate([*loops, *(held[pair] for pair in sorted(held))]) >= INLIER_WEIGHT


def _against_reference(
    component: _Component, kept: NDArray[np.bool_], T: Array, c2: float | None
) -> dict[str, Any]:
    """Precision and recall of loops and closures together, and of closures between robots alone.

    With c2 also the optimum of what the reference calls true, and how far the agents' poses are from it.
    """
    assert component.true is not None
    true = component.true

    def ratio(part: slice) -> dict[str, Any]:
        both = int((kept[part] & true[part]).sum())
        found, named = int(kept[part].sum()), int(true[part].sum())
        return {
            "true": named,
            "kept": found,
            "precision": both / found if found else None,
            "recall": both / named if named else None,
        }

    result = ratio(slice(None)) | {"between_robots": ratio(slice(len(true) - component.closures, None))}
    if c2 is not None:
        weights = component.trusted.astype(np.float64)
        weights[~component.trusted] = true
        solved = _solve_counted(component, T, weights)
        result["cost_of_reference"] = component.cost(solved.poses, c2)
        inliers = component.graph.relative_poses.select(weights > 0)
        result["optimum"] = solved.cost
        result["certified"] = is_global_minimum(inliers, solved.poses)
        result["optimum_converged"] = solved.converged
        result["gap"] = _gap(least_squares.cost(inliers, T), solved.cost, len(inliers))
    return result


def _gap(cost: float, optimum: float, factors: int) -> float | None:
    """How far a cost is above the optimum, as a share of it; None without factors."""
    return (cost - optimum) / _cost_scale(optimum, factors) if factors else None


def _cost_scale(optimum: float, factors: int) -> float:
    """What a gap is a share of: the optimum, or what counts as none where measurements contradict nowhere."""
    return max(optimum, _LEAST_COST * factors)


def _distance(T: Array, T_optimum: Array) -> float:
    """Root mean square distance (m) of the keyframes from the optimum, after the best rigid alignment."""
    p, q = T[:, :3, 3], T_optimum[:, :3, 3]
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(((b - a @ R.T) ** 2).sum(axis=1).mean()))


def _raw_bytes(members: list[PoseGraphAgent]) -> int:
    """What it takes to send every robot's graph once to every other robot, each closure from one end."""
    total = 0
    for agent in members:
        part = agent.part
        closures = sum(len(held) for peer, held in part.closures.items() if part.name < peer)
        share = RAW_FACTOR_BYTES * (len(part.odometry) + len(part.loops) + closures)
        total += share + HEADER_BYTES * -(-share // MAX_PAYLOAD_BYTES)
    return total * (len(members) - 1)


# --- the result


def _summary(
    graph: TeamGraph,
    path: Path,
    config: PoseGraphConfig,
    components: list[dict[str, Any]],
    *,
    agents: dict[str, PoseGraphAgent],
    traffic: Traffic,
    rounds: int,
    seconds: float,
) -> dict[str, Any]:
    """The whole team: sums over the components, and the slowest of them."""

    together = [c for c in components if len(c["robots"]) > 1]

    def total(name: str) -> Any:
        return sum(c[name] for c in components)

    def last(name: str, gap: str) -> int | None:
        values = [c[name][gap] for c in together]
        return None if None in values else max(values)

    optimum = total("optimum")
    return {
        "path": str(path),
        "robots": len(graph.robots),
        "solver": config.solver,
        "robust": "gnc" if config.consensus.robust else "none",
        "loss": config.loss_probability,
        "seed": config.seed,
        "keyframes": total("keyframes"),
        "factors": total("factors"),
        "closures": total("closures"),
        "cost": total("cost"),
        "inlier_cost": total("inlier_cost"),
        "optimum": optimum,
        "optimum_converged": all(c["optimum_converged"] for c in components),
        "gap": _gap(total("cost"), optimum, total("factors")),
        "rounds": max((c["rounds"] for c in components), default=0),
        "rounds_setup": max((c["rounds_setup"] for c in components), default=0),
        "bytes": traffic.bytes,
        "bytes_setup": total("bytes_setup"),
        "packets": traffic.packets,
        "packets_lost": traffic.lost,
        "rounds_to": {gap: last("rounds_to", gap) if together else 0 for gap in GAPS},
        "bytes_to": {
            gap: last("bytes_to", gap) if len(together) == 1 else _sum(together, gap) for gap in GAPS
        },
        "bytes_raw_alternative": total("bytes_raw_alternative"),
        "converged": all(agent.done for agent in agents.values()),
        "packets_refused": sum(sum(agent.refused.values()) for agent in agents.values()),
        "seconds": round(seconds, 3),
        "robot_ms_per_round": round(1e3 * seconds / (rounds * len(agents)), 3),
        "reference": graph.reference,
        "ignored_files": list(graph.ignored),
        "components": components,
    }


def _sum(components: list[dict[str, Any]], gap: str) -> int | None:
    values = [c["bytes_to"][gap] for c in components]
    return None if None in values else sum(values)
