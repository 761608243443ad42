"""How fast pixels move, and how long a shutter must be open for a motion blur of so many pixels."""

from collections.abc import Sequence

import numpy as np

from duagc.converters.simulate.render.renderer import CameraRenderer
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends
from duagc.pipeline.recording.shutter import LONGEST_S

MOMENT_S = 0.005  # over which the speed of a pixel is measured
FRAMES = 40  # of a path


def pixel_speed_px_s(
    renderer: CameraRenderer, T_world_camera: Array, twist: Array, camera: PinholeCamera
) -> float:
    """Speed of the median pixel of a view, pixels a second; 0 where nothing is seen.

    Args:
        renderer: with a small camera of the same view.
        T_world_camera: [4, 4].
        twist: [6], right tangent (m, rad) per second.
        camera: whose pixels are meant.
    """
    depth = renderer.depth(T_world_camera)[0]
    rays = renderer.camera.rays()[depth > 0]
    if not len(rays):
        return 0.0
    ends = []
    for time_s in (-MOMENT_S / 2, MOMENT_S / 2):
        points = se3.transform(se3.exp(-time_s * twist), rays * depth[depth > 0][:, None])
        ends.append(points[:, :2] / np.maximum(points[:, 2:], 1e-6))
    moved = (ends[1] - ends[0]) * np.array([camera.fx, camera.fy])
    return float(np.median(np.linalg.norm(moved, axis=1)) / MOMENT_S)


def exposure_for(
    blur_px: float,
    renderer: CameraRenderer,
    paths: Sequence[Array],
    twists: Sequence[Array],
    *,
    camera: PinholeCamera,
) -> float:
    """How long the shutter is open (s), the same for all frames: by the median frame its median pixel moves so far.

    Args:
        blur_px: how far.
        renderer: with a small camera of the same view.
        paths: T_world_camera [frames, 4, 4] of every robot.
        twists: [frames, 6] of every robot, right tangents (m, rad) per second.
        camera: whose pixels are meant.

    Raises:
        DuagError: the robots do not move, or so slowly that no log may state the exposure.
    """
    speeds = []
    for path, twist in zip(paths, twists, strict=True):
        for i in evenly_spaced_to_ends(len(path), FRAMES):
            speeds.append(pixel_speed_px_s(renderer, path[i], twist[i], camera))
    speed = float(np.median(speeds))
    if speed < 1e-3:
        raise DuagError(
            f"simulate: motion blur is {blur_px:g} px where nothing moves, expected robots that move"
        )
    exposure_s = blur_px / speed
    if exposure_s > LONGEST_S:
        raise DuagError(
            f"simulate: motion blur of {blur_px:g} px takes an exposure of {exposure_s:.2f} s at the robots' speed, "
            f"expected at most {LONGEST_S:g} s"
        )
    return exposure_s
