"""The fusion stage: the result of a session becomes a robot's fused map and its corrected trajectory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.shelf import SHELF, ShelvedList
from duagc.pipeline.config.consensus import MapMatching, WeightKind
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.consensus.weighting import STATED_KINDS, in_world, self_information
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.final_start import FinalStart, stated_of_fused, stated_of_taken
from duagc.pipeline.fusion.finest_views import from_finest_views
from duagc.pipeline.fusion.finetune import finetune_map
from duagc.pipeline.fusion.fuse import FusedMap, OwnMap, fuse
from duagc.pipeline.fusion.most_drawn import most_drawn
from duagc.pipeline.fusion.opacity_update import update_opacities
from duagc.pipeline.fusion.own_images import take_read_ahead
from duagc.pipeline.fusion.peer_validation import PeerCheck, ValidatedPeers, validate_peer_maps
from duagc.pipeline.fusion.peer_views import peer_views
from duagc.pipeline.fusion.stated_scale import stated_scale
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.surface_distance import DepthView
from duagc.pipeline.geometry.trajectory import Trajectory, write_tum
from duagc.pipeline.messages import (
    WORLD_FRAME,
    CorrectedKeyframes,
    GaussianMap,
    PeerColors,
    PeerMapReport,
    RejectedMatches,
)
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.runs.robot_data import AgentInput, RobotData, SessionResult
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.ply import write_ply
from duagc.schemas import topics


@dataclass(frozen=True)
class _Fusion:
    """What the stage found.

    Attributes:
        fused: the fused map.
        start: of the finetuning.
        refined: the finetuned map; None for a robot that met no other.
        valid: what was used of the peers' maps, and the checks.
    """

    fused: FusedMap
    start: FinalStart
    refined: Gaussians | None
    valid: ValidatedPeers


def run_fusion(
    source: AgentInput,
    result: SessionResult,
    folder: Path,
    *,
    config: FusionConfig,
    matching: MapMatching,
    moving: MovingConfig,
    weights: WeightKind = "block",
    seed: int = 0,
    threads: SupportsIndex = 1,
    checkpoints: Checkpoints | None = None,
) -> tuple[PeerCheck, ...]:
    """Write fused.mcap, fused.ply, refined.ply, trajectory.tum and odometry.tum of one robot.

    Args:
        source: the robot's own files.
        result: of the session.
        folder: where the results go.
        config: of fusion.
        matching: as the pairs of the session were found.
        moving: as the front end looked for what moves.
        weights: kind of the session.
        seed: of the run.
        threads: of the rasterizer; changes no bit.
        checkpoints: of this stage and robot, from which it goes on, and to which it saves; they change no bit.
    Returns:
        The check of every peer's map against own images.
    Raises:
        DuagError: a file lacks what it should hold, or two files do not belong together.
    """
    read = take_read_ahead(source, config.finetune)
    own, frames = read.own, read.frames
    T_world_camera = np.array(
        [result.T_world_keyframe[f.keyframe_index] @ f.T_keyframe_camera for f in frames]
    )
    context = MapContext(own.camera, config, matching, own.depth, weights, threads, seed=seed)
    views: Sequence[PosedRgbd] = []
    if len(result.component) > 1:
        views = read.images.views(T_world_camera, moving)
    fusion = _fuse(own, result, views, context, save=checkpoints or Checkpoints())
    SHELF.sweep(heap=True)
    refined = fusion.fused.gaussians if fusion.refined is None else fusion.refined
    write_ply(folder / "fused.ply", fusion.fused.gaussians)
    write_ply(folder / "refined.ply", refined)
    _write_log(folder / "fused.mcap", result, fusion, stamp_ns=frames[-1].stamp_ns, own=own)
    stamps = np.array([f.stamp_ns for f in frames], dtype=np.int64)
    before = np.array([f.T_map_camera for f in frames])
    write_tum(folder / "odometry.tum", Trajectory(stamps, before))
    write_tum(folder / "trajectory.tum", Trajectory(stamps, T_world_camera))
    return fusion.valid.checks


def _fuse(
    own: RobotData,
    result: SessionResult,
    views: Sequence[PosedRgbd],
    context: MapContext,
    *,
    save: Checkpoints,
) -> _Fusion:
    """Validate the peers' maps, fuse, update opacities, finetune.

    Args:
        own: the robot's own files.
        result: of the session.
        views: own images, keyframes first; none for a robot that met no other.
        context: camera and settings.
        save: checkpoints of the stage.
    """
    valid, fused = save.done("fused", lambda: _untrained(own, result, views, context))
    if len(result.component) < 2:
        return _Fusion(fused, FinalStart.of_fused(fused), None, valid)
    start, trained = _finetuned(own, result, fused, valid, views=views, context=context, save=save)
    return _Fusion(fused, start, trained, valid)


def _untrained(
    own: RobotData, result: SessionResult, views: Sequence[PosedRgbd], context: MapContext
) -> tuple[ValidatedPeers, FusedMap]:
    """Validate the peers' maps, fuse, update opacities, and hold the peers' deviations against own images."""
    poses, keyframe_views = result.T_world_keyframe_of, views[: own.keyframes]
    mine = SHELF.put(in_world(result.own_evidence, poses[own.robot], context.weights))
    valid = validate_peer_maps(
        mine,
        {name: SHELF.put(in_world(e, poses[name], context.weights)) for name, e in result.evidence.items()},
        result.pairs,
        context,
        views=keyframe_views,
        depth_kinds=result.depth_of,
        arrived=result.arrived,
    )
    SHELF.sweep(heap=True)
    in_map = SHELF.put(
        self_information(own.robot, own.gaussians, own.information, own.T_map_keyframe, kind=context.weights)
    )
    own_information = SHELF.put(in_world(in_map, poses[own.robot], context.weights))
    SHELF.sweep(heap=True)
    fused = fuse(
        OwnMap(own.robot, own.gaussians, own.T_map_keyframe, poses[own.robot]),
        {own.robot: mine, **valid.evidence},
        valid.pairs,
        context,
        self_information=own_information,
        depth_images=_depth_images(own),
        contradicted=valid.contradicted,
    )
    if len(result.component) < 2:
        return valid, fused
    fused = update_opacities(
        fused,
        keyframe_views,
        context,
        num_own=len(own.gaussians),
        color_sigma=own.information.color_sigma,
        pixels_per_sample=own.information.color_pixels_per_sample,
    ).shelved()
    stated = context.config.stated_scale
    if not stated.enabled or context.weights not in STATED_KINDS:
        return valid, fused
    some = (views[k] for k in evenly_spaced(len(views), min(stated.views, len(views))))
    seen = ShelvedList(DepthView(view.usable_depth, view.T_world_camera) for view in some)
    peers = valid.uncontradicted.values()
    return valid, replace(fused, stated_scale=stated_scale(peers, own.camera, seen, stated))


def _finetuned(
    own: RobotData,
    result: SessionResult,
    fused: FusedMap,
    valid: ValidatedPeers,
    *,
    views: Sequence[PosedRgbd],
    context: MapContext,
    save: Checkpoints,
) -> tuple[FinalStart, Gaussians | None]:
    """The fused map trained on own images and on renders of peers' maps; None if the settings have no steps."""
    config = context.config.finetune
    start, poses = FinalStart.of_fused(fused), result.T_world_keyframe_of
    if not config.steps(context.depth_kind).per_view:
        return start, None
    shown: Sequence[PosedRgbd] = ()
    if config.peer_share:
        usable = valid.uncontradicted
        shown = peer_views(
            usable,
            poses,
            context,
            depth_kinds=result.depth_of,
            cameras=result.camera_of,
            colors=fused.colors,
            keyframes=own.keyframes,
        )
        from_peers = len(shown) > 0 and context.config.imports_all
        if from_peers and context.config.final_start == "drawn":
            seen = [*views[: own.keyframes], *shown]
            start = most_drawn(fused, usable, valid.pairs, context, robot=own.robot, views=seen)
        elif from_peers and context.config.finer:
            start = from_finest_views(
                fused,
                usable,
                poses,
                context,
                robot=own.robot,
                factor=context.config.finer,
                depth_images=_depth_images(own),
                depth_kinds=result.depth_of,
                cameras=result.camera_of,
            )
    trained = None if shown else fused.source == fused.robots.index(own.robot)
    refined = finetune_map(
        start.gaussians,
        views,
        context,
        trained=trained,
        peer_views=shown,
        keyframes=own.keyframes,
        checkpoints=save,
    )
    return start, refined


