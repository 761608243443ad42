"""What sensors other than a perfect RGB-D camera make of a scene, all from its triangles and the exact poses.

A camera that moves while it looks: every row has a time of its own (rolling shutter), and the light of a pixel is the
mean over the time that the shutter is open (motion blur). The recorded pose is that of the middle row in the middle of
that time; depth is that of this one moment. Velocities are those between the frame and the next one.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.movers import Mover
from duagc.converters.simulate.render.raycast import OFFSETS, MeshRenderer
from duagc.converters.simulate.render.renderer import RenderedView
from duagc.converters.simulate.sensors.lens import RadialLens
from duagc.converters.simulate.trajectories.moments import pose_at
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3

SENSORS = ("rgbd", "stereo", "lidar")
BASELINE_M = 0.12
LEAST_MOMENTS = 8  # within an exposure, a multiple of the rays per pixel
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
        """What a robot's clock shows at the time 0, ns.

        Args:
            seed: of the simulation.
            robot: its name.
        """
        return round(
            1e9 * self.clock_s * random_streams.generator(seed, "simulate.clock", robot=robot).uniform(-1, 1)
        )

    def gain(self, seed: int, robot: str, time_s: float) -> float:
        """Exposure of a frame, as a factor of the light.

        Args:
            seed: of the simulation.
            robot: its name.
            time_s: of the frame, seconds since the first one.
        """
        rng = random_streams.generator(seed, "simulate.gain", robot=robot)
        periods, phases = rng.uniform(*GAIN_PERIODS_S, 2), rng.uniform(0, 2 * np.pi, 2)
        return float(2 ** (self.gain_stops * np.sin(2 * np.pi * time_s / periods + phases).mean()))

    def tint(self, seed: int, robot: str) -> tuple[Array, Array]:
        """How a robot's camera sees colors: gain [3] (of image values) and black level [3] (0..1) by channel.

        Args:
            seed: of the simulation.
            robot: its name.
        """
        if self.camera_stops == 0:
            return np.ones(3), np.zeros(3)
        rng = random_streams.generator(seed, "simulate.tint", robot=robot)
        stops, black = self.camera_stops * rng.uniform(-1, 1, (2, 3))
        return 2 ** (stops / GAMMA), BLACK_OF_STOP * black


def with_gain(
    color: NDArray[np.uint8], gain: float, tint: tuple[Array, Array] = (np.ones(3), np.zeros(3))
) -> NDArray[np.uint8]:
    """An image with another exposure, seen by a camera of its own tint; what is too bright is white.

    Args:
        color: [h, w, 3].
        gain: exposure, as a factor of the light.
        tint: gain [3] of image values and black level [3] (0..1) by channel, as from `Rig.tint`.
    """
    scale, black = tint
    return np.clip(np.rint(color * (gain ** (1 / GAMMA) * scale) + 255 * black), 0, 255).astype(np.uint8)


class MovingCamera:
    """Renders meshes and movers with a camera that has a rolling shutter, an exposure and a lens."""

    def __init__(
        self,
        renderer: MeshRenderer,
        rig: Rig,
        movers: list[Mover],
        *,
        lens: RadialLens | None = None,
        blur_px: float = 0.0,
    ) -> None:
        """Compute the rays of the pixels, and into how many moments an exposure is divided.

        Args:
            renderer: of the scene, with the camera whose images are rendered.
            rig: readout and exposure.
            movers: figures that walk through the scene.
            lens: of that camera; None: a pinhole camera.
            blur_px: about how far pixels move within an exposure: there are as many moments.
        """
        self.renderer, self.rig, self.camera, self.lens = renderer, rig, renderer.camera, lens
        self.movers = [(mover, mover.renderer(renderer.camera)) for mover in movers]
        moments = 0 if rig.exposure_s == 0 else max(LEAST_MOMENTS, math.ceil(blur_px))
        self._rounds = max(1, -(-moments // len(OFFSETS)))
        self._directions = {offset: self._rays_of(*offset) for offset in ((0.0, 0.0), *OFFSETS)}

    def _rays_of(self, du: float, dv: float) -> tuple[Array, Array]:
        """Rays (x, y, 1) next to the pixel centers, x and y [h, w] or of shapes that broadcast to it."""
        if self.lens is not None:
            return self.lens.rays(du, dv)
        c = self.camera
        x = (np.arange(c.width) + du - c.cx) / c.fx
        y = (np.arange(c.height) + dv - c.cy) / c.fy
        return np.asarray(x[None, :], dtype=np.float64), np.asarray(y[:, None], dtype=np.float64)

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
        offsets, blurs = OFFSETS * self._rounds, self.rig.exposure_s > 0
        shares = (np.arange(len(offsets)) + 0.5) / len(offsets) - 0.5
        rows = (np.arange(shape[0]) - (shape[0] - 1) / 2) / max(shape[0] - 1, 1) * self.rig.readout_s
        total, moving = np.zeros((*shape, 3), dtype=np.float32), np.zeros(shape, dtype=np.bool_)
        for share, offset in zip(shares, offsets, strict=True):
            times = rows + share * self.rig.exposure_s
            poses = T_world_camera @ se3.exp(times[:, None] * twist)
            _, colors, moved = self._trace(*_rays(poses, *self._directions[offset]), frame)
            total += (_light(colors) if blurs else colors).reshape(total.shape)
            moving |= moved.reshape(shape)
        depth, moved = self.depth(T_world_camera, frame)
        mean = total / np.float32(len(shares))
        color = np.clip(np.rint(_value(mean) if blurs else mean), 0, 255).astype(np.uint8)
        return RenderedView(color, depth, np.zeros(shape, dtype=np.int64)), ~(moving | moved)

    def depth(self, T_world_camera: Array, frame: float) -> tuple[Array, NDArray[np.bool_]]:
        """Depth (z, m, 0 = nothing) at one moment, and where something moves, [h, w].

        Args:
            T_world_camera: [4, 4].
            frame: index, for the movers; may be between two frames.
        """
        shape = (self.camera.height, self.camera.width)
        still = np.broadcast_to(T_world_camera, (shape[0], 4, 4))
        t, _, moved = self._trace(*_rays(still, *self._directions[0.0, 0.0]), frame)
        depth = np.where(np.isfinite(t), t, 0.0).astype(np.float64).reshape(shape)
        return depth, moved.reshape(shape)

    def _trace(
        self, origins: Array, directions: NDArray[np.float32], frame: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """z, color and whether it moves, of what rays meet first."""
        t, colors = self.renderer.shade(origins, directions)
        moving = np.zeros(len(t), dtype=np.bool_)
        for mover, renderer in self.movers:
            T = pose_at(mover.poses, frame)
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
        """Points [n, 3] (m, LiDAR) of one turn of the LiDAR at one moment, with the noise of its ranges.

        Args:
            T_world_camera: camera pose at that moment, [4, 4].
            frame: index, for the movers.
            rng: source of the noise of the ranges.
        """
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


def _light(colors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light, 0 to 1, of image values, 0 to 255."""
    return np.asarray((colors * np.float32(1 / 255)) ** np.float32(GAMMA), dtype=np.float32)


def _value(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Image values, 0 to 255, of light, 0 to 1."""
    return np.asarray(255 * light ** np.float32(1 / GAMMA), dtype=np.float32)


def _rays(poses: Array, x: Array, y: Array) -> tuple[Array, NDArray[np.float32]]:
    """Origins and directions [h * w, 3] of rays (x, y, 1) of an image whose rows have poses [h, 4, 4] of their own."""
    ahead = poses[:, None, :3, 0] * x[..., None] + (
        poses[:, None, :3, 1] * y[..., None] + poses[:, None, :3, 2]
    )
    origins = np.repeat(poses[:, :3, 3], ahead.shape[1], axis=0)
    return origins, ahead.reshape(-1, 3).astype(np.float32)
