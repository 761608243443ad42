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
through.
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
from duagc.pipeline.config.fusion import PeerValidationConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import team_colors
from duagc.pipeline.consensus.evidence import Evidence, rows_by_id
from duagc.pipeline.consensus.matching import Pairs, gaussian_distance, threshold, without
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.geometry import se3, spd
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import LOG_COVARIANCE, MEAN, gaussians_of

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
        trusted: whether the map explains own images, or too few pixels see it to decide.
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
    own_colors = _ColorStatistics(config.min_color_variance)
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
        judged[name] = _PhotometricCheck(views, context, depth_kinds[name], config, arrived=arrived[name])
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


class _ColorStatistics:
    """Variance of colors 0..1, summed as they come."""

    def __init__(self, least_variance: float) -> None:
        self.least_variance = least_variance
        self.pixels, self._sum, self._squares = 0, np.zeros(3), np.zeros(3)

    def add(self, colors: NDArray[np.float32]) -> None:
        """Colors [..., 3]."""
        c = colors.reshape(-1, 3)
        self.pixels += len(c)
        self._sum += c.sum(axis=0, dtype=np.float64)
        self._squares += (c**2).sum(axis=0, dtype=np.float64)

    @property
    def variance(self) -> float:
        """Mean over the channels, of colors 0..1; not below the least one."""
        n = max(self.pixels, 1)
        return max(float(np.mean(self._squares / n - (self._sum / n) ** 2)), self.least_variance)


class _PhotometricCheck:
    """Renders one peer's map at own keyframes.

    Attributes:
        explained: share of the variance of own pixels that the map must explain.
        own: own colors at the pixels on which the whole map was compared.
        color_mse: mean squared error of the map there, colors 0..1.
        num_contradicted: Gaussians that own images contradict.
    """

    def __init__(
        self,
        views: Sequence[PosedRgbd],
        context: MapContext,
        depth_kind: DepthKind,
        config: PeerValidationConfig,
        *,
        arrived: float,
    ) -> None:
        self.explained = config.min_explained_variance * arrived
        self.views, self.context, self.depth_kind, self.config = views, context, depth_kind, config
        self.rasterizer = Rasterizer(threads=context.threads)
        self.own, self.color_mse = _ColorStatistics(config.min_color_variance), 0.0
        self._seen_px = 0  # that saw the whole map
        self.num_contradicted = 0

    def trusted(self, own_px: int) -> bool:
        """Whether the map explains own images, or too few of all own pixels see it to decide.

        Of a map with holes as much is expected as there is of it; what is wrong explains nothing, however little it is.
        """
        return self._explains or self._seen_px < self.config.min_overlap * own_px

    @property
    def _explains(self) -> bool:
        """Whether the colors of the map explain enough where it is seen."""
        return self.color_mse <= (1 - self.explained) * self.own.variance

    def contradicted(self, world: Evidence, gray: float) -> NDArray[np.bool_]:
        """Which Gaussians [n] own images contradict: error above `gray`, the variance of own colors."""
        gaussians = gaussians_of(world.ids, world.anchors, world.theta)
        against = self._judged(gaussians, np.zeros(len(world), bool), gray)
        if self._explains:
            return against
        free, seen = self._in_free_space(world.theta[:, MEAN])
        if free.any() and np.sum(free) <= self.config.max_in_free_space * np.sum(seen):
            self.explained = max(self.explained, self.config.min_explained_by_rest)
            against = self._judged(gaussians, free, gray)
        return against

    def _judged(self, gaussians: Gaussians, without: NDArray[np.bool_], gray: float) -> NDArray[np.bool_]:
        """Which Gaussians [n] are contradicted, drawn without some, which are; own colors are counted anew.

        If it explains too little because of few of them, it is judged by the rest.
        """
        against, judged = without.copy(), np.zeros_like(without)
        for turn in range(self.config.passes):
            rows = np.flatnonzero(~against)
            errors = self._errors(gaussians.select(rows), count=turn == 0)
            if not (turn or without.any()):
                self._seen_px = self.own.pixels
            against[rows[errors > gray]] = True
            judged[rows[errors > 0]] = True
        false_share = int(np.sum(against & ~without)) / max(int(np.sum(judged)), 1)
        if not self._explains and false_share <= self.config.max_contradicted:  # what is not used may be why
            self._errors(gaussians.select(~against), count=True)
            self.explained = max(self.explained, self.config.min_explained_by_rest)
        return against

    def _in_free_space(self, means_world: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which places [n, 3] most own depth images that see as far measured beyond; and which any of them saw."""
        config, camera = self.context.config, self.context.camera
        beyond, there = np.zeros((2, len(means_world)), np.int64)
        for view in self.views:
            at = se3.transform(se3.inverse(view.T_world_camera), means_world)
            index, column, row = visible(camera, at)
            z, measured_m = at[index, 2], view.usable_depth[row, column].astype(np.float64)
            slack_m = config.explained_m + config.explained_relative * z
            known = measured_m > 0
            beyond[index] += known & (measured_m > z + slack_m)
            there[index] += known & (np.abs(measured_m - z) <= slack_m)
        return beyond > there, beyond + there > 0

    def _errors(self, gaussians: Gaussians, *, count: bool) -> Array:
        """Mean squared error of the pixels of each Gaussian [n], zero of too few; `count`: own colors there, anew."""
        if count:
            self.own = _ColorStatistics(self.config.min_color_variance)
        errors, weights = np.zeros(len(gaussians)), np.zeros(len(gaussians))
        total, fusion, least = 0.0, self.context.config, self.config.min_opacity
        for view in self.views:
            render = self.rasterizer.forward(
                gaussians,
                self.context.camera,
                se3.inverse(view.T_world_camera),
                mask=view.mask,
                depth_kind=self.depth_kind,
            )
            alpha = np.maximum(render.alpha, np.float32(least))
            reach = view.depth_m * (1 + fusion.explained_relative) + fusion.explained_m
            judged = (render.alpha >= least) & (view.depth_m > 0) & (render.depth / alpha <= reach)
            off = render.color / alpha[..., None] - view.unit_color
            images = np.zeros_like(render.color)
            images[..., 0] = np.where(judged, np.mean(np.clip(off, -1, 1) ** 2, axis=2), 0)
            images[..., 1] = judged
            sums = self.rasterizer.backward(images).colors  # of weight times image, over the pixels
            errors, weights = errors + sums[:, 0], weights + sums[:, 1]
            total += float(images[..., 0].sum(dtype=np.float64))
            if count:
                self.own.add(view.unit_color[judged])
        if count:
            self.color_mse = total / max(self.own.pixels, 1)
        least_px = self.config.min_gaussian_px
        return np.where(weights >= least_px, errors / np.maximum(weights, least_px), 0.0)
