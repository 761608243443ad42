"""Evidence in few bytes at the ends of its numbers: what does not fit is sent as the nearest that does."""

import numpy as np
import pytest

from duagc.pipeline.exchange.wire import compact_wire, evidence_wire
from duagc.pipeline.splat.information import (
    COLOR,
    COLOR_INFORMATION,
    LOG_COVARIANCE,
    OPACITY,
    OPACITY_INFORMATION,
    mean_block,
    pack_symmetric,
)

LARGEST_ROOT = 65504.0  # of float16


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_numbers_beyond_a_field_stay_at_its_end(sign: float) -> None:
    records = np.zeros(2, evidence_wire.RECORD)
    records["theta"][0] = sign * 1000.0
    found = compact_wire.decode(compact_wire.encode(records), evidence_wire.RECORD)
    theta = found["theta"].astype(np.float64)
    np.testing.assert_allclose(theta[0, LOG_COVARIANCE], sign * 32767 / 1024)
    np.testing.assert_allclose(theta[0, COLOR], sign * 32767 / 8192)
    np.testing.assert_allclose(theta[0, OPACITY], sign * 32767 / 1024)
    np.testing.assert_allclose(theta[0, :3], sign * 1000.0)  # meters have all of float32
    np.testing.assert_array_equal(theta[1], 0)


def test_information_beyond_its_field_is_the_most_that_it_holds() -> None:
    records = np.zeros(1, evidence_wire.RECORD)
    records["information"][:, COLOR_INFORMATION] = 1e30
    records["information"][:, OPACITY_INFORMATION] = 1e30
    records["information"][:, :6] = pack_symmetric(1e30 * np.eye(3)[None])
    found = compact_wire.decode(compact_wire.encode(records), evidence_wire.RECORD)
    information = found["information"].astype(np.float64)
    assert np.isfinite(information).all()
    np.testing.assert_allclose(information[:, COLOR_INFORMATION], LARGEST_ROOT**2, rtol=1e-6)
    np.testing.assert_allclose(information[:, OPACITY_INFORMATION], LARGEST_ROOT**2, rtol=1e-6)
    np.testing.assert_allclose(mean_block(information)[0], (16 * LARGEST_ROOT) ** 2 * np.eye(3), rtol=1e-6)
