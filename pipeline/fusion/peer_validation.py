"""What a robot's own images say against its neighbors' maps, before anything of them is used.

A signature says who made a Gaussian, not that it is true, and a robot that met the wrong neighbor must not end worse
than alone. So every neighbor's map is drawn where the robot's own keyframes stood, and compared with what they saw:

    e_p = |color drawn - color seen|^2,    blame of a Gaussian = (sum of its weights times e) / (sum of its weights),

over pixels at which the neighbor's surface lies in front of the measured one or on it; what lies behind is hidden and
says nothing. Colors are those that the own camera would show (`consensus.colors`, by the matches of this pair alone).
A Gaussian is contradicted if its pixels are drawn worse than by one gray for everything: blame above the variance of
the own images. So is a neighbor as a whole if its map does not explain some of the variance of the pixels that it was
judged on; honest ones explain two thirds and more, one color for everything nothing. What no own keyframe saw cannot
be judged.

Matches are checked, too, because the lower-named robot of a pair speaks for it: two Gaussians that are not where each
other are, or differ more than neighbors in the own map do, are none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.consensus import MatchingConfig, WeightKind
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import team_colors
from duagc.pipeline.consensus.evidence import Evidence, rows_by_id
from duagc.pipeline.consensus.matching import Pairs, gaussian_distance, threshold
from duagc.pipeline.consensus.weighting import in_world
from duagc.pipeline.fusion.finetune import View
from duagc.pipeline.geometry import se3, spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import LOG_COVARIANCE, MEAN, gaussians_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]
NOTHING: Index = np.zeros((0, 2), np.int64)
COVERED = 0.5  # opacity from which on a pixel shows a neighbor's surface
EXPLAINED = 0.3  # of the variance of own pixels, that a map must explain to be used at all
LEAST_GRAY = 0.01  # of images that show next to nothing, where errors of maps and poses count for more
LEAST_PX = 4.0  # weight, in pixels, from which on a Gaussian is judged
LEAST_SHARE = 0.01  # of the own pixels, from which on a neighbor is judged as a whole
PASSES = 2  # what hid behind a contradicted Gaussian is judged in the second
LARGEST = 2.0  # times the largest Gaussian of the own map: no mapper makes a larger one
# on what makes a match; far enough that rounding tips none of an honest robot
RADIUS_SLACK, DISTANCE_SLACK = 2.0, 1.5


@dataclass(frozen=True)
class PeerMapReport:
    """The check of one peer's map against own images.

    Attributes:
        peer: name of the robot that sent the map.
        gaussians: Gaussians that it sent.
        too_large: of them, not used because no mapper makes any that large.
        contradicted: of them, not used because own images contradict them.
        matches: of the peer with this robot.
        rejected_matches: of them, found to be false.
        compared_px: own pixels on which the map was compared.
        own_px: all own pixels.
        color_mse: mean squared error of the map's colors on the compared pixels, colors 0..1.
        color_variance: of the own colors there, at least LEAST_GRAY.
    """

    peer: str
    gaussians: int
    too_large: int
    contradicted: int
    matches: int
    rejected_matches: int
    compared_px: int
    own_px: int
    color_mse: float
    color_variance: float

    @property
    def trusted(self) -> bool:
        """Whether the map explains own images, or too few pixels of them see it to decide."""
        explains = self.color_mse <= (1 - EXPLAINED) * self.color_variance
        return explains or self.compared_px < LEAST_SHARE * self.own_px

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
    """What may be used of the neighbors' maps.

    evidence: by name, in anchor frames; empty of who is not trusted. contradicted: by name, which of these Gaussians
    own images contradict. pairs: of matched Gaussians. reports: one per neighbor, in order of name.
    """

    evidence: dict[str, Evidence]
    contradicted: dict[str, NDArray[np.bool_]]
    pairs: dict[tuple[str, str], Index]
    reports: tuple[PeerMapReport, ...]


def validate_peer_maps(
    own: Evidence,
    evidence: Mapping[str, Evidence],
    T_world_keyframe: Mapping[str, Array],
    pairs: Pairs,
    views: Sequence[View],
    camera: PinholeCamera,
    config: FusionConfig,
    matching: MatchingConfig,
    depth_of: Mapping[str, DepthKind],
    weights: WeightKind = "block",
    threads: int = 1,
) -> ValidatedPeers:
    """Hold every neighbor's map against the robot's own keyframes.

    Args:
        own: the robot's own evidence. evidence: of the neighbors, by name. Both in anchor frames.
        T_world_keyframe: by name, [k, 4, 4] by anchor. pairs: as they came, (robot a, robot b) -> ids [m, 2].
        views: own keyframes at their corrected poses. camera: of the views.
        matching: as the pairs were found. depth_of: as the neighbors' maps were made, by name. threads: changes no
            bit.
    """
    own_colors = _Spread()
    for view in views:
        own_colors.add(view.color[... if view.mask is None else view.mask])
    world = {own.owner: in_world(own, T_world_keyframe[own.owner], weights)}
    largest = LARGEST * _sizes_m(world[own.owner]).max(initial=0.0)
    kept, contradicted, reports = {}, {}, []
    for name in sorted(evidence):
        told = evidence[name]
        there = in_world(told, T_world_keyframe[name], weights)
        possible = _sizes_m(there) <= largest
        told, there = told.select(possible), there.select(possible)
        judge = _PeerMapCheck(views, camera, config, depth_of[name], threads)
        pair = _near(world[own.owner], there, _between(pairs, own.owner, name), matching)
        against = judge.contradicted(
            _in_colors_of(world[own.owner], there, pair, matching), own_colors.variance
        )
        report = PeerMapReport(
            name,
            len(possible),
            int(np.sum(~possible)),
            int(np.sum(against)),
            0,
            0,
            judge.own.pixels,
            own_colors.pixels,
            judge.error,
            judge.own.variance,
        )
        used = slice(None) if report.trusted else slice(0, 0)
        kept[name], contradicted[name], world[name] = told.select(used), against[used], there.select(used)
        reports.append(report)
    true = _true_pairs(world, pairs, DISTANCE_SLACK * threshold(world[own.owner], matching), matching)
    return ValidatedPeers(
        kept, contradicted, true, tuple(_with_pairs(d, own.owner, pairs, true) for d in reports)
    )


def _sizes_m(evidence: Evidence) -> Array:
    """Largest standard deviation [n] of each Gaussian."""
    values = np.linalg.eigvalsh(spd.vec_to_sym(evidence.theta[:, LOG_COVARIANCE]))
    return np.asarray(np.exp(0.5 * values.max(axis=1, initial=-np.inf)))


def _between(pairs: Pairs, own: str, other: str) -> Index:
    """Matches [m, 2] of two robots, the own id first."""
    found = pairs.get((min(own, other), max(own, other)), NOTHING)
    return found if own < other else np.flip(found, axis=1)


def _near(a: Evidence, b: Evidence, pairs: Index, matching: MatchingConfig) -> Index:
    """The pairs [m, 2] whose Gaussians are there and near each other."""
    i, j = rows_by_id(pairs[:, 0], a.ids), rows_by_id(pairs[:, 1], b.ids)
    known = np.flatnonzero((i >= 0) & (j >= 0))
    apart_m = np.linalg.norm(a.theta[i[known], MEAN] - b.theta[j[known], MEAN], axis=1)
    near: Index = pairs[known[apart_m <= RADIUS_SLACK * matching.radius_m]]
    return near


def _in_colors_of(a: Evidence, b: Evidence, pairs: Index, matching: MatchingConfig) -> Evidence:
    """Evidence of b as the camera of a would show it, by their matches [m, 2] alone."""
    cameras = team_colors({a.owner: a, b.owner: b}, {(a.owner, b.owner): pairs}, matching.colors)
    return cameras.between(b.owner, a.owner).of(b)


def _true_pairs(
    world: Mapping[str, Evidence], pairs: Pairs, largest: float, matching: MatchingConfig
) -> dict[tuple[str, str], Index]:
    """The pairs whose Gaussians are there, near each other and alike: d_G at most `largest`."""
    true = {}
    for a, b in sorted(p for p in pairs if p[0] in world and p[1] in world):
        near = _near(world[a], world[b], pairs[a, b], matching)
        i, j = rows_by_id(near[:, 0], world[a].ids), rows_by_id(near[:, 1], world[b].ids)
        other = _in_colors_of(world[a], world[b], near, matching)
        true[a, b] = near[gaussian_distance(world[a], i, other, j, matching) <= largest]
    return true


def _with_pairs(report: PeerMapReport, own: str, pairs: Pairs, true: Pairs) -> PeerMapReport:
    """How many matches of the neighbor with this robot there are, and how many of them are none."""
    count = len(_between(pairs, own, report.peer))
    return replace(report, matches=count, rejected_matches=count - len(_between(true, own, report.peer)))


class _Spread:
    """How much colors 0..255 differ, summed as they come."""

    def __init__(self) -> None:
        self.pixels, self._sum, self._squares = 0, np.zeros(3), np.zeros(3)

    def add(self, colors: NDArray[np.uint8]) -> None:
        """Colors [..., 3]."""
        c = colors.reshape(-1, 3).astype(np.float32) * np.float32(1 / 255)
        self.pixels += len(c)
        self._sum += c.sum(axis=0, dtype=np.float64)
        self._squares += (c**2).sum(axis=0, dtype=np.float64)

    @property
    def variance(self) -> float:
        """Mean over the channels, of colors 0..1; at least LEAST_GRAY."""
        n = max(self.pixels, 1)
        return max(float(np.mean(self._squares / n - (self._sum / n) ** 2)), LEAST_GRAY)


class _PeerMapCheck:
    """Draws a map at own keyframes. own, error: own colors at the judged pixels, mean squared error there, of the
    first drawing."""

    def __init__(
        self,
        views: Sequence[View],
        camera: PinholeCamera,
        config: FusionConfig,
        depth: DepthKind,
        threads: int,
    ) -> None:
        self.views, self.camera, self.config, self.depth = views, camera, config, depth
        self.rasterizer = Rasterizer(threads=threads)
        self.own, self.error = _Spread(), 0.0

    def contradicted(self, world: Evidence, gray: float) -> NDArray[np.bool_]:
        """Which Gaussians [n] own images contradict."""
        gaussians = gaussians_of(world.ids, world.anchors, world.theta)
        against = np.zeros(len(world), bool)
        for turn in range(PASSES):
            rows = np.flatnonzero(~against)
            blame = self._blame(gaussians.select(rows), first=turn == 0)
            against[rows[blame > gray]] = True
        return against

    def _blame(self, gaussians: Gaussians, first: bool) -> Array:
        """Mean squared error of what each Gaussian draws [n], zero of too little."""
        errors, weights = np.zeros(len(gaussians)), np.zeros(len(gaussians))
        total = 0.0
        for view in self.views:
            T_camera_world = se3.inverse(view.T_world_camera)
            render = self.rasterizer.forward(
                gaussians, self.camera, T_camera_world, mask=view.mask, depth_kind=self.depth
            )
            alpha = np.maximum(render.alpha, np.float32(COVERED))
            reach = view.depth_m * (1 + self.config.explained_relative) + self.config.explained_m
            judged = (render.alpha >= COVERED) & (view.depth_m > 0) & (render.depth / alpha <= reach)
            off = render.color / alpha[..., None] - view.color * np.float32(1 / 255)
            images = np.zeros_like(render.color)
            images[..., 0] = np.where(judged, np.mean(np.clip(off, -1, 1) ** 2, axis=2), 0)
            images[..., 1] = judged
            sums = self.rasterizer.backward(images).colors  # of weight times image, over the pixels
            errors, weights = errors + sums[:, 0], weights + sums[:, 1]
            total += float(images[..., 0].sum(dtype=np.float64))
            if first:
                self.own.add(view.color[judged])
        if first:
            self.error = total / max(self.own.pixels, 1)
        return np.where(weights >= LEAST_PX, errors / np.maximum(weights, LEAST_PX), 0.0)
