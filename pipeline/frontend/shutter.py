"""How long the shutter of a camera is open, by its images: the time for which they look most like the robot's map.

A map is drawn from the places that a camera passes in that time, and compared with frames that did not make it. A map
of blurred images is blurred itself, so that the best time is too short at first. So a copy of it is trained on its
keyframes with the time found, which makes it sharper, and the search begins again, as long as the time grows.
The mean of several renders is nearer to an image than one of them also where errors of the map merely cancel. So no
time is taken unless frames agree that their own motions explain them better than those of other frames do: blur grows
with speed, and such errors do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, SupportsIndex, TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.mapping_views import View
from duagc.pipeline.geometry.open_shutter import LEAST_PX, OpenShutter, motion_px
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.kernels import CompiledAdam, LossWeights, Rasterizer
from duagc.pipeline.kernels.sparse_steps import LookedAt, checkerboards
from duagc.pipeline.kernels.training import ScaleLimits, TrainingStep, TrainingView, step_in_place
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.splat.gaussians import Gaussians

FRAMES = 24
"""Most frames that are compared, evenly spread; a gain of a few percent shows in so many."""
MAX_PIXELS = 160_000
"""Of an image, or it is halved: so that a search takes a few percent of the time of mapping."""
APART_PX = 3.0
"""From one place to the next: a time is found by finer steps than a map is trained with."""
KEYFRAMES = 24
"""Most keyframes that a copy of the map is trained on, evenly spread."""
FEWEST = 6
"""Frames that move enough without which no time is found: the test has as many terms."""
SIGMAS = 3.0
"""Times its standard error that the mean gain against motions of other frames must have: of sets of 24 frames that gain
by chance, one in 300 has that."""
LEAST_GAIN = 0.03
"""Of the color loss, against sharp renders: less is not worth the time of training."""
LONGEST_S = 0.25
FACTOR = 1.25
"""From one time that is tried to the next."""
WORSE = 2
"""Times in a row with a larger loss than the best, after which none is tried."""
ROUNDS = 4
STEPS = 48
"""Of training in a round."""


_Timed: TypeAlias = tuple[int, TrainingView]
"""An image with the time of its stamp, ns."""


class Frame(Protocol):
    """A frame of the log.

    Attributes:
        frame_index: in it.
        stamp_ns: its time.
    """

    @property
    def frame_index(self) -> int: ...
    @property
    def stamp_ns(self) -> int: ...


class ShutterSearch:
    """Looks for the time that a robot's shutter is open."""

    def __init__(
        self,
        log: RgbdLog,
        config: MappingConfig,
        path: Trajectory,
        read: Callable[[int, Array], PosedRgbd],
        *,
        depth: DepthKind,
        threads: SupportsIndex = 1,
    ) -> None:
        """Prepare the training step, at half the resolution where images are large.

        Args:
            log: of the robot.
            config: of its mapping.
            path: T_map_camera of its frames.
            read: gives the image of a frame, by its index and T_map_camera.
            depth: of a Gaussian at a pixel.
            threads: of the rasterizer; changes no bit.
        """
        self._stated_s, self._depth = log.stated_shutter_s, depth
        self._level = int(log.camera.width * log.camera.height > MAX_PIXELS)
        self._camera = log.camera.halved() if self._level else log.camera
        self._config, self._read, self._threads = config, read, threads
        self._motion = log.motion_along(path)
        self._T_map_camera = dict(zip(path.stamps_ns.tolist(), path.poses, strict=True))
        weights = LossWeights(**config.loss.of(depth).model_dump())
        self._step = TrainingStep(Rasterizer(threads=threads), weights, depth)
        self._boards = checkerboards(self._camera.height, self._camera.width)

    def run(self, gaussians: Gaussians, compared: Sequence[Frame], trained: Sequence[Frame]) -> float:
        """The time in seconds, as the log states it or the images tell; 0 where they do not show that they are blurred.

        Where depth is exact, so is the surface of every Gaussian, and images are taken for sharp.

        Args:
            gaussians: the map as it has grown.
            compared: frames that did not make it.
            trained: its keyframes.
        """
        if self._depth == "ray_plane":
            return 0.0
        if self._stated_s is not None or self._config.shutter == "stated":
            return self._stated_s or 0.0
        seen = self._images(compared, FRAMES)
        found_s = self._best_s(gaussians, seen, 0.0)
        if found_s == 0:
            return 0.0
        adam, keyframes = (
            CompiledAdam(len(gaussians), threads=self._threads),
            self._images(trained, KEYFRAMES),
        )
        for _ in range(ROUNDS):
            gaussians = self._sharpened(gaussians, adam, keyframes, found_s)
            before_s, found_s = found_s, self._best_s(gaussians, seen, found_s)
            if found_s <= before_s:
                break
        return found_s

    def _images(self, frames: Sequence[Frame], most: int) -> list[_Timed]:
        """Images of some frames, evenly spread."""
        chosen = [frames[k] for k in evenly_spaced(len(frames), min(most, len(frames)))]
        return [(f.stamp_ns, self._image(f)) for f in chosen]

    def _image(self, frame: Frame) -> TrainingView:
        image = self._read(frame.frame_index, self._T_map_camera[frame.stamp_ns])
        view = View.of(frame.frame_index, image, self._step.loss)
        return view.training(self._level)

    def _best_s(self, gaussians: Gaussians, compared: Sequence[_Timed], from_s: float) -> float:
        """The time for which frames look most like a map: about another one, or if that is 0 any that they agree on."""
        shortest_s = from_s / FACTOR or self._shortest_s(compared)
        sharp = [self._loss(gaussians, each, from_s) for each in compared]
        best_s, least, time_s = from_s, sum(sharp), shortest_s
        worse = -2 if from_s else 0  # the time below and the same one are tried besides
        while time_s <= LONGEST_S and worse < WORSE:
            total = sum(self._loss(gaussians, each, time_s) for each in compared)
            worse += 1
            if total < least:
                best_s, least, worse = time_s, total, 0
            time_s *= FACTOR
        if best_s > from_s == 0.0 and not self._shows(gaussians, compared, best_s, sum(sharp)):
            return 0.0
        return best_s

    def _shows(
        self, gaussians: Gaussians, compared: Sequence[_Timed], shutter_s: float, sharp: float
    ) -> bool:
        """Whether frames agree that they are blurred by their own motions, by the mean of their gains."""
        gains, total, count = [], 0.0, len(compared)
        for k, each in enumerate(compared):
            own = self._loss(gaussians, each, shutter_s)
            others = {(k + count * part // 4) % count for part in (1, 2, 3)} - {k}
            exchanged = [self._loss(gaussians, each, shutter_s, moves_as=compared[o]) for o in sorted(others)]
            total += own
            gains.append(1 - own / float(np.mean(exchanged)))
        if total > (1 - LEAST_GAIN) * sharp:
            return False
        return bool(np.mean(gains) > SIGMAS * np.std(gains, ddof=1) / np.sqrt(count))

    def _shortest_s(self, compared: Sequence[_Timed]) -> float:
        """The time in which the median frame moves by as much as can be seen; infinite where nothing moves."""
        moment_ns = 10_000_000
        speeds = []
        for stamp_ns, image in compared:
            ends = self._motion.at(stamp_ns, stamp_ns + np.array([-moment_ns, moment_ns]))
            if ends is not None:
                speeds.append(motion_px(image.depth_m, self._camera, *ends) / (2e-9 * moment_ns))
        if len(speeds) < FEWEST or (speed := float(np.median(speeds))) == 0:
            return np.inf
        return LEAST_PX / speed

    def _loss(
        self, gaussians: Gaussians, timed: _Timed, shutter_s: float, *, moves_as: _Timed | None = None
    ) -> float:
        """Color loss of a frame with a time, by its own motion or that of another frame."""
        view = self._view(timed, shutter_s, self._boards[0], moves_as=moves_as)
        return self._step.loss_of(gaussians, self._camera, view).color

    def _view(
        self, timed: _Timed, shutter_s: float, board: NDArray[np.bool_], *, moves_as: _Timed | None = None
    ) -> TrainingView:
        stamp_ns, _ = moves_as or timed
        shutter, view = OpenShutter(shutter_s, self._motion), timed[1]
        moments = shutter.moments(stamp_ns, view.depth_m, self._camera, apart_px=APART_PX)
        return LookedAt(board, of_moving=board).of(replace(view, T_camera_moment=moments))

    def _sharpened(
        self, gaussians: Gaussians, adam: CompiledAdam, trained: Sequence[_Timed], shutter_s: float
    ) -> Gaussians:
        """The map after some training steps, each on a keyframe, in turn."""
        limits, sharpened = ScaleLimits.of(self._config), gaussians.copy()
        for step in range(STEPS):
            turn, number = divmod(step, len(trained))
            view = self._view(trained[number], shutter_s, self._boards[turn % 2])
            _, gradients = self._step.gradients(sharpened, self._camera, view)
            step_in_place(sharpened, adam, gradients, rates=self._config.rates, limits=limits)
        return sharpened
