"""Whose Gaussians draw each surface of the final map: those of the robot that saw it at the finest resolution.

Fusion keeps the own Gaussians wherever an own keyframe measured a surface, from however far and however aslant, and
imports the rest. Where a peer stood nearer, its Gaussians show more than own ones ever can. So the final map begins
with the fused one, in which the peer's Gaussians replace own ones on surfaces that both saw, and the peer at a
resolution finer by a factor. The resolution of a camera on a surface is the number of its pixels per meter,

    q = f / z,

z along the optical axis, largest over the keyframes that saw the place: that measured, or whose map draws, a surface
there or behind it. Peers' keyframes see what the peer's own map draws from there, without what own images contradict.
Training on own images and on renders of peers' maps follows (`finetune`) and closes the seams.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.coverage import DepthImages, known_surfaces
from duagc.pipeline.fusion.final_start import FinalStart
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import gaussians_of, mean_block
from duagc.pipeline.splat.map_cells import MapCells


def from_finest_views(
    fused: FusedMap,
    evidence: Mapping[str, Evidence],
    T_world_keyframe: Mapping[str, Array],
    context: MapContext,
    *,
    robot: str,
    factor: float,
    depth_images: DepthImages,
    depth_kinds: Mapping[str, DepthKind],
    cameras: Mapping[str, PinholeCamera],
) -> FinalStart:
    """A fused map with peers' Gaussians in the place of own ones where a peer's keyframes saw the surface finer.

    Args:
        fused: the fused map of the robot.
        evidence: of the peers, by name, in the world frame, each in its own colors, without what is contradicted.
        T_world_keyframe: of the robot and its peers, by name, [k, 4, 4] by anchor.
        context: the robot's own camera and settings.
        robot: its name.
        factor: by which a peer's resolution must exceed the own one.
        depth_images: of own keyframes.
        depth_kinds: as the peers' maps were made, by name.
        cameras: of the peers, by name.
    Returns:
        Without the own Gaussians that were replaced; ids of what comes in follow the largest of the fused map.
    """
    own_rows = np.flatnonzero(fused.source == fused.robots.index(robot))
    maps = {robot: fused.gaussians.select(own_rows)}
    peers = [name for name in sorted(evidence) if len(evidence[name])]
    if not peers:
        return FinalStart.of_fused(fused)
    for name in peers:
        theirs = evidence[name]
        maps[name] = gaussians_of(theirs.ids, theirs.anchors, fused.colors[name].parameters(theirs))
    SHELF.sweep(heap=True)
    found = _resolutions(
        maps,
        robot,
        T_world_keyframe,
        context=context,
        depth_images=depth_images,
        depth_kinds=depth_kinds,
        cameras=cameras,
    )
    kept = np.ones(len(fused.gaussians), bool)
    kept[own_rows[_seen_finer(found[robot], robot, factor)]] = False
    parts, stated = [fused.gaussians.select(np.flatnonzero(kept))], []
    next_id = int(fused.gaussians.ids.max()) + 1 if len(fused.gaussians) else 0
    for name in peers:
        taken = _belongs(found[name], name, robot, factor) & ~_imported(fused, name, maps[name].ids)
        if context.config.added_need_information:
            taken &= np.trace(mean_block(evidence[name].information), axis1=-2, axis2=-1) > 0
        rows = np.flatnonzero(taken)
        parts.append(maps[name].select(rows).replace(ids=next_id + np.arange(len(rows))))
        stated.append(fused.colors[name].of(evidence[name].select(rows)).information)
        next_id += len(rows)
    return FinalStart(Gaussians.concatenate(parts), np.concatenate(stated))


def _resolutions(
    maps: Mapping[str, Gaussians],
    robot: str,
    T_world_keyframe: Mapping[str, Array],
    *,
    context: MapContext,
    depth_images: DepthImages,
    depth_kinds: Mapping[str, DepthKind],
    cameras: Mapping[str, PinholeCamera],
) -> dict[str, dict[str, Array]]:
    """By owner of the Gaussians and by robot that saw them: the finest resolution at each [n]."""
    means = {name: np.asarray(g.means, dtype=np.float64) for name, g in maps.items()}
    long = len(T_world_keyframe[robot]) > context.config.finetune.keyframes
    cells = {name: MapCells.of(g) for name, g in maps.items()} if long else {}
    # a peer draws where it is opaque, not next to it
    exact = context.config.model_copy(update={"explained_px": 0})
    found: dict[str, dict[str, Array]] = {name: {} for name in maps}
    for seen_by, gaussians in maps.items():
        poses = T_world_keyframe[seen_by]
        if seen_by == robot:
            seeing, measured = context, depth_images
        else:
            camera = cameras[seen_by]
            seeing = replace(context, camera=camera, config=exact, depth_kind=depth_kinds[seen_by])
            empty = np.zeros((camera.height, camera.width), np.float32)
            measured = ((k, empty) for k in range(len(poses)))
        drawn = known_surfaces(gaussians, poses, measured, seeing)
        for name, finest in finest_resolution(means, poses, drawn, seeing, cells=cells).items():
            found[name][seen_by] = finest
    return found


def _imported(fused: FusedMap, owner: str, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of a peer's Gaussians the fused map has imported."""
    return np.isin(ids, fused.source_ids[fused.source == fused.robots.index(owner)])


