"""Laws of rotations and rigid motions."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from duagc.pipeline.geometry import se3, so3

angles = st.one_of(st.floats(-3.1, 3.1), st.floats(-1e-6, 1e-6))


@st.composite
def tangents(draw: st.DrawFn) -> np.ndarray:
    """A tangent whose rotation is shorter than pi; near zero and near pi included."""
    axis = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3)))
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-3 else np.array([1.0, 0.0, 0.0])
    angle = draw(st.one_of(st.floats(0, 3.14159), st.floats(0, 1e-7), st.floats(3.1415, 3.14159)))
    return np.concatenate([draw(st.tuples(*[st.floats(-10, 10)] * 3)), axis * angle])


@given(xi=tangents())
def test_log_undoes_exp(xi: np.ndarray) -> None:
    # 1e-8: a rotation matrix keeps about 1e-16 in its entries, and near pi the axis is read from products
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-8)


@given(xi=tangents(), eta=tangents())
def test_adjoint_moves_a_tangent_across(xi: np.ndarray, eta: np.ndarray) -> None:
    T = se3.exp(xi)
    np.testing.assert_allclose(
        T @ se3.exp(eta) @ se3.inverse(T), se3.exp(se3.adjoint(T) @ eta), atol=1e-6 * (1 + np.abs(xi).max())
    )


@given(xi=tangents())
@example(np.array([0, 0, 0, np.pi, 0, 0.0]))
@example(np.array([0, 0, 0, 0, np.pi, 0.0]))
@example(np.array([0, 0, 0, 0, 0, -np.pi]))
def test_quaternions_round_trip(xi: np.ndarray) -> None:
    R = so3.exp(xi[3:])
    q = so3.to_quat_wxyz(R)
    assert q[0] >= 0
    np.testing.assert_allclose(so3.from_quat_wxyz(q), R, atol=1e-12)


def test_batches_equal_single_motions() -> None:
    xi = np.random.default_rng(0).normal(size=(5, 6))
    np.testing.assert_array_equal(se3.exp(xi)[3], se3.exp(xi[3]))
    np.testing.assert_allclose(
        se3.inverse(se3.exp(xi)) @ se3.exp(xi), np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-13
    )


@given(xi=tangents())
@example(np.array([0, 0, 0, np.pi, 0, 0.0]))
@example(np.zeros(6))
def test_the_logarithm_of_one_rotation_has_the_bits_of_a_batch(xi: np.ndarray) -> None:
    R = so3.exp(xi[3:])
    np.testing.assert_array_equal(so3.log(R), so3.log(R[None])[0])


def test_projection_finds_the_nearest_rotation() -> None:
    rng = np.random.default_rng(1)
    R = so3.exp(rng.normal(size=3))
    noisy = R + 1e-3 * rng.normal(size=(3, 3))
    P = so3.project(noisy)
    np.testing.assert_allclose(P.T @ P, np.eye(3), atol=1e-12)
    assert np.linalg.det(P) > 0
    for _ in range(20):
        other = P @ so3.exp(1e-3 * rng.normal(size=3))
        assert np.linalg.norm(noisy - P) <= np.linalg.norm(noisy - other)
