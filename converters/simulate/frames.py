"""Frames of a simulated recording: rendered, disturbed and encoded, in as many processes as asked for."""

import tempfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.stereo import StereoRig
from duagc.converters.simulate.movers import Mover
from duagc.converters.simulate.render.raycast import MeshRenderer
from duagc.converters.simulate.render.renderer import RenderedView
from duagc.converters.simulate.sensors import noise
from duagc.converters.simulate.sensors.rig import BASELINE_M, MovingCamera, Rig, with_gain
from duagc.converters.simulate.settings import FRAME_RATE_HZ, SimulationSettings
from duagc.converters.simulate.simulated_scenes import SceneOnDisk, SimulatedScene
from duagc.pipeline.base import determinism, random_streams
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.geometry.camera import PinholeCamera

PNG_LEVEL = 1


@dataclass(frozen=True)
class FrameJob:
    """One frame to render.

    Attributes:
        robot: its name.
        index: of the frame.
        T_world_camera: [4, 4].
        twist: [6], its motion per second, a right tangent (m, rad).
    """

    robot: str
    index: int
    T_world_camera: NDArray[np.float64]
    twist: NDArray[np.float64]


@dataclass(frozen=True)
class FrameImages:
    """One frame as it goes into the logs.

    Attributes:
        png: the color image, encoded.
        depth: uint16 [h, w] in units of the scene's depth_scale_m, 0 = none; None: the depth is that of a LiDAR.
        exact_depth: likewise, without noise, where that differs.
        mask: [h, w], False where something moves; None where nothing can.
        sigma_m: [h, w], standard deviation of the depth, where it is known pixel by pixel.
        points: [n, 3], m, LiDAR frame, if there is a LiDAR.
    """

    png: bytes
    depth: NDArray[np.uint16] | None
    exact_depth: NDArray[np.uint16] | None
    mask: NDArray[np.bool_] | None = None
    sigma_m: NDArray[np.float32] | None = None
    points: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class FrameSettings:
    """What all frames of a recording have in common.

    Attributes:
        camera: of all robots.
        noise: "none" or "kinect".
        seed: of the noise.
        rig: the sensors.
        movers: figures that walk through the scene.
    """

    camera: PinholeCamera
    noise: str
    seed: int
    rig: Rig
    movers: list[Mover]

    @classmethod
    def of(cls, settings: SimulationSettings, camera: PinholeCamera, movers: list[Mover]) -> "FrameSettings":
        """Those of a simulation.

        Args:
            settings: of the simulation.
            camera: of all robots.
            movers: figures that walk through the scene.
        """
        return cls(camera, settings.noise, settings.seed, settings.rig, movers)


