"""Rigid motions T_a_b as float64 matrices [..., 4, 4]; tangents (translation m, rotation rad), on the right."""

import numpy as np
from numpy.typing import ArrayLike

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import so3


def from_rotation_translation(R: ArrayLike, t: ArrayLike) -> Array:
    """Matrix [..., 4, 4] of a rotation and a translation.

    Args:
        R: rotation [..., 3, 3].
        t: translation [..., 3].
    """
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def from_quat_translation(quat_wxyz: ArrayLike, t: ArrayLike) -> Array:
    """Matrix [..., 4, 4] of a quaternion and a translation.

    Args:
        quat_wxyz: [..., 4].
        t: translation [..., 3].
    """
    return from_rotation_translation(so3.from_quat_wxyz(quat_wxyz), t)


def inverse(T: ArrayLike) -> Array:
    """Inverse [..., 4, 4]: T_b_a of T_a_b.

    Args:
        T: [..., 4, 4], T_a_b.
    """
    T = np.asarray(T, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_rotation_translation(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def transform(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Points of frame b in frame a, [..., n, 3].

    Args:
        T_a_b: [..., 4, 4].
        points_b: [..., n, 3].
    """
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.asarray(points_b) @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def _left_jacobian(w: Array) -> Array:
    """V(w) [..., 3, 3] with exp((v, w)) = (exp(w), V(w) v)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < so3.SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    # 1 - cos as 2 sin^2(half): the difference loses half its digits below 1e-3 rad
    a = np.where(small, 0.5 - angle**2 / 24, 2 * np.sin(safe / 2) ** 2 / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    W = so3.hat(w)
    return np.eye(3) + a * W + b * (W @ W)


def exp(xi: ArrayLike) -> Array:
    """Motion [..., 4, 4] of a tangent.

    Args:
        xi: [..., 6], translation and rotation.
    """
    xi = np.asarray(xi, dtype=np.float64)
    v, w = xi[..., :3], xi[..., 3:]
    return from_rotation_translation(so3.exp(w), (_left_jacobian(w) @ v[..., None])[..., 0])


def log(T: ArrayLike) -> Array:
    """Tangent [..., 6] (translation, rotation) of a motion.

    Args:
        T: [..., 4, 4].
    """
    T = np.asarray(T, dtype=np.float64)
    w = so3.log(T[..., :3, :3])
    v = np.linalg.solve(_left_jacobian(w), T[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], axis=-1)


def adjoint(T: ArrayLike) -> Array:
    """Ad(T) [..., 6, 6] in (translation, rotation) order: T exp(xi) T^-1 = exp(Ad(T) xi).

    Args:
        T: [..., 4, 4].
    """
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = so3.hat(T[..., :3, 3]) @ R
    return out


def inverse_information(T_a_b: Array, information: Array) -> Array:
    """Information [6, 6] of the inverse motion T_b_a in its right tangent: inverse(T exp(x)) = T^-1 exp(-Ad(T) x).

    Args:
        T_a_b: [4, 4].
        information: [6, 6] of the right tangent of T_a_b.
    """
    adjoint_inverse = adjoint(inverse(T_a_b))
    out = adjoint_inverse.T @ information @ adjoint_inverse
    return 0.5 * (out + out.T)


def distance(T_a: ArrayLike, T_b: ArrayLike) -> tuple[Array, Array]:
    """Translation (m) and rotation (rad) between two motions, [...] each.

    Args:
        T_a: [..., 4, 4].
        T_b: [..., 4, 4].
    """
    D = inverse(T_a) @ np.asarray(T_b, dtype=np.float64)
    return np.linalg.norm(D[..., :3, 3], axis=-1), np.linalg.norm(so3.log(D[..., :3, :3]), axis=-1)