def _depth_images(own: RobotData) -> Iterator[tuple[int, NDArray[np.float32]]]:
    for keyframe in range(own.keyframes):
        yield keyframe, own.images(keyframe).depth_m


def _write_log(path: Path, result: SessionResult, fusion: _Fusion, *, stamp_ns: int, own: RobotData) -> None:
    robot, depth_kind, fused = result.robot, own.depth, fusion.fused
    keyframes = CorrectedKeyframes(
        stamp_ns=stamp_ns,
        robot=robot,
        component=list(result.component),
        keyframe_indices=np.arange(len(result.T_world_keyframe), dtype=np.int32),
        T_world_keyframe=result.T_world_keyframe,
    )
    stated = SHELF.put(stated_of_fused(robot, fused, stamp_ns))
    SHELF.sweep(heap=True)
    fused_map = GaussianMap(stamp_ns, robot, WORLD_FRAME, fused.gaussians, stated, depth_kind)
    with LogWriter(path, robot) as log:
        log.write(topics.CORRECTED_KEYFRAMES.of(robot), keyframes, stamp_ns, stamp_ns)
        log.write(topics.FUSED_MAP.of(robot), fused_map, stamp_ns, stamp_ns)
        if fusion.refined is not None:
            of_taken = SHELF.put(
                stated_of_taken(robot, fusion.start, stamp_ns, stated_scale=fused.stated_scale)
            )
            refined_map = GaussianMap(stamp_ns, robot, WORLD_FRAME, fusion.refined, of_taken, depth_kind)
            log.write(topics.REFINED_MAP.of(robot), refined_map, stamp_ns, stamp_ns)
        for peer, colors in sorted(fused.colors.items()):
            peer_colors = PeerColors(
                stamp_ns=stamp_ns,
                robot=robot,
                peer=peer,
                gain=colors.gain,
                offset=colors.offset,
                gain_sigma=colors.sigma_gain,
                offset_sigma=colors.sigma_offset,
                matches=colors.matches,
            )
            log.write(topics.PEER_COLORS.of(robot), peer_colors, stamp_ns, stamp_ns)
        for check in fusion.valid.checks:
            report = _report(robot, check, stamp_ns)
            log.write(topics.PEER_MAP_REPORT.of(robot), report, stamp_ns, stamp_ns)
        for (lower, higher), ids in sorted(fusion.valid.rejected.items()):
            rejected = RejectedMatches(stamp_ns, robot, lower, higher, ids)
            log.write(topics.REJECTED_MATCHES.of(robot), rejected, stamp_ns, stamp_ns)


def _report(robot: str, check: PeerCheck, stamp_ns: int) -> PeerMapReport:
    """The check of a peer's map as a message."""
    return PeerMapReport(
        stamp_ns=stamp_ns,
        robot=robot,
        peer=check.peer,
        gaussians=check.gaussians,
        too_large=check.too_large,
        contradicted=check.contradicted,
        matches=check.matches,
        rejected_matches=check.rejected_matches,
        compared_px=check.compared_px,
        own_px=check.own_px,
        color_mse=check.color_mse,
        color_variance=check.color_variance,
        used=check.trusted,
        reason=check.reason,
    )