class FrameRenderer:
    """Renders, disturbs and encodes frames; what it makes of a job depends on nothing but the job."""

    def __init__(self, scene: SimulatedScene, settings: FrameSettings) -> None:
        """Initialize.

        Args:
            scene: what is seen.
            settings: what all frames have in common.
        """
        self.settings, self.depth_scale_m = settings, scene.depth_scale_m
        self.renderer = scene.renderer(settings.camera)
        self.moving: MovingCamera | None = None
        if not settings.rig.plain or settings.movers:
            assert isinstance(self.renderer, MeshRenderer)
            self.moving = MovingCamera(self.renderer, settings.rig, settings.movers)
        self.stereo = StereoRig.rectified(settings.camera, settings.camera, BASELINE_M, "simulate")

    def render(self, job: FrameJob) -> FrameImages:
        """The images of one frame.

        Args:
            job: which frame.
        """
        settings, rig = self.settings, self.settings.rig
        view, mask = self._view(job, job.T_world_camera)
        color, exact = view.color, _units(view.depth, self.depth_scale_m)
        depth: NDArray[np.uint16] | None = exact
        sigma_m, points = None, None
        if settings.noise == "kinect":
            rng = random_streams.generator(settings.seed, "simulate.noise", robot=job.robot, frame=job.index)
            depth = _units(noise.kinect_depth(view.depth, settings.camera, rng), self.depth_scale_m)
            color = noise.gray_noise(color, rng)
        elif rig.sensor == "stereo":
            depth, sigma_m = self._stereo_depth(job, color)
        elif rig.sensor == "lidar":
            assert self.moving is not None
            rng = random_streams.generator(settings.seed, "simulate.lidar", robot=job.robot, frame=job.index)
            depth, points = None, self.moving.sweep(job.T_world_camera, job.index, rng)
        if rig.gain_stops > 0 or rig.camera_stops > 0:
            gain = rig.gain(settings.seed, job.robot, job.index / FRAME_RATE_HZ)
            color = with_gain(color, gain, rig.tint(settings.seed, job.robot))
        return FrameImages(
            _png(color),
            depth,
            None if depth is exact else exact,
            mask=mask if settings.movers else None,
            sigma_m=sigma_m,
            points=points,
        )

    def _view(
        self, job: FrameJob, T_world_camera: NDArray[np.float64]
    ) -> tuple[RenderedView, NDArray[np.bool_] | None]:
        if self.moving is None:
            return self.renderer.render(T_world_camera), None
        return self.moving.render(T_world_camera, job.twist, job.index)

    def _stereo_depth(
        self, job: FrameJob, left: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
        """Depth and its standard deviation (m) by matching with a second camera to the right."""
        T_world_right = job.T_world_camera.copy()
        T_world_right[:3, 3] += BASELINE_M * job.T_world_camera[:3, 0]
        right, _ = self._view(job, T_world_right)
        gray = [np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8) for each in (left, right.color)]
        depth_m, sigma_m = self.stereo.depth(gray[0], gray[1])
        return _units(depth_m.astype(np.float64), self.depth_scale_m), sigma_m


def _png(color: NDArray[np.uint8]) -> bytes:
    settings = [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
    _, png = cv2.imencode(".png", np.ascontiguousarray(color[..., ::-1]), settings)
    return png.tobytes()


def _units(depth_m: NDArray[np.float64], scale_m: float) -> NDArray[np.uint16]:
    """Depth in units of scale_m; what does not fit is no measurement."""
    units = np.rint(depth_m / scale_m)
    return np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)


class RenderPool:
    """Frame renderers in worker processes, which share one scene on disk; a single worker renders in this process."""

    def __init__(self, scene: SimulatedScene, settings: FrameSettings, workers: int) -> None:
        """Initialize.

        Args:
            scene: what is seen.
            settings: what all frames have in common.
            workers: how many processes.
        """
        self.scene, self.settings, self.workers = scene, settings, workers
        self._pool: ProcessPoolExecutor | None = None
        self._open = ExitStack()

    def __enter__(self) -> "RenderPool":
        if self.workers > 1:
            folder = self._open.enter_context(tempfile.TemporaryDirectory(prefix="duagc-atlas-"))
            start = (self.scene.store(Path(folder)), self.settings)
            self._pool = self._open.enter_context(worker_pool(self.workers, _start_worker, start))
        return self

    def images(self, jobs: list[FrameJob]) -> Iterator[FrameImages]:
        """The images of all jobs, in their order; a few are in work ahead of the one that is asked for.

        Args:
            jobs: the frames.
        """
        if self._pool is None:
            yield from map(FrameRenderer(self.scene, self.settings).render, jobs)
            return
        waiting: deque[Future[FrameImages]] = deque()
        for job in jobs:
            waiting.append(self._pool.submit(_render, job))
            if len(waiting) > 4 * self.workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)


_renderer: FrameRenderer | None = None


def _start_worker(stored: SceneOnDisk, settings: FrameSettings) -> None:
    """Set up the renderer of a worker process."""
    global _renderer
    determinism.configure_opencv()
    _renderer = FrameRenderer(stored.open(), settings)


def _render(job: FrameJob) -> Any:
    """One frame, in a worker process."""
    assert _renderer is not None
    return _renderer.render(job)
