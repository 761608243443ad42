"""What happened in a run, in words and numbers: one round, one packet, one Gaussian.

Everything comes from the run's own logs; a number that a log does not have is not made up.
"""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import Any

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.exchange.record import Recorded, RecordedPacket, read_session
from duagc.pipeline.exchange.wire import evidence_wire, state_wire
from duagc.pipeline.network.packets import (
    EVIDENCE_KINDS,
    HEADER_BYTES,
    Kind,
    MalformedError,
    Packet,
    parse,
    payload_bytes,
)
from duagc.pipeline.recording import read_log
from duagc.pipeline.report import labels
from duagc.pipeline.runs.folder import RunFolder, written
from duagc.pipeline.splat.information import COLOR, LOG_COVARIANCE, MEAN, OPACITY, theta_of
from duagc.schemas import topics

Facts = dict[str, Any]
_NS_PER_S = 1e9


class Inspector:
    """Questions about one run; logs are read when they are needed, and once."""

    def __init__(self, run: RunFolder) -> None:
        """Take the run; its logs are read later.

        Args:
            run: that is asked about.
        """
        self.run = run

    @cached_property
    def _session(self) -> Recorded:
        return read_session(written(self.run.path / "exchange.mcap"))

    def _consensus(self, topic: topics.Topic, robot: str) -> list[Any]:
        path = written(self.run.path / "consensus.mcap")
        return [record.message() for record in read_log(path, topics=[topic.of(robot)])]

    # --- one round

    def round(self, index: int) -> Facts:
        """Where every robot stood in a round, and what was on the air.

        Args:
            index: of the round, from 0.

        Raises:
            DuagError: the session had fewer rounds.
        """
        if not 0 <= index < self._session.rounds:
            raise DuagError(
                f"{self.run.path / 'exchange.mcap'}: has {_numbered('round', self._session.rounds)}, "
                f"found --round {index}"
            )
        return {
            "round": index,
            "rounds": self._session.rounds,
            "robots": {robot: self._robot_at(robot, index) for robot in self.run.robots},
            "links": self._air(index),
        }

    def _robot_at(self, robot: str, index: int) -> Facts:
        """The last that the log says of an agent up to a round; it is written when it changes."""
        facts: Facts = {}
        stands = [m for m in self._consensus(topics.AGENT_ROUND, robot) if m.round <= index]
        if stands:
            m = stands[-1]
            facts |= {"members": list(m.members), "root": m.root, "joined_links": m.joined_links}
            facts |= {"undecided_links": m.undecided_links, "revoked_links": m.revoked_links}
            facts |= {"evidence_owners": m.evidence_owners, "pair_lists": m.pair_lists}
            facts |= {"open_messages": m.open_messages, "packets_refused": m.packets_refused}
            facts |= {"agreed": m.agreed, "done": m.done}
        poses = [m for m in self._consensus(topics.CONSENSUS_ROUND, robot) if m.round == index]
        if poses:
            m = poses[0]
            facts["poses"] = {
                "largest_change": m.largest_change,
                "primal": m.primal,
                "dual": m.dual,
                "cost": m.cost,
                "step": m.step,
                "converged": m.converged,
                "links": {
                    link.peer: {
                        "penalty_translation": link.penalty_translation,
                        "penalty_rotation": link.penalty_rotation,
                        "version": link.version,
                        "loop_closure_weights": list(link.weights),
                    }
                    for link in m.links
                },
            }
        return facts

    def _air(self, index: int) -> dict[str, Facts]:
        """Packets of a round by directed link."""
        out: dict[str, Facts] = {}
        for p in self._session.packets:
            if p.round != index:
                continue
            link = out.setdefault(
                f"{p.sender} to {p.receiver}",
                {"packets": 0, "bytes": 0, "kinds": Counter(), "dropped": Counter()},
            )
            link["packets"] += 1
            link["bytes"] += len(p.data)
            link["kinds"][p.kind_name] += 1
            if p.dropped:
                link["dropped"][p.dropped] += 1
        for link in out.values():
            link["kinds"], link["dropped"] = dict(link["kinds"]), dict(link["dropped"])
        return out

    # --- loop closures

    def loop_closures(self, robot: str | None = None) -> Facts:
        """Every candidate for an inter-robot loop closure, with what became of it and why.

        Args:
            robot: only candidates that this robot took part in, as the one that decided or as its peer.

        Returns:
            "candidates": rows with the names of `labels.LOOP_CLOSURE`; "verdicts": how many candidates have each;
            without a candidate "packets": how many were sent and arrived, and how many with descriptors.

        Raises:
            DuagError: the run has no such robot.
        """
        if robot is not None and robot not in self.run.robots:
            raise DuagError(
                f"{self.run.path}: no robot {robot!r}, expected one of {', '.join(self.run.robots)}"
            )
        decisions = [
            decision
            for name in self.run.robots
            for decision in self._consensus(topics.LOOP_CLOSURE_DECISION, name)
            if robot in (None, decision.robot, decision.peer)
        ]
        rows = labels.loop_closures(decisions)
        facts: Facts = {"candidates": rows, "verdicts": labels.verdict_counts(rows)}
        if not rows:
            end_ns = max((p.send_ns for p in self._session.packets), default=0)
            sent = [p for p in self._session.packets if robot in (None, p.sender, p.receiver)]
            arrived = [p for p in sent if p.deliver_ns and min(p.deliver_ns) <= end_ns]
            described = sum(Kind[p.kind_name] is Kind.DESCRIPTORS for p in arrived)
            facts["packets"] = {"sent": len(sent), "arrived": len(arrived), "with_descriptors": described}
        return facts

    # --- one packet

    def packet(self, number: int) -> Facts:
        """One packet, by its place in exchange.mcap, counting from 0.

        Args:
            number: of the packet.

        Raises:
            DuagError: there are fewer.
        """
        packets = self._session.packets
        if not 0 <= number < len(packets):
            raise DuagError(
                f"{self.run.path / 'exchange.mcap'}: has {_numbered('packet', len(packets))}, "
                f"found --packet {number}"
            )
        p = packets[number]
        header = _parsed(p)
        return {
            "packet": number,
            "sender": p.sender,
            "receiver": p.receiver,
            "sequence": p.sequence,
            "round": p.round,
            "kind": p.kind_name,
            "bytes": len(p.data),
            "message": header.message,
            "offset": header.offset,
            "message_bytes": header.total,
            "sent_s": p.send_ns / _NS_PER_S,
            "delivered_s": [at / _NS_PER_S for at in p.deliver_ns],
            "dropped": p.dropped or None,
            "content": self._content(header),
        }

    def _content(self, packet: Packet) -> Facts:
        """What a packet says by itself; of a message in many packets only whole records can be read."""
        kind, payload, team = packet.kind, packet.payload, len(self._session.team)
        try:
            if kind is Kind.STATE:
                state, poses = state_wire.read_state(payload, team)
                names = self._session.team
                pairs = {
                    f"{a} and {b}": state_wire.pair_bit(i, j)
                    for j, b in enumerate(names)
                    for i, a in enumerate(names[:j])
                }
                return {
                    "links": [pair for pair, bit in pairs.items() if state.links & bit],
                    "revoked": [pair for pair, bit in pairs.items() if state.revoked_links & bit],
                    "alignment_hops": state.alignment_hops,
                    "converged_hops": state.converged_hops,
                    "agreed": state.agreed,
                    "done": state.done,
                    "bytes_of_poses": len(poses),
                }
            if kind in EVIDENCE_KINDS:
                owner, _, records = evidence_wire.read_evidence(kind, payload, team)
                return {"owner": self._session.team[owner], "gaussians": records["id"].tolist()}
        except MalformedError as error:
            return {"unreadable": str(error)}
        return {}

    # --- one Gaussian

    def gaussian(self, robot: str, gaussian_id: int) -> Facts:
        """One Gaussian of a robot's own map: its value, who matched it, how its evidence traveled, what fusion did.

        Args:
            robot: name of the robot, or of a component.
            gaussian_id: id of the Gaussian in that map.

        Raises:
            DuagError: no such robot, or no such Gaussian in its map.
        """
        if robot not in self.run.robots:
            raise DuagError(
                f"{self.run.path}: no robot {robot!r}, expected one of {', '.join(self.run.robots)}"
            )
        one = self.run.robots[robot]
        own = one.own_map.gaussians
        rows = np.flatnonzero(own.ids == gaussian_id)
        if not len(rows):
            ids = (
                f"an id from {own.ids.min()} to {own.ids.max()}" if len(own) else "a robot whose map has some"
            )
            raise DuagError(
                f"{one.folder / 'frontend.mcap'}: no Gaussian {gaussian_id} in the map of {robot}, expected {ids}"
            )
        row = slice(int(rows[0]), int(rows[0]) + 1)
        picked = own.select(row)
        evidence = Evidence.from_map(
            robot, picked, one.information, np.array([k.T_map_camera for k in one.keyframes])
        )
        facts: Facts = {"robot": robot, "id": gaussian_id, "anchor_keyframe": int(picked.anchors[0])}
        facts["own_map"] = _described(theta_of(picked)[0]) | {
            "scales_m": np.exp(picked.log_scales[0].astype(np.float64)).tolist(),
            "information_of_the_anchor_frame": _described(Weights.of(evidence).diagonal()[0]),
        }
        facts["matches"] = self._matches(robot, gaussian_id)
        fused = one.fused_map
        at = np.flatnonzero(fused.gaussians.ids[: len(own)] == gaussian_id)
        if len(at):
            merged = fused.gaussians.select(slice(int(at[0]), int(at[0]) + 1))
            facts["fused_map"] = _described(theta_of(merged)[0])
            if fused.information is not None:
                facts["fused_map"]["robots_in_it"] = int(fused.information.observations[at[0]])
        facts["evidence_sent"] = self._journeys(robot, gaussian_id)
        return facts

    def _matches(self, robot: str, gaussian_id: int) -> dict[str, int]:
        """Matched Gaussians by the other robot, of the newest pair lists."""
        from duagc.pipeline.evaluation.network import Session

        out = {}
        for (lower, higher), ids in Session(self.run).pairs.items():
            if robot in (lower, higher):
                own, other = (0, 1) if robot == lower else (1, 0)
                for pair in ids[ids[:, own] == gaussian_id]:
                    out[higher if robot == lower else lower] = int(pair[other])
        return out

    def _journeys(self, robot: str, gaussian_id: int) -> list[Facts]:
        """Packets that carried the Gaussian's evidence, in the order of the log."""
        out = []
        for number, p in enumerate(self._session.packets):
            if Kind[p.kind_name] not in EVIDENCE_KINDS:
                continue
            content = self._content(_parsed(p))
            if content.get("owner") == robot and gaussian_id in content["gaussians"]:
                out.append(
                    {
                        "packet": number,
                        "sender": p.sender,
                        "receiver": p.receiver,
                        "round": p.round,
                        "delivered_s": [at / _NS_PER_S for at in p.deliver_ns],
                        "dropped": p.dropped or None,
                    }
                )
        return out


