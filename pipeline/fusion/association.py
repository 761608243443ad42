"""How matched Gaussians of several robots are averaged: association variance and matrix-weighted means.

Each robot cut the surface into splats of its own, so matched splats differ by more than estimation errors. Their
association variance is spacing^2 / 12 along the surface, and the measured scatter of matched splats across it, in
shape, color and opacity; `FusionConfig.association` decides whose values carry it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import row_blocks
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.matching import held_thickness
from duagc.pipeline.geometry import spd
from duagc.pipeline.geometry.spd import add_covariance
from duagc.pipeline.geometry.statistics import MAD_TO_SIGMA
from duagc.pipeline.splat.information import (
    COLOR,
    COLOR_INFORMATION,
    LOG_COVARIANCE,
    MEAN,
    OPACITY,
    OPACITY_INFORMATION,
    THETA_SIZE,
    log_covariance_block,
    mean_block,
)

Index = NDArray[np.int64]
# Information of the own mean (1/m^2) and shape, which decides where no robot has any. Matches are within centimeters,
# so that of `neighbors` claims nothing; where all robots shall end with the same Gaussian it is next to nothing.
PRIOR = {"neighbors": (100.0, 0.1), "members": (1e-2, 1e-4)}


@dataclass(frozen=True)
class EvidenceRows:
    """Evidence of several robots in the world frame, one after the other.

    Attributes:
        theta: [r, 13].
        information: [r, 31].
    """

    theta: Array
    information: Array

    @property
    def position(self) -> Array:
        """[r, 3, 3], information of the mean, 1/m^2."""
        return mean_block(self.information)

    @property
    def shape(self) -> Array:
        """[r, 6, 6], information of vec log Sigma."""
        return log_covariance_block(self.information)

    @property
    def color(self) -> Array:
        """[r, 3]."""
        return self.information[:, COLOR_INFORMATION]

    @property
    def opacity(self) -> Array:
        """[r]."""
        return self.information[:, OPACITY_INFORMATION]


@dataclass(frozen=True)
class TrackMembers:
    """Matched Gaussians of several robots, the members of a track one after the other.

    Attributes:
        rows: their evidence, [r] members.
        reference: [g], row of every track that its fused value refers to: the receiver's, or that which knows its
            position best.
        first: [g], first row of every track.
    """

    rows: EvidenceRows
    reference: Index
    first: Index

    def some(self, tracks: slice) -> TrackMembers:
        """Those of some tracks that follow each other.

        Args:
            tracks: which.
        """
        ends = np.append(self.first, len(self.rows.theta))
        begin = ends[tracks.start]
        rows = slice(begin, ends[tracks.stop])
        part = EvidenceRows(self.rows.theta[rows], self.rows.information[rows])
        return TrackMembers(part, self.reference[tracks] - begin, self.first[tracks] - begin)

    @cached_property
    def sizes(self) -> Index:
        """Members of every track [g]."""
        return np.diff(np.append(self.first, len(self.rows.theta)))

    @cached_property
    def delta(self) -> Array:
        """theta minus that of the track's reference [r, 13]."""
        return self.rows.theta - np.repeat(self.rows.theta[self.reference], self.sizes, axis=0)


def association_covariance(vec_log_covariance: Array, spacing_per_sigma: float) -> Array:
    """Sigma_assoc [n, 3, 3], m^2: spacing^2 / 12 along the surface, zero along the shortest axis of each Gaussian.

    spacing^2 (Sigma - shortest^2) / 12, from the Gaussian's own extent, so that all robots compute the same from the
    evidence alone. No axis is chosen, so that it does not jump where two axes are as short as each other.

    Args:
        vec_log_covariance: [n, 6], in the frame in which the result is wanted.
        spacing_per_sigma: spacing of splats in units of their standard deviation along the surface.
    """
    values, vectors = np.linalg.eigh(spd.vec_to_sym(vec_log_covariance))
    variance = spacing_per_sigma**2 * (np.exp(values) - np.exp(values[:, :1])) / 12
    return (vectors * variance[:, None, :]) @ vectors.swapaxes(-1, -2)


