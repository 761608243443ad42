"""Large pose graphs of a team with loop closures that deceive, from a seed.

Robots walk the streets of a square town. True loop closures come in stretches where two walks, or one walk twice, see
the same place. False ones come in clusters: a stretch of one walk is taken for a stretch elsewhere, so that all loop
closures of the cluster agree on one wrong motion, with the same noise and in the same numbers as true ones; a share of
them is single. The information in the files is that of the noise that was drawn.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.atomic_folder import FolderKind, new_folder
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.base.random_streams import generator
from duagc.pipeline.geometry import se3, so3

_BLOCK_M, _STEP_M = 50.0, 1.5  # between two crossings; between two keyframes
_NEAR_M, _NEAR_RAD = 4.0, 0.8  # keyframes that see the same place
_FAR_M = 15.0  # a false loop closure joins places at least so far apart
_APART = 60  # keyframes between the ends of a loop of one robot
_LONGEST, _STRIDE = 15, 2  # loop closures of a stretch or cluster; keyframes between two of them
_SINGLE, _OWN = 0.1, 0.25  # share of false ones that stand alone; share of loops within one robot
_TRIES = 200_000
GRAPH = FolderKind(
    "a team's pose graph", ("reference_inliers.csv",), ("reference_inliers.csv", "robot*/measurements.csv")
)
COLUMNS = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau"


@dataclass(frozen=True)
class Noise:
    """Standard deviations of a measured motion, per axis.

    Attributes:
        rad: of the rotation.
        m: of the translation.
    """

    rad: float
    m: float

    @property
    def weights(self) -> tuple[float, float]:
        """SE-Sync's kappa and tau."""
        return 1 / (2 * self.rad**2), 1 / self.m**2


ODOMETRY, CLOSURE = Noise(0.003, 0.03), Noise(0.01, 0.1)

Measured = tuple[int, int, int, int, Array]
"""Robot and keyframe that it is seen from, robot and keyframe that is seen, [4, 4]."""


@dataclass(frozen=True)
class TownGraph:
    """A generated team.

    Attributes:
        T_world_keyframe: [n, 4, 4] by robot, the truth.
        odometry: measured motions between consecutive keyframes.
        closures: loops and loop closures, in the order of the files.
        true: bool per loop closure.
    """

    T_world_keyframe: list[Array]
    odometry: list[Measured]
    closures: list[Measured]
    true: list[bool]


def generate(robots: int, keyframes: int, closures: int, false: float, *, seed: int) -> TownGraph:
    """Make a team's pose graph.

    Args:
        robots: how many.
        keyframes: of each.
        closures: loop closures of the whole team, loops of single robots included.
        false: share of them that is false.
        seed: of everything that is random.
    Raises:
        DuagError: the walks do not meet often enough for so many loop closures.
    """
    side = max(2, round((robots * keyframes * _STEP_M / _BLOCK_M / 6) ** 0.5))
    poses = [_walk(side, keyframes, generator(seed, "walk", robot=r)) for r in range(robots)]
    odometry = []
    for r, T in enumerate(poses):
        rng = generator(seed, "odometry", robot=r)
        moved = _noisy(se3.inverse(T[:-1]) @ T[1:], ODOMETRY, rng)
        odometry += [(r, k, r, k + 1, M) for k, M in enumerate(moved)]
    wanted = round(closures * false)
    town = _Closures(poses)
    town.add_true(closures - wanted, generator(seed, "true closures"))
    town.add_false(wanted, generator(seed, "false closures"))
    rng = generator(seed, "order of closures")
    order = rng.permutation(len(town.found))
    ends = [town.found[k] for k in order]
    measured = _noisy(np.array([T for *_, T in ends]).reshape(-1, 4, 4), CLOSURE, rng)
    rows = [(a, i, b, j, M) for (a, i, b, j, _), M in zip(ends, measured, strict=True)]
    return TownGraph(poses, odometry, rows, [bool(k < town.count_true) for k in order])


def _walk(side: int, keyframes: int, rng: np.random.Generator) -> Array:
    """True poses [n, 4, 4] of a walk along the streets that never turns back; the ground rolls a little."""
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    at, heading = rng.integers(0, side, 2), int(rng.integers(4))
    corners = [at]
    while (len(corners) - 1) * _BLOCK_M < keyframes * _STEP_M:
        turns = [(heading + k) % 4 for k in (0, 1, 3)]
        free = [t for t in turns if np.all((at + ways[t] >= 0) & (at + ways[t] < side))]
        heading = int(rng.choice(free or [(heading + 2) % 4]))
        at = at + ways[heading]
        corners.append(at)
    along = _STEP_M * np.arange(keyframes) / _BLOCK_M
    k = along.astype(np.int64)
    line = np.array(corners, dtype=np.float64)
    way = line[k + 1] - line[k]
    xy = _BLOCK_M * (line[k] + way * (along - k)[:, None])
    xy += 1.5 * np.stack([-way[:, 1], way[:, 0]], axis=1)  # keeps to one side of the street
    z = 2 * np.sin(xy[:, 0] / 40) + 2 * np.cos(xy[:, 1] / 55)
    yaw = np.arctan2(way[:, 1], way[:, 0])
    R = so3.exp(np.stack([0 * yaw, 0 * yaw, yaw], axis=1)) @ so3.exp(0.02 * rng.normal(size=(keyframes, 3)))
    return se3.from_rotation_translation(R, np.column_stack([xy, z]))


