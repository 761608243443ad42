"""What sensors other than a perfect RGB-D camera make of a scene, all from its triangles and the exact poses.

A camera that moves while it looks: every row has a time of its own (rolling shutter), and a color is the mean over the
time that the shutter is open (motion blur). The recorded pose is that of the middle row in the middle of that time;
depth is that of this one moment. Velocities are those between the frame and the next one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.movers import Mover
from duagc.converters.simulate.render.raycast import OFFSETS, MeshRenderer
from duagc.converters.simulate.render.renderer import RenderedView
from duagc.pipeline.base import random_streams
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera

Array = NDArray[np.float64]

SENSORS = ("rgbd", "stereo", "lidar")
BASELINE_M = 0.12
BLUR_ROUNDS = 2  # times four moments within an exposure
RINGS_DEG, AZIMUTHS = np.linspace(-24.0, 14.0, 32), 900
FARTHEST_M, RANGE_SIGMA_M = 60.0, 0.02
T_CAMERA_LIDAR = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)  # 10 cm above the camera, x ahead, z up
GAMMA = 2.2
GAIN_PERIODS_S = (2.0, 5.0)
BLACK_OF_STOP = 0.04  # of full scale


@dataclass(frozen=True)
class Rig:
    """Sensors of a robot.

    Attributes:
        sensor: one of SENSORS.
        readout_s: from the first to the last row of an image.
        exposure_s: how long the shutter is open.
        gain_stops: largest change of the exposure, factors of two.
        clock_s: largest offset of a robot's clock.
        camera_stops: how much the cameras of two robots differ: each channel of each takes up to so many
            factors of two of light more or less, and has a black level of up to so many times BLACK_OF_STOP.
    """

    sensor: str = "rgbd"
    readout_s: float = 0.0
    exposure_s: float = 0.0
    gain_stops: float = 0.0
    clock_s: float = 0.0
    camera_stops: float = 0.0

    @property
    def plain(self) -> bool:
        """An RGB-D camera that stands still while it looks, as in the room's own renderer."""
        return self.sensor == "rgbd" and self.readout_s == self.exposure_s == 0.0

    def clock_offset_ns(self, seed: int, robot: str) -> int:
        """What a robot's clock shows at the time 0."""
        return round(
            1e9 * self.clock_s * random_streams.generator(seed, "simulate.clock", robot=robot).uniform(-1, 1)
        )

    def gain(self, seed: int, robot: str, time_s: float) -> float:
        """Exposure of a frame, as a factor of the light."""
        rng = random_streams.generator(seed, "simulate.gain", robot=robot)
        periods, phases = rng.uniform(*GAIN_PERIODS_S, 2), rng.uniform(0, 2 * np.pi, 2)
        return float(2 ** (self.gain_stops * np.sin(2 * np.pi * time_s / periods + phases).mean()))

    def tint(self, seed: int, robot: str) -> tuple[Array, Array]:
        """How a robot's camera sees colors: gain [3] (of image values) and black level [3] (0..1) by channel."""
        if self.camera_stops == 0:
            return np.ones(3), np.zeros(3)
        rng = random_streams.generator(seed, "simulate.tint", robot=robot)
        stops, black = self.camera_stops * rng.uniform(-1, 1, (2, 3))
        return 2 ** (stops / GAMMA), BLACK_OF_STOP * black


def with_gain(
    color: NDArray[np.uint8], gain: float, tint: tuple[Array, Array] = (np.ones(3), np.zeros(3))
) -> NDArray[np.uint8]:
    """An image [h, w, 3] with another exposure, seen by a camera of this tint; what is too bright is white."""
    scale, black = tint
    return np.clip(np.rint(color * (gain ** (1 / GAMMA) * scale) + 255 * black), 0, 255).astype(np.uint8)


