"""A merge of maps at the size of the fused one: of all robots' Gaussians those that draw most of the training's views.

Another start of the final map than `finest_views`: as many Gaussians as the fused map has, chosen from that map and all
that peers' maps have beyond it, neither matched, nor imported, nor contradicted. All of them are drawn together at the
own keyframes and at the poses of the peers' views that are trained on; those stay that draw most,

    (sum over the views of the blending weight, px) times (product of the two largest standard deviations).

The extent counts, because what a small Gaussian drew its neighbors learn to draw, and where a large one is missing,
there is a hole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import Pairs
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.final_start import FinalStart
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import INFORMATION_SIZE, gaussians_of, mean_block


def most_drawn(
    fused: FusedMap,
    evidence: Mapping[str, Evidence],
    pairs: Pairs,
    context: MapContext,
    *,
    robot: str,
    views: Sequence[PosedRgbd],
) -> FinalStart:
    """The Gaussians that the training begins with, at most as many as the fused map has.

    Args:
        fused: the fused map of the robot.
        evidence: of the peers, by name, in the world frame, each in its own colors, without what is contradicted.
        pairs: (robot a, robot b) -> ids int64 [m, 2] of matched Gaussians.
        context: the robot's own camera and settings.
        robot: its name.
        views: own keyframes, and what peers' maps show; only poses, cameras and masks are used.
    Returns:
        In the order of the fused map, then of the peers; ids of what comes in follow the largest of the fused map.
    """
    next_id = int(fused.gaussians.ids.max()) + 1 if len(fused.gaussians) else 0
    parts, stated = [fused.gaussians], [np.empty((0, INFORMATION_SIZE))]
    for name, rows in _others(fused, evidence, pairs, robot=robot, context=context):
        theirs = fused.colors[name].of(evidence[name].select(rows))
        parts.append(gaussians_of(next_id + np.arange(len(rows)), theirs.anchors, theirs.theta))
        stated.append(theirs.information)
        next_id += len(rows)
    everything, information = Gaussians.concatenate(parts), np.concatenate(stated)
    most = len(fused.gaussians)
    if context.config.most_final is not None:
        most = min(most, context.config.most_final)
    if len(everything) <= most:
        return FinalStart(everything, information)
    best = np.sort(np.argsort(-_drawn(everything, views, context), kind="stable")[:most])
    taken = best[best >= len(fused.gaussians)] - len(fused.gaussians)
    return FinalStart(everything.select(best), information[taken])


def _others(
    fused: FusedMap, evidence: Mapping[str, Evidence], pairs: Pairs, *, robot: str, context: MapContext
) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Of every peer the rows of what the fused map does not stand for; of matched peers that of the lowest name."""
    for name in sorted(evidence):
        e = evidence[name]
        taken = [fused.source_ids[fused.source == fused.robots.index(name)]]
        for (lower, higher), ids in pairs.items():
            if name == lower and higher == robot:
                taken.append(ids[:, 0])
            elif name == higher and lower == robot:
                taken.append(ids[:, 1])
            elif name == higher and lower in evidence:
                taken.append(ids[np.isin(ids[:, 0], evidence[lower].ids), 1])
        new = ~np.isin(e.ids, np.concatenate(taken))
        if context.config.added_need_information:
            new &= np.trace(mean_block(e.information), axis1=-2, axis2=-1) > 0
        if new.any():
            yield name, np.flatnonzero(new)


def _drawn(gaussians: Gaussians, views: Sequence[PosedRgbd], context: MapContext) -> Array:
    """How much each Gaussian [n] draws of the views, times its extent, px m^2."""
    rasterizer, weight = Rasterizer(threads=context.threads), np.zeros(len(gaussians))
    for view in views:
        rasterizer.forward(
            gaussians,
            view.camera or context.camera,
            se3.inverse(view.T_world_camera),
            mask=view.mask,
            depth_kind=context.depth_kind,
        )
        weight += rasterizer.contributions()[0]
    sizes = np.sort(gaussians.log_scales.astype(np.float64), axis=1)
    return np.asarray(weight * np.exp(sizes[:, 1] + sizes[:, 2]))
