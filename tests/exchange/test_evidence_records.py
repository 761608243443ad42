"""Own evidence is finite before it is rounded to integers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.consensus.matching import match
from duagc.pipeline.exchange.evidence_records import match_pairs, own_records, to_evidence
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


@pytest.mark.parametrize("kind", [Kind.EVIDENCE, Kind.EVIDENCE_EXACT])
def test_records_are_matched_as_their_evidence_in_the_world(make_robot: MakeRobot, kind: Kind) -> None:
    robots = [make_robot(name, first, keyframes=3) for name, first in (("alpha", 0.0), ("bravo", 0.1))]
    sides = [(data.robot, own_records(data, kind, ExchangeConfig().weights), T) for data, T in robots]
    placed = [to_evidence(name, records).in_world(T) for name, records, T in sides]
    expected = match(placed[0], placed[1], MapMatching())
    assert len(expected) > 10
    assert np.array_equal(match_pairs(sides[0], sides[1], MapMatching()), expected)
