"""Own evidence is finite before it is rounded to integers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.evidence_records import own_records
from duagc.pipeline.network.packets import Kind
from tests.exchange.conftest import MakeRobot


@pytest.mark.parametrize("kind", [Kind.EVIDENCE, Kind.EVIDENCE_EXACT])
@pytest.mark.parametrize(
    ("part", "name"),
    [
        ("gaussians", "colors"),
        ("gaussians", "opacity_logits"),
        ("gaussians", "log_scales"),
        ("information", "color"),
        ("information", "geometry"),
    ],
)
def test_a_map_that_is_not_finite_is_not_sent(
    make_robot: MakeRobot, kind: Kind, part: str, name: str
) -> None:
    data, _ = make_robot("alpha", 0.0, keyframes=2, gaussians=30)
    values = np.array(getattr(getattr(data, part), name))
    values[[3, 7]] = np.nan
    broken = replace(data, **{part: replace(getattr(data, part), **{name: values})})
    with pytest.raises(DuagError, match=r"alpha: \w+ of 2 of 30 Gaussians of its map are not finite"):
        own_records(broken, kind, ExchangeConfig().weights)
    assert len(own_records(data, kind, ExchangeConfig().weights)) == 30
