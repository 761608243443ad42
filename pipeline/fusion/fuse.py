"""One robot's fused map from everybody's evidence: method sections 3 and 4, mode `evidence`.

In the flat chart theta = (mean, vec log Sigma, color, opacity logit) the fused value of a track is, block by block,

    theta* = (sum W_eff)^-1 sum W_eff theta,        W_eff = (W^-1 + Sigma_assoc)^-1 = (I + W Sigma_assoc)^-1 W,

which is the paper's (12) and, as the chart is flat, its log-Euclidean mean (13). Sigma_assoc is the variance of where
on the surface a robot happened to put its splat: spacing^2 / 12 along the surface, and what the matched splats of two
robots were measured to differ by across it, in shape, color and opacity. `association` says whose values carry it: by
default the neighbors', and the own splat counts with its stiffness among its own (`Evidence.of_splats`), because what
makes a picture is not where one splat is but what they are together. A thickness that the mapper holds at its floor is
held here too. Every robot's evidence counts once, however often it arrived and through whom. Where no member of a track
knows anything, the own value stays. The result is a continuous function of the evidence. Everything is fused in colors
common to the team (`consensus.colors`), and each robot's map has those of its own camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.consensus import MatchingConfig, WeightKind
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import ColorMap, team_colors
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import Pairs, held_thickness, tracks
from duagc.pipeline.consensus.weighting import in_world
from duagc.pipeline.geometry import se3, spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.geometry.statistics import MAD_TO_SIGMA
from duagc.pipeline.posegraph.factors import inflated
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import (
    COLOR,
    COLOR_INFORMATION,
    LOG_COVARIANCE,
    MEAN,
    OPACITY,
    THETA_SIZE,
    gaussians_of,
    mean_block,
    pack_information,
)

Array = NDArray[np.float64]
Index = NDArray[np.int64]
# Information of the own mean (1/m^2) and shape, which decides where nobody knows more. Matches are within centimeters,
# so that of `neighbors` is no claim; where all robots shall end with the same Gaussian it is next to nothing.
PRIOR = {"neighbors": (100.0, 0.1), "members": (1e-2, 1e-4)}
_NEAR_M = 0.05  # points closer to a camera than this are not judged by it


@dataclass(frozen=True)
class FusedMap:
    """A robot's fused map in the world frame: its own Gaussians first, in their order, then those taken over.

    gaussians: ids of own ones are kept; those taken over count on from the largest own id. Anchors are keyframes of
    the source robot. theta: float64 [n, 13], the same before rounding to float32. information: float64 [n, 31] as in
    `consensus.evidence`, world frame, the sum over members.
    robots: names. source: int32 [n], index into robots: whose Gaussian it was. source_ids: int64 [n], its id there.
    members: int32 [n], robots whose evidence is in it. matched: own Gaussians fused with others. added: taken over.
    colors: from every other robot's colors to the receiver's, which are those of the map.
    """

    gaussians: Gaussians
    theta: Array
    information: Array
    robots: tuple[str, ...]
    source: NDArray[np.int32]
    source_ids: Index
    members: NDArray[np.int32]
    matched: int
    added: int
    colors: dict[str, ColorMap]


@dataclass(frozen=True)
class _Rows:
    """Evidence of all robots in the world frame, one after the other, in order of name."""

    theta: Array
    position: Array
    shape: Array
    color: Array
    opacity: Array

    @staticmethod
    def of(evidence: list[Evidence]) -> _Rows:
        return _Rows(
            np.concatenate([e.theta for e in evidence]),
            np.concatenate([e.position_information() for e in evidence]),
            np.concatenate([e.shape_information() for e in evidence]),
            np.concatenate([e.color_information() for e in evidence]),
            np.concatenate([e.opacity_information() for e in evidence]),
        )

    def with_rows(self, at: Index, other: _Rows) -> _Rows:
        """Those of `other`, in order, in the places `at`."""
        changed = {name: array.copy() for name, array in vars(self).items()}
        for name, array in changed.items():
            array[at] = getattr(other, name)
        return _Rows(**changed)

    def take(self, rows: Index) -> _Rows:
        return _Rows(
            self.theta[rows], self.position[rows], self.shape[rows], self.color[rows], self.opacity[rows]
        )


def association_covariance(vec_log_covariance: Array, spacing_per_sigma: float) -> Array:
    """Sigma_assoc [n, 3, 3], m^2: spacing^2 / 12 along the surface, zero along the shortest axis of each Gaussian.

    spacing^2 (Sigma - shortest^2) / 12, from the Gaussian's own extent, so that everybody computes the same from the
    evidence alone. No axis is chosen, so that it does not jump where two axes are as short as each other.

    Args:
        vec_log_covariance: [n, 6], in the frame in which the result is wanted.
    """
    values, vectors = np.linalg.eigh(spd.vec_to_sym(vec_log_covariance))
    variance = spacing_per_sigma**2 * (np.exp(values) - np.exp(values[:, :1])) / 12
    return (vectors * variance[:, None, :]) @ vectors.swapaxes(-1, -2)


def weighted_move(
    weights: Array,
    values: Array,
    first: Index,
    prior: float,
    free: Array | None = None,
) -> Array:
    """How far the fused value of each group lies from its reference: (prior + sum W)^-1 sum W (value - reference).

    A matrix-weighted mean may lie far outside its members if they are sure of different directions and contradict
    each other there: two planes that are nearly parallel cross far away. Farther from the mean weighted by traces than
    its members it does not get: it stops on the way. Everything is a continuous function of weights and values, so
    that rounding tips no decision.

    Args:
        weights: [r, d, d], positive semidefinite; rows of a group follow each other.
        values: [r, d], differences from the group's reference.
        first: [g], first row of every group.
        prior: information of the reference's own value in every direction, so little that it only decides where
            nobody knows anything.
        free: [g, d, d], shares of each direction in which a group may move, symmetric, eigenvalues 0 to 1.
    Returns:
        [g, d]; exactly zero in directions that nobody knows.
    """
    total = np.add.reduceat(weights, first, axis=0)
    pull = np.add.reduceat((weights @ values[..., None])[..., 0], first, axis=0)
    trace = np.maximum(np.trace(weights, axis1=-2, axis2=-1), 0.0)
    center = _weighted_move_diagonal(trace[:, None], values, first)
    size = np.diff(np.append(first, len(values)))
    apart = values - np.repeat(center, size, axis=0)
    if free is not None:
        total, pull = free @ total @ free, (free @ pull[..., None])[..., 0]
        apart = (np.repeat(free, size, axis=0) @ apart[..., None])[..., 0]
    right = np.stack([pull, (total @ center[..., None])[..., 0]], axis=-1)
    solved = np.linalg.solve(total + prior * np.eye(total.shape[-1]), right)
    move, center = solved[..., 0], solved[..., 1]  # the center as far as anybody knows its directions
    known = trace / (trace + prior)  # who knows nothing does not stake out where the others may go
    reach = np.maximum.reduceat(known * np.linalg.norm(apart, axis=1), first)
    beyond = np.linalg.norm(move - center, axis=1)
    share = np.minimum(1.0, reach / np.where(beyond > 0, beyond, 1.0))
    return np.asarray(center + share[:, None] * (move - center), dtype=np.float64)


def _weighted_move_diagonal(weights: Array, values: Array, first: Index) -> Array:
    """sum w (value - reference) / sum w per group, for weights [r, 1 or d] and values [r, d]; zero without weight."""
    total = np.add.reduceat(weights, first, axis=0)
    pull = np.add.reduceat(weights * values, first, axis=0)
    return np.where(total > 0, pull / np.where(total > 0, total, 1.0), 0.0)


@dataclass(frozen=True)
class Scatter:
    """How far two robots' splats of one place lie apart, standard deviations: of the mean across the surface (m), of
    coordinates of vec log Sigma, of colors (0..1), of opacity logits. Measured by the receiver on its own tracks, but
    where all robots shall end with the same Gaussian: there what is expected stands.

    It is no estimation error: each robot cut the surface into splats of its own, which make up for each other.
    """

    position_m: float
    shape: float
    color: float
    opacity: float

    @staticmethod
    def of(rows: _Rows, delta: Array, reference: Index, first: Index, config: FusionConfig) -> Scatter:
        """Robust spread (1.48 times the median) of members with information about their references, [r, 13] `delta`.

        What the settings expect counts as much as `scatter_support` members.
        """
        if config.association == "members":
            return Scatter(
                config.scatter_position_m,
                config.scatter_log_covariance,
                config.scatter_color,
                config.scatter_opacity,
            )
        size = np.diff(np.append(first, len(delta)))
        informed = np.trace(rows.position, axis1=-2, axis2=-1) > 0
        informed[reference] = False
        seen = delta[informed]
        across = _across(rows.theta[np.repeat(reference, size)[informed], LOG_COVARIANCE])
        parts = (
            (np.sqrt(np.sum((across @ seen[:, MEAN, None])[..., 0] ** 2, axis=1)), config.scatter_position_m),
            (np.abs(seen[:, LOG_COVARIANCE]), config.scatter_log_covariance),
            (np.abs(seen[:, COLOR]), config.scatter_color),
            (np.abs(seen[:, OPACITY]), config.scatter_opacity),
        )
        n, support = len(seen), config.scatter_support
        variances = [
            (n * (MAD_TO_SIGMA * np.median(x)) ** 2 + support * expected**2) / (n + support)
            if n
            else expected**2
            for x, expected in parts
        ]
        return Scatter(*(float(np.sqrt(v)) for v in variances))


def _across(vec_log_covariance: Array) -> Array:
    """shortest^2 Sigma^-1 [n, 3, 3]: one across a disc, almost zero along it, one in all directions of a ball."""
    values, vectors = np.linalg.eigh(spd.vec_to_sym(vec_log_covariance))
    return np.asarray((vectors * np.exp(values[:, :1] - values)[:, None, :]) @ vectors.swapaxes(-1, -2))


@dataclass(frozen=True)
class _Spread:
    """Covariance that each of r members gets on top of its own: position [r, 3, 3], the others [r] per coordinate."""

    position: Array
    shape: Array
    color: Array
    opacity: Array

    @staticmethod
    def of(rows: _Rows, delta: Array, reference: Index, first: Index, config: FusionConfig) -> _Spread:
        """By `config.association`. References are the receiver's own rows, or a track's lowest name."""
        scatter = Scatter.of(rows, delta, reference, first, config)
        share = np.full(len(delta), 0.5)  # of the variance of a difference: both members' alike
        assigned = association_covariance(rows.theta[:, LOG_COVARIANCE], config.spacing_per_sigma)
        if config.association == "neighbors":
            share[:] = 1.0
            share[reference] = 0.0  # where a robot put its own splat is no estimate
            assigned[reference] = 0.0
        return _Spread(
            assigned + (share * scatter.position_m**2)[:, None, None] * np.eye(3),
            share * scatter.shape**2,
            share * scatter.color**2,
            share * scatter.opacity**2,
        )


def _moves(
    rows: _Rows, reference: Index, first: Index, config: FusionConfig, thickness_floor_m: float
) -> Array:
    """Fused minus reference theta [g, 13] of every track."""
    size = np.diff(np.append(first, len(rows.theta)))
    delta = rows.theta - np.repeat(rows.theta[reference], size, axis=0)
    spread = _Spread.of(rows, delta, reference, first, config)
    held = held_thickness(rows.theta[reference, LOG_COVARIANCE], thickness_floor_m)
    free = np.eye(6) - held.swapaxes(-1, -2) @ held
    position = inflated(rows.position, spread.position)
    shape = inflated(rows.shape, spread.shape[:, None, None] * np.eye(6))
    color = rows.color / (1 + rows.color * spread.color[:, None])
    opacity = rows.opacity / (1 + rows.opacity * spread.opacity)
    prior_position, prior_shape = PRIOR[config.association]
    move = np.zeros((len(first), THETA_SIZE))
    move[:, MEAN] = weighted_move(position, delta[:, MEAN], first, prior_position)
    move[:, LOG_COVARIANCE] = weighted_move(shape, delta[:, LOG_COVARIANCE], first, prior_shape, free)
    move[:, COLOR] = _weighted_move_diagonal(color, delta[:, COLOR], first)
    move[:, OPACITY] = _weighted_move_diagonal(opacity[:, None], delta[:, OPACITY, None], first)[:, 0]
    return move


def fuse(
    robot: str,
    gaussians: Gaussians,
    T_map_keyframe: ArrayLike,
    evidence: Mapping[str, Evidence],
    own_splats: Evidence,
    T_world_keyframe: Mapping[str, Array],
    pairs: Pairs,
    depth_images: Iterable[tuple[int, NDArray[np.float32]]],
    camera: PinholeCamera,
    config: FusionConfig,
    matching: MatchingConfig,
    depth: DepthKind = "blended",
    weights: WeightKind = "block",
    *,
    contradicted: Mapping[str, NDArray[np.bool_]] | None = None,
) -> FusedMap:
    """Fuse what a robot knows into one map in the world frame.

    Args:
        robot: the receiver.
        gaussians: its own map, in its map frame.
        T_map_keyframe: [k, 4, 4], its keyframes in its own map, by anchor.
        evidence: by robot, in anchor frames, the receiver's own included (of all its Gaussians, by id).
        own_splats: how stiff the receiver's splats are (`Evidence.of_splats`), in anchor frames, of all its Gaussians;
            for `association = neighbors`.
        T_world_keyframe: by robot, [k, 4, 4] by anchor, for every robot in `evidence`.
        pairs: (robot a, robot b) -> ids int64 [m, 2] of matched Gaussians.
        depth_images: (own keyframe index, depth [H, W] in meters, 0 invalid), read once; for `coverage = all`.
        camera: of these depth images.
        matching: as the pairs were found; for splitting tracks that hold two Gaussians of one robot, and for what the
            pairs tell of the robots' cameras.
        depth: of a Gaussian at a pixel, as the own map was made.
        weights: kind of the information in `evidence` and `own_splats`.
        contradicted: by robot, [n] of its evidence: what is not taken over, whatever space it is in.
    """
    own, own_splats = (_in_order_of(gaussians.ids, e) for e in (evidence[robot], own_splats))
    names = tuple(sorted(evidence))
    world = {n: in_world(own if n == robot else evidence[n], T_world_keyframe[n], weights) for n in names}
    cameras = team_colors(world, pairs, matching.colors)
    common = cameras.to_common(robot)
    world = {n: cameras.to_common(n).of(e) for n, e in world.items()}
    start = np.concatenate([[0], np.cumsum([len(world[n]) for n in names])]).astype(np.int64)
    rows = _Rows.of([world[n] for n in names])
    owner = np.repeat(np.arange(len(names)), np.diff(start))
    me = names.index(robot)

    found = tracks(world, pairs, matching)
    member = start[found.robot] + found.row
    first = np.flatnonzero(np.diff(found.track, prepend=-1)).astype(np.int64)
    track_of_member = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(member))))
    reference = first.copy()  # the lowest name of a track, or the receiver
    reference[track_of_member[found.robot == me]] = np.flatnonzero(found.robot == me)
    representative = member[reference]

    move = np.zeros((len(rows.theta), THETA_SIZE))
    members = np.ones(len(rows.theta), dtype=np.int32)
    sums = pack_information(rows.position, rows.shape, rows.color, rows.opacity)
    if len(first):
        taking_part, mine = rows.take(member), np.flatnonzero(found.robot == me)
        if config.association == "neighbors":
            splats = in_world(common.of(own_splats.select(found.row[mine])), T_world_keyframe[robot], weights)
            taking_part = taking_part.with_rows(mine, _Rows.of([splats]))
        move[representative] = _moves(taking_part, reference, first, config, matching.thickness_floor_m)
        members[representative] = np.diff(np.append(first, len(member)))
        sums[representative] = np.add.reduceat(sums[member], first, axis=0)

    own_rows = np.arange(start[me], start[me + 1])
    absorbed = np.zeros(len(rows.theta), dtype=bool)
    absorbed[member] = True
    absorbed[representative] = False
    for name, against in (contradicted or {}).items():
        absorbed[start[names.index(name)] + np.flatnonzero(against)] = True
    foreign = np.flatnonzero((owner != me) & ~absorbed)
    same_frame = np.array_equal(T_map_keyframe, T_world_keyframe[robot])
    moved = gaussians if same_frame else gaussians.moved(T_map_keyframe, T_world_keyframe[robot])
    added = np.zeros(0, np.int64)
    if config.coverage == "all" and len(foreign):
        surfaces = _surfaces(moved, T_world_keyframe[robot], depth_images, camera, config, depth)
        added = _to_add(foreign, rows, sums, T_world_keyframe[robot], surfaces, camera, config)

    theta, move[:, COLOR] = rows.theta + move, move[:, COLOR] / common.gain
    theta[:, COLOR] = common.from_other(theta[:, COLOR])
    sums[:, COLOR_INFORMATION] *= common.gain**2
    kept = _applied(moved, move[own_rows], rows.theta[own_rows, LOG_COVARIANCE])
    ids = np.concatenate([world[n].ids for n in names])
    anchors = np.concatenate([world[n].anchors for n in names])
    next_id = int(gaussians.ids.max()) + 1 if len(gaussians) else 0
    taken = gaussians_of(next_id + np.arange(len(added)), anchors[added], theta[added])
    order = np.concatenate([own_rows, added])
    return FusedMap(
        gaussians=Gaussians.concatenate([kept, taken]),
        theta=theta[order],
        information=sums[order],
        robots=names,
        source=owner[order].astype(np.int32),
        source_ids=ids[order],
        members=members[order],
        matched=int(np.sum(members[own_rows] > 1)),
        added=len(added),
        colors={n: cameras.between(n, robot) for n in names if n != robot},
    )


def _in_order_of(ids: Index, own: Evidence) -> Evidence:
    """Own evidence in the order of the map's ids."""
    if not np.array_equal(np.sort(own.ids), np.sort(ids)):
        raise ValueError(f"{own.owner}: the own evidence must be on the Gaussians of the own map")
    return own.select(np.argsort(own.ids, kind="stable")[_rank(ids)])


