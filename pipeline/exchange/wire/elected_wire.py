"""Bytes of what robots send when one of them solves for all: their graphs up the tree, the answer down."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.exchange.wire.reader import Reader, check_information, pose_bytes
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses

Index = NDArray[np.int64]
GRAPHS, ANSWER = 8, 9  # first byte; above those of elimination
_HEAD, _PART, _LINK, _ROBOT = (struct.Struct(f) for f in ("<BB", "<BIIIB", "<BI", "<BIIB"))
_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class GraphPart:
    """What one robot knows.

    Attributes:
        T_world_keyframe: [n, 4, 4], where its keyframes start.
        trusted: relative poses between them.
        loops: further ones, which may be false.
        closures: loop closures that it holds, by index of the other robot.
    """

    T_world_keyframe: Array
    trusted: RelativePoses
    loops: RelativePoses
    closures: Mapping[int, tuple[LoopClosure, ...]]


@dataclass(frozen=True)
class AnswerPart:
    """What the elected robot found for one robot.

    Attributes:
        T_world_keyframe: [n, 4, 4].
        loop_weights: of its own loops.
        closure_weights: of the loop closures that it holds, by index of the other robot.
    """

    T_world_keyframe: Array
    loop_weights: Array
    closure_weights: Mapping[int, Array]


def write_graphs(parts: Mapping[int, GraphPart]) -> bytes:
    """Bytes of the graphs of some robots, by index.

    Args:
        parts: by index of the robot.
    """
    out = [_HEAD.pack(GRAPHS, len(parts))]
    for index, part in sorted(parts.items()):
        counts = len(part.T_world_keyframe), len(part.trusted), len(part.loops), len(part.closures)
        out += [_PART.pack(index, *counts), pose_bytes(part.T_world_keyframe)]
        for factors in (part.trusted, part.loops):
            ends = np.stack([factors.i, factors.j], axis=1)
            out.append(_factors(ends, factors.T_i_j, factors.information))
        for peer, closures in sorted(part.closures.items()):
            ends = np.array([(c.own_keyframe, c.peer_keyframe) for c in closures], np.int64).reshape(-1, 2)
            T = np.array([c.T_own_peer for c in closures]).reshape(-1, 4, 4)
            information = np.array([c.information for c in closures]).reshape(-1, 6, 6)
            out += [_LINK.pack(peer, len(closures)), _factors(ends, T, information)]
            out.append(array_bytes([c.measured_from_peer for c in closures], "uint8"))
    return b"".join(out)


def read_graphs(payload: bytes, team: int) -> dict[int, GraphPart]:
    """The graphs of some robots.

    Args:
        payload: of the message.
        team: number of robots.

    Returns:
        The graphs by index of the robot.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader, out = Reader(payload, "graphs"), dict[int, GraphPart]()
    for _ in range(_count(reader, GRAPHS)):
        index, keyframes, trusted, loops, links = reader.fields(_PART)
        poses = reader.poses(keyframes)
        both = []
        for count in (trusted, loops):
            ends, T, information = _read_factors(reader, count)
            if np.any((ends < 0) | (ends >= keyframes)):
                raise MalformedError("graphs: a keyframe does not exist")
            both.append(RelativePoses(ends[:, 0], ends[:, 1], T, information))
        closures = dict[int, tuple[LoopClosure, ...]]()
        for _ in range(links):
            peer, count = reader.fields(_LINK)
            closures[peer] = _read_closures(reader, count, keyframes)
        if index in out or max([index, *closures]) >= team or index in closures:
            raise MalformedError("graphs: a robot twice, or none of the team")
        out[index] = GraphPart(poses, both[0], both[1], closures)
    reader.done()
    return out


def write_answer(parts: Mapping[int, AnswerPart]) -> bytes:
    """Bytes of the answer for some robots, by index.

    Args:
        parts: by index of the robot.
    """
    out = [_HEAD.pack(ANSWER, len(parts))]
    for index, part in sorted(parts.items()):
        sizes = len(part.T_world_keyframe), len(part.loop_weights), len(part.closure_weights)
        out += [_ROBOT.pack(index, *sizes), pose_bytes(part.T_world_keyframe)]
        out.append(array_bytes(part.loop_weights, "float64"))
        for peer, weights in sorted(part.closure_weights.items()):
            out += [_LINK.pack(peer, len(weights)), array_bytes(weights, "float64")]
    return b"".join(out)


def read_answer(payload: bytes) -> dict[int, AnswerPart]:
    """The answer for some robots.

    Args:
        payload: of the message.

    Returns:
        The answer by index of the robot.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader, out = Reader(payload, "answer"), dict[int, AnswerPart]()
    for _ in range(_count(reader, ANSWER)):
        index, keyframes, loops, links = reader.fields(_ROBOT)
        poses, loop_weights = reader.poses(keyframes), reader.array("float64", (loops,))
        weights = dict[int, Array]()
        for _ in range(links):
            peer, count = reader.fields(_LINK)
            weights[peer] = reader.array("float64", (count,))
        out[index] = AnswerPart(poses, loop_weights, weights)
    reader.done()
    return out


def _count(reader: Reader, expected: int) -> int:
    code, count = reader.fields(_HEAD)
    if code != expected:
        raise MalformedError(f"elected: message {code}, expected {expected}")
    return int(count)


def _factors(ends: Index, T: Array, information: Array) -> bytes:
    upper = information[:, _UPPER[0], _UPPER[1]]
    return array_bytes(ends, "int32") + pose_bytes(T) + array_bytes(upper, "float64")


def _read_factors(reader: Reader, count: int) -> tuple[Index, Array, Array]:
    ends = reader.array("int32", (count, 2)).astype(np.int64)
    T, upper = reader.poses(count), reader.array("float64", (count, 21))
    information = np.zeros((count, 6, 6))
    information[:, _UPPER[0], _UPPER[1]] = upper
    information[:, _UPPER[1], _UPPER[0]] = upper
    check_information(information, "graphs")
    return ends, T, information


def _read_closures(reader: Reader, count: int, keyframes: int) -> tuple[LoopClosure, ...]:
    ends, T, information = _read_factors(reader, count)
    turned = reader.array("uint8", (count,)).astype(bool).tolist()
    if np.any((ends < 0) | (ends[:, :1] >= keyframes)):
        raise MalformedError("graphs: a keyframe does not exist")
    return tuple(
        LoopClosure(own, peer, T[k], information[k], turned[k]) for k, (own, peer) in enumerate(ends.tolist())
    )
