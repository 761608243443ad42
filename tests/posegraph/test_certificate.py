"""The certificate holds at the optimum, and not at other minima or points."""

import numpy as np
import pytest
import scipy.sparse.linalg

from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.certificate import is_global_minimum
from duagc.pipeline.posegraph.initialization import chordal
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import RelativePoses, isotropic_information
from tests.fixtures.pose_graphs import KAPPA, TAU, helix_edges


def graph(rows):
    i, j, T = (np.array(column) for column in zip(*rows, strict=True))
    return RelativePoses(i, j, T, isotropic_information(np.full(len(i), KAPPA), np.full(len(i), TAU)))


def test_the_optimum_is_certified_in_every_frame():
    factors = graph(helix_edges(40))
    found = solve_pose_graph(factors, chordal(factors, 40))
    assert is_global_minimum(factors, found.poses)
    assert is_global_minimum(factors, se3.exp([5.0, -3, 2, 0.5, 1, -2]) @ found.poses)


def test_a_point_that_is_no_minimum_is_not_certified():
    factors = graph(helix_edges(40))
    assert not is_global_minimum(factors, chordal(factors, 40))


def test_numbers_that_nobody_can_solve_for_are_not_certified(monkeypatch):
    factors = graph(helix_edges(40))
    found = solve_pose_graph(factors, chordal(factors, 40))

    def singular(*_, **__):
        raise RuntimeError("Factor is exactly singular")

    monkeypatch.setattr(scipy.sparse.linalg, "splu", singular)
    assert not is_global_minimum(factors, found.poses)


@pytest.mark.parametrize(("turns", "certified"), [(0, True), (1, False)])
def test_a_local_minimum_is_not_certified(turns, certified):
    """A ring of identities that is wound once around itself."""
    n = 12
    ring = np.arange(n)
    information = isotropic_information(np.full(n, 10.0), np.ones(n))
    factors = RelativePoses(ring, (ring + 1) % n, np.tile(np.eye(4), (n, 1, 1)), information)
    w = np.outer(2 * np.pi * turns * ring / n, [0, 0, 1.0])
    found = solve_pose_graph(factors, se3.from_rotation_translation(so3.exp(w), np.zeros((n, 3))))
    assert found.converged
    assert is_global_minimum(factors, found.poses) == certified
