"""Pose graphs of a team as the field distributes them: `.g2o`, one `.g2o` per robot, Kimera-Multi csv.

A loop closure that both ends' files hold counts once; both ends know it, as in these files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.posegraph.cut import owners, spanning_forest
from duagc.pipeline.posegraph.edges import Edges, Key, read_g2o, read_kimera
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, isotropic_information

_REFERENCES = ("reference_inliers.csv", "gt_info.xml")


@dataclass(frozen=True)
class RobotGraph:
    """One robot's part of a pose graph.

    Attributes:
        name: of the robot.
        keyframes: how many.
        odometry: relative poses between own keyframes that are trusted: consecutive ones.
        loops: all other own relative poses.
        closures: loop closures by neighbor, from this robot's side.
    """

    name: str
    keyframes: int
    odometry: RelativePoses
    loops: RelativePoses
    closures: dict[str, list[LoopClosure]]


@dataclass(frozen=True)
class TeamGraph:
    """What the robots know, and what only the evaluation knows.

    Attributes:
        robots: their parts, by name.
        loops_true: by robot, bool per loop; None without reference.
        closures_true: by pair (a < b), bool per loop closure; None without reference.
        reference: name of the reference file.
        ignored: files of the folder that were not read.
    """

    robots: dict[str, RobotGraph]
    loops_true: dict[str, NDArray[np.bool_]] | None = None
    closures_true: dict[tuple[str, str], NDArray[np.bool_]] | None = None
    reference: str | None = None
    ignored: tuple[str, ...] = ()

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Pairs (a < b) of robots with loop closures, sorted."""
        return sorted((a, b) for a, robot in self.robots.items() for b in robot.closures if a < b)

    def components(self) -> list[tuple[str, ...]]:
        """Robots that loop closures connect, each group and the list of groups sorted."""
        left, found = set(self.robots), []
        while left:
            reached, border = set(), {min(left)}
            while border:
                reached |= border
                border = {b for a in border for b in self.robots[a].closures} - reached
            found.append(tuple(sorted(reached)))
            left -= reached
        return found


def read_team_graph(
    path: str | Path, robots: int | None = None, *, only_reference: bool = False
) -> TeamGraph:
    """Read a pose graph and give every robot its own.

    Args:
        path: a `.g2o` file; a folder of one `.g2o` per robot with gtsam symbols as keys; a folder of
            Kimera-Multi `robot*/measurements.csv`; or a folder with one `.g2o`.
        robots: cut a single graph among so many (default 4): into blocks of consecutive keys or, where one of them
            is not connected, along its edges; for a team's own files, at most a check.
        only_reference: leave out loops and loop closures that the reference next to the graph does not name
            as true.
    Raises:
        DuagError: nothing of the kind is there, a line is not understood, or the graph is two-dimensional.
    """
    path = Path(path)
    edges, files, ignored = _read(path)
    names = sorted({key[0] for key in (*edges.i, *edges.j)})
    if names == [""]:
        edges, order = _cut(edges, 4 if robots is None else robots, path)
    elif robots is not None and robots != len(names):
        raise DuagError(
            f"{path}: --robots {robots}, but the graph is that of {len(names)} robots: {', '.join(names)}"
        )
    else:
        order = {(robot, key): at for robot, own in _indices(edges).items() for key, at in own.items()}
    edges, reference = _with_reference(edges, path, files)
    consecutive = _consecutive(edges, order)
    if only_reference:
        if edges.inlier is None:
            raise DuagError(f"{path}: no reference next to it, expected {' or '.join(_REFERENCES)}")
        keep = edges.inlier | consecutive
        edges, consecutive = edges.select(keep), consecutive[keep]
    return _team(edges, consecutive, reference, ignored, path=path)


def _read(path: Path) -> tuple[Edges, int, tuple[str, ...]]:
    """Edges of a file or a folder, how many files they are from, and the files of it that were not read."""
    if path.is_file():
        return _merge([read_g2o(path)]), 1, ()
    if not path.is_dir():
        raise DuagError(f"{path}: not found, expected a .g2o file or a folder of a team's pose graphs")
    tables = sorted(path.glob("robot*/measurements.csv"), key=_natural)
    if tables:
        return _merge([read_kimera(table) for table in tables]), len(tables), ()
    files = sorted(path.glob("*.g2o"), key=_natural)
    if not files:
        raise DuagError(
            f"{path}: found neither *.g2o nor robot*/measurements.csv, expected a team's pose graphs"
        )
    graphs = [read_g2o(file) for file in files]
    if len(files) == 1:
        return _merge(graphs), 1, ()
    plain = [all(key[0] == "" for key in (*g.i, *g.j)) for g in graphs]
    team = [g for g, is_plain in zip(graphs, plain, strict=True) if not is_plain]
    if not team:
        raise DuagError(
            f"{path}: {len(files)} graphs with plain keys; a team's graphs need gtsam symbols as keys"
        )
    ignored = tuple(f.name for f, is_plain in zip(files, plain, strict=True) if is_plain)
    return _merge(team), len(team), ignored


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts robot10 behind robot9."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", str(path))]


