"""Tracks: which Gaussians of many robots are one piece of surface, by the matched pairs of every two of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.disjoint_sets import root_of
from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.consensus.evidence import Evidence, rows_by_id
from duagc.pipeline.consensus.matching import Index, Pairs, gaussian_distance


@dataclass(frozen=True)
class Tracks:
    """Groups of matched Gaussians over all robots, at most one of each robot in a group.

    Rows of a track follow in order of robot.

    Attributes:
        robots: names, sorted.
        track: int64 [r], ascending.
        robot: int64 [r], index into robots.
        row: int64 [r], row in that robot's evidence.
    """

    robots: tuple[str, ...]
    track: Index
    robot: Index
    row: Index


def tracks(evidence: Mapping[str, Evidence], pairs: Pairs, config: MapMatching) -> Tracks:
    """Connected components of the pairs over all robots.

    A component that holds two Gaussians of one robot loses its pair of largest d_G (ties by ids) until none does.

    Args:
        evidence: of every robot, in the world frame.
        pairs: (robot a, robot b) -> ids int64 [m, 2]; pairs of Gaussians that `evidence` lacks are left out,
            which is what a robot does that has not received them.
        config: scales of the distance.
    """
    robots = tuple(sorted(evidence))
    first = dict(zip(robots, np.cumsum([0, *(len(evidence[r]) for r in robots)]).tolist(), strict=False))
    owner = np.repeat(np.arange(len(robots)), [len(evidence[r]) for r in robots])
    parts, apart = [], []
    for a, b in sorted(p for p in pairs if p[0] in evidence and p[1] in evidence):
        i, j = (rows_by_id(pairs[a, b][:, k], evidence[name].ids) for k, name in enumerate((a, b)))
        known = (i >= 0) & (j >= 0)
        i, j = i[known], j[known]
        parts.append((first[a] + i, first[b] + j))
        apart.append((evidence[a], i, evidence[b], j))
    if not any(len(rows) for rows, _ in parts):
        none = np.zeros(0, np.int64)
        return Tracks(robots, none, none, none)
    i, j = (np.concatenate([p[k] for p in parts]).astype(np.int64) for k in range(2))
    component, touched, broken = _components(i, j, owner)
    if len(broken):
        d = np.concatenate([gaussian_distance(*pair, config=config) for pair in apart if len(pair[1])])
        bad = np.flatnonzero(np.isin(component[i], broken))
        keep = np.ones(len(i), dtype=bool)
        keep[bad] = _of_sound_components(i[bad], j[bad], d[bad], owner)
        i, j = i[keep], j[keep]
        component, touched, _ = _components(i, j, owner)
    track = np.unique(component[touched], return_inverse=True)[1].astype(np.int64)
    order = np.lexsort((touched, track))
    rows, robot = touched[order], owner[touched[order]].astype(np.int64)
    start = np.array([first[r] for r in robots], dtype=np.int64)
    return Tracks(robots, track[order], robot, rows - start[robot])


def _components(i: Index, j: Index, owner: Index) -> tuple[Index, Index, Index]:
    """Component of every Gaussian by the pairs i, j, which Gaussians have one, and components with a robot twice.

    Args:
        i: [m], rows of all Gaussians.
        j: [m], rows of all Gaussians.
        owner: [n], robot of every Gaussian.
    """
    graph = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(len(owner), len(owner)))
    component = csgraph.connected_components(graph, directed=False)[1].astype(np.int64)
    touched = np.unique(np.concatenate([i, j]))
    robots = int(owner.max()) + 1
    twice, count = np.unique(component[touched] * robots + owner[touched], return_counts=True)
    return component, touched, np.unique(twice[count > 1] // robots)


def _of_sound_components(i: Index, j: Index, d: Array, owner: Index) -> NDArray[np.bool_]:
    """Which pairs [m] are left when every component with a robot twice has lost its worst pair, until none has one.

    A pair becomes the worst of its component when all worse ones are gone, and the better ones are still there. So it
    is left if it and the better ones connect it with no robot twice: one pass over the pairs, from the best, joins
    their components.

    Args:
        i: [m], rows of all Gaussians.
        j: [m], rows of all Gaussians.
        d: [m], how much the two differ.
        owner: [n], robot of every Gaussian.
    """
    nodes, at = np.unique(np.concatenate([i, j]), return_inverse=True)
    ends = at.reshape(2, -1).T.tolist()
    parent = list(range(len(nodes)))
    # robots of the component of a root, by bits; 0: one of them is there twice
    robots = [1 << int(k) for k in owner[nodes]]
    keep = np.zeros(len(i), dtype=bool)
    for k in np.lexsort((j, i, -d))[::-1].tolist():
        first, second = (root_of(parent, end) for end in ends[k])
        if first != second:
            a, b = robots[first], robots[second]
            parent[second] = first
            robots[first] = 0 if a & b or not (a and b) else a | b
        keep[k] = robots[first] != 0
    return keep
