"""The result of a session at one robot, by its own estimate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.exchange.evidence_records import to_evidence
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.exchange.wire.anchors_wire import Anchors
from duagc.pipeline.exchange.wire.state_wire import PairList
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.runs.robot_data import LoopClosureRecord, SessionResult


def result_of(agent: MapAgent) -> SessionResult:
    """The result of an agent. Alone, its poses are those of its own map, bit for bit.

    Args:
        agent: after its last tick.
    """
    robot, team, knowledge = agent.data.robot, agent.team, agent.knowledge
    T_common = {robot: agent.data.T_map_keyframe}
    gauge = np.eye(4)
    others: list[int] = []
    placed = _placed(agent)
    if placed:
        others = agent.others
        T_common = {team[i]: poses.T_common_keyframe for i, poses in sorted(placed.items())}
        gauge = _gauge(placed.get(agent.alignment.root))
    T_world = {name: gauge @ T for name, T in T_common.items()} if placed else T_common
    names = [robot, *(team[i] for i in others)]
    own = agent.evidence.own_records()
    evidence = {team[i]: knowledge.sound_records(placed[i]) for i in others if i in placed}
    depths = {team[i]: knowledge.depth(i) for i in others}
    return SessionResult(
        robot=robot,
        component=tuple(sorted(names)),
        T_world_keyframe=T_world[robot],
        T_world_keyframe_of=T_world,
        own_evidence=SHELF.put(to_evidence(robot, own[np.argsort(own["id"])])),
        evidence={name: SHELF.put(to_evidence(name, records)) for name, records in evidence.items()},
        # a robot that sent no kind of depth sent no Gaussian either: nothing of it is rendered
        depth_of={name: depths[name] or agent.data.depth for name in evidence},
        camera_of={team[i]: placed[i].camera for i in others if i in placed},
        arrived={team[i]: agent.config.evidence_share * knowledge.share(i) for i in others if i in placed},
        pairs=_pairs(agent, placed),
        closures=tuple(_closures(agent)),
        agreed=agent.agreed or not others,
        converged=agent.converged,
        rounds=agent.round + 1,
        rounds_to_agreement=agent.rounds_to_agreement,
        refused=dict(sorted(agent.refused.items())),
    )


def _active(agent: MapAgent, pairs: PairList) -> bool:
    """Whether a pair list counts: at the end that made it, only when the other end is known to have it."""
    if pairs.lower != agent.own or agent.done:
        return True
    neighbor = agent.neighbors.get(pairs.higher)
    message = None if neighbor is None else neighbor.passed.pairs.get((pairs.lower, pairs.higher))
    return neighbor is not None and message is not None and not neighbor.transport.is_open(message)


def _placed(agent: MapAgent) -> dict[int, Anchors]:
    """Poses by owner: the final ones as far as they have arrived, else the newest ones."""
    alignment = agent.alignment
    if agent.poses is None and (not agent.others or alignment.undecided):
        return {}
    T_own = alignment.T_world_first(agent.own) @ agent.graph.T_first_keyframe
    if agent.poses is not None:
        T_own = agent.poses.T_world_keyframe
    own = Anchors(agent.own, T_own, agent.graph.T_map_keyframe[0], agent.data.camera)
    newest = agent.evidence.current.known(alignment.revoked, alignment.members, alignment.T_world_first)
    return {**newest, agent.own: own, **agent.knowledge.anchors}


def _pairs(agent: MapAgent, placed: Mapping[int, Anchors]) -> dict[tuple[str, str], NDArray[np.int64]]:
    """Matched Gaussians of the component.

    Where a contact ended before the list of two robots was here, and their poses and some of their evidence are, this
    robot matches what it has.
    """
    team, knowledge = agent.team, agent.knowledge
    members = sorted({agent.own, *agent.others}) if placed else [agent.own]
    found = dict[tuple[str, str], NDArray[np.int64]]()
    for a, b in combinations(members, 2):
        known = knowledge.pairs.get((a, b))
        if known is not None and _active(agent, known):
            found[team[a], team[b]] = known.ids
        elif a in placed and b in placed:
            ids = agent.evidence.matched(placed[a], placed[b])
            found |= {(team[a], team[b]): ids} if len(ids) else {}
    return found


def _gauge(root: Anchors | None) -> Array:
    """T_world_common: the root's first keyframe is where its own map has it. Identity before that has arrived."""
    if root is None:
        return np.eye(4)
    return root.T_map_first @ se3.inverse(root.T_common_keyframe[0])


def _closures(agent: MapAgent) -> Iterator[LoopClosureRecord]:
    """Every candidate that this robot decided on, with the reason for what became of it."""
    for n in agent.neighbors.values():
        for t in n.loop_closing.tried if n.loop_closing else ():
            r = t.result
            weight = None if r.closure is None else _weight(agent, n, r.closure)
            verdict, detail = r.verdict, r.detail
            if weight is not None:
                detail = f"{detail}; the link {n.link.contradiction}" if n.link.contradiction else detail
                if n.link.undecided:
                    verdict, weight = Verdict.UNDECIDED, 0.0
                elif n.link.revoked:
                    verdict = Verdict.ALONE if weight >= INLIER_WEIGHT else Verdict.OUTWEIGHED
                    detail, weight = f"weight {weight:.2f} when the link was revoked; {detail}", 0.0
                else:  # the graduated weights have the last word
                    verdict = Verdict.KEPT if weight >= INLIER_WEIGHT else Verdict.OUTWEIGHED
            yield LoopClosureRecord(
                robot=agent.data.robot,
                peer=n.name,
                own_keyframe=t.candidate.own_keyframe,
                peer_keyframe=t.candidate.peer_keyframe,
                score=t.candidate.score,
                verdict=verdict.value,
                matches=r.matches,
                inliers=r.inliers,
                detail=detail,
                weight=weight,
                T_own_peer=None if r.closure is None else r.closure.T_own_peer,
                information=None if r.closure is None else r.closure.information,
            )


def _weight(agent: MapAgent, n: Neighbor, closure: LoopClosure) -> float | None:
    """Robust weight of a loop closure at the end, or when its link was revoked; None if it took no part."""
    if n.loop_closing is None or n.loop_closing.joined is None:
        return None
    held = n.loop_closing.joined.closures
    if n.link.revoked:  # without weights: a state revoked the link before this robot had decided on it
        weights = n.link.weights or [0.0] * len(held)
    elif agent.poses is not None and n.index in agent.links:
        weights = agent.poses.weights(n.name).tolist()
    else:
        return None
    return next((w for w, other in zip(weights, held, strict=True) if other is closure), None)
