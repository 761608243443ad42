"""Frames of a log of ROS whose depth is measured by a camera: color as it is, depth in the units of the recording."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.ros_images import (
    UnusableImage,
    check_decodes,
    color_bytes,
    depth_values,
    encoded_size,
    in_meters,
)
from duagc.converters.logs.derived import Picture
from duagc.converters.logs.robot_log import RobotLog
from duagc.converters.logs.unmeasured import first_depths, float_unit_m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.greatest_depth import SATURATED, units_of_depth, unmeasured
from duagc.pipeline.recording.register_depth import register_depth

FARTHEST = SATURATED - 1  # in units of depth


def rules_of_depth(source: RobotLog) -> tuple[float, float]:
    """How the depth images of a log are read; what users should know of it goes to the warnings of the log.

    Args:
        source: the log of a robot.

    Returns:
        Distance from which on depth images say nothing, meters (0: all counts), and meters per unit of floats.

    Raises:
        DuagError: depth in floats is of no known unit.
    """
    settings = source.settings
    if source.derived is not None:
        return settings.farthest_m, 1.0
    held_out = {source.pairs[color] for index, color in enumerate(sorted(source.pairs)) if is_held_out(index)}
    images = first_depths(source.log, source.depth, lambda entry: source.time_ns(entry) not in held_out)
    stated_m = settings.depth_scale if "depth_scale" in settings.model_fields_set else None
    limit_m, where = FARTHEST * source.depth_scale, f"{source.name}: {source.depth}"
    unit_m = float_unit_m(images, limit_m, stated_m, where)
    if settings.farthest_m:
        return settings.farthest_m, unit_m
    found_m, share = unmeasured([in_meters(image, settings.depth_scale, unit_m) for image in images])
    if found_m:
        source.warnings.append(
            f"{share:.0%} of {source.depth} is exactly {found_m:.3f} m, the greatest: taken for none; "
            "expected 0 where nothing was measured"
        )
    return found_m, unit_m


def measured(
    source: RobotLog, stamp_ns: int, color: Any, depth: Any | None, *, rules: tuple[float, float]
) -> tuple[Picture, int]:
    """A frame with the depth that its image has, registered to color.

    Args:
        source: the log of a robot.
        stamp_ns: time of the color image.
        color: message with it.
        depth: message with the depth image; None: there is none.
        rules: of `rules_of_depth`.

    Returns:
        The frame, and how many pixels are farther away than the recording can hold.

    Raises:
        UnusableImage: an image is cut short or broken.
        DuagError: an image has another size than its camera.
    """
    import cv2

    farthest_m, float_unit = rules
    log = source.name
    where = f"{log}: {source.color} at {stamp_ns} ns"
    data, color_format = color_bytes(color, where)
    _check_size(where, encoded_size(data) or (0, 0), source.camera)
    if hasattr(color, "format"):
        check_decodes(data, where)
    if depth is None:
        return Picture(data, color_format), 0
    where = f"{log}: {source.depth} at {stamp_ns} ns"
    try:
        values: NDArray[Any] = depth_values(depth, where)
    except UnusableImage:
        if source.settings.association != "all":
            raise
        return Picture(data, color_format), 0
    _check_size(where, (values.shape[1], values.shape[0]), source.depth_camera.camera)
    if farthest_m:
        meters = in_meters(values, source.settings.depth_scale, float_unit)
        values = np.where(meters < farthest_m, values, values.dtype.type(0))
    if source.depth_maps is not None:
        values = cv2.remap(values, *source.depth_maps, cv2.INTER_NEAREST)
    if source.settings.depth_along == "ray":
        seen_by = source.camera if source.T_color_depth is None else source.depth_camera.camera
        along_z = values / seen_by.ray_lengths()
        values = along_z if values.dtype.kind == "f" else np.rint(along_z).astype(values.dtype)
    if source.keeps_depth and values.dtype == np.uint16:
        return Picture(data, color_format, np.asarray(values, dtype=np.uint16)), 0
    meters = in_meters(values, source.settings.depth_scale, float_unit)
    if source.T_color_depth is not None:
        meters = register_depth(meters, source.depth_camera.camera, source.T_color_depth, source.camera)
    raw, beyond = units_of_depth(meters, source.depth_scale)
    return Picture(data, color_format, raw), beyond


def _check_size(where: str, found: tuple[int, int], camera: PinholeCamera) -> None:
    if found != (camera.width, camera.height):
        raise DuagError(
            f"{where} is {found[0]}x{found[1]}, expected {camera.width}x{camera.height} as in its CameraInfo"
        )
