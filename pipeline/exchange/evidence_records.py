"""Evidence as records on the wire: made from a robot's own map, ranked, cut to the space a neighbor saw."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.consensus import MapMatching, WeightKind
from duagc.pipeline.config.exchange import EvidenceOrder
from duagc.pipeline.consensus.evidence import Evidence, PlacedGaussians, moved_parameters
from duagc.pipeline.consensus.matching import match
from duagc.pipeline.consensus.weighting import shared_evidence
from duagc.pipeline.exchange.wire.evidence_wire import record_dtype
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind
from duagc.pipeline.runs.robot_data import RobotData
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import COLOR_INFORMATION, INFORMATION_DIAGONAL, MEAN

Records = NDArray[Any]

# what a receiver expects before any evidence: standard deviations of position (m), log-covariance, color, opacity logit
PRIOR_SIGMA = np.repeat([0.05, 1.0, 0.1, 2.0], [3, 6, 3, 1])
VOXEL_BITS = 20  # per axis; voxels beyond +-2^19 share those at the border


def own_records(data: RobotData, kind: Kind, weights: WeightKind) -> Records:
    """A robot's own evidence in the frames of its anchors, in the precision of this kind of evidence.

    Args:
        data: of this robot.
        kind: of the evidence; says the precision of the records.
        weights: what a Gaussian weighs by, `exchange.weights`.

    Returns:
        [n] of `record_dtype(kind)`, with theta [13] and information [31] of every Gaussian, meters, in its
        anchor's frame.

    Raises:
        DuagError: some of it is not finite; integers of the compact kind cannot say so.
    """
    evidence = shared_evidence(
        data.robot, data.gaussians, data.information, data.T_map_keyframe, kind=weights
    )
    for name, values in (("parameters", evidence.theta), ("information", evidence.information)):
        broken = len(values) - int(np.isfinite(values).all(axis=1).sum())
        if broken:
            raise DuagError(
                f"{data.robot}: {name} of {broken} of {len(values)} Gaussians of its map are not finite, expected "
                "finite numbers"
            )
    return to_records(evidence, kind)


def to_records(evidence: Evidence, kind: Kind) -> Records:
    """Records of evidence, in the same order.

    Args:
        evidence: on n Gaussians, each in the frame of its anchor.
        kind: of the evidence; says the precision of the records.

    Returns:
        [n] of `record_dtype(kind)`.
    """
    records = np.zeros(len(evidence), record_dtype(kind))
    records["id"], records["anchor"] = evidence.ids, evidence.anchors
    records["theta"], records["information"] = evidence.theta, evidence.information
    return records


def to_evidence(owner: str, records: Records) -> Evidence:
    """Evidence of records, in the same order.

    Args:
        owner: name of the robot that the evidence is of.
        records: [n], in the frames of its keyframes.
    """
    return Evidence(owner, records["id"], records["anchor"], records["theta"], records["information"])


def gain(records: Records) -> Array:
    """Expected information gain [n], nats: 1/2 sum over dimensions of log(1 + information * prior variance).

    It has no unit, unlike the paper's (4), which adds 1/m^2 to 1/rad^2. All records have the same size.

    Args:
        records: [n], with information in 1/m^2 and without a unit (log-covariance, color, opacity).
    """
    known = np.maximum(records["information"][:, INFORMATION_DIAGONAL].astype(np.float64), 0.0)
    return 0.5 * np.log1p(known * PRIOR_SIGMA**2).sum(axis=1)


def paper_priority(records: Records) -> Array:
    """The paper's (4) [n]: the sum of the information over all dimensions, which depends on the unit of length.

    Args:
        records: [n], with information in 1/m^2 and without a unit (log-covariance, color, opacity).
    """
    return np.maximum(records["information"][:, INFORMATION_DIAGONAL].astype(np.float64), 0.0).sum(axis=1)


def order_of_sending(records: Records, order: EvidenceOrder, seed: int, robot: str) -> NDArray[np.int64]:
    """Which records [n] go first; ties by id. All have the same size.

    Args:
        records: of one robot.
        order: by falling gain or rising gain, by the paper's priority, or random.
        seed: of the run.
        robot: its name.
    """
    if order == "random":
        drawn = random_streams.generator(seed, "evidence_order", robot=robot).random(len(records))
        return np.argsort(drawn, kind="stable")
    value = {"gain": gain, "paper": paper_priority, "reversed": lambda r: -gain(r)}[order](records)
    return np.lexsort((records["id"], -value))


def voxel_keys(points: Array, edge_m: float) -> NDArray[np.int64]:
    """Key of the voxel of every point [n, 3].

    Args:
        points: [n, 3], meters, in the frame in which the grid is laid out.
        edge_m: of a voxel, meters.

    Returns:
        int64 [n], 20 bits per axis.
    """
    half = 1 << (VOXEL_BITS - 1)
    cell = np.clip(np.floor(points / edge_m), -half, half - 1).astype(np.int64) + half
    return (cell[:, 0] << 2 * VOXEL_BITS) | (cell[:, 1] << VOXEL_BITS) | cell[:, 2]


def seen_voxels(gaussians: Gaussians, T_world_map: Array, edge_m: float) -> NDArray[np.int64]:
    """Ascending keys of the voxels with a Gaussian of this map, and of those around them.

    Args:
        gaussians: of the own map, in the map frame.
        T_world_map: [4, 4], own map frame in the common frame in which the grid is laid out.
        edge_m: of a voxel, meters.
    """
    points = se3.transform(T_world_map, gaussians.means.astype(np.float64))
    steps = np.array(np.meshgrid(*[[-1, 0, 1]] * 3)).reshape(3, -1).T * edge_m
    occupied = np.unique(np.floor(points / edge_m), axis=0) * edge_m + 0.5 * edge_m
    return np.unique(voxel_keys((occupied[:, None] + steps).reshape(-1, 3), edge_m))


def within(
    records: Records, T_world_keyframe: Array, voxels: NDArray[np.int64], edge_m: float
) -> NDArray[np.bool_]:
    """Which records [n] lie in one of the voxels.

    Args:
        records: of one owner.
        T_world_keyframe: [k, 4, 4] of the owner's keyframes, by anchor.
        voxels: ascending keys.
        edge_m: of a voxel.
    """
    T = T_world_keyframe[records["anchor"]]
    mean = records["theta"][:, MEAN].astype(np.float64)
    points = (T[:, :3, :3] @ mean[:, :, None])[..., 0] + T[:, :3, 3]
    return np.isin(voxel_keys(points, edge_m), voxels)


def match_pairs(
    own: tuple[str, Records, Array], peer: tuple[str, Records, Array], config: MapMatching
) -> NDArray[np.int64]:
    """Ids of matched Gaussians of two robots, int64 [n, 2].

    Args:
        own: name, evidence, and keyframes [k, 4, 4] by anchor in the common frame.
        peer: the same of the other robot.
        config: of the matching.
    """
    a, b = (
        PlacedGaussians(
            records["id"].astype(np.int64),
            moved_parameters(records["theta"], T_common, records["anchor"]),
            records["information"][:, COLOR_INFORMATION],
        )
        for _, records, T_common in (own, peer)
    )
    SHELF.sweep(heap=True)
    return match(a, b, config)
