"""One robot's fused map from all robots' evidence: method sections 3 and 4, mode `evidence`.

In the flat chart theta = (mean, vec log Sigma, color, opacity logit) the fused value of a track is, block by block,

    theta* = (sum W_eff)^-1 sum W_eff theta,        W_eff = (W^-1 + Sigma_assoc)^-1 = (I + W Sigma_assoc)^-1 W,

which is the paper's (12) and, as the chart is flat, its log-Euclidean mean (13). Sigma_assoc is the association
variance (`association`). By default peers' values carry it, and the own splat counts with the information of its
rendering (`Evidence.from_rendering`), because an image depends on all of its splats together, not on where one of them
is. A thickness that the mapper holds at its floor is held here too. Every robot's evidence counts once, however often
it arrived and from which peer. Where no member of a track has information, the own value stays. The result is a
continuous function of the evidence. Everything is fused in colors common to the team (`consensus.colors`), and each
robot's map has those of its own camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import in_blocks, row_blocks
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import Pairs
from duagc.pipeline.consensus.tracks import Tracks as FoundTracks
from duagc.pipeline.consensus.tracks import tracks
from duagc.pipeline.fusion.association import EvidenceRows, TrackMembers, fused_moves
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.coverage import DepthImages, known_surfaces, select_unseen
from duagc.pipeline.fusion.team_evidence import TeamEvidence
from duagc.pipeline.geometry import spd
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import (
    COLOR,
    COLOR_INFORMATION,
    INFORMATION_SIZE,
    LOG_COVARIANCE,
    MEAN,
    OPACITY,
    THETA_SIZE,
    gaussians_of,
    mean_block,
)

Index = NDArray[np.int64]


@dataclass(frozen=True)
class FusedMap:
    """A robot's fused map in the world frame: its own Gaussians first, in their order, then the imported ones.

    Attributes:
        gaussians: ids of own ones are kept; those of imported ones follow the largest own id. Anchors are keyframes of
            the source robot.
        theta: float64 [n, 13], the same before rounding to float32.
        information: float64 [n, 31] as in `splat.information`, world frame, the sum over members.
        robots: names.
        source: int32 [n], index into robots: whose Gaussian it was.
        source_ids: int64 [n], its id there.
        members: int32 [n], robots whose evidence is in it.
        matched: own Gaussians fused with others.
        added: imported Gaussians.
        colors: from every other robot's colors to the receiver's, which are those of the map.
        stated_scale: factor on the standard deviations of positions that the information states.
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
    stated_scale: float = 1.0

    def shelved(self) -> FusedMap:
        """The same, with what no training looks at in a file: of a long log some hundred megabytes."""
        theta, information = SHELF.put((self.theta, self.information))
        return replace(self, theta=theta, information=information)


@dataclass(frozen=True)
class OwnMap:
    """The map of the robot that fuses, before and after its keyframes were corrected.

    Attributes:
        robot: its name.
        gaussians: in its map frame.
        T_map_keyframe: [k, 4, 4], its keyframes in its own map, by anchor.
        T_world_keyframe: [k, 4, 4], the same in the world.
    """

    robot: str
    gaussians: Gaussians
    T_map_keyframe: Array
    T_world_keyframe: Array

    def in_world(self) -> Gaussians:
        """The Gaussians in the world, each moved with its keyframe; the same bits where nothing moved."""
        if np.array_equal(self.T_map_keyframe, self.T_world_keyframe):
            return self.gaussians
        return self.gaussians.moved(self.T_map_keyframe, self.T_world_keyframe)


@dataclass(frozen=True)
class _Tracks:
    """What matched Gaussians become.

    Attributes:
        representative: int64 [g], row that stands for each track.
        move: [g, 13], fused minus own theta of that row.
        members: int32 [g], robots whose evidence is in it.
        information: [g, 31], summed over the members.
        absorbed: bool [rows], rows that are represented by another one.
    """

    representative: Index
    move: Array
    members: NDArray[np.int32]
    information: Array
    absorbed: NDArray[np.bool_]

    def among(self, rows: Index) -> tuple[Index, Index]:
        """Places in some rows of those that stand for a track, and these tracks."""
        track = np.full(len(self.absorbed), -1)
        track[self.representative] = np.arange(len(self.representative))
        places = np.flatnonzero(track[rows] >= 0)
        return places, track[rows[places]]


