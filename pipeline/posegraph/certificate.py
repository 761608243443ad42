"""Whether a minimum of a pose graph is the global one, by the dual of its semidefinite relaxation.

With Y = [R_1 .. R_n, t_1 .. t_n], 3 x 4n, the cost is tr(Y M Y') for a sparse M. At a stationary point the multipliers
of R_i' R_i = I are L_i = sym(R_i' (Y M)_i), and S = M - diag(L_1 .. L_n, 0) has the rows of Y and a common shift of all
t_i in its kernel. If S has no negative eigenvalue, no other point has a lower cost. Source: Rosen, Carlone, Bandeira,
Leonard, "SE-Sync", 2019, theorem 7.

The eigenvalues are counted, not computed: S - shift has as many negative ones as negative pivots. If there are four,
they are those of the known kernel, and all others are above the shift.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.relative_poses import RelativePoses

_KERNEL = 4  # three rows of Y, and the common shift
_SHIFT, _RESIDUAL = 1e-9, 1e-10  # of the largest entry of M


def is_global_minimum(factors: RelativePoses, T: Array) -> bool:
    """Whether poses at a minimum of the unweighted cost have the least cost of all; False: not known.

    Args:
        factors: isotropic relative poses (`isotropic_information`); the graph must be connected.
        T: [n, 4, 4], the minimum, converged.
    """
    n, M = len(T), _data_matrix(factors, len(T))
    Y = np.concatenate([np.concatenate(list(T[:, :3, :3]), axis=1), T[:, :3, 3].T], axis=1)
    pulled = np.asarray((M @ Y.T).T)
    own = np.swapaxes(T[:, :3, :3], -1, -2) @ pulled[:, : 3 * n].reshape(3, n, 3).swapaxes(0, 1)
    multipliers = sparse.block_diag([*(0.5 * (own + np.swapaxes(own, -1, -2))), sparse.csc_matrix((n, n))])
    S = (M - multipliers).tocsc()
    scale = float(np.abs(M.diagonal()).max())
    if float(np.abs(S @ Y.T).max()) > _RESIDUAL * scale * max(1.0, float(np.abs(Y).max())):
        return False  # not stationary
    shifted = (S - _SHIFT * scale * sparse.identity(4 * n)).tocsc()
    try:
        lu = least_squares.decomposed(shifted, **least_squares.SYMMETRIC)
    except DuagError:
        return False
    symmetric = np.array_equal(lu.perm_r, lu.perm_c)  # else the pivots do not count eigenvalues
    return bool(symmetric and np.count_nonzero(lu.U.diagonal() < 0) == _KERNEL)


def _data_matrix(factors: RelativePoses, n: int) -> sparse.csc_matrix:
    """M [4 n, 4 n]: rotations first, three rows each, then translations."""
    m = len(factors)
    R, t = factors.T_i_j[:, :3, :3], factors.T_i_j[:, :3, 3]
    root_kappa = np.sqrt(factors.information[:, 3, 3] / 2)
    root_tau = np.sqrt(factors.information[:, 0, 0])
    rows, columns, values = [], [], []
    for a in range(3):  # column a of Rj - Ri Rij
        e = 3 * np.arange(m) + a
        rows += [e] * 4
        columns += [3 * factors.j + a, *(3 * factors.i + b for b in range(3))]
        values += [root_kappa, *(-root_kappa * R[:, b, a] for b in range(3))]
    e = 3 * m + np.arange(m)  # tj - ti - Ri tij
    rows += [e] * 5
    columns += [3 * n + factors.j, 3 * n + factors.i, *(3 * factors.i + b for b in range(3))]
    values += [root_tau, -root_tau, *(-root_tau * t[:, b] for b in range(3))]
    index = (np.concatenate(rows), np.concatenate(columns))
    A = sparse.csr_matrix((np.concatenate(values), index), shape=(4 * m, 4 * n))
    return (A.T @ A).tocsc()
