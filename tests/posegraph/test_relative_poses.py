"""Relative-pose factors: derivatives, the product group, identity with SE-Sync's cost, benchmark optimum."""

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.spd import add_covariance
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.initialization import chordal
from duagc.pipeline.posegraph.least_squares import difference, retract
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import RelativePoses, isotropic_information
from tests.fixtures.pose_worlds import benchmark, random_information, random_poses


def scattered(seed, n=6, m=9):
    """Factors between random poses, far from satisfied."""
    rng = np.random.default_rng(seed)
    i = rng.integers(n, size=m)
    j = (i + rng.integers(1, n, size=m)) % n
    poses = random_poses(rng, n)
    T = se3.inverse(poses[i]) @ poses[j] @ se3.exp(0.4 * rng.normal(size=(m, 6)))
    return RelativePoses(i, j, T, random_information(rng, m)), poses


def test_derivatives_match_finite_differences():
    factors, poses = scattered(0)
    _, Ji, Jj = least_squares.linearized(factors, poses)
    h = 1e-6  # central differences: error h^2 and 1e-16 / h, relative to residuals of about 1e2
    for k in range(6):
        for J, ends in ((Ji, factors.i), (Jj, factors.j)):
            for f in range(len(factors)):
                step = np.zeros((len(poses), 6))
                step[ends[f], k] = h
                plus = least_squares.residuals(factors, retract(poses, step))[f]
                minus = least_squares.residuals(factors, retract(poses, -step))[f]
                np.testing.assert_allclose((plus - minus) / (2 * h), J[f, :, k], atol=1e-5)


def test_difference_undoes_retract_and_is_antisymmetric():
    rng = np.random.default_rng(1)
    poses, delta = random_poses(rng, 50), rng.normal(size=(50, 6))
    np.testing.assert_allclose(difference(retract(poses, delta), poses), delta, atol=1e-12)
    other = random_poses(rng, 50)
    np.testing.assert_allclose(difference(poses, other), -difference(other, poses), atol=1e-12)


def test_isotropic_factors_are_the_se_sync_cost():
    factors, poses = scattered(2)
    rng = np.random.default_rng(3)
    kappa, tau = rng.uniform(1, 1e3, len(factors)), rng.uniform(1, 1e3, len(factors))
    factors = RelativePoses(factors.i, factors.j, factors.T_i_j, isotropic_information(kappa, tau))
    Ri, Rj = poses[factors.i, :3, :3], poses[factors.j, :3, :3]
    ti, tj = poses[factors.i, :3, 3], poses[factors.j, :3, 3]
    rotation = np.sum((Rj - Ri @ factors.T_i_j[:, :3, :3]) ** 2, axis=(1, 2))
    translation = np.sum((tj - ti - (Ri @ factors.T_i_j[:, :3, 3:])[..., 0]) ** 2, axis=1)
    expected = kappa * rotation + tau * translation
    np.testing.assert_allclose(least_squares.squared_residuals(factors, poses), expected, rtol=1e-12)


def test_small_error_costs_its_mahalanobis_distance():
    """|r|^2 is xi' W xi for T_i_j wrong by a small right tangent xi, correlations included."""
    rng = np.random.default_rng(4)
    poses, information = random_poses(rng, 2), random_information(rng, 1)
    xi = 1e-5 * rng.normal(size=6)
    wrong = se3.inverse(poses[0]) @ poses[1] @ se3.exp(-xi)
    factors = RelativePoses([0], [1], wrong[None], information)
    np.testing.assert_allclose(
        least_squares.cost(factors, poses), xi @ information[0] @ xi, rtol=1e-4
    )  # third order in xi


def test_inflation_equals_its_formula_and_keeps_ignorance():
    rng = np.random.default_rng(5)
    W, C = random_information(rng, 3), random_information(rng, 3) / 1e6
    np.testing.assert_allclose(
        add_covariance(W, C), np.linalg.inv(np.linalg.inv(W) + C), rtol=1e-9, atol=1e-9 * W.max()
    )
    blind = np.eye(6) - np.outer(np.eye(6)[2], np.eye(6)[2])
    np.testing.assert_allclose(add_covariance(blind @ W @ blind, C)[:, 2], 0, atol=1e-12 * W.max())
    np.testing.assert_array_equal(add_covariance(np.zeros((6, 6)), C), 0)
    np.testing.assert_array_equal(add_covariance(W, np.zeros((6, 6))), 0.5 * (W + W.swapaxes(-1, -2)))


def test_negative_information_is_refused():
    with pytest.raises(ValueError, match="semidefinite"):
        RelativePoses([0], [1], np.eye(4)[None], -np.eye(6)[None])


def test_gauge_does_not_change_the_cost():
    factors, poses = scattered(6)
    T = random_poses(np.random.default_rng(7), 1, 10.0)[0]
    np.testing.assert_allclose(
        least_squares.squared_residuals(factors, T @ poses),
        least_squares.squared_residuals(factors, poses),
        rtol=1e-9,
    )


@pytest.mark.parametrize(
    ("name", "optimum"), [("tinyGrid3D.g2o", 18.51936642), ("smallGrid3D.g2o", 1025.398056)]
)
def test_central_solution_is_the_certified_optimum(name, optimum):
    (factors,) = benchmark(name, 1).odometry.values()
    n = int(max(factors.i.max(), factors.j.max())) + 1
    solution = solve_pose_graph(factors, chordal(factors, n))
    assert solution.converged
    np.testing.assert_allclose(solution.cost, optimum, rtol=1e-9)  # digits of the published value


def test_central_solution_stands_still_where_every_gradient_vanishes():
    factors, poses = scattered(8)
    consistent = RelativePoses(
        factors.i, factors.j, se3.inverse(poses[factors.i]) @ poses[factors.j], factors.information
    )
    start = retract(poses, 0.05 * np.random.default_rng(9).normal(size=(len(poses), 6)))
    solution = solve_pose_graph(consistent, start)
    assert solution.cost < 1e-15
    g, _ = least_squares.gradient(consistent, np.ones(len(consistent)), solution.poses)
    assert np.abs(g).max() < 1e-6


def test_central_solution_names_the_number_that_is_not_finite():
    factors, poses = scattered(10)
    broken, measured, weights = poses.copy(), factors.T_i_j.copy(), np.ones(len(factors))
    broken[2, 0, 3] = measured[3, 1, 3] = weights[4] = np.nan
    with pytest.raises(DuagError, match="start 2 is not finite"):
        solve_pose_graph(factors, broken)
    with pytest.raises(DuagError, match="relative pose 3 is not finite"):
        solve_pose_graph(RelativePoses(factors.i, factors.j, measured, factors.information), poses)
    with pytest.raises(DuagError, match="weight 4 is not finite"):
        solve_pose_graph(factors, poses, weights)
