"""Bonn RGB-D Dynamic: rooms with moving people and things, in the layout of TUM RGB-D.

SRC is a sequence, for example `rgbd_bonn_balloon`. `groundtruth.txt` is of the marker body, not of the camera:

    T_world_camera = T_ros^-1 T_marker T_ros T_m

with the published T_m, whose 3x3 block is a rotation times 1.059; its rotation is taken.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from duagc.converters.layouts import image_folder, tum_layout
from duagc.converters.layouts.image_files import options_of
from duagc.converters.layouts.image_folder import Clip
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera

DEPTH_SCALE = 1 / 5000
CAMERA = PinholeCamera(640, 480, 542.822841, 542.576870, 315.593520, 237.756098)
DISTORTION = (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_M = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
    ]
)
T_MARKER_CAMERA = se3.from_rotation_translation(so3.project(_M[:, :3]), _M[:, 3])


class Options(tum_layout.SequenceOptions):
    """Lens and association."""

    undistort: bool = True
    """Take the lens distortion out of depth, and of color on reading."""


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert a sequence, cut into contiguous parts.

    Args:
        src: folder of the sequence.
        out: folder of the recording.
        robots: how many parts.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "bonn")
    frames, _, warnings = tum_layout.frames_of(src, settings)
    frames = [
        replace(f, T_world_camera=camera_pose(f.T_world_camera), T_world_depth=camera_pose(f.T_world_depth))
        for f in frames
    ]
    clip = Clip(
        "",
        frames,
        CAMERA,
        DEPTH_SCALE,
        distortion=DISTORTION if settings.undistort else (),
        sensors={"moving_objects": "in color and depth; no masks"} | settings.notes,
    )
    image_folder.write_parts(
        out, "bonn", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def camera_pose(T_marker: np.ndarray | None) -> np.ndarray | None:
    """T_world_camera [4, 4] of a line of groundtruth.txt; None of none.

    Args:
        T_marker: pose of the marker body, [4, 4]; None: not known.
    """
    if T_marker is None:
        return None
    return se3.inverse(T_ROS) @ T_marker @ T_ROS @ T_MARKER_CAMERA