def finest_resolution(
    means: Mapping[str, Array],
    T_world_keyframe: Array,
    surfaces: DepthImages,
    context: MapContext,
    *,
    cells: Mapping[str, MapCells] | None = None,
) -> dict[str, Array]:
    """Finest resolution, pixels per meter, at which keyframes of one robot saw each place; 0 of what none saw.

    Args:
        means: places [n, 3] in the world, meters, by any name.
        T_world_keyframe: [k, 4, 4], of the keyframes.
        surfaces: depth of known surfaces by keyframe (`known_surfaces`).
        context: their camera, and tolerances.
        cells: of Gaussians at these places, so that not all are looked at in every image; None: all are.
    """
    config, camera = context.config, context.camera
    finest = {name: np.zeros(len(points)) for name, points in means.items()}
    for keyframe, depth_m in surfaces:
        T_camera_world = se3.inverse(T_world_keyframe[keyframe])
        for name, points in means.items():
            near: NDArray[np.int64] | slice = slice(None)
            if cells:
                near = cells[name].in_image(T_world_keyframe[keyframe], camera)
            seen = se3.transform(T_camera_world, points[near])
            index, column, row = visible(camera, seen)
            z, surface_m = seen[index, 2], depth_m[row, column].astype(np.float64)
            reach_m = surface_m + config.explained_m + config.explained_relative * z
            saw = (surface_m > 0) & (z <= reach_m)
            index, z = index[saw], z[saw]
            index = index if isinstance(near, slice) else near[index]
            finest[name][index] = np.maximum(finest[name][index], camera.fx / z)
    return finest


def _seen_finer(resolution: Mapping[str, Array], robot: str, factor: float) -> NDArray[np.bool_]:
    """Whether some peer saw the places of own Gaussians finer by the factor; what own keyframes do not tell stays."""
    peers = [resolution[name] for name in sorted(resolution) if name != robot]
    own = resolution[robot]
    return np.asarray((own > 0) & (np.max(peers, axis=0) > factor * own))


def _belongs(resolution: Mapping[str, Array], owner: str, robot: str, factor: float) -> NDArray[np.bool_]:
    """Whether places that the robot saw are drawn by a peer: it saw them finer by the factor, and no other peer finer.

    Of peers that saw a place equally the first in order of name draws it.
    """
    own = resolution[owner]
    first = (resolution[robot] > 0) & (own > factor * resolution[robot])
    for name in resolution.keys() - {owner, robot}:
        first &= (own >= resolution[name]) if owner < name else (own > resolution[name])
    return np.asarray(first)
