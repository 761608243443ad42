"""Cost of a pose graph and its derivatives, on the product group SO(3) x R^3.

A pose x = (R, t) is a matrix T_world_keyframe [4, 4]. Its tangent is (translation v in the world frame, rotation w in
the keyframe's own frame):

    x (+) (v, w) = (R Exp(w), t + v)            x (-) y = (tx - ty, Log(Ry' Rx))

Not SE(3): here x (-) y = -(y (-) x) exactly, which the fixed point of the pose consensus needs (a penalty on the SE(3)
logarithm is not antisymmetric under unequal weights, and moves it). The front end refines its own keyframes in the
right tangent of SE(3) (`frontend.keyframe_graph`): there it needs the marginal covariances in that tangent, which is
the one of the registrations, and Huber weights on the whole residual. The two minimize different costs.

A measurement is T_i_j with information in the right tangent (translation, rotation) of T_i_j. With q the quaternion of
the rotation error Rij' Ri' Rj, its residual before whitening is

    e = [ Ri' (tj - ti) - tij      (m, frame i)
          2 q_vec                   (rad for small errors, frame j) ]

and |r|^2 = e' W e. With W = diag(tau, tau, tau, 2 kappa, 2 kappa, 2 kappa) this is exactly the term
kappa |Rj - Ri Rij|_F^2 + tau |tj - ti - Ri tij|^2 of SE-Sync, because |Rj - Ri Rij|_F^2 = 8 |q_vec|^2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.relative_poses import RelativePoses

SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}
"""Options of `decomposed` that pivot on the diagonal."""


def retract(T: Array, delta: Array) -> Array:
    """x (+) delta: poses [n, 4, 4] moved by tangents [n, 6] (translation, rotation) of the product group.

    Args:
        T: [n, 4, 4], T_world_keyframe, meters.
        delta: [n, 6], translation in the world frame (m), rotation in the keyframe's own frame (rad).
    """
    return se3.from_rotation_translation(
        T[..., :3, :3] @ so3.exp(delta[..., 3:]), T[..., :3, 3] + delta[..., :3]
    )


def difference(T: Array, T_base: Array) -> Array:
    """x (-) y: tangents [n, 6] (translation, rotation) from T_base to T on the product group.

    Args:
        T: [n, 4, 4], T_world_keyframe, meters.
        T_base: [n, 4, 4], likewise; the rotation is in its frame.
    """
    rotation = so3.log(np.swapaxes(T_base[..., :3, :3], -1, -2) @ T[..., :3, :3])
    return np.concatenate([T[..., :3, 3] - T_base[..., :3, 3], rotation], axis=-1)


def _errors(factors: RelativePoses, T: Array) -> tuple[Array, Array, Array]:
    """e [m, 6] before whitening, the scalar part of its quaternion [m], and Ri' (tj - ti) [m, 3]."""
    Ri, Rj = T[factors.i, :3, :3], T[factors.j, :3, :3]
    Ri_t = np.swapaxes(Ri, -1, -2)
    baseline = (Ri_t @ (T[factors.j, :3, 3] - T[factors.i, :3, 3])[..., None])[..., 0]
    quat = so3.to_quat_wxyz(np.swapaxes(factors.T_i_j[:, :3, :3], -1, -2) @ Ri_t @ Rj)
    return np.concatenate([baseline - factors.T_i_j[:, :3, 3], 2 * quat[:, 1:]], axis=1), quat[:, 0], baseline


def errors(factors: RelativePoses, T: Array) -> Array:
    """Errors e [m, 6] before whitening: meters, and twice the vector part of a quaternion.

    Args:
        factors: m relative poses between the n variables.
        T: [n, 4, 4], T_world_keyframe of the variables, meters.
    """
    return _errors(factors, T)[0]


def residuals(factors: RelativePoses, T: Array) -> Array:
    """Whitened residuals r [m, 6], no unit.

    Args:
        factors: m relative poses between the n variables.
        T: [n, 4, 4], T_world_keyframe of the variables, meters.
    """
    return (factors.whitening @ _errors(factors, T)[0][..., None])[..., 0]


def squared_residuals(factors: RelativePoses, T: Array) -> Array:
    """|r|^2 [m] of every factor.

    Args:
        factors: m relative poses between the n variables.
        T: [n, 4, 4], T_world_keyframe of the variables, meters.
    """
    return np.sum(residuals(factors, T) ** 2, axis=1)


def cost(factors: RelativePoses, T: Array, weights: ArrayLike = 1.0) -> float:
    """Sum of weight |r|^2 (SE-Sync's F for isotropic information).

    Args:
        factors: m relative poses between the n variables.
        T: [n, 4, 4], T_world_keyframe of the variables, meters.
        weights: [m], or one for all.
    """
    return float(np.sum(np.asarray(weights) * squared_residuals(factors, T)))


