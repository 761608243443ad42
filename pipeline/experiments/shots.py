"""Frames of a log or of a simulated room, as tests and experiments on tracking take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render import bake
from duagc.converters.simulate.render.renderer import Renderer
from duagc.converters.simulate.scenes.catalog import build
from duagc.converters.simulate.trajectories import loops
from duagc.pipeline.geometry.camera import PinholeCamera

FRAME_NS = 33_333_333  # between simulated frames


@dataclass(frozen=True)
class Shot:
    """One frame.

    Attributes:
        index: in the log.
        stamp_ns: its time.
        color: uint8 [h, w, 3].
        depth: float32 [h, w], meters, 0 = unknown.
        disturbed: whether it is not what the camera saw.
        foreign: whether it shows another place, so that any pose is wrong.
    """

    index: int
    stamp_ns: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    disturbed: bool = False
    foreign: bool = False


def filmed(seed: int, frames: int, camera: PinholeCamera) -> list[Shot]:
    """Frames of a robot in a simulated room, 22 mm apart.

    Args:
        seed: of the room.
        frames: number of frames.
        camera: of the robot.
    """
    room = build("room", seed)
    renderer = Renderer(room, bake.bake(room, 0.008), camera)
    path = loops.plan(room, 1, 160, 0.6, camera=camera)[0]
    views = [renderer.render(T) for T in path[:frames]]
    return [Shot(k, k * FRAME_NS, view.color, view.depth.astype(np.float32)) for k, view in enumerate(views)]


def resized(shots: Sequence[Shot], camera: PinholeCamera) -> list[Shot]:
    """Frames in the image size of another camera.

    Args:
        shots: the frames.
        camera: of the other size.
    """
    size = (camera.width, camera.height)
    return [
        replace(
            shot,
            color=np.asarray(cv2.resize(shot.color, size), dtype=np.uint8),
            depth=np.asarray(cv2.resize(shot.depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32),
        )
        for shot in shots
    ]
