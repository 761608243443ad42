"""What neighbors' maps show from where the neighbors stood: views to train on that no own camera took.

A robot has its neighbors' whole maps and the poses of their keyframes, both by packets. What a neighbor's map draws
from there stands in for the images that the neighbor took and never sent. From such views the fused map learns what
two robots saw from different sides, which neither robot's own images can tell.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.consensus import WeightKind
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.weighting import in_world
from duagc.pipeline.fusion.finetune import View
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.information import gaussians_of

Array = NDArray[np.float64]
COVERED = 0.9
"""Opacity from which on a pixel of a neighbor's map counts as seen by it."""


def peer_views(
    evidence: Mapping[str, Evidence],
    T_world_keyframe: Mapping[str, Array],
    camera: PinholeCamera,
    most: int,
    depth_of: Mapping[str, DepthKind],
    weights: WeightKind = "block",
    threads: int = 1,
    *,
    colors: Mapping[str, ColorMap],
) -> list[View]:
    """Color and depth of every neighbor's map at its keyframes and half way between them, as the own camera sees.

    Args:
        evidence: of the neighbors, by name, in anchor frames. T_world_keyframe: by name, [k, 4, 4] by anchor.
        camera: the robot's own; what the neighbor's map does not cover counts as not seen.
        most: so many views in all, evenly spread.
        depth_of: as the maps were made, by name. threads: changes no bit.
        colors: from every neighbor's colors to the own.
    """
    rasterizer = Rasterizer(threads=threads)
    shown = [name for name in sorted(evidence) if len(evidence[name])]
    poses = [(name, T) for name in shown for T in _with_middles(T_world_keyframe[name])]
    count = min(most, len(poses))
    chosen = [poses[k] for k in evenly_spaced(len(poses), count)]
    views, drawn = [], ""
    for name, T_world_camera in chosen:
        if name != drawn:
            there = in_world(colors[name].of(evidence[name]), T_world_keyframe[name], weights)
            gaussians, drawn = gaussians_of(there.ids, there.anchors, there.theta), name
        render = rasterizer.forward(gaussians, camera, se3.inverse(T_world_camera), depth_kind=depth_of[name])
        seen = render.alpha >= COVERED
        share = np.where(seen, render.alpha, np.float32(1))
        color = np.rint(np.clip(render.color / share[..., None], 0, 1) * 255).astype(np.uint8)
        depth_m = np.where(seen, render.depth / share, np.float32(0))
        views.append(View(color, depth_m, T_world_camera, seen))
    return views


def _with_middles(T: Array) -> Array:
    """Poses [k, 4, 4] and those half way from each to the next: [2 k - 1, 4, 4]."""
    out = np.repeat(T, 2, axis=0)[:-1]
    out[1::2] = T[:-1] @ se3.exp(0.5 * se3.log(se3.inverse(T[:-1]) @ T[1:]))
    return out
