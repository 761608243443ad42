"""Frames of a simulated recording: rendered, disturbed and encoded, in as many processes as asked for."""

import pickle
import tempfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.stereo import StereoRig
from duagc.converters.simulate.movers import Mover
from duagc.converters.simulate.render.raycast import MeshRenderer
from duagc.converters.simulate.render.renderer import CameraRenderer, RenderedView
from duagc.converters.simulate.sensors import noise
from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ, Degradations
from duagc.converters.simulate.sensors.lens import RadialLens
from duagc.converters.simulate.sensors.light import vignette, with_light
from duagc.converters.simulate.sensors.rig import BASELINE_M, MovingCamera, Rig, with_gain
from duagc.converters.simulate.settings import Cover, SimulationSettings
from duagc.converters.simulate.simulated_scenes import SimulatedScene
from duagc.pipeline.base import determinism, random_streams
from duagc.pipeline.base.files import encode_png, new_file
from duagc.pipeline.base.workers import start_now, worker_pool
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.greatest_depth import units_of_depth


@dataclass(frozen=True)
class FrameJob:
    """One frame to render.

    Attributes:
        robot: its name.
        index: of the frame.
        T_world_camera: [4, 4].
        twist: [6], its motion per second, a right tangent (m, rad).
        gains: of red, green and blue, factors of the light.
        T_world_depth: [4, 4], where the camera was when a late depth image was taken; None: it is not late.
    """

    robot: str
    index: int
    T_world_camera: NDArray[np.float64]
    twist: NDArray[np.float64]
    gains: tuple[float, ...] = (1.0, 1.0, 1.0)
    T_world_depth: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class FrameImages:
    """One frame as it goes into the logs.

    Attributes:
        png: the color image, encoded.
        depth: uint16 [h, w] in units of the scene's depth_scale_m, 0 = none; None: the depth is that of a LiDAR.
        exact_depth: likewise, without noise, where that differs.
        mask: [h, w], False where something moves or the lens saw nothing; None where neither can be.
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
        covers: when a lens is covered.
        degradations: what makes the camera worse than an ideal one.
    """

    camera: PinholeCamera
    noise: str
    seed: int
    rig: Rig
    movers: list[Mover]
    covers: tuple[Cover, ...]
    degradations: Degradations

    @property
    def lens(self) -> RadialLens | None:
        """The lens of the camera; None: a pinhole."""
        k1 = self.degradations.lens_k1
        return RadialLens(self.camera, k1) if k1 != 0 else None

    @classmethod
    def of(
        cls, settings: SimulationSettings, camera: PinholeCamera, movers: list[Mover], rig: Rig
    ) -> "FrameSettings":
        """Those of a simulation.

        Args:
            settings: of the simulation.
            camera: of all robots.
            movers: figures that walk through the scene.
            rig: the sensors, with the exposure that the motion blur takes.
        """
        s = settings
        return cls(camera, s.noise, s.seed, rig, movers, covers=s.covers, degradations=s.degradations)