def fuse(
    own: OwnMap,
    evidence: Mapping[str, Evidence],
    pairs: Pairs,
    context: MapContext,
    *,
    self_information: Evidence,
    depth_images: DepthImages = (),
    contradicted: Mapping[str, NDArray[np.bool_]] | None = None,
) -> FusedMap:
    """Fuse the evidence of a robot and its peers into one map in the world frame.

    Args:
        own: the receiver's own map.
        evidence: by robot, in the world frame (`consensus.weighting.in_world`), the receiver's own included
            (of all its Gaussians, by id).
        pairs: (robot a, robot b) -> ids int64 [m, 2] of matched Gaussians.
        context: camera and settings.
        self_information: the receiver's own evidence for `association = neighbors`, in the world frame, of
            all its Gaussians (`consensus.weighting.self_information`).
        depth_images: of own keyframes; for `coverage = all`.
        contradicted: by robot, bool [n] of its evidence: Gaussians that are not imported, whatever space they
            are in.
    Raises:
        ValueError: the own evidence is not on the Gaussians of the own map.
    """
    ids = own.gaussians.ids
    ordered = {n: _in_order_of(ids, e) if n == own.robot else e for n, e in evidence.items()}
    team = TeamEvidence.of(own.robot, ordered, pairs, context)
    refused = np.zeros(len(team.theta), dtype=bool)
    for name, against in (contradicted or {}).items():
        refused[team.start[team.names.index(name)] + np.flatnonzero(against)] = True
    found = _tracks(team, pairs, context, refused)
    matched = _fuse_tracks(team, found, _in_order_of(ids, self_information), context)
    SHELF.sweep(heap=True)
    absorbed = matched.absorbed | refused
    moved = own.in_world()
    added = np.flatnonzero((team.owner != team.names.index(team.robot)) & ~absorbed)
    if context.config.coverage == "all" and len(added):
        surfaces = known_surfaces(moved, own.T_world_keyframe, depth_images, context)
        theta, information = SHELF.put((team.theta[added], _information(team, matched, added)))
        SHELF.sweep(heap=True)
        unseen = select_unseen(
            theta,
            information,
            T_world_keyframe=own.T_world_keyframe,
            surfaces=surfaces,
            context=context,
        )
        added = added[unseen]
    else:
        added = added[:0]
    return _fused_map(team, matched, moved, added)


def _tracks(team: TeamEvidence, pairs: Pairs, context: MapContext, refused: NDArray[np.bool_]) -> FoundTracks:
    """All tracks; refused rows [rows] take part only in those of the receiver, and leave the others what they saw."""
    found = tracks(team.evidence, pairs, context.matching)
    own = np.zeros(len(np.unique(found.track)), dtype=bool)
    own[found.track[found.robot == team.names.index(team.robot)]] = True
    leaves = refused[team.start[found.robot] + found.row] & ~own[found.track]
    if not leaves.any():
        return found
    gone = {
        name: team.evidence[name].ids[found.row[leaves & (found.robot == k)]]
        for k, name in enumerate(team.names)
    }
    kept = {
        (a, b): ids[~(np.isin(ids[:, 0], gone[a]) | np.isin(ids[:, 1], gone[b]))]
        for (a, b), ids in pairs.items()
        if a in gone and b in gone
    }
    return tracks(team.evidence, kept, context.matching)


