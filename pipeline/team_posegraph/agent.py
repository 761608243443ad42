"""The agent of a robot whose loop closures are known: the agent of a run, without images and maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig, TransportConfig
from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.exchange.agent import Agent
from duagc.pipeline.exchange.elimination_solver import EliminationSolver
from duagc.pipeline.exchange.known_loop_closures import KnownLoopClosures, KnownPair
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.pose_solver import LinkStart, PoseSolver, SolverStart
from duagc.pipeline.exchange.shared_data import NoSharing
from duagc.pipeline.posegraph.files import RobotGraph
from duagc.pipeline.posegraph.initialization import own_start
from duagc.pipeline.posegraph.loop_closures import drift
from duagc.pipeline.team_posegraph.printed_admm import PrintedAdmmSolver

_NEVER = 1 << 30
_UNLIMITED_BYTES = 1 << 40  # what a solver sends is counted, not held back


def exchange_config(config: PoseGraphConfig) -> ExchangeConfig:
    """The settings of a run on a pose graph as those of a session.

    Args:
        config: solver, losses and settings of the consensus.

    Returns:
        Settings with links of no latency, no limit of bytes, and no contact that is given up.
    """
    consensus, solver = config.consensus, config.solver
    if solver == "elimination":
        consensus = consensus.model_copy(update={"tolerance": config.elimination_tolerance})
    return ExchangeConfig(
        max_rounds=config.max_rounds,
        solver="elimination" if solver == "elimination" else "admm",
        elimination_wire=config.elimination_wire,
        link=LinkConfig(
            loss_probability=config.loss_probability, latency_ns=0, budget_bytes=_UNLIMITED_BYTES
        ),
        transport=TransportConfig(contact_lost_after_rounds=_NEVER, silent_after_rounds=_NEVER),
        consensus=consensus,
    )


class PoseGraphAgent(Agent):
    """Has its part of a pose graph, and shares nothing but poses.

    Attributes:
        part: its part of the pose graph.
    """

    def __init__(self, part: RobotGraph, team: Sequence[str], config: PoseGraphConfig) -> None:
        """Solve the own graph in the own frame.

        Args:
            part: what this robot measured.
            team: names of all robots that may exist.
            config: the same at all robots.
        """
        self.part = part
        own = _own_graph(part, config.consensus)
        exact, printed = config.solver == "elimination", config.solver == "paper"
        source = KnownLoopClosures(
            own,
            part.closures,
            config.consensus,
            precision="float64" if exact else "float32",
            held_by_both=printed,
        )

        def print_solver(start: SolverStart) -> PoseSolver:
            return PrintedAdmmSolver(start, config)

        super().__init__(
            own,
            team,
            sorted(part.closures),
            exchange_config(config),
            seed=config.seed,
            loop_closing=source,
            sharing=NoSharing(sorted(team).index(part.name), len(team)),
            solver=print_solver if printed else None,
        )

    @property
    def exchanges(self) -> int | None:
        """Exchanges along the tree of robots so far; None with another solver."""
        return self.poses.node.exchange if isinstance(self.poses, EliminationSolver) else None

    def kept(self) -> tuple[Array, dict[str, Array]]:
        """Robust weights of own loops, and of loop closures that this robot holds, by neighbor.

        Before the solver starts, there are only the loops that the robot itself kept.
        """
        if self.poses is None:
            return self.graph.keep_loops.astype(np.float64), {}
        held = {link.name: self._kept_of(link) for link in self.links.values() if len(link.closures)}
        revoked = {n.name: np.zeros(len(n.link.weights)) for n in self.neighbors.values() if n.link.weights}
        return self.poses.loop_weights, held | revoked

    def _kept_of(self, link: LinkStart) -> Array:
        """Weights of all loop closures of a pair; zero for those that the solver did not get."""
        assert self.poses is not None
        pair = self.neighbors[link.index].loop_closing
        assert isinstance(pair, KnownPair)
        weights = np.zeros(len(pair.closures))
        weights[pair.in_solver] = self.poses.weights(link.name)
        return weights


def _own_graph(part: RobotGraph, config: PoseConsensusConfig) -> OwnGraph:
    """A robot's optimum before it has met any other, in its own frame."""
    T_map_keyframe, keep_loops = own_start(part.odometry, part.loops, part.keyframes, config)
    grown = drift(part.odometry, part.keyframes, config.closures)
    return OwnGraph(part.name, T_map_keyframe, part.odometry, grown, part.loops, keep_loops)