def _noisy(T: Array, noise: Noise, rng: np.random.Generator) -> Array:
    """Motions [m, 4, 4] with noise."""
    w, v = noise.rad * rng.normal(size=(len(T), 3)), noise.m * rng.normal(size=(len(T), 3))
    return T @ se3.from_rotation_translation(so3.exp(w), v)


class _Closures:
    """Loop closures without noise, true ones first."""

    def __init__(self, poses: list[Array]) -> None:
        self.poses, self.n = poses, len(poses[0])
        self.found: list[Measured] = []
        self.count_true = 0
        self._taken: set[tuple[int, int, int, int]] = set()

    def add_true(self, count: int, rng: np.random.Generator) -> None:
        """Stretches where two walks pass the same place."""
        T = np.concatenate(self.poses)
        near = cKDTree(T[:, :3, 3]).query_pairs(_NEAR_M, output_type="ndarray")
        near = near[np.lexsort(near.T[::-1])]
        angle = se3.distance(T[near[:, 0]], T[near[:, 1]])[1]
        same = near[:, 0] // self.n == near[:, 1] // self.n
        near = near[(angle < _NEAR_RAD) & ~(same & (near[:, 1] - near[:, 0] < _APART))]
        same = near[:, 0] // self.n == near[:, 1] // self.n
        pools = [near[same], near[~same]]
        for _ in range(_TRIES):
            left = count - len(self.found)
            pool = pools[0 if rng.random() < _OWN else 1]
            if not left or not (len(pools[0]) or len(pools[1])):
                break
            if len(pool):
                p, q = pool[int(rng.integers(len(pool)))].tolist()
                first, second, length = divmod(p, self.n), divmod(q, self.n), min(left, _length(rng))
                self._stretch(first, second, length, T_moved=np.eye(4), near_m=_NEAR_M)
        if len(self.found) < count:
            raise DuagError(f"the walks meet for {len(self.found)} true loop closures, expected {count}")
        self.count_true = len(self.found)

    def add_false(self, count: int, rng: np.random.Generator) -> None:
        """Stretches that are taken for a place elsewhere."""
        goal = len(self.found) + count
        for _ in range(_TRIES):
            left = goal - len(self.found)
            if not left:
                break
            a, i, b, j = (int(rng.integers(limit)) for limit in (len(self.poses), self.n) * 2)
            own = rng.random() < _OWN
            b = a if own else b
            offset = np.concatenate([rng.uniform(-2, 2, 2), rng.uniform(-0.3, 0.3, 4) * [1, 0.1, 0.1, 1]])
            length = 1 if rng.random() < _SINGLE else min(left, _length(rng))
            apart = np.linalg.norm(self.poses[a][i, :3, 3] - self.poses[b][j, :3, 3])
            if (a == b) == own and apart > _FAR_M and (a != b or abs(i - j) >= _APART):
                T_wrong = self.poses[a][i] @ se3.exp(offset) @ se3.inverse(self.poses[b][j])
                self._stretch((a, i), (b, j), length, T_moved=T_wrong, near_m=_NEAR_M + 2)
        if len(self.found) < goal:
            raise DuagError(f"no room for {count} false loop closures between the walks")

    def _stretch(
        self,
        first: tuple[int, int],
        second: tuple[int, int],
        length: int,
        *,
        T_moved: Array,
        near_m: float,
    ) -> None:
        """Loop closures along two walks that go the same way while the second, moved, stays near the first."""
        (a, i), (b, j) = first, second
        for _ in range(length):
            if max(i, j) >= self.n:
                break
            T = se3.inverse(self.poses[a][i]) @ T_moved @ self.poses[b][j]
            if np.linalg.norm(T[:3, 3]) > near_m:
                break
            ends = (a, i, b, j) if (a, i) < (b, j) else (b, j, a, i)
            if ends not in self._taken:
                self._taken.add(ends)
                self.found.append((*ends, T if ends[:2] == (a, i) else se3.inverse(T)))
            i, j = i + _STRIDE, j + _STRIDE


def _length(rng: np.random.Generator) -> int:
    return int(rng.integers(3, _LONGEST + 1))


def write(graph: TownGraph, folder: Path, *, force: bool = False) -> None:
    """Write the tables of Kimera-Multi: `robot*/measurements.csv`, `reference_inliers.csv`.

    Args:
        graph: the team.
        folder: to write.
        force: replace a pose graph that is there.
    Raises:
        DuagError: there is something else, or a graph that is not to be replaced.
    """
    with new_folder(folder, force, GRAPH) as out:
        for robot in range(len(graph.T_world_keyframe)):
            (out / f"robot{robot}").mkdir()
            rows = [(m, ODOMETRY) for m in graph.odometry] + [(m, CLOSURE) for m in graph.closures]
            path = out / f"robot{robot}" / "measurements.csv"
            with new_file(path) as part, part.open("w", newline="") as file:
                table = csv.writer(file, lineterminator="\n")
                table.writerow(COLUMNS.split(","))
                for (a, i, b, j, T), noise in rows:
                    if robot in (a, b):
                        quat = so3.to_quat_wxyz(T[:3, :3])[[1, 2, 3, 0]]
                        table.writerow([a, i, b, j, *quat.tolist(), *T[:3, 3].tolist(), *noise.weights])
        lines = ["robot_src,pose_src,robot_dst,pose_dst,inlier\n"]
        for (a, i, b, j, _), true in zip(graph.closures, graph.true, strict=True):
            lines.append(f"{a},{i},{b},{j},{int(true)}\n")
        with new_file(out / "reference_inliers.csv") as part:
            part.write_text("".join(lines))
