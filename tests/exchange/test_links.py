"""The simulated radio: every kind of trouble, each from nothing but the seed, the link and the packet."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.base import dump_config, load_config
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig, LinkWindow
from duagc.pipeline.network import link_model
from duagc.pipeline.network.link_model import Fate, LinkModel, neighbors

TEAM = ["delta", "alpha", "charlie", "bravo"]
MS = 1_000_000


def fates(
    config: LinkConfig, count: int = 400, every_ns: int = 0, seed: int = 1, size: int = 1000
) -> list[Fate]:
    """Fates of so many packets of one link."""
    model = LinkModel(config, seed)
    return [model.fate("alpha", "bravo", sequence=s, send_ns=s * every_ns, size=size) for s in range(count)]


def test_topologies() -> None:
    def linked(**changes: object) -> dict[str, tuple[str, ...]]:
        return neighbors(LinkConfig(**changes), TEAM)  # type: ignore[arg-type]

    assert linked(topology="full")["alpha"] == ("bravo", "charlie", "delta")
    assert linked(topology="chain") == {
        "alpha": ("bravo",),
        "bravo": ("alpha", "charlie"),
        "charlie": ("bravo", "delta"),
        "delta": ("charlie",),
    }
    assert linked(topology="ring")["alpha"] == ("bravo", "delta")
    assert linked(topology="star")["charlie"] == ("alpha",)
    assert set(linked(topology="none").values()) == {()}
    assert set(linked(enabled=False).values()) == {()}
    assert neighbors(LinkConfig(topology="ring"), ["a", "b"]) == {"a": ("b",), "b": ("a",)}
    # listed: a partitioned team, one of the links in one direction only
    windows = [
        {"sender": "alpha", "receiver": "bravo"},
        {"sender": "delta", "receiver": "charlie", "both_ways": False},
    ]
    assert linked(topology="listed", windows=windows) == {
        "alpha": ("bravo",),
        "bravo": ("alpha",),
        "charlie": ("delta",),
        "delta": ("charlie",),
    }


@pytest.mark.parametrize(
    "trouble", [{"loss_probability": 0.5}, {"jitter_ns": 10 * MS}, {"duplicate_probability": 0.5}]
)
def test_a_fate_depends_on_no_other_packet(trouble: dict[str, Any]) -> None:
    config = LinkConfig(**trouble)
    alone = fates(config, 200)
    model = LinkModel(config, seed=1)
    mixed = []
    for s in reversed(range(200)):
        model.fate("bravo", "alpha", sequence=s, send_ns=0, size=1000)
        mixed.append(model.fate("alpha", "bravo", sequence=s, send_ns=s * 0, size=1000))
    assert alone == mixed[::-1]
    assert alone != fates(config, 200, seed=2)


def test_losses_are_independent() -> None:
    lost = np.array([not f.delivered for f in fates(LinkConfig(loss_probability=0.3), 4000)])
    assert lost.mean() == pytest.approx(0.3, abs=0.03)
    assert (lost[1:] & lost[:-1]).mean() == pytest.approx(0.09, abs=0.02)
    assert {f.reason for f in fates(LinkConfig(loss_probability=1.0), 3)} == {link_model.LOST}


def test_bursts_have_their_length_and_share() -> None:
    """Gilbert-Elliott: one lost packet is mostly followed by another, and a quarter of the time is bad."""
    config = LinkConfig(burst_gap_ns=300 * MS, burst_length_ns=100 * MS)
    lost = np.array([not f.delivered for f in fates(config, 40_000, every_ns=10 * MS)])
    assert lost.mean() == pytest.approx(0.25, abs=0.02)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]]))))[::2]
    assert runs.mean() == pytest.approx(10.5, abs=1.0)  # packets, 10 ms apart, of bursts of 100 ms
    half = fates(config.model_copy(update={"burst_loss_probability": 0.5}), 40_000, every_ns=10 * MS)
    assert np.mean([not f.delivered for f in half]) == pytest.approx(0.125, abs=0.02)
    assert {f.reason for f in half if not f.delivered} == {link_model.BURST}


def test_jitter_reorders() -> None:
    times = [
        f.deliver_ns[0] for f in fates(LinkConfig(latency_ns=20 * MS, jitter_ns=50 * MS), every_ns=5 * MS)
    ]
    delays = np.array(times) - 5 * MS * np.arange(len(times))
    assert delays.min() >= 20 * MS
    assert delays.max() <= 70 * MS
    assert delays.mean() == pytest.approx(45 * MS, rel=0.05)
    assert sorted(times) != times


def test_duplicates_come_with_their_own_delay() -> None:
    got = fates(LinkConfig(duplicate_probability=0.2, jitter_ns=50 * MS), 2000)
    twice = [f for f in got if len(f.deliver_ns) == 2]
    assert len(twice) / len(got) == pytest.approx(0.2, abs=0.03)
    assert all(f.deliver_ns[0] <= f.deliver_ns[1] for f in twice)
    assert sum(f.deliver_ns[0] != f.deliver_ns[1] for f in twice) > 0.9 * len(twice)


def test_nothing_is_there_when_it_is_sent() -> None:
    """Or a replay, which knows all packets, would deliver it a round earlier than the session did."""
    assert {f.deliver_ns for f in fates(LinkConfig(latency_ns=0), 3, every_ns=0)} == {(1,)}


def test_a_bandwidth_holds() -> None:
    """1000 bytes at 100 kB/s take 10 ms each; what would wait longer than the queue allows is dropped."""
    config = LinkConfig(latency_ns=0, bandwidth_bytes_per_s=100_000, queue_ns=95 * MS)
    got = fates(config, 30)
    assert [f.deliver_ns for f in got[:10]] == [((k + 1) * 10 * MS,) for k in range(10)]
    assert {f.reason for f in got[10:]} == {link_model.QUEUE_FULL}
    model = LinkModel(config, 0)
    assert model.fate("alpha", "bravo", sequence=0, send_ns=0, size=1000) == model.fate(
        "bravo", "alpha", sequence=0, send_ns=0, size=1000
    )  # a link each way


def test_a_packet_may_wait_as_long_as_the_queue_allows_and_no_nanosecond_longer() -> None:
    config = LinkConfig(latency_ns=0, bandwidth_bytes_per_s=100_000, queue_ns=10 * MS)
    for send_ns, waits in ((0, True), (-1, False)):
        model = LinkModel(config, 0)
        model.fate("alpha", "bravo", sequence=0, send_ns=0, size=1000)
        later = model.fate("alpha", "bravo", sequence=1, send_ns=send_ns, size=1000)
        assert later.delivered == waits
        assert later.reason == ("" if waits else link_model.QUEUE_FULL)


def test_a_packet_meets_the_link_as_it_is_when_it_goes_on_air() -> None:
    window = LinkWindow(sender="alpha", receiver="bravo", until_ns=5 * MS)
    config = LinkConfig(topology="listed", windows=(window,), bandwidth_bytes_per_s=100_000)
    model = LinkModel(config, 0)
    fates = [model.fate("alpha", "bravo", sequence=k, send_ns=0, size=1000) for k in range(2)]
    assert [f.reason for f in fates] == ["", link_model.DOWN]  # the second waits for 10 ms


def test_jitter_reaches_both_ends_of_its_range() -> None:
    late = {f.deliver_ns[0] for f in fates(LinkConfig(latency_ns=10, jitter_ns=2), 200, every_ns=0)}
    assert late == {10, 11, 12}


def test_a_robot_alone_has_no_link() -> None:
    for topology in ("full", "star", "chain", "ring"):
        assert neighbors(LinkConfig(topology=topology), ["alpha"]) == {"alpha": ()}


def test_windows_open_close_and_have_a_direction() -> None:
    windows = (
        {"sender": "alpha", "receiver": "bravo", "until_ns": 100},
        {"sender": "alpha", "receiver": "bravo", "from_ns": 200, "both_ways": False, "loss_probability": 1.0},
        {"sender": "alpha", "receiver": "bravo", "from_ns": 200, "both_ways": False},
    )
    model = LinkModel(LinkConfig(topology="listed", windows=windows), 0)  # type: ignore[arg-type]

    def reason(sender: str, receiver: str, now_ns: int) -> str:
        return model.fate(sender, receiver, sequence=0, send_ns=now_ns, size=100).reason

    assert reason("alpha", "bravo", 99) == reason("bravo", "alpha", 99) == ""
    assert reason("alpha", "bravo", 100) == reason("bravo", "alpha", 250) == link_model.DOWN
    assert reason("alpha", "bravo", 250) == link_model.LOST  # the first window that fits counts
    assert reason("alpha", "charlie", 0) == link_model.DOWN


def test_range_follows_the_waypoints() -> None:
    waypoints = (
        {"robot": "alpha", "position_m": (0, 0, 0)},
        {"robot": "bravo", "position_m": (0, 0, 0)},
        {"robot": "bravo", "position_m": (100, 0, 0), "time_ns": 1000},
    )
    config = LinkConfig(topology="range", range_m=30.0, waypoints=waypoints)  # type: ignore[arg-type]
    assert neighbors(config, ["alpha", "bravo"]) == {"alpha": ("bravo",), "bravo": ("alpha",)}
    got = {
        t: LinkModel(config, 0).fate("alpha", "bravo", sequence=0, send_ns=t, size=100).reason
        for t in (0, 299, 301, 5000)
    }
    assert got == {0: "", 299: "", 301: link_model.FAR, 5000: link_model.FAR}
    with pytest.raises(DuagError, match="none of charlie, expected one for each robot"):
        neighbors(config, ["alpha", "bravo", "charlie"])
    with pytest.raises(DuagError, match="robot 'bravo', expected one of alpha"):
        link_model.check_names(config, ["alpha"])
    link_model.check_names(config, ["alpha", "bravo"])
    assert neighbors(config, ["alpha"]) == {"alpha": ()}  # no map could be begun in the log of bravo


def test_links_survive_a_configuration_file(tmp_path: Path) -> None:
    text = """
        [link]
        topology = "listed"
        [[link.windows]]
        sender = "alpha"
        receiver = "bravo"
        until_ns = 3_000_000_000
        [[link.windows]]
        sender = "bravo"
        receiver = "charlie"
        both_ways = false
        loss_probability = 0.25
    """
    (tmp_path / "links.toml").write_text(text)
    config = load_config(ExchangeConfig, tmp_path / "links.toml")
    assert config.link.windows[0] == LinkWindow(sender="alpha", receiver="bravo", until_ns=3_000_000_000)
    (tmp_path / "again.toml").write_text(dump_config(config))
    assert load_config(ExchangeConfig, tmp_path / "again.toml") == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"topology": "listed"}, "windows is empty"),
        ({"topology": "range"}, "expects range_m above 0 and waypoints"),
        ({"windows": ({"sender": "a", "receiver": "a"},)}, "a to a, expected different robots"),
        (
            {"windows": ({"sender": "a", "receiver": "b", "from_ns": 5, "until_ns": 5},)},
            "expected later than 5 ns",
        ),
        ({"duplicate_probability": 1.5}, "less than or equal to 1"),
    ],
)
def test_what_makes_no_sense_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        LinkConfig(**settings)