def weighted_move(
    weights: Array,
    values: Array,
    first: Index,
    prior: float,
    *,
    free: Array | None = None,
) -> Array:
    """How far the fused value of each group lies from its reference: (prior + sum W)^-1 sum W (value - reference).

    A matrix-weighted mean may lie far outside its members if they are certain of different directions and contradict
    each other there: two planes that are nearly parallel cross far away. Its distance from the mean weighted by traces
    is therefore limited to that of the members. Everything is a continuous function of weights and values, so that
    rounding tips no decision.

    Args:
        weights: [r, d, d], positive semidefinite; rows of a group follow each other.
        values: [r, d], differences from the group's reference.
        first: [g], first row of every group.
        prior: information of the reference's own value in every direction, so little that it only decides
            where no member has information.
        free: [g, d, d], shares of each direction in which a group may move, symmetric, eigenvalues 0 to 1.
    Returns:
        [g, d]; exactly zero in directions without information.
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
    move, center = solved[..., 0], solved[..., 1]  # the center, in directions with information
    known = trace / (trace + prior)  # a member without information does not limit the others
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
    """How far matched splats of two robots lie apart, standard deviations.

    The receiver measures it on its own tracks; where all robots shall end with the same Gaussian, the expected values
    are used. It is no estimation error: each robot cut the surface into splats of its own, which compensate for each
    other.

    Attributes:
        position_m: of the mean across the surface, meters.
        shape: of coordinates of vec log Sigma.
        color: of colors, 0..1.
        opacity: of opacity logits.
    """

    position_m: float
    shape: float
    color: float
    opacity: float

    @staticmethod
    def of(members: TrackMembers, config: FusionConfig) -> Scatter:
        """Robust spread (1.48 times the median) of members with information about their references.

        What the settings expect counts as much as `scatter_support` members.

        Args:
            members: of all tracks.
            config: what is expected, and by which rule.
        """
        if config.association == "members":
            return Scatter(
                config.scatter_position_m,
                config.scatter_log_covariance,
                config.scatter_color,
                config.scatter_opacity,
            )
        rows = members.rows
        informed = np.trace(rows.position, axis1=-2, axis2=-1) > 0
        informed[members.reference] = False
        seen = members.delta[informed]
        across = _across(rows.theta[np.repeat(members.reference, members.sizes)[informed], LOG_COVARIANCE])
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
class _AssociationCovariance:
    """Covariance that is added to that of each of r members.

    Attributes:
        position: [r, 3, 3], of the mean, m^2.
        shape: [r], of every coordinate of vec log Sigma.
        color: [r], of every channel.
        opacity: [r].
    """

    position: Array
    shape: Array
    color: Array
    opacity: Array

    @staticmethod
    def of(members: TrackMembers, scatter: Scatter, config: FusionConfig) -> _AssociationCovariance:
        """By `config.association`."""
        theta = members.rows.theta
        share = np.full(len(theta), 0.5)  # of the variance of a difference: both members' alike
        assigned = association_covariance(theta[:, LOG_COVARIANCE], config.spacing_per_sigma)
        if config.association == "neighbors":
            share[:] = 1.0
            share[members.reference] = 0.0  # where a robot put its own splat is no estimate
            assigned[members.reference] = 0.0
        return _AssociationCovariance(
            assigned + (share * scatter.position_m**2)[:, None, None] * np.eye(3),
            share * scatter.shape**2,
            share * scatter.color**2,
            share * scatter.opacity**2,
        )


def fused_moves(members: TrackMembers, config: FusionConfig, thickness_floor_m: float) -> Array:
    """Fused minus reference theta [g, 13] of every track.

    Args:
        members: of the tracks.
        config: association and scatter.
        thickness_floor_m: least standard deviation that the mapper lets a Gaussian have.
    """
    scatter = Scatter.of(members, config)
    return np.concatenate(
        [
            _fused_moves(members.some(tracks), scatter, config, thickness_floor_m)
            for tracks in row_blocks(len(members.first))
        ]
    )


def _fused_moves(
    members: TrackMembers, scatter: Scatter, config: FusionConfig, thickness_floor_m: float
) -> Array:
    """`fused_moves` of some tracks, with the scatter of all."""
    rows, delta, first = members.rows, members.delta, members.first
    spread = _AssociationCovariance.of(members, scatter, config)
    held = held_thickness(rows.theta[members.reference, LOG_COVARIANCE], thickness_floor_m)
    free = np.eye(6) - held.swapaxes(-1, -2) @ held
    position = add_covariance(rows.position, spread.position)
    shape = add_covariance(rows.shape, spread.shape[:, None, None] * np.eye(6))
    color = rows.color / (1 + rows.color * spread.color[:, None])
    opacity = rows.opacity / (1 + rows.opacity * spread.opacity)
    prior_position, prior_shape = PRIOR[config.association]
    move = np.zeros((len(first), THETA_SIZE))
    move[:, MEAN] = weighted_move(position, delta[:, MEAN], first, prior_position)
    move[:, LOG_COVARIANCE] = weighted_move(shape, delta[:, LOG_COVARIANCE], first, prior_shape, free=free)
    move[:, COLOR] = _weighted_move_diagonal(color, delta[:, COLOR], first)
    move[:, OPACITY] = _weighted_move_diagonal(opacity[:, None], delta[:, OPACITY, None], first)[:, 0]
    return move
