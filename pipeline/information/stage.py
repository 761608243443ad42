"""The information stage: Gauss-Newton Fisher sums of one robot's final map over its own keyframes.

Reads the robot's log (keyframes and some frames between them; held-out frames are never decoded) and its
frontend.mcap, writes information.mcap. Source: method section 1 and 2, paper eq. (2)-(4) with J^T R^-1 J in place of
squared gradients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.geometry.masks import masked_depth
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.surface_distance import DepthView
from duagc.pipeline.information.deviation import surface_deviation
from duagc.pipeline.information.noise import estimate_noise, with_correlation
from duagc.pipeline.information.sums import sum_information, without_thickness
from duagc.pipeline.information.views import MapViews, free_space, without_moving
from duagc.pipeline.messages import GaussianInformation, GaussianMap, Keyframe, Odometry
from duagc.pipeline.recording import LogWriter, RgbdLog, open_rgbd, read_exposures, read_log
from duagc.pipeline.registration.moving import FreeSpace
from duagc.schemas import topics


def run_information(
    log_path: Path,
    frontend_path: Path,
    out_path: Path,
    *,
    config: InformationConfig,
    moving: MovingConfig,
    thickness_floor_m: float,
    threads: SupportsIndex = 1,
) -> GaussianInformation:
    """Write the Fisher information of a robot's final map, from its own keyframes.

    Args:
        log_path: the robot's sensor log.
        frontend_path: its frontend.mcap.
        out_path: information.mcap, written.
        config: which keyframes are summed, and the noise of their images.
        moving: as the front end looked for what moves.
        thickness_floor_m: that the map was made with: log-scales there carry no information.
        threads: of the rasterizer; changes no bit of the result.
    Returns:
        What was written, in the order of the map's Gaussians.
    Raises:
        DuagError: no map in the front end's log, or a keyframe that is held out or not in the sensor log.
    """
    front = read_frontend(frontend_path)
    final = front.final
    with open_rgbd(log_path) as log:
        if log.robot != robot_of(final.robot):
            raise DuagError(f"{frontend_path}: has the map of {final.robot}, expected that of {log.robot}")
        views, free = own_views(log, front, frontend_path, moving, threads=threads)
        seen = chain(
            (DepthView(image.usable_depth, image.T_world_camera) for image in views.images),
            _depth_views(log, front.between(config.deviation_frames), free),
        )
        deviation_m = surface_deviation(final.gaussians, log.camera, seen, config.deviation_gate_m)
    result = _information(views, final, config, thickness_floor_m=thickness_floor_m, deviation_m=deviation_m)
    # a message is copied while it is written: nothing else may be in memory then
    del views, free, seen
    with LogWriter(out_path, robot=final.robot) as writer:
        writer.write(topics.INFORMATION.of(final.robot), result, front.log_time_ns)
    return result


def own_views(
    log: RgbdLog,
    front: FrontEnd,
    frontend_path: Path,
    moving: MovingConfig,
    *,
    threads: SupportsIndex = 1,
) -> tuple[MapViews, FreeSpace]:
    """A robot's final map with the images of its keyframes, without what moved, and the space seen to be free.

    Args:
        log: the robot's sensor log, open.
        front: what its front end ended with.
        frontend_path: frontend.mcap, by which depth of another time is moved.
        moving: as the front end looked for what moves.
        threads: of the rasterizer.
    Raises:
        DuagError: a keyframe is not in the sensor log.
    """
    log.move_depth_by(frontend_path)
    final = front.final
    named = ((topics.KEYFRAME, front.keyframes), (topics.ODOMETRY, front.others))
    for topic, posed_frames in named:
        if beyond := [k.frame_index for k in posed_frames if k.frame_index >= len(log)]:
            raise DuagError(
                f"{frontend_path}: {topic.of(final.robot)} names frame {beyond[0]}, "
                f"expected less than the {len(log)} frames of {log.path.name}"
            )
    exposures = read_exposures(frontend_path, final.robot)

    def posed(keyframe: Keyframe) -> PosedRgbd:
        frame, T = log.frame(keyframe.frame_index), keyframe.T_map_camera
        return PosedRgbd(
            frame.color, frame.depth, T, frame.mask, frame.depth_sigma, exposures.at(frame.index)
        )

    images = ShelvedList(map(posed, front.keyframes))
    free = free_space(images, log.camera, moving)
    views = MapViews(final.gaussians, log.camera, without_moving(images, free), final.depth, threads)
    return views, free


def _information(
    views: MapViews,
    final: GaussianMap,
    config: InformationConfig,
    *,
    thickness_floor_m: float,
    deviation_m: NDArray[np.float64],
) -> GaussianInformation:
    """The message; what it is computed from is freed."""
    noise, overlap = with_correlation(estimate_noise(views, config), views, config)
    sums = sum_information(views, noise, config)
    return GaussianInformation(
        stamp_ns=final.stamp_ns,
        robot=final.robot,
        kind="gauss_newton",
        window=config.window if config.window == "all" else f"{config.window} {config.window_length}",
        ids=final.gaussians.ids,
        geometry=without_thickness(sums.geometry, final.gaussians, thickness_floor_m, dtype=np.float32),
        color=sums.color.astype(np.float32),
        opacity=sums.opacity.astype(np.float32),
        observations=sums.observations,
        color_sigma=noise.color_sigma,
        depth_sigma=noise.depth_formula(),
        deviation_m=deviation_m.astype(np.float32),
        color_pixels_per_sample=noise.color_pixels,
        depth_pixels_per_sample=noise.depth_pixels,
        overlap=overlap,
    )


@dataclass(frozen=True)
class FrontEnd:
    """What a front end ended with.

    Attributes:
        final: its last map.
        log_time_ns: of that.
        keyframes: the last message of each, in order.
        others: other frames that were tracked, in order; none is held out.
    """

    final: GaussianMap
    log_time_ns: int
    keyframes: list[Keyframe]
    others: list[Odometry]

    def between(self, most: int) -> list[Odometry]:
        """At most so many of the other frames, evenly spread.

        Args:
            most: largest number of frames.
        """
        total = len(self.others)
        return [self.others[k] for k in evenly_spaced(total, min(most, total))]


def _depth_views(log: RgbdLog, frames: Sequence[Odometry], free: FreeSpace) -> Iterator[DepthView]:
    for odometry in frames:
        depth_m, T_map_camera = log.usable_depth(odometry.frame_index), odometry.T_map_camera
        yield DepthView(masked_depth(depth_m, free.usable(depth_m, T_map_camera, None)), T_map_camera)


def read_frontend(path: Path) -> FrontEnd:
    """What the log of a front end has of its end.

    Args:
        path: of the log.

    Raises:
        DuagError: no map, or a keyframe whose frame is held out for evaluation.
    """
    final: GaussianMap | None = None
    log_time_ns = 0
    keyframes: dict[int, Keyframe] = {}
    frames: dict[int, Odometry] = {}
    for record in read_log(path, (topics.MAP, topics.KEYFRAME, topics.ODOMETRY)):
        row = topics.find(record.topic)
        if row is None:
            continue
        if row[0] is topics.MAP:
            final, log_time_ns = record.message(), record.log_time_ns
        elif row[0] is topics.KEYFRAME:
            keyframe: Keyframe = record.message()
            keyframes[keyframe.keyframe_index] = keyframe
        elif row[0] is topics.ODOMETRY:
            odometry: Odometry = record.message()
            frames[odometry.frame_index] = odometry
    if final is None:
        raise DuagError(
            f"{path}: {topics.MAP.pattern} has no message, expected the map of a finished front end"
        )
    ordered = [keyframes[index] for index in sorted(keyframes)]
    for keyframe in ordered:
        at = frames.pop(keyframe.frame_index, None)
        if at is not None and at.held_out:
            raise DuagError(
                f"{path}: {topics.KEYFRAME.of(keyframe.robot)} has frame {keyframe.frame_index}, "
                "expected no frame that is held out for evaluation"
            )
    others = [f for _, f in sorted(frames.items()) if f.status != "lost" and not f.held_out]
    return FrontEnd(final, log_time_ns, ordered, others)
