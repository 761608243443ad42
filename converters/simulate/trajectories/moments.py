"""Poses of a path between its frames, and how it moves there."""

import numpy as np

from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3


def twists_of(T_world_camera: Array) -> Array:
    """Motion per second along a path, right tangents [frames, 6]; the last frame moves on as the one before.

    Args:
        T_world_camera: [frames, 4, 4].
    """
    twist = FRAME_RATE_HZ * se3.log(se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:])
    return np.concatenate([twist, twist[-1:]])


def pose_at(T_world_body: Array, moment: float) -> Array:
    """Pose [4, 4] on a path: even motion between two frames; beyond its ends, as between the first or last two.

    Args:
        T_world_body: [frames, 4, 4].
        moment: in frames; the pose of a whole number is that of the frame.
    """
    frame = int(np.clip(np.floor(moment), 0, len(T_world_body) - 1))
    if frame == moment:
        return np.asarray(T_world_body[frame])
    frame = min(frame, len(T_world_body) - 2)
    step = se3.log(se3.inverse(T_world_body[frame]) @ T_world_body[frame + 1])
    return np.asarray(T_world_body[frame] @ se3.exp((moment - frame) * step))
