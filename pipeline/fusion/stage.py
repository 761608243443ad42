"""The fusion stage: what a robot took home from the session becomes its fused map and its corrected trajectory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc import schemas
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import MatchingConfig, WeightKind
from duagc.pipeline.config.fusion import FusionConfig, RefineConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.consensus.weighting import own_stiffness
from duagc.pipeline.fusion.finetune import View, refine
from duagc.pipeline.fusion.fuse import FusedMap, fuse
from duagc.pipeline.fusion.opacity_update import weigh_by_own_pixels
from duagc.pipeline.fusion.peer_validation import PeerMapReport, validate_peer_maps
from duagc.pipeline.fusion.peer_views import peer_views
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory, write_tum
from duagc.pipeline.messages import (
    WORLD_FRAME,
    CorrectedKeyframes,
    GaussianInformation,
    GaussianMap,
    Odometry,
    pack_stamp,
)
from duagc.pipeline.recording import LogWriter, open_rgbd, read_log
from duagc.pipeline.registration.moving import FreeSpace
from duagc.pipeline.runs.robot_data import AgentInput, AgentResult, RobotData, load
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import COLOR_INFORMATION, OPACITY_INFORMATION, geometry_of_information
from duagc.pipeline.splat.ply import write_ply
from duagc.schemas import topics

Array = NDArray[np.float64]
FUSED_KIND = "gauss_newton"


def run_fusion(
    source: AgentInput,
    result: AgentResult,
    folder: Path,
    config: FusionConfig,
    matching: MatchingConfig,
    moving: MovingConfig,
    weights: WeightKind = "block",
    *,
    seed: int = 0,
    threads: int = 1,
) -> tuple[PeerMapReport, ...]:
    """Write fused.mcap, fused.ply, refined.ply, trajectory.tum and odometry.tum of one robot.

    Args:
        source: the robot's own files.
        result: what it took home from the session.
        folder: where the results go.
        matching: as the pairs of the session were found. weights: kind of the session.
        moving: as the front end looked for what moves.
        seed: of the run. threads: of the rasterizer; changes no bit.
    Returns:
        What own images say against every neighbor's map.
    """
    own = load(source)
    frames = _frames(source)
    hung = np.array([result.T_world_keyframe[f.keyframe_index] @ f.T_keyframe_camera for f in frames])
    stamp_ns = frames[-1].stamp_ns
    met = len(result.component) > 1
    views = training_views(source, frames, hung, config.refine, moving) if met else []
    validated = validate_peer_maps(
        result.own_evidence,
        result.evidence,
        result.T_world_keyframe_of,
        result.pairs,
        views[: own.keyframes],
        own.camera,
        config,
        matching,
        result.depth_of,
        weights,
        threads,
    )
    fused = fuse(
        own.robot,
        own.gaussians,
        own.T_map_keyframe,
        {own.robot: result.own_evidence, **validated.evidence},
        own_stiffness(own.robot, own.gaussians, own.information, own.T_map_keyframe, weights),
        result.T_world_keyframe_of,
        validated.pairs,
        _depth_images(own),
        own.camera,
        config,
        matching,
        own.depth,
        weights,
        contradicted=validated.contradicted,
    )
    refined = None
    if met:
        info = own.information
        fused = weigh_by_own_pixels(
            fused,
            len(own.gaussians),
            views[: own.keyframes],
            own.camera,
            info.color_sigma,
            info.color_pixels_per_sample,
            config,
            own.depth,
            threads,
        )
        if config.refine.steps_per_view:
            shown = peer_views(
                {name: e.select(~validated.contradicted[name]) for name, e in validated.evidence.items()},
                result.T_world_keyframe_of,
                own.camera,
                config.refine.peer_views if config.refine.peer_share else 0,
                result.depth_of,
                weights,
                threads,
                colors=fused.colors,
            )
            owned = fused.source == fused.robots.index(own.robot)
            refined = refine(
                fused.gaussians,
                np.ones_like(owned) if shown else owned,
                views,
                own.camera,
                config.refine,
                matching.thickness_floor_m,
                own.depth,
                seed,
                threads,
                peer_views=shown,
            )
    write_ply(folder / "fused.ply", fused.gaussians)
    write_ply(folder / "refined.ply", fused.gaussians if refined is None else refined)
    _write_log(folder / "fused.mcap", result, fused, refined, validated.reports, stamp_ns, own.depth)
    stamps = np.array([f.stamp_ns for f in frames], dtype=np.int64)
    before = np.array([f.T_map_camera for f in frames])
    write_tum(folder / "odometry.tum", Trajectory(stamps, before))
    write_tum(folder / "trajectory.tum", Trajectory(stamps, hung))
    return validated.reports


def training_views(
    source: AgentInput,
    frames: Sequence[Odometry],
    T_frame_camera: Array,
    config: RefineConfig,
    moving: MovingConfig,
) -> list[View]:
    """The robot's keyframes and, evenly spread, frames between them; none held out.

    Args:
        frames: that have a pose, in order. T_frame_camera: [n, 4, 4], these poses, in the frame of the views.
        moving: as the front end looked for what moves.
    """
    topic = topics.KEYFRAME.of(source.robot)
    keyframes = {record.message().frame_index for record in read_log(source.frontend, (topic,))}
    first = [k for k, f in enumerate(frames) if f.frame_index in keyframes]
    others = [k for k, f in enumerate(frames) if f.frame_index not in keyframes and not f.held_out]
    count = min(config.support_views, len(others))
    middles = [others[k] for k in evenly_spaced(len(others), count)]
    views = []
    with open_rgbd(source.log) as log:
        free = FreeSpace(log.camera, moving)
        for k in (*first, *middles):
            frame = log.frame(frames[k].frame_index)
            usable = frame.usable_depth
            if frames[k].frame_index in keyframes:
                free.add(usable, T_frame_camera[k])
            views.append(View(frame.color, usable, T_frame_camera[k], frame.mask, frame.depth_sigma))
    return [replace(v, mask=free.usable(v.depth_m, v.T_world_camera, v.mask)) for v in views]


def _depth_images(own: RobotData) -> Iterator[tuple[int, NDArray[np.float32]]]:
    for keyframe in range(own.keyframes):
        yield keyframe, own.images(keyframe).depth_m


def _frames(source: AgentInput) -> list[Odometry]:
    """Every frame that the front end placed, in order."""
    topic = topics.ODOMETRY.of(source.robot)
    frames = [record.message() for record in read_log(source.frontend, (topic,))]
    placed = [f for f in frames if f.status != "lost"]
    if not placed:
        raise DuagError(f"{source.frontend}: {topic} has no tracked frame")
    return placed


def _write_log(
    path: Path,
    result: AgentResult,
    fused: FusedMap,
    refined: Gaussians | None,
    reports: Sequence[PeerMapReport],
    stamp_ns: int,
    depth: DepthKind,
) -> None:
    robot = result.robot
    keyframes = CorrectedKeyframes(
        stamp_ns=stamp_ns,
        robot=robot,
        component=list(result.component),
        keyframe_indices=np.arange(len(result.T_world_keyframe), dtype=np.int32),
        T_world_keyframe=result.T_world_keyframe,
    )
    fused_map = GaussianMap(
        stamp_ns, robot, WORLD_FRAME, fused.gaussians, _information(robot, fused, stamp_ns), depth
    )
    with LogWriter(path, robot) as log:
        log.write(topics.CORRECTED_KEYFRAMES.of(robot), keyframes, stamp_ns, stamp_ns)
        log.write(topics.FUSED_MAP.of(robot), fused_map, stamp_ns, stamp_ns)
        if refined is not None:
            refined_map = GaussianMap(stamp_ns, robot, WORLD_FRAME, refined, None, depth)
            log.write(topics.REFINED_MAP.of(robot), refined_map, stamp_ns, stamp_ns)
        for peer, colors in sorted(fused.colors.items()):
            message = schemas.new(
                "PeerColors",
                robot=robot,
                peer=peer,
                gain=colors.gain,
                offset=colors.offset,
                gain_sigma=colors.sigma_gain,
                offset_sigma=colors.sigma_offset,
                matches=colors.matches,
            )
            pack_stamp(message, stamp_ns)
            log.write(topics.PEER_COLORS.of(robot), message, stamp_ns, stamp_ns)
        for report in reports:
            log.write(
                topics.PEER_MAP_REPORT.of(robot),
                _peer_map_report(robot, report, stamp_ns),
                stamp_ns,
                stamp_ns,
            )


def peer_colors(path: Path, robot: str) -> dict[str, ColorMap]:
    """From every neighbor's colors to the robot's, by name, of its fused.mcap; empty if that holds none."""
    found = [record.message() for record in read_log(path, (topics.PEER_COLORS.of(robot),))]
    return {
        m.peer: ColorMap(
            np.array(m.gain), np.array(m.offset), np.array(m.gain_sigma), np.array(m.offset_sigma), m.matches
        )
        for m in found
    }


def _peer_map_report(robot: str, report: PeerMapReport, stamp_ns: int) -> Any:
    """duagc.v1.PeerMapReport."""
    message = schemas.new(
        "PeerMapReport", robot=robot, used=report.trusted, reason=report.reason, **vars(report)
    )
    pack_stamp(message, stamp_ns)
    return message


def _information(robot: str, fused: FusedMap, stamp_ns: int) -> GaussianInformation:
    """The summed information of the fused Gaussians as a message; no cross terms between mean and covariance."""
    return GaussianInformation(
        stamp_ns=stamp_ns,
        robot=robot,
        kind=FUSED_KIND,
        window="sum over the robots whose evidence was fused; observations count those robots",
        ids=fused.gaussians.ids,
        geometry=geometry_of_information(fused.information).astype(np.float32),
        color=fused.information[:, COLOR_INFORMATION].astype(np.float32),
        opacity=fused.information[:, OPACITY_INFORMATION].astype(np.float32),
        observations=fused.members.astype(np.uint32),
        color_sigma=0.0,
        depth_sigma="as each member said",
        deviation_m=np.zeros(len(fused.gaussians), np.float32),  # in what the members said
        color_pixels_per_sample=1.0,
        depth_pixels_per_sample=1.0,
        overlap=1.0,
        frame_id=WORLD_FRAME,
    )
