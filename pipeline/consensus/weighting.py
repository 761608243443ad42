"""Kinds of weights: the information that a robot shares, in full, in part, or replaced by a rule of thumb.

    block               the information itself: 3x3 of the mean, 6x6 of vec log Sigma, diagonals of color and opacity
    diagonal            its diagonal in the common frame: (12) of the paper
    scalar              one number per block, the mean of its diagonal: Theorem 6
    observation_count   the same for all coordinates, times the views that saw the Gaussian (Table 14)
    residual_magnitude  over the square of its distance from the surface that the depth images show (Table 14)
    uniform             the same for all

The last three use no information; so that they can be combined with the association variance and be sent as
information, they are in units of what two robots' splats usually differ by.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import WeightKind
from duagc.pipeline.consensus.evidence import Evidence, MapInformation, rows_by_id
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import pack_information

STATED_KINDS: tuple[WeightKind, ...] = ("diagonal", "block")
"""Those that state deviations, not only how robots compare."""
UNIT_SIGMA_M, UNIT_SIGMA_SHAPE, UNIT_SIGMA_COLOR, UNIT_SIGMA_OPACITY = 0.01, 1.0, 0.07, 0.5
"""Standard deviations of a weight of one: mean, coordinates of vec log Sigma, colors, opacity logits."""


def shared_evidence(
    owner: str,
    gaussians: Gaussians,
    information: MapInformation,
    T_map_keyframe: ArrayLike,
    *,
    kind: WeightKind,
) -> Evidence:
    """Evidence of a robot's own map with weights of a kind, as it is shared with peers.

    Args:
        owner: as of `Evidence.from_map`.
        gaussians: as of `Evidence.from_map`.
        information: as of `Evidence.from_map`.
        T_map_keyframe: as of `Evidence.from_map`.
        kind: of the weights; `diagonal` depends on the frame, see `in_world`.
    """
    full = Evidence.from_map(owner, gaussians, information, T_map_keyframe)
    if kind in STATED_KINDS:
        return full
    if kind == "scalar":
        ones = np.ones((len(full), 1))
        position = np.trace(full.position_information(), axis1=1, axis2=2)[:, None] / 3 * ones
        shape = np.trace(full.shape_information(), axis1=1, axis2=2)[:, None] / 6 * ones
        color = full.color_information().mean(axis=1, keepdims=True)
        return _with(full, _isotropic(position, shape, color, full.opacity_information()))
    rows = rows_by_id(gaussians.ids, information.ids)
    known = rows >= 0
    measure = np.ones(len(full))
    if kind == "observation_count":
        measure = np.zeros(len(full))
        measure[known] = information.observations[rows[known]]
    elif kind == "residual_magnitude":
        measure = np.zeros(len(full), information.deviation_m.dtype)
        measure[known] = (UNIT_SIGMA_M / np.maximum(information.deviation_m[rows[known]], 1e-6)) ** 2
    m = measure[:, None]
    return _with(
        full,
        _isotropic(
            m / UNIT_SIGMA_M**2,
            m / UNIT_SIGMA_SHAPE**2,
            m / UNIT_SIGMA_COLOR**2,
            measure / UNIT_SIGMA_OPACITY**2,
        ),
    )


def self_information(
    owner: str,
    gaussians: Gaussians,
    information: MapInformation,
    T_map_keyframe: ArrayLike,
    *,
    kind: WeightKind,
) -> Evidence:
    """Evidence that a robot's own splats count with in its own map.

    With `block`, the information of their common rendering (`Evidence.from_rendering`), else what is shared with peers.

    Args:
        owner: as of `Evidence.from_map`.
        gaussians: as of `Evidence.from_map`.
        information: as of `Evidence.from_map`.
        T_map_keyframe: as of `Evidence.from_map`.
        kind: of the weights.
    """
    if kind == "block":
        return Evidence.from_rendering(owner, gaussians, information, T_map_keyframe)
    return shared_evidence(owner, gaussians, information, T_map_keyframe, kind=kind)


def in_world(evidence: Evidence, T_world_keyframe: ArrayLike, kind: WeightKind) -> Evidence:
    """`shared_evidence` or `self_information` in the world frame; of `diagonal`, the diagonal there.

    Args:
        evidence: in anchor frames.
        T_world_keyframe: [k, 4, 4], the owner's keyframes, by anchor.
        kind: of the weights.
    """
    there = evidence.in_world(T_world_keyframe)
    if kind != "diagonal":
        return there
    position, shape = (
        np.diagonal(b, axis1=1, axis2=2) for b in (there.position_information(), there.shape_information())
    )
    packed = pack_information(
        position[:, :, None] * np.eye(3),
        shape[:, :, None] * np.eye(6),
        there.color_information(),
        there.opacity_information(),
    )
    return _with(there, packed)


def _isotropic(position: Array, shape: Array, color: Array, opacity: Array) -> Array:
    """Packed information [n, 31] of one number per block: [n, 1] each, opacity [n]."""
    return pack_information(
        position[:, :, None] * np.eye(3),
        shape[:, :, None] * np.eye(6),
        np.repeat(color, 3, axis=1),
        opacity,
    )


def _with(evidence: Evidence, information: Array) -> Evidence:
    return Evidence(evidence.owner, evidence.ids, evidence.anchors, evidence.theta, information)
