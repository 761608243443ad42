"""Renders of peers' maps from the peers' keyframes: views to train on that no own camera took.

A robot has its peers' whole maps and the poses of their keyframes, both by packets. A render of a peer's map from
there stands in for the images that the peer took and never sent. From such views the fused map learns what two robots
saw from different sides, which neither robot's own images contain.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.blended_values import blended_values
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import gaussians_of, sigma_along

COVERED = 0.9
"""Opacity from which on a pixel of a peer's map counts as seen by it."""


def peer_views(
    evidence: Mapping[str, Evidence],
    T_world_keyframe: Mapping[str, Array],
    context: MapContext,
    *,
    depth_kinds: Mapping[str, DepthKind],
    cameras: Mapping[str, PinholeCamera],
    colors: Mapping[str, ColorMap],
    keyframes: int = 0,
) -> Sequence[PosedRgbd]:
    """Color and depth of every peer's map at its keyframes and half way between them, as its camera sees.

    What a peer's map does not cover is masked, and what `peer_pixels` leaves out.

    Args:
        evidence: of the peers, by name, in the world frame, each in its own colors.
        T_world_keyframe: by name, [k, 4, 4] by anchor.
        context: settings; `config.finetune.peer_views` of all views are taken, evenly spread.
        depth_kinds: as the maps were made, by name.
        cameras: that took the keyframes, by name.
        colors: from every peer's colors to the own.
        keyframes: of the robot: a longer log has more views.
    """
    shown = [name for name in sorted(evidence) if len(evidence[name])]
    poses = [(name, T) for name in shown for T in _with_middles(T_world_keyframe[name])]
    config = context.config.finetune
    count = min(config.at_most(config.peer_views, keyframes), len(poses))
    chosen = [poses[k] for k in evenly_spaced(len(poses), count)]
    return ShelvedList(
        _views(evidence, chosen, context, depth_kinds=depth_kinds, cameras=cameras, colors=colors)
    )


def _views(
    evidence: Mapping[str, Evidence],
    chosen: Sequence[tuple[str, Array]],
    context: MapContext,
    *,
    depth_kinds: Mapping[str, DepthKind],
    cameras: Mapping[str, PinholeCamera],
    colors: Mapping[str, ColorMap],
) -> Iterator[PosedRgbd]:
    rasterizer, drawn = Rasterizer(threads=context.threads), ""
    kind = context.config.finetune.peer_pixels
    for number, (name, T_world_camera) in enumerate(chosen):
        if name != drawn:
            peer, drawn = evidence[name], name
            gaussians = gaussians_of(peer.ids, peer.anchors, colors[name].parameters(peer))
            if kind not in ("covered", "random"):
                sigma_m, _ = sigma_along(peer.position_information(), gaussians.normals())
        T_camera_world, camera = se3.inverse(T_world_camera), cameras[name]
        render = rasterizer.forward(gaussians, camera, T_camera_world, depth_kind=depth_kinds[name])
        seen = render.alpha >= COVERED
        if kind == "random":
            stream = random_streams.generator(context.seed, "fusion.peer-pixels", view=number)
            seen &= stream.random(seen.shape) < 0.5
        elif kind != "covered":
            stated = _relative_sigma(
                gaussians,
                sigma_m,
                camera,
                T_camera_world,
                threads=context.threads,
                depth=depth_kinds[name],
            )
            middle = np.median(stated[seen]) if seen.any() else 0.0
            seen &= stated <= middle if kind == "certain" else stated > middle
        share = np.where(seen, render.alpha, np.float32(1))
        color = np.rint(np.clip(render.color / share[..., None], 0, 1) * 255).astype(np.uint8)
        depth_m = np.where(seen, render.depth / share, np.float32(0))
        yield PosedRgbd(color, depth_m, T_world_camera, seen, camera=camera)


def _relative_sigma(
    gaussians: Gaussians,
    sigma_m: Array,
    camera: PinholeCamera,
    T_camera_world: Array,
    *,
    threads: SupportsIndex,
    depth: DepthKind,
) -> NDArray[np.float32]:
    """Stated deviation of what a pixel blends, over its depth [h, w]; infinite where nothing is stated.

    sigma_m: [n], of each Gaussian across its disc; infinite where it is not determined.
    """
    blended = blended_values(
        gaussians,
        sigma_m,
        camera,
        T_camera_world,
        rasterizer=Rasterizer(threads=threads),
        depth_kind=depth,
    )
    depth_m = blended.render.depth / np.maximum(blended.render.alpha, np.float32(1e-6))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(blended.weight > 0, blended.mean / depth_m, np.float32(np.inf)))


def _with_middles(T: Array) -> Array:
    """Poses [k, 4, 4] and those half way from each to the next: [2 k - 1, 4, 4]."""
    out = np.repeat(T, 2, axis=0)[:-1]
    out[1::2] = T[:-1] @ se3.exp(0.5 * se3.log(se3.inverse(T[:-1]) @ T[1:]))
    return out
