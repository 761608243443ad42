"""Which Gaussians of two robots are the same piece of surface: paper eqs. (6)-(7).

The distance of two Gaussians in the flat chart is, with Delta the difference of their theta in one frame,

    d_G^2 = |Delta mean|^2 / l^2 + 0.1 |Delta log Sigma|_F^2 + 1.0 |Delta c|^2 + 0.5 Delta alpha^2

with colors as degree-0 spherical-harmonic coefficients and l = delta, the search radius: (6) adds square meters to
squares without a unit, which would make the position count for nothing within 5 cm (l = 1 m gives (6) as printed).
The thickness of a Gaussian has no meaning where it is at the mapper's floor: against one that is thicker, that
component of log Sigma, e e' with e the axis, is left out; two at the floor are equally thin. Tilts stay in.

Two cameras may see colors differently. So the Gaussians are first matched without their colors, which is enough to
estimate gain and offset (`consensus.colors`), and the other robot's colors are compared as the own camera would show
them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import in_blocks, row_blocks
from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.consensus.colors import ColorMap, team_colors
from duagc.pipeline.consensus.evidence import Evidence, PlacedGaussians
from duagc.pipeline.geometry import spd
from duagc.pipeline.splat.information import COLOR, LOG_COVARIANCE, MEAN, OPACITY
from duagc.pipeline.splat.ply import SH_DEGREE_0

Index = NDArray[np.int64]
Rows = NDArray[np.int32] | NDArray[np.int64]
Pairs = Mapping[tuple[str, str], Index]
Placed = Evidence | PlacedGaussians
_FLOOR_SLACK = 1e-3  # of a log-scale: float32 and rotations


def held_thickness(vec_log_covariance: Array, floor_m: float) -> Array:
    """Unit vectors v = vec(e e') [n, 3, 6] of the axes at the thickness floor; zero for the others.

    Args:
        vec_log_covariance: [n, 6], of Gaussians with standard deviations in meters.
        floor_m: least standard deviation that the mapper allows.
    """
    return in_blocks(lambda rows: _Axes.of(rows).held(floor_m), vec_log_covariance)


@dataclass(frozen=True)
class _Axes:
    """Eigenvalues [n, 3] and eigenvectors [n, 3, 3], in columns, of log-covariances."""

    values: Array
    vectors: Array

    @staticmethod
    def of(vec_log_covariance: Array) -> _Axes:
        return _Axes(*np.linalg.eigh(spd.vec_to_sym(vec_log_covariance)))

    def held(self, floor_m: float) -> Array:
        """As `held_thickness`."""
        held = 0.5 * self.values <= np.log(floor_m) + _FLOOR_SLACK
        axes = self.vectors.swapaxes(-1, -2)  # [n, axis, 3]
        return spd.sym_to_vec(axes[..., :, None] * axes[..., None, :]) * held[..., None]

    def no_thinner(self, floor_m: float) -> Array:
        """The log-covariances [n, 6] with no standard deviation below the floor."""
        values = np.maximum(self.values, 2 * np.log(floor_m))
        return spd.sym_to_vec((self.vectors * values[:, None, :]) @ self.vectors.swapaxes(-1, -2))


def _without(delta: Array, v: Array) -> Array:
    """delta [m, 6] without its components along the unit vectors v [m, 3, 6]."""
    along = np.sum(v * delta[:, None, :], axis=-1)
    return delta - np.sum(v * along[..., None], axis=1)


@dataclass(frozen=True)
class _Chart:
    """theta [n, 13] with thicknesses no less than the floor, and the held components of log Sigma [n, 3, 6].

    `thick`: bool [n], those of which nothing is held.
    """

    theta: Array
    held: Array
    thick: NDArray[np.bool_]

    @staticmethod
    def of(theta: Array, config: MapMatching) -> _Chart:
        clamped, held = theta.copy(), np.empty((len(theta), 3, 6))
        for rows in row_blocks(len(theta)):
            axes = _Axes.of(theta[rows, LOG_COVARIANCE])
            clamped[rows, LOG_COVARIANCE] = axes.no_thinner(config.thickness_floor_m)
            held[rows] = axes.held(config.thickness_floor_m)
        return _Chart(clamped, held, ~np.any(held != 0, axis=(1, 2)))


def _shape_difference(charts: tuple[_Chart, _Chart], i: Rows, j: Rows) -> Array:
    """Differences [m, 6] of log Sigma without what one of a pair holds and the other does not."""
    a, b = charts
    delta: Array = a.theta[i, LOG_COVARIANCE] - b.theta[j, LOG_COVARIANCE]
    lacking = (a.held, i, b.thick[j] & ~a.thick[i]), (b.held, j, a.thick[i] & ~b.thick[j])
    for held, at, unequal in lacking:
        delta[unequal] = _without(delta[unequal], held[at[unequal]])
    return delta


@dataclass(frozen=True)
class _Compared:
    """Pairs of Gaussians, rows i [m] of the first chart and j [m] of the second; what colors do not change is known.

    `apart`: what places and shapes are of d_G^2 [m].
    """

    charts: tuple[_Chart, _Chart]
    i: Rows
    j: Rows
    apart: Array

    @staticmethod
    def of(charts: tuple[_Chart, _Chart], i: Rows, j: Rows, config: MapMatching) -> _Compared:
        a, b = charts
        apart = np.empty(len(i))
        for part in row_blocks(len(i)):
            delta = a.theta[i[part], MEAN] - b.theta[j[part], MEAN]
            shape = _shape_difference(charts, i[part], j[part])
            apart[part] = np.sum(delta**2, axis=1) / config.position_scale_m**2
            apart[part] += config.beta_log_covariance * np.sum(shape**2, axis=1)
        return _Compared(charts, i, j, apart)

    def distances(self, config: MapMatching) -> Array:
        """d_G [m]."""
        a, b = self.charts
        out = np.empty(len(self.i))
        for part in row_blocks(len(self.i)):
            i, j = self.i[part], self.j[part]
            color = (a.theta[i, COLOR] - b.theta[j, COLOR]) / SH_DEGREE_0
            opacity = a.theta[i, OPACITY] - b.theta[j, OPACITY]
            squared = self.apart[part] + config.beta_color * np.sum(color**2, axis=1)
            out[part] = np.sqrt(squared + config.beta_opacity * opacity**2)
        return out


def gaussian_distance(a: Evidence, i: Index, b: Evidence, j: Index, *, config: MapMatching) -> Array:
    """d_G [m] of pairs of Gaussians.

    Args:
        a: of one robot, in the world frame.
        i: [m], rows of `a`.
        b: of the other robot, in the world frame, in the colors of the first.
        j: [m], rows of `b`.
        config: scales of the distance.
    """
    used_a, i = np.unique(i, return_inverse=True)
    used_b, j = np.unique(j, return_inverse=True)
    charts = _Chart.of(a.theta[used_a], config), _Chart.of(b.theta[used_b], config)
    return _Compared.of(charts, i, j, config).distances(config)


def threshold(own: Evidence, config: MapMatching) -> float:
    """tau_G of a map: how much its own neighboring Gaussians differ; 0 if no two are within the radius.

    Args:
        own: all Gaussians of the map, in any one frame.
        config: radius, percentile and scales of the distance.
    """
    if len(own) < 2:
        return 0.0
    return _threshold(_neighbors_compared(_Chart.of(own.theta, config), config), config)


def _neighbors(means: Array, radius_m: float) -> tuple[Index, Index]:
    """Rows that have a nearest other one within the radius, and that one."""
    distance, neighbor = cKDTree(means).query(means, k=2)
    near = np.flatnonzero(distance[:, 1] <= radius_m)
    # of coinciding Gaussians the query may name the Gaussian itself second
    return near, np.where(neighbor[near, 1] == near, neighbor[near, 0], neighbor[near, 1])


def _neighbors_compared(chart: _Chart, config: MapMatching) -> _Compared:
    """The Gaussians of a map that have a neighbor, with it."""
    nobody = np.zeros(0, np.int64)
    near = (nobody, nobody) if len(chart.theta) < 2 else _neighbors(chart.theta[:, MEAN], config.radius_m)
    return _Compared.of((chart, chart), *near, config)


def _threshold(neighbors: _Compared, config: MapMatching) -> float:
    """tau_G of a map by its neighbors."""
    return float(np.percentile(neighbors.distances(config), config.percentile)) if len(neighbors.i) else 0.0


def match(own: Placed, peer: Placed, config: MapMatching) -> Index:
    """Matched Gaussians of two robots: within the radius, d_G below tau_G, and each the other's best.

    Args:
        own: all Gaussians of the computing robot, in the world frame; they give tau_G.
        peer: those of the other robot, in the world frame, in its own camera's colors.
        config: radius and scales of the distance.
    Returns:
        int64 [m, 2], ids of (own, peer), ascending; each id at most once.
    """
    if not len(own) or not len(peer):
        return np.zeros((0, 2), np.int64)
    both = _Both.of(own, peer, config)
    if config.colors.enabled and config.beta_color > 0:
        blind = both.matched(config.model_copy(update={"beta_color": 0.0}))
        a, b = "own", "peer"
        both = both.in_colors(team_colors({a: own, b: peer}, {(a, b): blind}, config.colors).between(b, a))
    return both.matched(config)


@dataclass(frozen=True)
class _Both:
    """Two maps that are matched, none empty: what does not depend on colors is computed once.

    Attributes:
        own: Gaussians of the computing robot.
        peer: of the other one, in its own camera's colors.
        candidates: of both maps.
        neighbors: of the own map.
    """

    own: Placed
    peer: Placed
    candidates: _Compared
    neighbors: _Compared

    @staticmethod
    def of(own: Placed, peer: Placed, config: MapMatching) -> _Both:
        charts = _Chart.of(own.theta, config), _Chart.of(peer.theta, config)
        candidates = _candidates(own.theta[:, MEAN], peer.theta[:, MEAN], config)
        return _Both(
            own,
            peer,
            _Compared.of(charts, *candidates, config),
            _neighbors_compared(charts[0], config),
        )

    def in_colors(self, colors: ColorMap) -> _Both:
        """With the chart of the peer's Gaussians in other colors."""
        if colors.is_identity:
            return self
        mine, theirs = self.candidates.charts
        theta = theirs.theta.copy()
        theta[:, COLOR] = colors.to_other(self.peer.theta[:, COLOR])
        return replace(self, candidates=replace(self.candidates, charts=(mine, replace(theirs, theta=theta))))

    def matched(self, config: MapMatching) -> Index:
        """Ids of (own, peer), as `match`."""
        own, peer = self.own, self.peer
        i, j = self.candidates.i, self.candidates.j
        d, limit = self.candidates.distances(config), _threshold(self.neighbors, config)
        best_of_own = _best_of_each(i, d, limit, lambda at: peer.ids[j[at]])
        best_of_peer = _best_of_each(j, d, limit, lambda at: own.ids[i[at]])
        mutual = np.intersect1d(best_of_own, best_of_peer)
        pairs = np.stack([own.ids[i[mutual]], peer.ids[j[mutual]]], axis=1)
        return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _candidates(means_own: Array, means_peer: Array, config: MapMatching) -> tuple[Rows, Rows]:
    """Rows (own, peer) within the radius: the nearest few of either side, each pair once."""
    n, m, k = len(means_own), len(means_peer), config.candidates
    key, count = np.empty(n * min(k, m) + m * min(k, n), np.int64), 0
    for a, b, turned in ((means_own, means_peer, False), (means_peer, means_own, True)):
        ranks, tree = [*range(1, min(k, len(b)) + 1)], cKDTree(b)
        for rows in row_blocks(len(a)):
            distance, neighbor = tree.query(a[rows], k=ranks, distance_upper_bound=config.radius_m)
            row, rank = np.nonzero(np.isfinite(distance))
            row, column = row + rows.start, neighbor[row, rank]
            own, peer = (column, row) if turned else (row, column)
            key[count : count + len(own)] = own * m + peer
            count += len(own)
    key = key[:count]
    key.sort()
    first = np.ones(count, bool)
    np.not_equal(key[1:], key[:-1], out=first[1:])
    key = key[first]
    row_type = np.int32 if max(n, m) < 1 << 31 else np.int64
    i: Rows = in_blocks(lambda of: (of // m).astype(row_type), key)
    j: Rows = in_blocks(lambda of: (of % m).astype(row_type), key)
    return i, j


def _best_of_each(group: Rows, d: Array, limit: float, tie: Callable[[Index], Index]) -> Index:
    """Positions, ascending by group, of the least (d, tie) of every group that has a d below the limit."""
    if not len(group):
        return np.zeros(0, np.int64)
    least = np.full(int(group.max()) + 1, limit)
    np.minimum.at(least, group, d)
    nearest = np.flatnonzero(in_blocks(lambda g, x: (x == least[g]) & (x < limit), group, d))
    nearest = nearest[np.lexsort((tie(nearest), group[nearest]))]
    return nearest[np.diff(group[nearest], prepend=-1) > 0]


def without(pairs: Index, left_out: Index) -> Index:
    """Pairs that are not among others, in their order.

    Args:
        pairs: int64 [n, 2], ids.
        left_out: int64 [m, 2], likewise.
    """
    if not len(left_out):
        return pairs
    both = np.concatenate([left_out, pairs])
    order = np.lexsort((both[:, 1], both[:, 0]))
    number = np.empty(len(both), np.int64)  # the same of equal pairs
    number[order] = np.cumsum(np.any(np.diff(both[order], axis=0, prepend=both[order[:1]]), axis=1))
    left: Index = pairs[~np.isin(number[len(left_out) :], number[: len(left_out)])]
    return left
