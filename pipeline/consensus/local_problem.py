"""What one robot minimizes in a round: its own cost, with the pull of its links; one Gauss-Newton step of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import AdmmEdge
from duagc.pipeline.geometry.spd import add_covariance
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.relative_poses import RelativePoses


class LocalProblem:
    """f(x) + 1/2 sum over links |x - y|_W^2, with a factorization that is kept until the poses have turned.

    Attributes:
        factorizations: how many there were.
    """

    def __init__(self, factors: RelativePoses, config: PoseConsensusConfig) -> None:
        """Give every factor the weight 1, until `weigh` is called; nothing is factorized yet.

        Args:
            factors: between the robot's variables.
            config: the same at all robots.
        """
        self._factors, self._config = factors, config
        self._counted, self._weights = factors, np.ones(len(factors))
        self._solve: Callable[[Array], Array] | None = None
        self._moved_rad = 0.0
        self.factorizations = 0

    def extend(self, parts: Sequence[RelativePoses]) -> None:
        """Add factors after those that are there; all weights must follow.

        Args:
            parts: between the robot's variables.
        """
        self._factors = RelativePoses.concatenate([self._factors, *parts])

    def weigh(self, weights: Array) -> None:
        """Weigh the factors.

        Args:
            weights: one of every factor.
        """
        counts = weights != 0.0  # the others would only fill the factorization
        everything = bool(counts.all()) or not self._config.team_schedule().drop_idle
        self._counted = self._factors if everything else self._factors.select(counts)
        self._weights = weights if everything else weights[counts]
        self._solve = None

    def refactorize(self) -> None:
        """Factorize before the next step: penalties have changed."""
        self._solve = None

    def cost(self, x: Array) -> float:
        """f(x), weighted.

        Args:
            x: [n, 4, 4], all variables.
        """
        return least_squares.cost(self._counted, x, self._weights)

    def newton_step(self, x: Array, links: Sequence[AdmmEdge], forces: Sequence[Array]) -> Array:
        """Tangents [n, 6] of one Gauss-Newton step, shortened to the largest turn that is allowed.

        Args:
            x: [n, 4, 4], all variables.
            links: of the robot.
            forces: `AdmmEdge.force` of each.
        """
        g, jacobians = least_squares.gradient(self._counted, self._weights, x)
        for link, force in zip(links, forces, strict=True):
            g[link.slots] += force
        if self._solve is None or self._moved_rad > self._config.relinearize_rad:
            diagonal = np.zeros_like(g)
            for link in links:
                diagonal[link.slots] += link.penalty()
            stiffest = diagonal.max() or max(float(link.metric.max()) for link in links)
            diagonal += 1e-9 * stiffest  # a variable without any factor stays where it is
            H = least_squares.curvature_matrix(self._counted, jacobians, diagonal)
            self._solve, self._moved_rad = least_squares.factorized(H), 0.0
            self.factorizations += 1
        delta = -self._solve(g.ravel()).reshape(-1, 6)
        turn_rad = float(np.linalg.norm(delta[:, 3:], axis=1).max())
        if turn_rad > self._config.step_limit_rad:
            delta *= self._config.step_limit_rad / turn_rad
        self._moved_rad += float(np.abs(delta[:, 3:]).max())
        return delta


def with_floor(odometry: RelativePoses, config: PoseConsensusConfig) -> RelativePoses:
    """Odometry as the objective uses it: its covariance plus the floor of the settings.

    Args:
        odometry: factors between keyframes of one robot.
        config: the floor, m and rad.
    """
    floor = np.repeat([config.odometry_floor_m**2, config.odometry_floor_rad**2], 3) * np.eye(6)
    return RelativePoses(odometry.i, odometry.j, odometry.T_i_j, add_covariance(odometry.information, floor))
