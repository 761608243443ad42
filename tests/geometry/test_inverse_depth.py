"""Inverse depth keeps what is known, and what is not."""

import numpy as np
import pytest

from duagc.pipeline.geometry.inverse_depth import inverse_or_zero


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_unknown_depth_has_no_inverse(kind: type[np.floating]) -> None:
    depth_m = np.array([[0.0, 0.5], [-1.0, 4.0]], kind)
    with np.errstate(all="raise"):
        inverse = inverse_or_zero(depth_m)
    assert inverse.dtype == kind
    np.testing.assert_array_equal(inverse, [[0.0, 2.0], [0.0, 0.25]])
    np.testing.assert_array_equal(inverse_or_zero(inverse), [[0.0, 0.5], [0.0, 4.0]])
    assert inverse_or_zero(np.zeros((0, 3), kind)).shape == (0, 3)