class MovingCamera:
    """Renders meshes and movers with a camera that has a rolling shutter and an exposure."""

    def __init__(self, renderer: MeshRenderer, rig: Rig, movers: list[Mover]) -> None:
        self.renderer, self.rig, self.camera = renderer, rig, renderer.camera
        self.movers = [(mover, mover.renderer(renderer.camera)) for mover in movers]

    def render(
        self, T_world_camera: Array, twist: Array, frame: int
    ) -> tuple[RenderedView, NDArray[np.bool_]]:
        """Color and depth, and where nothing moves, [h, w].

        Args:
            T_world_camera: [4, 4], of the middle of the exposure of the middle row.
            twist: [6], right tangent (m, rad) per second.
            frame: index, for the movers.
        """
        shape = (self.camera.height, self.camera.width)
        rounds = BLUR_ROUNDS if self.rig.exposure_s > 0 else 1
        shares = (np.arange(rounds * len(OFFSETS)) + 0.5) / (rounds * len(OFFSETS)) - 0.5
        rows = (np.arange(shape[0]) - (shape[0] - 1) / 2) / max(shape[0] - 1, 1) * self.rig.readout_s
        total, moving = np.zeros((*shape, 3), dtype=np.float32), np.zeros(shape, dtype=np.bool_)
        for share, offset in zip(shares, OFFSETS * rounds, strict=True):
            times = rows + share * self.rig.exposure_s
            poses = T_world_camera @ se3.exp(times[:, None] * twist)
            _, colors, moved = self._trace(*_rays(self.camera, poses, *offset), frame)
            total += colors.reshape(total.shape)
            moving |= moved.reshape(shape)
        still = np.broadcast_to(T_world_camera, (shape[0], 4, 4))
        t, _, moved = self._trace(*_rays(self.camera, still, 0.0, 0.0), frame)
        depth = np.where(np.isfinite(t), t, 0.0).astype(np.float64).reshape(shape)
        color = np.clip(np.rint(total / len(shares)), 0, 255).astype(np.uint8)
        return RenderedView(color, depth, np.zeros(shape, dtype=np.int64)), ~(moving | moved.reshape(shape))

    def _trace(
        self, origins: Array, directions: NDArray[np.float32], frame: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """z, color and whether it moves, of what rays meet first."""
        t, colors = self.renderer.shade(origins, directions)
        moving = np.zeros(len(t), dtype=np.bool_)
        for mover, renderer in self.movers:
            T = mover.poses[frame]
            near = np.flatnonzero(mover.near(T, origins, directions))
            if near.size:
                start, direction = (
                    (origins[near] - T[:3, 3]) @ T[:3, :3],
                    directions[near] @ T[:3, :3].astype(np.float32),
                )
                t_mover, paint = renderer.shade(start, np.asarray(direction, dtype=np.float32))
                ahead = t_mover < t[near]
                t[near[ahead]], colors[near[ahead]], moving[near[ahead]] = t_mover[ahead], paint[ahead], True
        return t, colors, moving

    def sweep(self, T_world_camera: Array, frame: int, rng: np.random.Generator) -> Array:
        """Points [n, 3] (m, LiDAR) of one turn of the LiDAR at one moment, with the noise of its ranges."""
        up, turn = np.deg2rad(RINGS_DEG)[:, None], np.linspace(-np.pi, np.pi, AZIMUTHS, endpoint=False)
        beams = np.stack(
            np.broadcast_arrays(np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)), axis=-1
        ).reshape(-1, 3)
        T_world_lidar = T_world_camera @ T_CAMERA_LIDAR
        directions = (beams @ T_world_lidar[:3, :3].T).astype(np.float32)
        origins = np.broadcast_to(T_world_lidar[:3, 3], directions.shape)
        ranges, _, _ = self._trace(origins, directions, frame)
        measured = ranges + RANGE_SIGMA_M * rng.standard_normal(len(ranges))
        seen = np.isfinite(ranges) & (ranges < FARTHEST_M)
        return np.asarray(measured[seen, None] * beams[seen])


def _rays(camera: PinholeCamera, poses: Array, du: float, dv: float) -> tuple[Array, NDArray[np.float32]]:
    """Origins and directions [h * w, 3] of rays next to the pixel centers; poses [h, 4, 4], one for every row."""
    x = (np.arange(camera.width) + du - camera.cx) / camera.fx
    y = (np.arange(camera.height) + dv - camera.cy) / camera.fy
    ahead = poses[:, None, :3, 0] * x[:, None] + (poses[:, :3, 1] * y[:, None] + poses[:, :3, 2])[:, None]
    origins = np.repeat(poses[:, :3, 3], camera.width, axis=0)
    return origins, ahead.reshape(-1, 3).astype(np.float32)
