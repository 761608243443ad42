"""Sessions on whose air somebody plays: damaged, repeated, forged and invented packets move no honest robot."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import TransportConfig
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of, team_of
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.exchange.wire import evidence_wire
from duagc.pipeline.network.packets import (
    HEADER_BYTES,
    Kind,
    MalformedError,
    Packet,
    chunk_bytes,
    parse,
    payload_bytes,
    records_per_chunk,
    serialize,
)
from duagc.pipeline.network.signatures import SIGNATURE_BYTES, Identity
from duagc.pipeline.runs.robot_data import RobotData, SessionResult
from tests.fixtures.results import same
from tests.fixtures.sampling import sampled

NAMES = ("alpha", "bravo")
SIGNED = ExchangeConfig(transport=TransportConfig(signatures="ed25519"))
PACKET = Packet(Kind.SAMPLE, 0, 1, 3, 7, 5, 0, 20, bytes(20))
Tamper = Callable[[np.random.Generator, list[bytes]], bytes]


@pytest.fixture(scope="module")
def team(make_robot: Any) -> list[RobotData]:
    return [make_robot(name, 0.6 * i, keyframes=4)[0] for i, name in enumerate(NAMES)]


def meet(
    team: list[RobotData], config: ExchangeConfig, tampers: list[Tamper], per_round: int, seed: int = 0
) -> tuple[dict[str, SessionResult], dict[str, MapAgent], int]:
    """A session over lossless air, with invented packets among the true ones, in any order."""
    agents = team_of(team, config, seed=0)
    rng = np.random.default_rng(seed)
    air: dict[str, list[bytes]] = {name: [] for name in agents}
    heard: list[bytes] = []
    invented = 0
    for round_index in range(600):
        sent = {name: agent.tick(round_index, air[name]) for name, agent in agents.items()}
        air = {name: [o.packet for s in sent.values() for o in s if o.receiver == name] for name in agents}
        heard += [o.packet for s in sent.values() for o in s]
        for name in agents if tampers else ():
            for _ in range(per_round):
                bad = tampers[rng.integers(len(tampers))](rng, heard)
                at = int(rng.integers(len(air[name]) + 1))
                if bad not in air[name][at:]:  # to be first with a true packet is to deliver it
                    air[name].insert(at, bad)
                    invented += 1
        if all(agent.done for agent in agents.values()):
            break
    return {name: result_of(agent) for name, agent in agents.items()}, agents, invented


def moved(results: dict[str, SessionResult], others: dict[str, SessionResult]) -> list[str]:
    """Robots whose results are not the same bit for bit; what they refused does not count."""
    return [
        name
        for name in NAMES
        if not same(
            dataclasses.replace(results[name], refused={}), dataclasses.replace(others[name], refused={})
        )
    ]


def some(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    return heard[rng.integers(len(heard))]


def flipped(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    """Some bits are wrong."""
    data = bytearray(some(rng, heard))
    for _ in range(rng.integers(1, 5)):
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    return bytes(data)


def cut(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    data = some(rng, heard)
    return data[: rng.integers(len(data))]


def spliced(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    """The head of one packet and the tail of another, or a packet with something behind it."""
    one, other = some(rng, heard), some(rng, heard)
    return one[:HEADER_BYTES] + other[HEADER_BYTES:] if rng.random() < 0.5 else one + other


def repeated(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    return some(rng, heard)


def invented(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    return rng.bytes(int(rng.integers(0, 1300)))


def forged(rng: np.random.Generator, heard: list[bytes]) -> bytes:
    """A packet of the team with other content, sequence, sender or receiver and a CRC that fits; its old signature."""
    data = some(rng, heard)
    end = HEADER_BYTES + payload_bytes(data)
    packet = parse(data[:end])
    payload = bytearray(packet.payload)
    for _ in range(rng.integers(0, 4) if payload else 0):
        payload[rng.integers(len(payload))] = int(rng.integers(256))
    changes: dict[str, Any] = {"payload": bytes(payload), "sequence": int(rng.integers(1 << 32))}
    if rng.random() < 0.3:
        changes |= {"sender": packet.receiver, "receiver": packet.sender}
    if rng.random() < 0.3:
        changes["sender"] = int(rng.integers(1 << 16))
    if rng.random() < 0.3:
        changes["kind"] = Kind(int(rng.integers(1, len(Kind) + 1)))
    return serialize(dataclasses.replace(packet, **changes)) + data[end:]


MANY = sampled([120, 360])  # per round


@pytest.fixture(scope="module")
def quiet(team: list[RobotData]) -> dict[str, SessionResult]:
    results, _, _ = meet(team, ExchangeConfig(), [], 0)
    assert all(result.converged for result in results.values())
    return results


@pytest.mark.parametrize("many", MANY)
def test_thousands_of_damaged_packets_change_nothing(team: list[RobotData], quiet: Any, many: int) -> None:
    """Whatever the CRC or the sequence number shows."""
    results, agents, count = meet(team, ExchangeConfig(), [flipped, cut, spliced, repeated, invented], many)
    assert count > 55 * many
    assert not moved(results, quiet)
    assert sum(sum(agent.refused.values()) for agent in agents.values()) > 0.7 * count


@pytest.mark.parametrize("many", MANY)
def test_thousands_of_forged_packets_change_nothing_where_packets_are_signed(
    team: list[RobotData], many: int
) -> None:
    alone, _, _ = meet(team, SIGNED, [], 0)
    results, agents, count = meet(team, SIGNED, [forged, forged, flipped, cut, repeated], many)
    assert count > 55 * many
    assert not moved(results, alone)
    reasons = agents["alpha"].refused
    assert reasons["not signed by its sender"] > 2.7 * many
    assert all(result.converged for result in results.values())


def test_signatures_change_bytes_and_nothing_else(
    team: list[RobotData], quiet: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    signed, _, _ = meet(team, SIGNED, [], 0)
    assert not moved(signed, quiet)
    folder = tmp_path_factory.mktemp("signed")
    results = run_session_of(
        team, SIGNED, seed=0, exchange_path=folder / "exchange.mcap", consensus_path=folder / "consensus.mcap"
    )
    packets = read_session(folder / "exchange.mcap").packets
    assert all(len(p.data) == HEADER_BYTES + payload_bytes(p.data) + SIGNATURE_BYTES for p in packets)
    for data in team:
        again, sent = replay_agent_of(data, SIGNED, seed=0, exchange_path=folder / "exchange.mcap")
        assert sent.equal
        assert same(again, results[data.robot])


@pytest.mark.parametrize("seed", range(3))
def test_forgeries_that_nothing_betrays_crash_and_hang_nobody(team: list[RobotData], seed: int) -> None:
    """Without signatures well-formed lies are trusted; results may be wrong, but they are there and finite."""
    results, agents, count = meet(team, ExchangeConfig(), [forged], 4, seed=seed)
    assert count > 100
    for name, result in results.items():
        assert np.isfinite(result.T_world_keyframe).all()
        assert name in result.component
    assert all(agent.round < 10_000 for agent in agents.values())


@pytest.mark.parametrize(
    ("owner", "color", "reason"),
    [
        (0, np.nan, "evidence: not a finite number"),
        (0, 1e30, "evidence: a Gaussian of impossible place or size"),
        (1, 0.5, "evidence: a neighbor speaks for this robot"),
        (0, 0.5, None),
    ],
)
def test_a_part_of_evidence_is_refused_as_it_arrives(
    team: list[RobotData], owner: int, color: float, reason: str | None
) -> None:
    """A chunk of a message whose rest never comes."""
    kind = Kind.EVIDENCE_EXACT
    bravo = team_of(team, ExchangeConfig(evidence_wire="float32"), seed=0)["bravo"]
    body = np.zeros(2 * records_per_chunk(kind), evidence_wire.record_dtype(kind))
    body["id"] = np.arange(len(body))
    body["theta"][1] = color
    evidence = evidence_wire.write_evidence(kind, owner, "blended", body)
    bravo.tick(0, [serialize(Packet(kind, 0, 1, 0, 0, 9, 0, len(evidence), evidence[: chunk_bytes(kind)]))])
    taken = reason is None
    assert bravo.refused == ({} if taken else {reason: 1})
    assert len(bravo.sharing.knowledge.incoming) == taken
    assert len(bravo.sharing.knowledge.records(0)) == taken * records_per_chunk(kind)


def test_a_signature_holds_for_one_sender_and_one_seed() -> None:
    alpha = Identity.simulated(1, NAMES, "alpha")
    bravo = Identity.simulated(1, NAMES, "bravo")
    packet = parse(serialize(PACKET))
    sealed = alpha.seal(packet)
    assert bravo.open(sealed) == packet
    assert alpha.seal(packet) == sealed
    with pytest.raises(MalformedError, match="not signed by its sender"):
        Identity.simulated(2, NAMES, "bravo").open(sealed)
    with pytest.raises(MalformedError, match="not signed by its sender"):
        bravo.open(bravo.seal(packet))  # in the name of alpha
    with pytest.raises(MalformedError, match="expected a packet and its signature"):
        bravo.open(b"short")