def _numbered(thing: str, count: int) -> str:
    """Which there are of things that count from 0."""
    return f"{thing}s 0 to {count - 1}" if count > 1 else f"{thing} 0 alone" if count else f"no {thing}"


def _parsed(p: RecordedPacket) -> Packet:
    """The packet without its signature."""
    return parse(p.data[: HEADER_BYTES + payload_bytes(p.data)])


def _described(theta: np.ndarray) -> Facts:
    """theta [13], or numbers by the same coordinates, with their names."""
    return {
        "mean_m": theta[MEAN].tolist(),
        "vec_log_covariance": theta[LOG_COVARIANCE].tolist(),
        "color": theta[COLOR].tolist(),
        "opacity_logit": float(theta[OPACITY]),
    }


def _why_none(packets: dict[str, int]) -> str:
    """Why there is no candidate, by the packets that were sent and arrived."""
    sent, arrived, described = packets.values()
    if not sent:
        return "no packet was sent"
    if not arrived:
        return f"of {sent} packets none arrived in time"
    if not described:
        return f"of {sent} packets {arrived} arrived in time, none with descriptors"
    return (
        f"of {sent} packets {arrived} arrived in time, {described} with descriptors; "
        "no keyframe of one robot resembled one of another by them"
    )


def format_loop_closures(facts: Facts) -> str:
    """Candidates for loop closures as a table, then how many have each verdict.

    Args:
        facts: of the candidates, as `Inspector.loop_closures` gives them.
    """
    rows = facts["candidates"]
    if not rows:
        return f"no candidates: {_why_none(facts['packets'])}"
    cells = [[label for label, _ in labels.LOOP_CLOSURE.values()]]
    cells += [[labels.text(name, row[name]) for name in labels.LOOP_CLOSURE] for row in rows]
    widths = [max(len(row[column]) for row in cells) for column in range(len(labels.LOOP_CLOSURE))]
    lines = ["  ".join(v.ljust(w) for v, w in zip(row, widths, strict=True)).rstrip() for row in cells]
    counts = [f"{count:6} {verdict}" for verdict, count in facts["verdicts"].items()]
    return "\n".join([*lines, "", f"{len(rows):6} candidates, of which", *counts])


def format_facts(facts: Facts, indent: int = 0) -> str:
    """Facts as lines, a name and a value each, what belongs together indented.

    Args:
        facts: by name: numbers, texts, lists and nested facts.
        indent: spaces before every line.
    """
    lines = []
    width = max((len(name) for name in facts), default=0)
    for name, value in facts.items():
        label = " " * indent + name.replace("_", " ")
        if isinstance(value, dict):
            lines.append(label + ("" if value else ": nothing"))
            if value:
                lines.append(format_facts(value, indent + 2))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            lines.append(label)
            lines += [" " * (indent + 2) + _row(entry) for entry in value]
        else:
            lines.append(f"{label:<{indent + width + 2}}{_text(value)}")
    return "\n".join(lines)


def _row(entry: Facts) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {_text(value)}" for name, value in entry.items())


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return " ".join(_text(v) for v in value) or "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else str(value)