def linearized(factors: RelativePoses, T: Array) -> tuple[Array, Array, Array]:
    """Residuals [m, 6] and their derivatives [m, 6, 6] by the product-group tangents of poses i and j.

    Args:
        factors: m relative poses between the n variables.
        T: [n, 4, 4], T_world_keyframe of the variables, meters.

    Returns:
        Whitened residuals r [m, 6], dr/dxi [m, 6, 6] and dr/dxj [m, 6, 6], 1/m and 1/rad.
    """
    e, qw, baseline = _errors(factors, T)
    Ri_t = np.swapaxes(T[factors.i, :3, :3], -1, -2)
    q_hat = so3.hat(0.5 * e[:, 3:])
    q_eye = qw[:, None, None] * np.eye(3)
    Ji, Jj = np.zeros((len(factors), 6, 6)), np.zeros((len(factors), 6, 6))
    Ji[:, :3, :3], Jj[:, :3, :3] = -Ri_t, Ri_t
    Ji[:, :3, 3:] = so3.hat(baseline)
    Ji[:, 3:, 3:] = -(q_eye - q_hat) @ np.swapaxes(factors.T_i_j[:, :3, :3], -1, -2)
    Jj[:, 3:, 3:] = q_eye + q_hat
    A = factors.whitening
    return (A @ e[..., None])[..., 0], A @ Ji, A @ Jj


def gradient(factors: RelativePoses, weights: Array, T: Array) -> tuple[Array, tuple[Array, Array]]:
    """Half the gradient J' r [n, 6] of the weighted cost, and the weighted Jacobians for `curvature_matrix`.

    Args:
        factors: m relative poses between the n variables.
        weights: [m], one per relative pose.
        T: [n, 4, 4], T_world_keyframe of the variables, meters.
    """
    r, Ji, Jj = linearized(factors, T)
    root = np.sqrt(weights)
    r, Ji, Jj = r * root[:, None], Ji * root[:, None, None], Jj * root[:, None, None]
    g = np.zeros((len(T), 6))
    np.add.at(g, factors.i, (np.swapaxes(Ji, -1, -2) @ r[..., None])[..., 0])
    np.add.at(g, factors.j, (np.swapaxes(Jj, -1, -2) @ r[..., None])[..., 0])
    return g, (Ji, Jj)


def curvature_matrix(
    factors: RelativePoses, jacobians: tuple[Array, Array], diagonal: Array
) -> sparse.csc_matrix:
    """Gauss-Newton matrix J' J + diag(diagonal), sparse [6 n, 6 n].

    Args:
        factors: m relative poses between the n variables.
        jacobians: [m, 6, 6] by pose i and by pose j, weighted, from `gradient`.
        diagonal: [n, 6], added to that of J' J, 1/m^2 and 1/rad^2.
    """
    Ji, Jj = jacobians
    Ji_t, Jj_t = np.swapaxes(Ji, -1, -2), np.swapaxes(Jj, -1, -2)
    off = Ji_t @ Jj
    lanes = np.arange(6)
    rows, columns, values = [], [], []
    for a, b, block in (
        (factors.i, factors.i, Ji_t @ Ji),
        (factors.j, factors.j, Jj_t @ Jj),
        (factors.i, factors.j, off),
        (factors.j, factors.i, np.swapaxes(off, -1, -2)),
    ):
        rows.append(np.broadcast_to(6 * a[:, None, None] + lanes[:, None], block.shape).ravel())
        columns.append(np.broadcast_to(6 * b[:, None, None] + lanes, block.shape).ravel())
        values.append(block.ravel())
    size = diagonal.size
    rows.append(np.arange(size))
    columns.append(np.arange(size))
    values.append(diagonal.ravel())
    coordinates = (np.concatenate(rows), np.concatenate(columns))
    return sparse.coo_matrix((np.concatenate(values), coordinates), shape=(size, size)).tocsc()


def factorized(H: sparse.csc_matrix) -> Callable[[Array], Array]:
    """Solver of H x = b for a symmetric positive definite sparse H.

    Args:
        H: sparse [k, k].

    Returns:
        From b [k] or [k, c] to x of the same shape.

    Raises:
        DuagError: it is singular in its numbers.
    """
    return decomposed(H, **SYMMETRIC).solve


def decomposed(H: sparse.csc_matrix, **options: Any) -> sparse_linalg.SuperLU:
    """Factors of a sparse matrix.

    Args:
        H: square.
        options: of `scipy.sparse.linalg.splu`.
    Raises:
        DuagError: it is singular in its numbers.
    """
    try:
        return sparse_linalg.splu(H, **options)
    except RuntimeError as error:
        raise DuagError(
            f"pose graph: {error}: its numbers cannot be solved for, expected measurements of like size"
        ) from error
