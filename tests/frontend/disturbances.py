"""What can happen to a camera, made of sound frames: for the tests of tracking."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.frontend.config import FrontendConfig
from pipeline.frontend.tracked import Status, TrackedFrame
from pipeline.frontend.tracking import Tracker
from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera

WRONG_M, WRONG_RAD = 0.05, np.deg2rad(3.0)
"""A pose called good that is farther than this from that of the undisturbed run is wrong."""


@dataclass(frozen=True)
class Shot:
    """One frame: colour uint8 [h, w, 3], depth float32 [h, w] m. disturbed: not what the camera saw. foreign: of
    another place, so that any pose is wrong."""

    index: int
    stamp_ns: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    disturbed: bool = False
    foreign: bool = False


def covered(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """The lens is covered for 20 frames: dark noise, no depth."""
    for k, shot in enumerate(shots):
        if k >= 20:
            yield shot
            continue
        dark = rng.integers(0, 4, shot.color.shape, dtype=np.uint8)
        yield replace(shot, color=dark, depth=np.zeros_like(shot.depth), disturbed=True)


def hand(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames something 40 cm away that moves with the camera hides half of the view."""
    for k, shot in enumerate(shots):
        if k >= 20:
            yield shot
            continue
        color, depth = shot.color.copy(), shot.depth.copy()
        half = slice(0, depth.shape[1] // 2)
        color[:, half], depth[:, half] = 30, 0.4
        yield replace(shot, color=color, depth=depth, disturbed=True)


def foreign(other: Sequence[Shot]) -> Callable[[Sequence[Shot], np.random.Generator], Iterator[Shot]]:
    """For 30 frames the images come from another room, in which a camera moves as well."""

    def foreign_room(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
        for k, shot in enumerate(shots):
            if k >= 30:
                yield shot
                continue
            there = other[k % len(other)]
            yield replace(shot, color=there.color, depth=there.depth, disturbed=True, foreign=True)

    return foreign_room


def mirrored(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 30 frames the images are those of the room in a mirror: another place that looks much like this one."""
    for k, shot in enumerate(shots):
        if k >= 30:
            yield shot
            continue
        color, depth = (np.ascontiguousarray(a[:, ::-1]) for a in (shot.color, shot.depth))
        yield replace(shot, color=color, depth=depth, disturbed=True, foreign=True)


def dropped(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """Every second frame is missing."""
    yield from (replace(shot, disturbed=True) for shot in shots[1::2])


def frozen(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames the depth image is stuck while the colour moves on."""
    for k, shot in enumerate(shots):
        yield replace(shot, depth=shots[0].depth, disturbed=True) if k < 20 else shot


def frozen_color(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames the colour image is stuck while the depth moves on."""
    for k, shot in enumerate(shots):
        yield replace(shot, color=shots[0].color, disturbed=True) if k < 20 else shot


def flipped(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 30 frames the exposure jumps between a third and three times, every third frame; bright pixels saturate."""
    for k, shot in enumerate(shots):
        if k >= 30:
            yield shot
            continue
        gain = (0.33, 3.0)[k // 3 % 2]
        color = np.clip(gain * shot.color.astype(np.float32), 0, 255).astype(np.uint8)
        yield replace(shot, color=color, disturbed=True)


def depthless(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames the depth camera delivers nothing."""
    for k, shot in enumerate(shots):
        yield replace(shot, depth=np.zeros_like(shot.depth), disturbed=True) if k < 20 else shot


def blurred(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 10 frames the colour is smeared over a sixteenth of the image's width, in another direction each."""
    for k, shot in enumerate(shots):
        if k >= 10:
            yield shot
            continue
        length = shot.color.shape[1] // 16 | 1
        line = np.zeros((length, length), dtype=np.float32)
        end = (length // 2 * np.array([np.cos(k), np.sin(k)])).round().astype(int)
        cv2.line(line, tuple((length // 2 - end).tolist()), tuple((length // 2 + end).tolist()), 1.0)
        color = cv2.filter2D(shot.color, -1, line / line.sum())
        yield replace(shot, color=np.asarray(color, dtype=np.uint8), disturbed=True)


def passer(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """In 30 frames something patterned, half as wide as the view and 1 m away, crosses it from left to right."""
    h, w = shots[0].depth.shape
    pattern = rng.integers(20, 236, (h // 16 + 1, w // 32 + 1, 3), dtype=np.uint8)
    pattern = cv2.resize(pattern, (w // 2, h), interpolation=cv2.INTER_LINEAR)
    for k, shot in enumerate(shots):
        if k >= 30:
            yield shot
            continue
        left = round((k + 1) / 30 * 1.5 * w) - w // 2
        seen = slice(max(left, 0), min(left + w // 2, w))
        color, depth = shot.color.copy(), shot.depth.copy()
        color[:, seen] = pattern[:, seen.start - left : seen.stop - left]
        depth[:, seen] = np.float32(1.0)
        yield replace(shot, color=color, depth=depth, disturbed=True)


def hunting(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 30 frames the automatic exposure swings between a third and three times, once in 12 frames."""
    for k, shot in enumerate(shots):
        if k >= 30:
            yield shot
            continue
        gain = 3.0 ** np.sin(2 * np.pi * (k + 1) / 12)
        color = np.clip(gain * shot.color.astype(np.float32), 0, 255).astype(np.uint8)
        yield replace(shot, color=color, disturbed=True)


def dark(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames the light is off: the depth camera goes on, the colour is noise."""
    for k, shot in enumerate(shots):
        if k >= 20:
            yield shot
            continue
        color = shot.color // 40 + rng.integers(0, 4, shot.color.shape, dtype=np.uint8)
        yield replace(shot, color=color, disturbed=True)


def half_depth(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames the right half of the depth image is missing."""
    for k, shot in enumerate(shots):
        if k >= 20:
            yield shot
            continue
        depth = shot.depth.copy()
        depth[:, depth.shape[1] // 2 :] = 0
        yield replace(shot, depth=depth, disturbed=True)


def late_depth(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 30 frames the depth image is that of two frames before."""
    for k, shot in enumerate(shots):
        yield replace(shot, depth=shots[max(k - 2, 0)].depth, disturbed=True) if k < 30 else shot


def noisy_stuck(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 20 frames the depth image is stuck, but something adds 0.3 % of noise to it, new in every frame."""
    for k, shot in enumerate(shots):
        if k >= 20:
            yield shot
            continue
        noise = 1 + 0.003 * rng.standard_normal(shot.depth.shape, dtype=np.float32)
        yield replace(shot, depth=shots[0].depth * noise, disturbed=True)


def paused(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """25 frames are missing: the driver hangs for most of a second."""
    yield from shots[25:]


def odd_stamps(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 30 frames every third stamp comes 30 ms late, just before the next; then the clock jumps by ten seconds."""
    for k, shot in enumerate(shots):
        later_ns = (30_000_000 if k % 3 == 0 else 0) if k < 30 else 10_000_000_000
        yield replace(shot, stamp_ns=shot.stamp_ns + later_ns, disturbed=k <= 30)


Disturbance = Callable[[Sequence[Shot], np.random.Generator], Iterator[Shot]]


def every(other: Sequence[Shot]) -> list[Disturbance]:
    """All of them; other: frames of a foreign room."""
    return [
        covered,
        hand,
        foreign(other),
        mirrored,
        dropped,
        frozen,
        frozen_color,
        flipped,
        depthless,
    ]


def further() -> list[Disturbance]:
    """What else happens in the field."""
    return [blurred, passer, hunting, dark, half_depth, late_depth, noisy_stuck, paused, odd_stamps]


def resized(shots: Sequence[Shot], camera: PinholeCamera) -> list[Shot]:
    """Frames in the image size of another camera."""
    size = (camera.width, camera.height)
    return [
        replace(
            shot,
            color=cv2.resize(shot.color, size),
            depth=cv2.resize(shot.depth, size, interpolation=cv2.INTER_NEAREST),
        )
        for shot in shots
    ]


@dataclass(frozen=True)
class Row:
    """A tracked frame of a disturbed run beside the undisturbed one: distance of the poses in the map."""

    shot: Shot
    frame: TrackedFrame
    moved_m: float
    turned_rad: float

    @property
    def good(self) -> bool:
        """Whether the tracker says that the pose may be used."""
        return self.frame.status is not Status.LOST

    @property
    def wrong(self) -> bool:
        """Whether the tracker says so and it may not."""
        far = self.moved_m > WRONG_M or self.turned_rad > WRONG_RAD
        return self.good and (self.shot.foreign or far)


def track(tracker: Tracker, shot: Shot) -> tuple[TrackedFrame, NDArray[np.float64]]:
    """The tracked frame and its pose T_map_camera [4, 4], before any refinement."""
    image = shot.color.astype(np.float32) * np.float32(1 / 255)
    frame = tracker.track(shot.index, shot.stamp_ns, image, shot.depth)
    if not tracker.keyframes:
        return frame, np.eye(4)
    return frame, tracker.keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera


class Undisturbed:
    """A run over sound frames, with copies of the tracker as it was before some of them."""

    def __init__(self, tracker: Tracker, shots: Sequence[Shot], starts: Sequence[int]) -> None:
        self.shots = shots
        self.frames: list[TrackedFrame] = []
        self.poses: list[NDArray[np.float64]] = []
        self._before: dict[int, Tracker] = {}
        for shot in shots:
            if shot.index in starts:
                self._before[shot.index] = _copied(tracker)
            frame, pose = track(tracker, shot)
            self.frames.append(frame)
            self.poses.append(pose)

    def tracker(self, start: int) -> Tracker:
        """A tracker as it was before frame `start`."""
        return _copied(self._before[start])

    def disturbed(
        self,
        start: int,
        disturbance: Disturbance,
        frames: int = 45,
        config: FrontendConfig | None = None,
    ) -> list[Row]:
        """Track on from frame `start` with a disturbance that begins there, maybe with another configuration."""
        tracker = self.tracker(start)
        tracker.config = config or tracker.config
        rows = []
        for shot in disturbance(self.shots[start : start + frames], np.random.default_rng(start)):
            frame, pose = track(tracker, shot)
            moved_m, turned_rad = se3.distance(self.poses[shot.index], pose)
            rows.append(Row(shot, frame, float(moved_m), float(turned_rad)))
        return rows


def _copied(tracker: Tracker) -> Tracker:
    """A tracker that goes on from the same state; what it has measured is never changed, so it is shared."""
    other = copy.copy(tracker)
    for name, value in vars(tracker).items():
        if isinstance(value, list):
            setattr(other, name, list(value))
    other._stuck = copy.copy(tracker._stuck)
    other._obstruction = copy.copy(tracker._obstruction)
    other._pace = copy.copy(tracker._pace)
    return other
