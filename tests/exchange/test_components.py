"""Parts of one robot's path that did not join each other take part like robots; between them no radio is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.component_names import component_name, robot_of, same_robot, submap_of
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.link_model import LinkModel, neighbors
from duagc.pipeline.recording import read_log
from duagc.pipeline.runs.robot_data import RobotData, SessionResult
from duagc.schemas import topics


def meet(data: Sequence[RobotData], folder: Path, **config: Any) -> dict[str, SessionResult]:
    return run_session_of(
        data,
        ExchangeConfig(**config),
        seed=0,
        exchange_path=folder / "exchange.mcap",
        consensus_path=folder / "consensus.mcap",
    )


def test_a_component_has_the_name_of_its_robot_and_a_number() -> None:
    assert component_name("alpha", 2) == "alpha-2"
    assert (robot_of("alpha-2"), submap_of("alpha-2")) == ("alpha", 2)
    assert (robot_of("alpha_2"), submap_of("alpha_2")) == ("alpha_2", None)
    assert same_robot("alpha", "alpha-12")
    assert not same_robot("alpha", "alpha_2")
    assert topics.find("/alpha-2/keyframe") == (topics.KEYFRAME, "alpha-2")
    assert topics.find("/alpha-02/keyframe") is None


def test_the_topology_is_that_of_the_robots() -> None:
    chain = neighbors(LinkConfig(topology="chain"), ["bravo", "alpha-2", "charlie", "alpha"])
    assert chain == {
        "alpha": ("alpha-2", "bravo"),
        "alpha-2": ("alpha", "bravo"),
        "bravo": ("alpha", "alpha-2", "charlie"),
        "charlie": ("bravo",),
    }
    assert neighbors(LinkConfig(enabled=False), ["alpha", "alpha-2", "bravo"])["alpha"] == ("alpha-2",)


def test_nothing_is_lost_inside_a_robot() -> None:
    model = LinkModel(LinkConfig(loss_probability=1.0, bandwidth_bytes_per_s=1), seed=0)
    inside = [model.fate("alpha", "alpha-2", sequence=k, send_ns=k, size=1000) for k in range(20)]
    assert [fate.deliver_ns for fate in inside] == [(k + 1,) for k in range(20)]
    assert not model.fate("alpha-2", "bravo", sequence=0, send_ns=0, size=1).delivered


def test_components_share_the_radio_of_their_robot() -> None:
    model = LinkModel(LinkConfig(bandwidth_bytes_per_s=1_000_000), seed=0)
    first = model.fate("alpha", "bravo", sequence=0, send_ns=0, size=1000)
    second = model.fate("alpha-2", "bravo", sequence=0, send_ns=0, size=1000)
    assert second.deliver_ns[0] - first.deliver_ns[0] == 1_000_000


@pytest.mark.parametrize("witness", [False, True], ids=["nobody saw both", "bravo saw both"])
def test_a_robot_that_saw_both_places_joins_them(make_robot: Any, tmp_path: Path, witness: bool) -> None:
    truth = {
        "alpha": make_robot("alpha", 0.0, 3, 40),
        "alpha-2": make_robot("alpha-2", 1.8, 3, 40),
    }
    if witness:
        truth["bravo"] = make_robot("bravo", 0.3, 7, 60)
    results = meet([data for data, _ in truth.values()], tmp_path)
    if not witness:
        assert [results[name].component for name in truth] == [("alpha",), ("alpha-2",)]
        return
    assert {result.component for result in results.values()} == {tuple(truth)}
    one, other = (results[name].T_world_keyframe[0] for name in ("alpha", "alpha-2"))
    expected = se3.inverse(truth["alpha"][1][0]) @ truth["alpha-2"][1][0]
    moved_m, turned_rad = se3.distance(expected, se3.inverse(one) @ other)
    assert moved_m < 0.05
    assert turned_rad < 0.02


def test_components_of_one_robot_meet_without_radio(make_robot: Any, tmp_path: Path) -> None:
    data = [make_robot("alpha", 0.0, 3, 40)[0], make_robot("alpha-2", 0.3, 3, 40)[0]]
    results = meet(data, tmp_path, link=LinkConfig(loss_probability=1.0))
    assert {result.component for result in results.values()} == {("alpha", "alpha-2")}
    assert all(result.converged for result in results.values())
    summary = next(
        record.message() for record in read_log(tmp_path / "exchange.mcap", [topics.EXCHANGE_SUMMARY.pattern])
    )
    assert summary.bytes_sent == summary.packets_sent == 0
    assert len(list(read_log(tmp_path / "exchange.mcap", [topics.PEER_PACKET.of("alpha")]))) > 0
    assert np.isfinite(results["alpha-2"].T_world_keyframe).all()