def _merge(graphs: Sequence[Edges]) -> Edges:
    """All edges of all files; one that another file holds too, number for number, counts once."""
    i: list[Key] = []
    j: list[Key] = []
    kept: list[NDArray[np.bool_]] = []
    seen: set[tuple[Key, Key, bytes]] = set()
    for g in graphs:
        names = [(a, b, T.tobytes()) for a, b, T in zip(g.i, g.j, g.T_i_j, strict=True)]
        new = np.array([name not in seen for name in names], dtype=bool)
        seen.update(names)
        kept.append(new)
        i += [k for k, is_new in zip(g.i, new, strict=True) if is_new]
        j += [k for k, is_new in zip(g.j, new, strict=True) if is_new]

    def joined(name: str) -> Array:
        return np.concatenate([getattr(g, name)[k] for g, k in zip(graphs, kept, strict=True)])

    return Edges(i, j, joined("T_i_j"), joined("kappa"), joined("tau"))


def _cut(edges: Edges, robots: int, path: Path) -> tuple[Edges, dict[Key, int]]:
    """One graph cut among robots, and the place of every key in the order of all keys."""
    keys = sorted({key[1] for key in (*edges.i, *edges.j)})
    rank = {key: at for at, key in enumerate(keys)}
    ends = [(rank[i[1]], rank[j[1]]) for i, j in zip(edges.i, edges.j, strict=True)]
    width = len(str(robots - 1))
    names = [f"robot{robot:0{width}}" for robot in owners(len(keys), ends, robots, path)]
    i, j = [(names[a], keys[a]) for a, _ in ends], [(names[b], keys[b]) for _, b in ends]
    order = {(names[at], key): at for key, at in rank.items()}
    return Edges(i, j, edges.T_i_j, edges.kappa, edges.tau, edges.inlier), order


def _with_reference(edges: Edges, path: Path, files: int) -> tuple[Edges, str | None]:
    """Mark what a file next to the graph names as true; for the evaluation only."""
    folder = path if path.is_dir() else path.parent
    found = [folder / name for name in _REFERENCES if (folder / name).is_file()]
    if not found:
        return edges, None
    file = found[0]
    inlier = _named_true(edges, file) if file.suffix == ".csv" else _not_numbered(len(edges.i), file, files)
    return Edges(edges.i, edges.j, edges.T_i_j, edges.kappa, edges.tau, inlier), file.name


def _named_true(edges: Edges, file: Path) -> NDArray[np.bool_]:
    """What a reference of Kimera-Multi calls true, bool [m]; it may name an edge from its other end."""
    named: dict[tuple[Key, Key], bool] = {}
    head, *lines = read_text(file, "a pose graph").splitlines() or [""]
    if len(head.split(",")) != 5 or head.replace(",", "").strip().isdecimal():
        raise DuagError(
            f"{file}: begins with {head[:60]!r}, expected robot_src,pose_src,robot_dst,pose_dst,inlier"
        )
    for line in lines:
        words = line.split(",")
        if len(words) != 5 or not all(word.strip().isdecimal() for word in words):
            raise DuagError(f"{file}: expected robot_src,pose_src,robot_dst,pose_dst,inlier, found {line!r}")
        a, i, b, j, flag = (int(word) for word in words)
        ends = (f"robot{a}", i), (f"robot{b}", j)
        named[ends] = named.get(ends, False) or flag != 0
    present = {ends for i, j in zip(edges.i, edges.j, strict=True) for ends in ((i, j), (j, i))}
    looked_for = {ends for ends, true in named.items() if true} or set(named)
    if looked_for and not looked_for & present:
        source, target = min(looked_for)
        raise DuagError(
            f"{file}: found {len(looked_for)} edges, the first from {source[0]} {source[1]} to {target[0]} "
            f"{target[1]}, and none is in the graph; expected the reference of this graph"
        )
    pairs = zip(edges.i, edges.j, strict=True)
    return np.array([named.get((i, j), named.get((j, i), False)) for i, j in pairs], dtype=bool)


