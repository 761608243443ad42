"""The layouts of packed information agree with the matrices that they stand for."""

import numpy as np
import pytest

from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import (
    GEOMETRY_SIZE,
    INFORMATION_DIAGONAL,
    INFORMATION_SIZE,
    THETA_SIZE,
    gaussians_of,
    geometry_of_information,
    information_of_geometry,
    log_covariance_block,
    mean_block,
    pack_geometry,
    pack_information,
    theta_of,
    unpack_geometry,
)

N = 5


@pytest.fixture
def full() -> np.ndarray:
    """Positive definite matrices [n, 13, 13] over theta."""
    root = np.random.default_rng(0).normal(size=(N, THETA_SIZE, THETA_SIZE))
    return root @ root.swapaxes(1, 2)


def packed_of(full: np.ndarray) -> np.ndarray:
    diagonal = np.diagonal(full, axis1=1, axis2=2)
    return pack_information(full[:, :3, :3], full[:, 3:9, 3:9], diagonal[:, 9:12], diagonal[:, 12])


def test_information_holds_the_blocks_and_the_diagonal(full: np.ndarray) -> None:
    packed = packed_of(full)
    assert packed.shape == (N, INFORMATION_SIZE)
    np.testing.assert_array_equal(mean_block(packed), full[:, :3, :3])
    np.testing.assert_array_equal(log_covariance_block(packed), full[:, 3:9, 3:9])
    np.testing.assert_array_equal(packed[:, INFORMATION_DIAGONAL], np.diagonal(full, axis1=1, axis2=2))


def test_geometry_is_the_upper_triangle_of_mean_and_log_covariance(full: np.ndarray) -> None:
    geometry = pack_geometry(full[:, :9, :9])
    assert geometry.shape == (N, GEOMETRY_SIZE)
    np.testing.assert_array_equal(geometry[:, [0, 1, 9, 44]], full[:, [0, 0, 1, 8], [0, 1, 1, 8]])
    np.testing.assert_array_equal(unpack_geometry(geometry), full[:, :9, :9])


def test_information_of_geometry_drops_the_cross_terms_and_nothing_else(full: np.ndarray) -> None:
    diagonal = np.diagonal(full, axis1=1, axis2=2)
    information = information_of_geometry(pack_geometry(full[:, :9, :9]), diagonal[:, 9:12], diagonal[:, 12])
    np.testing.assert_array_equal(information, packed_of(full))
    back = unpack_geometry(geometry_of_information(information))
    assert not back[:, :3, 3:].any()
    np.testing.assert_array_equal(back[:, :3, :3], full[:, :3, :3])
    np.testing.assert_array_equal(back[:, 3:, 3:], full[:, 3:9, 3:9])


def test_gaussians_of_theta_are_the_gaussians() -> None:
    rng = np.random.default_rng(1)
    scales = np.sort(rng.uniform(-5, -3, (N, 3)), axis=1)
    gaussians = Gaussians(
        ids=np.arange(N),
        anchors=np.zeros(N, np.int32),
        means=rng.normal(size=(N, 3)),
        quats_wxyz=rng.normal(size=(N, 4)),
        log_scales=scales,
        colors=rng.uniform(size=(N, 3)),
        opacity_logits=rng.normal(size=N),
    )
    theta = theta_of(gaussians)
    back = gaussians_of(gaussians.ids, gaussians.anchors, theta)
    np.testing.assert_allclose(theta_of(back), theta, atol=1e-5)  # float32
    np.testing.assert_array_equal(back.means, gaussians.means)
    np.testing.assert_array_equal(back.opacity_logits, gaussians.opacity_logits)
