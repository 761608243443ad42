"""Photometric consistency check of peers' maps, before anything of them is used.

A signature proves who made a Gaussian, not that it is true, and a robot that met a wrong peer must not end worse than
alone. So every peer's map is rendered where the robot's own keyframes were, and compared with their images:

    e_p = |color rendered - color seen|^2,    error of a Gaussian = (sum of its weights times e) / (sum of its weights),

over pixels at which the peer's surface lies in front of the measured one or on it; what lies behind is hidden and gives
no evidence. Colors are those that the own camera would show (`consensus.colors`, by the matches of this pair alone).
A Gaussian is contradicted if its pixels are rendered worse than by one gray for everything: its error is above the
variance of the own images. A peer as a whole is contradicted if its map does not explain some of the variance of the
pixels that it was judged on, neither as it is nor, if they are few, without the Gaussians that are contradicted: where
a camera measures no depth, honest maps hold Gaussians that are right in that camera's own views alone. In front of all
else they hide what is true; if need be a map is judged without all that stands in space that own depth images saw
through. A map that is seen from behind may show more that is wrong than right, and still most of what it shows in
detail is there: then blocks of the images decide, of which a false map shows few.
What no own keyframe saw cannot be judged.

Matches are checked, too, because the lower-named robot of a pair decides on them: two Gaussians that are not near each
other, or differ more than neighbors in the own map do, are no match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import in_blocks
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import team_colors
from duagc.pipeline.consensus.evidence import Evidence, rows_by_id
from duagc.pipeline.consensus.matching import Pairs, gaussian_distance, threshold, without
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.photometric_check import ColorStatistics, PhotometricCheck
from duagc.pipeline.geometry import spd
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.splat.information import LOG_COVARIANCE, MEAN

Index = NDArray[np.int64]
NO_PAIRS: Index = np.zeros((0, 2), np.int64)


@dataclass(frozen=True)
class PeerCheck:
    """What own images show of one peer's map.

    Attributes:
        peer: name of the robot that sent the map.
        gaussians: Gaussians that it sent.
        too_large: of them, not used because they are larger than a mapper makes any.
        contradicted: of them, not used because own images contradict them.
        compared_px: own pixels on which the map was compared.
        own_px: all own pixels.
        color_mse: mean squared error of the map's colors on the compared pixels, colors 0..1.
        color_variance: of the own colors there, at least `PeerValidationConfig.min_color_variance`.
        trusted: whether the map explains own images, or blocks of them correlate with it, or too few pixels see it to
            decide.
        matches: of the peer with this robot.
        rejected_matches: of them, found to be false.
    """

    peer: str
    gaussians: int
    too_large: int
    contradicted: int
    compared_px: int
    own_px: int
    color_mse: float
    color_variance: float
    trusted: bool
    matches: int
    rejected_matches: int

    @property
    def reason(self) -> str:
        """Why nothing of the map is used; empty if it is used."""
        if self.trusted:
            return ""
        return (
            f"it contradicts own images: squared error {self.color_mse:.4f} on {self.compared_px} common pixels, "
            f"whose variance is {self.color_variance:.4f}"
        )


@dataclass(frozen=True)
class ValidatedPeers:
    """What may be used of the peers' maps.

    Attributes:
        evidence: by name, in the world frame; empty of a peer that is not trusted.
        contradicted: by name, bool [n], which of these Gaussians own images contradict.
        pairs: (robot a, robot b) -> ids int64 [m, 2] of matched Gaussians.
        rejected: likewise, matches that are not used though both Gaussians are here; only pairs of robots that have
            any.
        checks: one per peer, in order of name.
    """

    evidence: dict[str, Evidence]
    contradicted: dict[str, NDArray[np.bool_]]
    pairs: dict[tuple[str, str], Index]
    rejected: dict[tuple[str, str], Index]
    checks: tuple[PeerCheck, ...]

    @cached_property
    def uncontradicted(self) -> dict[str, Evidence]:
        """By name, in order, the evidence without what own images contradict."""
        against = self.contradicted
        return {
            name: SHELF.put(e.select(~against[name])) if against[name].any() else e
            for name, e in sorted(self.evidence.items())
        }


def validate_peer_maps(
    own: Evidence,
    peers: Mapping[str, Evidence],
    pairs: Pairs,
    context: MapContext,
    *,
    views: Sequence[PosedRgbd],
    depth_kinds: Mapping[str, DepthKind],
    arrived: Mapping[str, float],
) -> ValidatedPeers:
    """Compare every peer's map with the robot's own keyframes.

    Args:
        own: the robot's own evidence, in the world frame.
        peers: evidence of the peers, by name, in the world frame.
        pairs: as they were received, (robot a, robot b) -> ids int64 [m, 2].
        context: camera and settings.
        views: own keyframes at their corrected poses.
        depth_kinds: as the peers' maps were made, by name.
        arrived: share of their Gaussians that are here, by name.
    """
    config, matching = context.config.peer_validation, context.matching
    own_colors = ColorStatistics(config.min_color_variance)
    for view in views:
        own_colors.add(view.unit_color[... if view.mask is None else view.mask])
    own_m = _sizes_m(own).max() if len(own) else np.inf
    largest_m = max(config.max_size_ratio * own_m, config.max_size_m)
    radius_m = config.match_radius_factor * matching.radius_m
    world, contradicted, judged = {own.owner: own}, {}, {}
    too_large = {}
    for name in sorted(peers):
        possible = _sizes_m(peers[name]) <= largest_m
        peer = peers[name] if possible.all() else SHELF.put(peers[name].select(possible))
        too_large[name] = int(np.sum(~possible))
        near = _near(own, peer, _between(pairs, own.owner, name), radius_m)
        judged[name] = PhotometricCheck(views, context, depth_kinds[name], config, arrived=arrived[name])
        shown = SHELF.put(_in_colors_of(own, peer, near, matching))
        against = judged[name].contradicted(shown, own_colors.variance)
        used = slice(None) if judged[name].trusted(own_colors.pixels) else slice(0, 0)
        world[name], contradicted[name] = peer.select(used), against[used]
        judged[name].num_contradicted = int(np.sum(against))
    true = _true_pairs(
        world,
        pairs,
        matching,
        radius_m=radius_m,
        factor=config.match_distance_factor,
        own_threshold=threshold(own, matching),
    )
    checks = []
    for name, check in judged.items():
        matches = len(_between(pairs, own.owner, name))
        checks.append(
            PeerCheck(
                peer=name,
                gaussians=len(peers[name]),
                too_large=too_large[name],
                contradicted=check.num_contradicted,
                compared_px=check.own.pixels,
                own_px=own_colors.pixels,
                color_mse=check.color_mse,
                color_variance=check.own.variance,
                trusted=check.trusted(own_colors.pixels),
                matches=matches,
                rejected_matches=matches - len(_between(true, own.owner, name)),
            )
        )
    evidence = {name: world[name] for name in sorted(peers)}
    rejected = _rejected({own.owner: own, **peers}, pairs, true)
    return ValidatedPeers(evidence, contradicted, true, rejected, tuple(checks))


def _sizes_m(evidence: Evidence) -> Array:
    """Largest standard deviation [n] of each Gaussian."""

    def sizes_m(vec_log_covariance: Array) -> Array:
        values = np.linalg.eigvalsh(spd.vec_to_sym(vec_log_covariance))
        return np.asarray(np.exp(0.5 * values.max(axis=1, initial=-np.inf)))

    return in_blocks(sizes_m, evidence.theta[:, LOG_COVARIANCE])


def _between(pairs: Pairs, own: str, other: str) -> Index:
    """Matches [m, 2] of two robots, the own id first."""
    found = pairs.get((min(own, other), max(own, other)), NO_PAIRS)
    return found if own < other else np.flip(found, axis=1)


def _near(a: Evidence, b: Evidence, pairs: Index, radius_m: float) -> Index:
    """The pairs [m, 2] whose Gaussians exist and are near each other."""
    i, j = rows_by_id(pairs[:, 0], a.ids), rows_by_id(pairs[:, 1], b.ids)
    known = np.flatnonzero((i >= 0) & (j >= 0))
    apart_m = np.linalg.norm(a.theta[i[known], MEAN] - b.theta[j[known], MEAN], axis=1)
    near: Index = pairs[known[apart_m <= radius_m]]
    return near


def _in_colors_of(a: Evidence, b: Evidence, pairs: Index, matching: MapMatching) -> Evidence:
    """Evidence of b as the camera of a would show it, by their matches [m, 2] alone."""
    cameras = team_colors({a.owner: a, b.owner: b}, {(a.owner, b.owner): pairs}, matching.colors)
    return cameras.between(b.owner, a.owner).of(b)


def _true_pairs(
    world: Mapping[str, Evidence],
    pairs: Pairs,
    matching: MapMatching,
    *,
    radius_m: float,
    factor: float,
    own_threshold: float,
) -> dict[tuple[str, str], Index]:
    """The pairs whose Gaussians exist, are near each other and alike: d_G at most `factor` times tau_G.

    That of the own map, where it has neighbors; else that of the map by which the pair was matched.
    """
    true = {}
    for a, b in sorted(p for p in pairs if p[0] in world and p[1] in world):
        near = _near(world[a], world[b], pairs[a, b], radius_m)
        i, j = rows_by_id(near[:, 0], world[a].ids), rows_by_id(near[:, 1], world[b].ids)
        other = _in_colors_of(world[a], world[b], near, matching)
        largest = factor * (own_threshold or threshold(world[a], matching))
        true[a, b] = near[gaussian_distance(world[a], i, other, j, config=matching) <= largest]
    return true


def _rejected(received: Mapping[str, Evidence], pairs: Pairs, true: Pairs) -> dict[tuple[str, str], Index]:
    """The pairs whose Gaussians were received but that are not among the true ones.

    What never arrived is a matter of the exchange, not of a decision.
    """
    rejected = {}
    for a, b in sorted(p for p in pairs if p[0] in received and p[1] in received):
        here = [
            rows_by_id(ids, received[r].ids) >= 0
            for r, ids in ((a, pairs[a, b][:, 0]), (b, pairs[a, b][:, 1]))
        ]
        left = without(pairs[a, b][here[0] & here[1]], true.get((a, b), NO_PAIRS))
        if len(left):
            rejected[a, b] = left
    return rejected