def _not_numbered(count: int, file: Path, files: int) -> NDArray[np.bool_]:
    """What is left by numbers of false edges of the only file, counted from 1 in its order; odometry included."""
    if files != 1:
        raise DuagError(
            f"{file}: numbers the edges of one file, but {files} were read; expected {_REFERENCES[0]}"
        )
    text = read_text(file, "a pose graph")
    false = [int(n) for n in re.findall(r"<outlier_lc_indices>\s*(\d+)\s*<", text)]
    if not false or max(false) > count or min(false) < 1:
        raise DuagError(f"{file}: expected <outlier_lc_indices> from 1 to the {count} edges of the graph")
    inlier = np.ones(count, dtype=bool)
    inlier[np.array(false) - 1] = False
    return inlier


def _indices(edges: Edges) -> dict[str, dict[int, int]]:
    """By robot: index of a keyframe among its own by key, ascending."""
    keys: dict[str, set[int]] = {}
    for robot, key in (*edges.i, *edges.j):
        keys.setdefault(robot, set()).add(key)
    return {robot: {key: at for at, key in enumerate(sorted(own))} for robot, own in sorted(keys.items())}


def _consecutive(edges: Edges, order: Mapping[Key, int]) -> NDArray[np.bool_]:
    """Edges between neighboring keyframes of one robot: its odometry.

    Args:
        edges: of the whole graph.
        order: place of a keyframe among its robot's own, or among all if one graph was cut.
    """
    pairs = zip(edges.i, edges.j, strict=True)
    return np.array([i[0] == j[0] and abs(order[i] - order[j]) == 1 for i, j in pairs], dtype=bool)


@dataclass
class _Own:
    """Rows of the edge list that belong to one robot."""

    odometry: list[int] = field(default_factory=list)
    loops: list[int] = field(default_factory=list)


def _team(
    edges: Edges,
    consecutive: NDArray[np.bool_],
    reference: str | None,
    ignored: tuple[str, ...],
    *,
    path: Path,
) -> TeamGraph:
    """Give every edge to the robots that it concerns."""
    at = _indices(edges)
    own = {robot: _Own() for robot in at}
    pairs: dict[tuple[str, str], list[int]] = {}
    for k, ((a, _), (b, _)) in enumerate(zip(edges.i, edges.j, strict=True)):
        if a == b:
            (own[a].odometry if consecutive[k] else own[a].loops).append(k)
        else:
            pairs.setdefault((min(a, b), max(a, b)), []).append(k)
    information = isotropic_information(edges.kappa, edges.tau)

    def factors(rows: Iterable[int]) -> RelativePoses:
        k = np.array(list(rows), dtype=np.int64)
        i, j = ([at[keys[r][0]][keys[r][1]] for r in k] for keys in (edges.i, edges.j))
        return RelativePoses(np.array(i, np.int64), np.array(j, np.int64), edges.T_i_j[k], information[k])

    def closure(k: int, side: str) -> LoopClosure:
        (a, i), (b, j) = edges.i[k], edges.j[k]
        seen_from_i = LoopClosure(at[a][i], at[b][j], edges.T_i_j[k], information[k])
        return seen_from_i if a == side else seen_from_i.reversed()

    robots = {}
    for name in at:
        _tie(own[name], edges, at[name], name=name, path=path)
        closures = {
            (b if a == name else a): [closure(k, name) for k in rows]
            for (a, b), rows in sorted(pairs.items())
            if name in (a, b)
        }
        robots[name] = RobotGraph(
            name, len(at[name]), factors(own[name].odometry), factors(own[name].loops), closures
        )
    if edges.inlier is None:
        return TeamGraph(robots, ignored=ignored)
    return TeamGraph(
        robots,
        {name: edges.inlier[np.array(rows.loops, np.int64)] for name, rows in own.items()},
        {pair: edges.inlier[np.array(rows, np.int64)] for pair, rows in pairs.items()},
        reference,
        ignored,
    )


def _tie(own: _Own, edges: Edges, at: dict[int, int], *, name: str, path: Path) -> None:
    """Trust loops without which a robot's own keyframes fall apart: nothing could contradict them.

    Raises:
        DuagError: they fall apart even so.
    """
    rows = [*own.odometry, *own.loops]
    ends = [(at[edges.i[k][1]], at[edges.j[k][1]]) for k in rows]
    used, piece = spanning_forest(len(at), ends)
    tying = {rows[position] for position in used if position >= len(own.odometry)}
    own.odometry += [k for k in own.loops if k in tying]
    own.loops = [k for k in own.loops if k not in tying]
    pieces = len(np.unique(piece))
    if pieces > 1:
        raise DuagError(
            f"{path}: the own keyframes of {name} fall into {pieces} pieces without the other robots; expected one"
        )
