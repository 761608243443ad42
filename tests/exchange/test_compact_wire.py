"""Evidence in few bytes at the ends of its numbers: what does not fit is sent as the nearest that does."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.exchange.wire import compact_wire, evidence_wire
from duagc.pipeline.network.packets import EVIDENCE_KINDS, Kind, MalformedError
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


@pytest.mark.parametrize("kind", sorted(EVIDENCE_KINDS))
def test_a_chunk_is_refused_for_the_same_reasons_before_and_when_it_is_read(kind: Kind) -> None:
    """A chunk on its arrival is checked, not read: what is found wrong must be the same, whatever byte is changed."""
    rng = np.random.default_rng(0)
    records = np.zeros(3, evidence_wire.record_dtype(kind))
    records["id"], records["theta"] = np.arange(3), rng.normal(size=(3, 13))
    records["information"][:, :6] = pack_symmetric(np.eye(3)[None])
    records["information"][:, 6:27] = pack_symmetric(np.eye(6)[None])
    data = evidence_wire.write_evidence(kind, 1, "blended", evidence_wire.to_body(kind, records))

    def outcome(read: Callable[[Kind, bytes, int], Any], changed: bytes) -> str:
        try:
            found = read(kind, changed, 3)
        except MalformedError as error:
            return str(error)
        return f"of {found if isinstance(found, int) else found[0]}"

    refused = set()
    for at in range(len(data)):
        for value in (0, 1, 127, 128, 252, 255):
            changed = data[:at] + bytes([value]) + data[at + 1 :]
            said = outcome(evidence_wire.check_chunk, changed)
            assert said == outcome(evidence_wire.read_evidence, changed)
            refused.add(said)
    assert {"of 0", "of 1"} <= refused
    assert len(refused) > 5
    for short in (b"", data[:5], data[:-1], data + b"\0"):
        assert outcome(evidence_wire.check_chunk, short) == outcome(evidence_wire.read_evidence, short)