def _rank(ids: Index) -> Index:
    """Place of every id in ascending order."""
    out = np.empty(len(ids), np.int64)
    out[np.argsort(ids, kind="stable")] = np.arange(len(ids))
    return out


def _applied(gaussians: Gaussians, move: Array, vec_log_covariance: Array) -> Gaussians:
    """Gaussians moved in the flat chart; what is not moved keeps every bit.

    The shape is only rebuilt from the chart where the shape itself was fused.
    """
    means, colors, logits = gaussians.means.copy(), gaussians.colors.copy(), gaussians.opacity_logits.copy()
    quats, scales = gaussians.quats_wxyz.copy(), gaussians.log_scales.copy()
    rows = np.flatnonzero(np.any(move[:, MEAN] != 0, axis=1))
    means[rows] = means[rows] + move[rows, MEAN]
    rows = np.flatnonzero(np.any(move[:, COLOR] != 0, axis=1))
    colors[rows] = colors[rows] + move[rows, COLOR]
    rows = np.flatnonzero(move[:, OPACITY] != 0)
    logits[rows] = logits[rows] + move[rows, OPACITY]
    rows = np.flatnonzero(np.any(move[:, LOG_COVARIANCE] != 0, axis=1))
    quats[rows], scales[rows] = spd.from_log_covariance(vec_log_covariance[rows] + move[rows, LOG_COVARIANCE])
    return gaussians.replace(
        means=means, quats_wxyz=quats, log_scales=scales, colors=colors, opacity_logits=logits
    )


