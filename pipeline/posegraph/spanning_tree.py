"""The best supported tree over a team's links, and the common frame that follows from it."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3


def chain_frames(
    pairs: Mapping[tuple[str, str], tuple[Array, float]], robots: Sequence[str]
) -> dict[str, Array]:
    """Frames of all robots in their component's root, the lowest name, along the best supported spanning tree.

    Args:
        pairs: (a, b) -> (T_amap_bmap, support); one direction of each pair is enough.
        robots: all names.
    Returns:
        T_world_map [4, 4] of every robot; the identity for every root, a robot without a partner included.
    """
    motion = {}
    for (a, b), (T_a_b, _) in pairs.items():
        motion[a, b] = np.asarray(T_a_b)
        motion.setdefault((b, a), se3.inverse(T_a_b))
    parent = spanning_tree({pair: support for pair, (_, support) in pairs.items()}, robots)
    T_world_map: dict[str, Array] = {}
    for robot, nearer in parent.items():
        T_world_map[robot] = np.eye(4) if nearer is None else T_world_map[nearer] @ motion[nearer, robot]
    return T_world_map


def spanning_tree(pairs: Mapping[tuple[str, str], float], robots: Sequence[str]) -> dict[str, str | None]:
    """Parent of every robot in its component's best supported tree, parents first; None for every root.

    Args:
        pairs: (a, b) -> support; one direction of each pair is enough.
        robots: all names; the lowest of a component is its root.
    """
    support = {**{(b, a): value for (a, b), value in pairs.items()}, **pairs}
    edges: dict[str, list[tuple[float, tuple[str, str]]]] = {robot: [] for robot in robots}
    for (a, b), value in support.items():
        edges[a].append((-value, (a, b)))
    parent: dict[str, str | None] = {}
    for root in sorted(robots):
        if root in parent:
            continue
        parent[root] = None
        border = list(edges[root])
        heapq.heapify(border)
        while border:
            a, b = heapq.heappop(border)[1]
            if b not in parent:
                parent[b] = a
                for edge in edges[b]:
                    heapq.heappush(border, edge)
    return parent
