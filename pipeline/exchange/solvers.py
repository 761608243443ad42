"""The solver of the poses that the settings name."""

from __future__ import annotations

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.admm_solver import AdmmSolver
from duagc.pipeline.exchange.algorithm_1 import Algorithm1Solver
from duagc.pipeline.exchange.block_descent import BlockDescentSolver
from duagc.pipeline.exchange.elected import ElectedSolver
from duagc.pipeline.exchange.elimination_solver import EliminationSolver
from duagc.pipeline.exchange.pose_solver import PoseSolver, SolverFactory, SolverStart


def solver_of(config: ExchangeConfig, team: int, seed: int = 0) -> SolverFactory:
    """How a solver is made by the settings.

    Args:
        config: the same at all robots.
        team: number of robots.
        seed: of faults made on purpose.
    """

    def make(start: SolverStart) -> PoseSolver:
        if config.solver == "admm":
            return AdmmSolver(start, config.consensus, config.injection, seed=seed)
        if config.solver == "elected":
            return ElectedSolver(start, config.consensus, team)
        if config.solver == "block_descent":
            return BlockDescentSolver(start, config.consensus)
        if config.solver != "elimination":
            printed = config.solver == "algorithm_1_printed"
            return Algorithm1Solver(start, config.consensus, config.algorithm_1_penalty if printed else None)
        return EliminationSolver(start, config.consensus, team, config.elimination_wire)

    return make
