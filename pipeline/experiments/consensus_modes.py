"""How much it costs a team to agree on matched Gaussians: rounds, bytes and time of every mode, against one optimum.

Teams are made, or those of a finished run (`team_of_run`). In made ones every robot has evidence on every track,
with information spread over a contrast and a share of it missing. `evidence` travels as in an exchange, over the real
transport with acknowledgements, compact, in float32 or in float64; `admm` and `paper` send float64 values in every
round. Loss is drawn by the link model. The optimum is computed with the evidence of all robots, which no robot has;
for `paper`, whose weights are per coordinate, it is that of those weights.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import progress, random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.config.network import LinkConfig, TransportConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.exchange.wire import evidence_wire
from duagc.pipeline.experiments.gaussian_consensus import (
    COORDINATES,
    GaussianAgent,
    GaussianConsensusConfig,
    Shares,
    optimum,
    total_weights,
)
from duagc.pipeline.network.link_model import LinkModel, neighbors
from duagc.pipeline.network.messages import Message
from duagc.pipeline.network.packets import EVIDENCE_HEAD_BYTES, HEADER_BYTES, MAX_PAYLOAD_BYTES, Kind, parse
from duagc.pipeline.network.transport import Transport
from duagc.pipeline.splat.information import pack_information

PERIOD_NS = 100_000_000
EVIDENCE_MODES = {
    "evidence": Kind.EVIDENCE,
    "evidence_float32": Kind.EVIDENCE_EXACT,
    "evidence_float64": Kind.EVIDENCE_DOUBLE,
}
MODES = (*EVIDENCE_MODES, "admm", "paper")
PAPER_BYTES_PER_PAIR = 28 * 4  # what the paper counts per matched pair and round
_PACKET_HEAD_BYTES = 12  # sequence, first row, counts
STILL_ROUNDS = 100  # in a row without any change, lost packets or not: it will not come nearer
_NEAR_SIGMA, _AT_SIGMA = 0.05, 1e-6


@dataclass(frozen=True)
class ConsensusPlan:
    """What to measure; every combination."""

    robots: tuple[int, ...] = (2, 4, 8)
    topologies: tuple[str, ...] = ("full", "ring", "chain")
    losses: tuple[float, ...] = (0.0, 0.3, 0.6, 0.9)
    contrasts: tuple[float, ...] = (47.0, 1e4)
    unknown: tuple[float, ...] = (0.0, 0.2)
    modes: tuple[str, ...] = MODES
    tracks: int = 200
    max_rounds: int = 3000
    seed: int = 0

    def cases(self) -> list[dict[str, Any]]:
        """One entry per row of the result; a ring of two is left out."""
        names = ("topology", "robots", "contrast", "unknown", "loss", "mode")
        values = itertools.product(
            self.topologies, self.robots, self.contrasts, self.unknown, self.losses, self.modes
        )
        cases: list[dict[str, Any]] = [dict(zip(names, row, strict=True)) for row in values]
        return [c for c in cases if c["robots"] > 2 or c["topology"] == "full"]


@dataclass
class Team:
    """Evidence of a team in the common frame: values [tracks, 13] and their weights by robot, zero of no member."""

    names: list[str]
    linked: dict[str, tuple[str, ...]]
    theta: dict[str, Array]
    weights: dict[str, Weights]
    best: Array = field(init=False)
    roots: Array = field(init=False)

    def __post_init__(self) -> None:
        tracks = len(self.theta[self.names[0]])
        weights, rows = [self.weights[n] for n in self.names], [np.arange(tracks)] * len(self.names)
        self.best = optimum([self.theta[n] for n in self.names], weights, rows, tracks)
        self.roots = np.sqrt(total_weights(weights, rows, tracks).diagonal())

    @staticmethod
    def made(case: dict[str, Any], plan: ConsensusPlan) -> Team:
        """A team with evidence drawn at random, around a truth that all its robots share.

        Args:
            case: of `ConsensusPlan.cases`.
            plan: number of tracks, and the seed.
        """
        names = [f"robot_{k}" for k in range(case["robots"])]
        link = LinkConfig(topology=case["topology"])
        theta, weights = {}, {}
        shape = (plan.tracks, COORDINATES)
        truth = random_streams.generator(plan.seed, "bench.truth").normal(size=shape)
        for name in names:
            rng = random_streams.generator(plan.seed, "bench.evidence", robot=name)
            diagonal = 100 * np.exp(rng.uniform(0, np.log(case["contrast"]), shape))
            diagonal[rng.random(plan.tracks) < case["unknown"]] = 0.0
            W = Weights.of_diagonal(diagonal)
            if case["mode"] != "paper":
                for blocks, size in ((W.position, 3), (W.shape, 6)):
                    Q = np.linalg.qr(rng.normal(size=(plan.tracks, size, size)))[0]
                    blocks[:] = Q @ blocks @ Q.swapaxes(1, 2)
            spread = W.inverse().diagonal()
            weights[name] = W
            theta[name] = truth + np.sqrt(np.where(spread > 0, spread, 1.0)) * rng.normal(size=shape)
        return Team(names, neighbors(link, names), theta, weights)

    def per_coordinate(self) -> Team:
        """The same with the diagonals of the weights, as (12) has them."""
        weights = {name: Weights.of_diagonal(w.diagonal()) for name, w in self.weights.items()}
        return Team(self.names, self.linked, self.theta, weights)

    def gaps_sigma(self, values: dict[str, Array]) -> Array:
        """Largest distance of a coordinate from the optimum, in its standard deviations, [robots, tracks].

        Args:
            values: [tracks, 13] by robot.
        """
        return np.stack([np.max(np.abs(x - self.best) * self.roots, axis=1) for x in values.values()])


@dataclass
class _Cost:
    """What a session cost so far."""

    rounds: int = 0
    bytes: int = 0
    seconds: float = 0.0
    gap_sigma: float = np.inf
    gap_sigma_p99: float = np.inf
    rounds_near: int | None = None
    bytes_near: int | None = None
    rounds_at: int | None = None

    def note(self, gaps_sigma: Array) -> None:
        self.gap_sigma = gap_sigma = float(np.max(gaps_sigma, initial=0.0))
        self.gap_sigma_p99 = float(np.percentile(gaps_sigma, 99)) if gaps_sigma.size else 0.0
        if gap_sigma < _NEAR_SIGMA and self.rounds_near is None:
            self.rounds_near, self.bytes_near = self.rounds, self.bytes
        if gap_sigma < _AT_SIGMA and self.rounds_at is None:
            self.rounds_at = self.rounds


def run(plan: ConsensusPlan) -> dict[str, Any]:
    """Measure made teams. One row per case: times are CPU time of all robots together.

    Args:
        plan: the cases, number of tracks and limits.
    """
    return _measured(plan, ((case, Team.made(case, plan)) for case in plan.cases()), len(plan.cases()))


def run_on(team: Team, topology: str, plan: ConsensusPlan) -> dict[str, Any]:
    """The same on evidence that is there, for every loss and mode of the plan.

    Args:
        team: with its evidence.
        topology: of the links, as it is named in the rows.
        plan: losses, modes and limits; the number of tracks is that of the team.
    """
    weights = np.stack([w.diagonal() for w in team.weights.values()])
    known = weights[weights > 0]
    case = {
        "topology": topology,
        "robots": len(team.names),
        "contrast": float(f"{np.divide(*np.percentile(known, [99, 1])):.1e}"),  # 99th over 1st percentile
        "unknown": round(float(np.mean(~np.any(weights > 0, axis=2))), 3),
    }
    cases = [case | {"loss": loss, "mode": mode} for loss in plan.losses for mode in plan.modes]
    diagonal = team.per_coordinate()
    teams = ((c, diagonal if c["mode"] == "paper" else team) for c in cases)
    return _measured(replace(plan, tracks=len(team.best)), teams, len(cases))


def _measured(
    plan: ConsensusPlan, cases: Iterator[tuple[dict[str, Any], Team]], count: int
) -> dict[str, Any]:
    rows = []
    for case, team in progress.track(cases, "consensus of Gaussians", count):
        model = LinkModel(LinkConfig(topology=case["topology"], loss_probability=case["loss"]), plan.seed)
        cost = (_rounds if case["mode"] in ("admm", "paper") else _evidence)(team, model, case, plan)
        pairs = plan.tracks * sum(len(peers) for peers in team.linked.values()) // 2
        rows.append(
            {
                **case,
                "rounds_to_0.05_sigma": cost.rounds_near,
                "rounds_to_1e-6_sigma": cost.rounds_at,
                "bytes_to_0.05_sigma": cost.bytes_near,
                "gap_sigma": cost.gap_sigma,
                "gap_sigma_p99": cost.gap_sigma_p99,
                "rounds": cost.rounds,
                "bytes": cost.bytes,
                "bytes_paper_accounting": None
                if case["mode"].startswith("evidence")
                else pairs * PAPER_BYTES_PER_PAIR * cost.rounds,
                "cpu_s": cost.seconds,
            }
        )
    return {"plan": {k: list(v) if isinstance(v, tuple) else v for k, v in vars(plan).items()}, "rows": rows}


def _rounds(team: Team, model: LinkModel, case: dict[str, Any], plan: ConsensusPlan) -> _Cost:
    """Rounds of `admm` or `paper` until the optimum, or until nothing moves any more."""
    config = GaussianConsensusConfig(mode=case["mode"], wire="float64")
    shares = Shares.of({n: np.arange(plan.tracks) for n in team.names}, team.linked)
    agents = {
        n: GaussianAgent(
            team.theta[n],
            team.weights[n],
            {peer: shares.shared[min(n, peer), max(n, peer)] for peer in team.linked[n]},
            config,
        )
        for n in team.names
    }
    cost, still = _Cost(), 0
    sequences: dict[tuple[str, str], Iterator[int]] = {}
    for round_index in range(plan.max_rounds):
        begun = time.process_time()
        sent = []
        for name, agent in agents.items():
            for peer in team.linked[name]:
                counter = sequences.setdefault((name, peer), itertools.count())
                for part in agent.outgoing(peer).parts(MAX_PAYLOAD_BYTES - _PACKET_HEAD_BYTES):
                    size = HEADER_BYTES + _PACKET_HEAD_BYTES + part.size_bytes
                    cost.bytes += size
                    if model.fate(
                        name, peer, sequence=next(counter), send_ns=round_index * PERIOD_NS, size=size
                    ).delivered:
                        sent.append((name, peer, part))
        for name, peer, part in sent:
            agents[peer].receive(name, part)
        for agent in agents.values():
            agent.step()
        cost.seconds += time.process_time() - begun
        cost.rounds = round_index + 1
        cost.note(team.gaps_sigma({n: agent.x for n, agent in agents.items()}))
        moving = max(agent.change_sigma for agent in agents.values()) > 1e-12
        still = 0 if moving else still + 1
        if cost.rounds_at is not None or still > STILL_ROUNDS:
            break
    return cost


def _evidence(team: Team, model: LinkModel, case: dict[str, Any], plan: ConsensusPlan) -> _Cost:
    """Every robot's evidence goes once along the shortest paths to all robots; each sums up what it has."""
    kind = EVIDENCE_MODES[case["mode"]]
    index = {name: k for k, name in enumerate(team.names)}
    children = {owner: _tree(owner, team.linked) for owner in team.names}
    payloads = {
        n: evidence_wire.write_evidence(
            kind, index[n], "blended", evidence_wire.to_body(kind, _records(team, n, kind))
        )
        for n in team.names
    }
    ids = {name: itertools.count(1) for name in team.names}
    ends = {
        (n, peer): Transport(index[n], index[peer], peer, TransportConfig(), new_id=ids[n].__next__)
        for n in team.names
        for peer in team.linked[n]
    }
    known = {name: {name: payloads[name]} for name in team.names}
    for name in team.names:
        for child in children[name][name]:
            ends[name, child].send(Message(next(ids[name]), kind, payloads[name]))
    cost = _Cost()
    for round_index in range(plan.max_rounds):
        begun = time.process_time()
        sent = []
        for (name, peer), end in ends.items():
            beacon = Message(
                next(ids[name]), Kind.STATE, b""
            )  # as agents do: silence would be taken for absence
            for out in end.burst(round_index, [beacon], LinkConfig().budget_bytes):
                packet = parse(out.packet)
                size = len(out.packet)
                cost.bytes += size
                if model.fate(
                    name, peer, sequence=packet.sequence, send_ns=round_index * PERIOD_NS, size=size
                ).delivered:
                    sent.append((name, peer, packet))
        for name, peer, packet in sent:
            arrival = ends[peer, name].receive(packet, round_index)
            if arrival is None or not arrival.complete or arrival.kind is not kind:
                continue
            owner = team.names[
                evidence_wire.read_evidence_head(
                    kind, arrival.payload[:EVIDENCE_HEAD_BYTES], len(team.names)
                )[0]
            ]
            known[peer][owner] = arrival.payload
            for child in children[owner][peer]:
                ends[peer, child].send(Message(next(ids[peer]), kind, arrival.payload))
        cost.rounds = round_index + 1
        complete = all(len(k) == len(team.names) for k in known.values())
        if complete:
            sums = {name: _sum(kind, payload, len(team.names)) for name, payload in known.items()}
        cost.seconds += time.process_time() - begun
        if complete:
            cost.note(team.gaps_sigma(sums))
            break
    return cost