def _fuse_tracks(
    team: TeamEvidence, found: FoundTracks, self_information: Evidence, context: MapContext
) -> _Tracks:
    """Fuse all tracks; the receiver's row stands for a track, else that which knows its position best."""
    me = team.names.index(team.robot)
    member = team.start[found.robot] + found.row
    first = np.flatnonzero(np.diff(found.track, prepend=-1)).astype(np.int64)
    track_of_member = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(member))))
    known = in_blocks(lambda m: np.trace(mean_block(team.information[m]), axis1=-2, axis2=-1), member)
    reference = np.lexsort((np.arange(len(member)), -known, track_of_member))[first]
    reference[track_of_member[found.robot == me]] = np.flatnonzero(found.robot == me)
    representative = member[reference]

    move = np.zeros((len(first), THETA_SIZE))
    if len(first):
        theta, information = _gathered(team.theta, member), _gathered(team.information, member)
        if context.config.association == "neighbors":
            mine = np.flatnonzero(found.robot == me)
            common = team.cameras.to_common(team.robot)
            for some in row_blocks(len(mine)):
                rows = mine[some]
                splats = common.of(self_information.select(found.row[rows]))
                theta[rows], information[rows] = splats.theta, splats.information
                SHELF.sweep()
        tracked = TrackMembers(EvidenceRows(*SHELF.put((theta, information))), reference, first)
        del theta, information
        SHELF.sweep(heap=True)
        move = fused_moves(tracked, context.config, context.matching.thickness_floor_m)
    absorbed = np.zeros(len(team.theta), dtype=bool)
    absorbed[member] = True
    absorbed[representative] = False
    move, information = SHELF.put((move, _summed(team.information, member, first)))
    return _Tracks(
        representative,
        move,
        np.diff(np.append(first, len(member))).astype(np.int32),
        information,
        absorbed,
    )


def _gathered(array: Array, rows: Index) -> Array:
    """Rows [n, k] of an array that lies in a file, block by block: of a long log these are some hundred megabytes."""
    out = np.empty((len(rows), array.shape[1]))
    for some in row_blocks(len(rows)):
        out[some] = array[rows[some]]
        SHELF.sweep()
    return out


def _summed(information: Array, member: Index, first: Index) -> Array:
    """Information [g, 31] of every track, summed over its members."""
    sums = np.empty((len(first), INFORMATION_SIZE))
    ends = np.append(first, len(member))
    for some in row_blocks(len(first)):
        begin = ends[some.start]
        rows = information[member[begin : ends[some.stop]]]
        np.add.reduceat(rows, first[some] - begin, axis=0, out=sums[some])
    return sums


def _information(team: TeamEvidence, matched: _Tracks, rows: Index) -> Array:
    """Information [n, 31] of some rows, summed over the members of those that stand for a track."""
    information = _gathered(team.information, rows)
    places, track = matched.among(rows)
    for some in row_blocks(len(places)):
        information[places[some]] = matched.information[track[some]]
    return information


def _fused_map(team: TeamEvidence, matched: _Tracks, own_world: Gaussians, added: Index) -> FusedMap:
    """The receiver's Gaussians as moved, then the imported ones, in the receiver's colors."""
    own_rows, robot = team.own_rows, team.robot
    common = team.cameras.to_common(robot)
    order = np.concatenate([own_rows, added])
    places, track = matched.among(order)
    members = np.ones(len(order), np.int32)
    members[places] = matched.members[track]
    sums = _information(team, matched, order)
    sums[:, COLOR_INFORMATION] *= common.gain**2
    sums = SHELF.put(sums)
    SHELF.sweep(heap=True)
    move = np.zeros((len(order), THETA_SIZE))
    move[places] = matched.move[track]
    theta = team.theta[order]
    theta += move
    move[:, COLOR] /= common.gain
    theta[:, COLOR] = common.from_other(theta[:, COLOR])
    own = slice(len(own_rows))
    kept = _applied(own_world, move[own], team.theta[own_rows, LOG_COVARIANCE])
    del move
    ids = np.concatenate([team.evidence[n].ids for n in team.names])
    anchors = np.concatenate([team.evidence[n].anchors for n in team.names])
    next_id = int(own_world.ids.max()) + 1 if len(own_world) else 0
    imported = gaussians_of(next_id + np.arange(len(added)), anchors[added], theta[len(own_rows) :])
    theta = SHELF.put(theta)
    SHELF.sweep(heap=True)
    return FusedMap(
        gaussians=Gaussians.concatenate([kept, imported]),
        theta=theta,
        information=sums,
        robots=team.names,
        source=team.owner[order].astype(np.int32),
        source_ids=ids[order],
        members=members,
        matched=int(np.sum(members[own] > 1)),
        added=len(added),
        colors={n: team.cameras.between(n, robot) for n in team.names if n != robot},
    )


def _in_order_of(ids: Index, own: Evidence) -> Evidence:
    """Own evidence in the order of the map's ids."""
    if not np.array_equal(np.sort(own.ids), np.sort(ids)):
        raise ValueError(f"{own.owner}: the own evidence must be on the Gaussians of the own map")
    if np.array_equal(own.ids, ids):
        return own
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
