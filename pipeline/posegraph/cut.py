"""One pose graph cut into the graphs of several robots, each of which is connected.

Blocks of consecutive keys are the nearest to what robots would have measured. Where such a block falls to pieces, the
cut follows the graph: a spanning tree of odometry first, then of other edges in the order of the file, is cut into
subtrees that are as equal as its branches allow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.disjoint_sets import join, root_of
from duagc.pipeline.base.errors import DuagError

Index = NDArray[np.int64]


def spanning_forest(count: int, edges: Sequence[tuple[int, int]]) -> tuple[list[int], Index]:
    """Edges of a spanning forest, earlier ones first, and to which tree every node belongs.

    Args:
        count: number of nodes.
        edges: by node; an edge is used if those before it do not join its ends.
    Returns:
        Positions of the used edges; int64 [count], the lowest node of each node's tree.
    """
    group = list(range(count))
    used = []
    for position, (i, j) in enumerate(edges):
        if join(group, i, j):
            used.append(position)
    return used, np.array([root_of(group, k) for k in range(count)], dtype=np.int64)


def owners(count: int, edges: Sequence[tuple[int, int]], robots: int, path: object) -> list[int]:
    """Which robot gets which pose, so that every robot's own graph is connected.

    Args:
        count: number of poses, in the order of their keys.
        edges: ends of the measurements, in the order of the file.
        robots: how many.
        path: of the graph, for messages.
    Returns:
        Number of the robot by pose; robots are numbered by their first pose.
    Raises:
        DuagError: there are too few poses, or more pieces that nothing joins than robots.
    """
    if robots > count // 2:
        raise DuagError(f"{path}: {count} poses cannot be cut into {robots} robots of two poses or more")
    blocks = [min(at * robots // count, robots - 1) for at in range(count)]
    within = [(i, j) for i, j in edges if blocks[i] == blocks[j]]
    if len(set(spanning_forest(count, within)[1].tolist())) == robots:
        return blocks
    first = sorted(range(len(edges)), key=lambda k: abs(edges[k][0] - edges[k][1]) != 1)  # odometry first
    ordered = [edges[k] for k in first]
    used, piece = spanning_forest(count, ordered)
    pieces, sizes = np.unique(piece, return_counts=True)
    if len(pieces) > robots:
        raise DuagError(
            f"{path}: falls into {len(pieces)} pieces that no edge joins; expected at most one for each of "
            f"{robots} robots"
        )
    tree = [ordered[k] for k in used]
    part = np.zeros(count, dtype=np.int64)
    made = 0
    for root, share in zip(pieces.tolist(), _shares(sizes, robots), strict=True):
        for members in _subtrees(root, np.flatnonzero(piece == root), tree, share):
            part[members] = made
            made += 1
    _, starts = np.unique(part, return_index=True)
    number = np.empty(robots, dtype=np.int64)
    number[np.argsort(starts)] = np.arange(robots)
    return [int(k) for k in number[part]]


def _shares(sizes: Index, robots: int) -> list[int]:
    """Robots for every piece: one, and each further one where a robot has most poses so far."""
    shares = np.ones(len(sizes), dtype=np.int64)
    for _ in range(robots - len(sizes)):
        shares[int(np.argmax(sizes / shares))] += 1
    return [int(k) for k in shares]


def _subtrees(root: int, nodes: Index, tree: Sequence[tuple[int, int]], parts: int) -> list[Index]:
    """A tree cut into connected parts: again and again the branch off whose size is nearest to an equal share."""
    neighbors: dict[int, list[int]] = {int(k): [] for k in nodes}
    for i, j in tree:
        if i in neighbors:
            neighbors[i].append(j)
            neighbors[j].append(i)
    parent, order = {root: root}, [root]
    for k in order:  # it grows while it is walked along
        for child in sorted(neighbors[k]):
            if child != parent[k]:
                parent[child] = k
                order.append(child)
    left, out = order, []
    for more in range(parts, 1, -1):
        size = dict.fromkeys(left, 1)
        for k in reversed(left[1:]):
            size[parent[k]] += size[k]
        share = len(left) / more
        top = min(left[1:], key=lambda k: (abs(size[k] - share), k))
        branch = {top}
        for k in left:
            if k != root and parent[k] in branch:
                branch.add(k)
        out.append(np.array(sorted(branch), dtype=np.int64))
        left = [k for k in left if k not in branch]
    return [*out, np.array(sorted(left), dtype=np.int64)]