def _sum(kind: Kind, payloads: dict[str, bytes], team: int) -> Array:
    """What a robot makes of the evidence that it has, its own as the others read it."""
    theta, weights = [], []
    for _, payload in sorted(payloads.items()):
        _, _, records = evidence_wire.read_evidence(kind, payload, team)
        theta.append(records["theta"].astype(np.float64))
        evidence = Evidence(
            "", records["id"], records["anchor"], theta[-1], records["information"].astype(np.float64)
        )
        weights.append(Weights.of(evidence))
    tracks = len(theta[0])
    return optimum(theta, weights, [np.arange(tracks)] * len(theta), tracks)


def _tree(owner: str, linked: dict[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """To whom each robot hands on what came from `owner`: a tree of shortest ways, ties by name."""
    children: dict[str, list[str]] = {name: [] for name in linked}
    seen, queue = {owner}, [owner]
    while queue:
        name = queue.pop(0)
        for peer in linked[name]:
            if peer not in seen:
                seen.add(peer)
                queue.append(peer)
                children[name].append(peer)
    return children


def _records(team: Team, name: str, kind: Kind) -> NDArray[Any]:
    """A robot's evidence as records of the wire."""
    W, theta = team.weights[name], team.theta[name]
    out = np.zeros(len(theta), evidence_wire.record_dtype(kind))
    out["id"] = np.arange(len(theta))
    out["theta"] = theta
    out["information"] = pack_information(W.position, W.shape, W.color, W.opacity)
    return out


HEAD = (
    "topology | robots | contrast | unknown | loss | mode | to 0.05 sigma | to 1e-6 | end, rounds | "
    "gap, sigma | at 99 % | kB | kB as the paper counts | CPU s"
)
LEGEND = """
Unknown: share of its tracks that a robot knows nothing of. Rounds: until the worst coordinate of any robot is that
near the optimum, and until the session ended (there, or nothing moved any more, or --max-rounds); "-": not reached.
Gap: from the optimum with the evidence of all robots, largest and at 99 %, in its standard deviations; for paper,
of its weights. kB: of all robots, headers and lost packets too; as the paper counts: 28 float32 per pair and round."""


def format_table(result: dict[str, Any]) -> str:
    """The rows as a Markdown table that can be read as it stands, and what its columns mean.

    Args:
        result: of `run` or `run_on`.
    """
    rows: list[list[object]] = []
    for r in result["rows"]:
        paper = r["bytes_paper_accounting"]
        rows.append(
            [
                r["topology"],
                r["robots"],
                f"{r['contrast']:g}",
                f"{100 * r['unknown']:g} %",
                f"{100 * r['loss']:g} %",
                r["mode"],
                r["rounds_to_0.05_sigma"],
                r["rounds_to_1e-6_sigma"],
                r["rounds"],
                f"{r['gap_sigma']:.1e}",
                f"{r['gap_sigma_p99']:.1e}",
                f"{r['bytes'] / 1000:.0f}",
                None if paper is None else f"{paper / 1000:.0f}",
                f"{r['cpu_s']:.2f}",
            ]
        )
    return "\n".join([*markdown(HEAD.split(" | "), rows), LEGEND])