def _to_add(
    foreign: Index,
    rows: _Rows,
    sums: Array,
    T_world_keyframe: Array,
    depth_images: Iterable[tuple[int, NDArray[np.float32]]],
    camera: PinholeCamera,
    config: FusionConfig,
) -> Index:
    """Which of the neighbors' Gaussians to take over: those in space that no own keyframe saw."""
    position = np.trace(mean_block(sums[foreign]), axis1=-2, axis2=-1)
    if config.added_need_information:
        foreign, position = foreign[position > 0], position[position > 0]
    new = ~explained(rows.theta[foreign, MEAN], T_world_keyframe, depth_images, camera, config)
    foreign, position = foreign[new], position[new]
    if config.max_added is not None and len(foreign) > config.max_added:
        foreign = np.sort(foreign[np.lexsort((foreign, -position))[: config.max_added]])
    return foreign


def _surfaces(
    own_world: Gaussians,
    T_world_keyframe: Array,
    depth_images: Iterable[tuple[int, NDArray[np.float32]]],
    camera: PinholeCamera,
    config: FusionConfig,
    depth: DepthKind,
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """What own keyframes know of surfaces, where the own map draws them: measured depth, rendered where it is missing,
    the farthest close by."""
    from scipy.ndimage import maximum_filter

    from duagc.pipeline.kernels import Rasterizer

    rasterizer = Rasterizer()
    for keyframe, measured in depth_images:
        T_camera_world = se3.inverse(T_world_keyframe[keyframe])
        render = rasterizer.forward(own_world, camera, T_camera_world, depth_kind=depth)
        drawn = render.depth / np.maximum(render.alpha, np.float32(1e-3))
        surface = np.where(measured > 0, measured, drawn)
        known = np.where(render.alpha >= config.explained_opacity, surface, np.float32(0))
        yield keyframe, maximum_filter(known, 2 * config.explained_px + 1)


def explained(
    points_world: Array,
    T_world_keyframe: Array,
    depth_images: Iterable[tuple[int, NDArray[np.float32]]],
    camera: PinholeCamera,
    config: FusionConfig,
) -> NDArray[np.bool_]:
    """Whether some keyframe saw the space at each point [n, 3]: it measured a surface there or behind it.

    A keyframe that measured something nearer says nothing about what is hidden behind.
    """
    seen = np.zeros(len(points_world), dtype=bool)
    for keyframe, depth in depth_images:
        left = np.flatnonzero(~seen)
        p = se3.transform(se3.inverse(T_world_keyframe[keyframe]), points_world[left])
        index, column, row = visible(camera, p, _NEAR_M)
        left, z = left[index], p[index, 2]
        measured = depth[row, column].astype(np.float64)
        reach = measured + config.explained_m + config.explained_relative * z
        seen[left[(measured > 0) & (z <= reach)]] = True
    return seen