class FrameRenderer:
    """Renders, disturbs and encodes frames; what it makes of a job depends on nothing but the job."""

    def __init__(self, scene: SimulatedScene, settings: FrameSettings) -> None:
        """Prepare the renderers, a stereo pair, and the vignette and lens that the settings ask for.

        Args:
            scene: what is seen.
            settings: what all frames have in common.
        """
        self.settings, self.depth_scale_m = settings, scene.depth_scale_m
        self.renderer = scene.renderer(settings.camera)
        self.moving: MovingCamera | None = None
        lens, d = settings.lens, settings.degradations
        if not settings.rig.plain or settings.movers or lens is not None:
            assert isinstance(self.renderer, MeshRenderer)
            self.moving = MovingCamera(
                self.renderer, settings.rig, settings.movers, lens=lens, blur_px=d.blur_px
            )
        self.stereo = StereoRig.rectified(settings.camera, settings.camera, BASELINE_M, "simulate")
        self.vignette = vignette(settings.camera, d.vignette) if d.vignette > 0 else None
        self.straight = None if lens is None else _Undistortion(lens, scene.renderer(lens.pinhole))

    def render(self, job: FrameJob) -> FrameImages:
        """The images of one frame.

        Args:
            job: which frame.
        """
        settings, rig = self.settings, self.settings.rig
        if any(cover.hides(job.robot, job.index) for cover in settings.covers):
            return self._covered()
        view, mask = self._view(job, job.T_world_camera, job.twist)
        color, exact_m = self._lit(view.color, job), view.depth
        depth_m = exact_m
        if job.T_world_depth is not None:
            depth_m, still_before = self._depth_before(job, job.T_world_depth)
            mask = mask if still_before is None or mask is None else mask & still_before
        sigma_m, points = None, None
        if settings.noise == "kinect":
            rng = random_streams.generator(settings.seed, "simulate.noise", robot=job.robot, frame=job.index)
            depth_m = noise.kinect_depth(depth_m, settings.camera, rng)
            color = noise.gray_noise(color, rng)
        depth_m = noise.quantized(depth_m, settings.degradations.depth_step_m)
        if rig.gain_stops > 0 or rig.camera_stops > 0:
            gain = rig.gain(settings.seed, job.robot, job.index / FRAME_RATE_HZ)
            color = with_gain(color, gain, rig.tint(settings.seed, job.robot))
        mask = mask if settings.movers else None
        if self.straight is not None:
            color, depth_m, mask = (
                self.straight.color(color),
                self.straight.depth(depth_m),
                self.straight.mask,
            )
            exact_m = self.straight.exact_depth(job.T_world_camera)
        depth: NDArray[np.uint16] | None = _units(depth_m, self.depth_scale_m)
        exact = None if depth_m is exact_m else _units(exact_m, self.depth_scale_m)
        if rig.sensor == "stereo":
            depth, sigma_m = self._stereo_depth(job, view.color)
            exact = _units(exact_m, self.depth_scale_m)
        elif rig.sensor == "lidar":
            assert self.moving is not None
            rng = random_streams.generator(settings.seed, "simulate.lidar", robot=job.robot, frame=job.index)
            depth, points = None, self.moving.sweep(job.T_world_camera, job.index, rng)
            exact = _units(exact_m, self.depth_scale_m)
        return FrameImages(
            encode_png(color[..., ::-1]), depth, exact, mask=mask, sigma_m=sigma_m, points=points
        )

    def _lit(self, color: NDArray[np.uint8], job: FrameJob) -> NDArray[np.uint8]:
        """The image as the camera's exposure, white balance and vignette have it."""
        if job.gains == (1.0, 1.0, 1.0) and self.vignette is None:
            return color
        return with_light(color, np.array(job.gains), self.vignette)

    def _depth_before(
        self, job: FrameJob, T_world_depth: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
        """Exact depth as it was a delay before the frame, and where nothing moved in it, if anything can."""
        if self.moving is None:
            return self.renderer.depth(T_world_depth)[0], None
        before = job.index - self.settings.degradations.depth_delay_s * FRAME_RATE_HZ
        depth_m, moved = self.moving.depth(T_world_depth, before)
        return depth_m, ~moved

    def _covered(self) -> FrameImages:
        """What a covered camera sees: nothing; the mask, where there are any, is that of the lens."""
        settings, camera = self.settings, self.settings.camera
        depth = np.zeros((camera.height, camera.width), dtype=np.uint16)
        of_images = settings.rig.sensor != "lidar"
        exact_apart = settings.noise == "kinect" or settings.degradations.of_depth_or_lens
        mask = np.ones(depth.shape, dtype=np.bool_) if settings.movers else None
        return FrameImages(
            encode_png(np.zeros((*depth.shape, 3), dtype=np.uint8)),
            depth if of_images else None,
            depth if exact_apart else None,
            mask=mask if self.straight is None else self.straight.mask,
            sigma_m=np.zeros(depth.shape, dtype=np.float32) if settings.rig.sensor == "stereo" else None,
        )

    def _view(
        self, job: FrameJob, T_world_camera: NDArray[np.float64], twist: NDArray[np.float64]
    ) -> tuple[RenderedView, NDArray[np.bool_] | None]:
        if self.moving is None:
            return self.renderer.render(T_world_camera), None
        return self.moving.render(T_world_camera, twist, job.index)

    def _stereo_depth(
        self, job: FrameJob, left: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
        """Depth and its standard deviation (m) by matching with a second camera to the right."""
        T_world_right = job.T_world_camera.copy()
        T_world_right[:3, 3] += BASELINE_M * job.T_world_camera[:3, 0]
        twist_right = job.twist.copy()
        twist_right[:3] += np.cross(job.twist[3:], [BASELINE_M, 0.0, 0.0])
        right, _ = self._view(job, T_world_right, twist_right)
        gray = [np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8) for each in (left, right.color)]
        depth_m, sigma_m = self.stereo.depth(gray[0], gray[1])
        return _units(depth_m.astype(np.float64), self.depth_scale_m), sigma_m


class _Undistortion:
    """Images of a lens as a converter would write them: of a pinhole camera, with a rim that the lens did not see."""

    def __init__(self, lens: RadialLens, renderer: CameraRenderer) -> None:
        self._u, self._v, self.mask = lens.maps()
        self._renderer = renderer

    def color(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Color [h, w, 3], black in the rim."""
        straight = cv2.remap(color, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.where(self.mask[..., None], np.asarray(straight, dtype=np.uint8), np.uint8(0))

    def depth(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth [h, w], never interpolated, 0 in the rim."""
        straight = cv2.remap(depth_m, self._u, self._v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return np.where(self.mask, np.asarray(straight, dtype=np.float64), 0.0)

    def exact_depth(self, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """True depth [h, w] at the pixel centers, 0 in the rim."""
        return np.where(self.mask, self._renderer.depth(T_world_camera)[0], 0.0)


def _units(depth_m: NDArray[np.float64], scale_m: float) -> NDArray[np.uint16]:
    """Depth in units of scale_m; what does not fit is no measurement."""
    return units_of_depth(depth_m, scale_m)[0]


class RenderPool:
    """Worker processes that render frames of one scene on disk; a single worker renders in this process.

    They start, and import what they need, while the scene is set up.
    """

    def __init__(self, workers: int) -> None:
        """Keep the number of workers; if there are several, they start when the context is entered.

        Args:
            workers: how many processes.
        """
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._open = ExitStack()

    def __enter__(self) -> "RenderPool":
        if self.workers > 1:
            prefix = "duagc-atlas-"
            self._folder = Path(self._open.enter_context(tempfile.TemporaryDirectory(prefix=prefix)))
            self._pool = self._open.enter_context(worker_pool(self.workers, determinism.configure_opencv))
            start_now(self._pool, self.workers)
        return self

    def images(
        self, scene: SimulatedScene, settings: FrameSettings, jobs: list[FrameJob]
    ) -> Iterator[FrameImages]:
        """The images of all jobs, in their order; a few are in work ahead of the one that is asked for, from now on.

        Args:
            scene: what is seen; a pool renders one.
            settings: what all frames have in common.
            jobs: the frames.
        """
        if self._pool is None:
            return map(FrameRenderer(scene, settings).render, jobs)
        start = self._folder / "start.pickle"
        with new_file(start) as part:
            part.write_bytes(pickle.dumps((scene.store(self._folder), settings)))
        left = iter(jobs)
        ahead = deque(self._pool.submit(_render, start, job) for job in islice(left, 4 * self.workers))
        return self._in_order(ahead, start, left)

    def _in_order(
        self, ahead: deque[Future[FrameImages]], start: Path, left: Iterator[FrameJob]
    ) -> Iterator[FrameImages]:
        assert self._pool is not None
        while ahead:
            ahead.extend(self._pool.submit(_render, start, job) for job in islice(left, 1))
            yield ahead.popleft().result()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)


@cache
def _renderer_of(start: Path) -> FrameRenderer:
    """The renderer of a worker process, of a scene that is stored, and of settings."""
    stored, settings = pickle.loads(start.read_bytes())
    return FrameRenderer(stored.open(), settings)


def _render(start: Path, job: FrameJob) -> Any:
    """One frame, in a worker process."""
    return _renderer_of(start).render(job)
