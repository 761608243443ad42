"""Laws of the Log-Euclidean chart."""

import numpy as np
from scipy.linalg import logm

from duagc.pipeline.geometry import so3, spd


def test_chart_is_an_isometry_and_rotates() -> None:
    rng = np.random.default_rng(0)
    S = rng.normal(size=(10, 3, 3))
    S = S + np.swapaxes(S, 1, 2)
    R = so3.exp(rng.normal(size=(10, 3)))
    v = spd.sym_to_vec(S)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), np.linalg.norm(S, axis=(1, 2)))
    np.testing.assert_allclose(spd.vec_to_sym(v), S)
    rotated = R @ S @ np.swapaxes(R, 1, 2)
    np.testing.assert_allclose(
        (spd.sym_rotation(R) @ v[..., None])[..., 0], spd.sym_to_vec(rotated), atol=1e-12
    )


def test_log_covariance_is_the_matrix_logarithm() -> None:
    rng = np.random.default_rng(1)
    q, s = rng.normal(size=4), rng.normal(-3, 1, 3)
    R = so3.from_quat_wxyz(q)
    covariance = R @ np.diag(np.exp(2 * s)) @ R.T
    np.testing.assert_allclose(spd.vec_to_sym(spd.log_covariance(q, s)), logm(covariance), atol=1e-9)


def test_scales_and_rotation_come_back() -> None:
    rng = np.random.default_rng(2)
    q, s = rng.normal(size=(50, 4)), rng.normal(-3, 1, (50, 3))
    s[:5, 1] = s[:5, 0]  # discs
    s[5:8] = s[5:8, :1]  # spheres
    quats, scales = spd.from_log_covariance(spd.log_covariance(q, s))
    np.testing.assert_allclose(scales, -np.sort(-s, axis=1), atol=1e-12)
    np.testing.assert_allclose(spd.log_covariance(quats, scales), spd.log_covariance(q, s), atol=1e-10)
