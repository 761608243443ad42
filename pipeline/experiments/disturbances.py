"""Disturbances of a camera, applied to undisturbed frames: for tests and experiments on tracking."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render import bake
from duagc.converters.simulate.render.renderer import Renderer
from duagc.converters.simulate.scenes.catalog import build
from duagc.converters.simulate.trajectories import loops
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera

FRAME_NS = 33_333_333  # between simulated frames
WRONG_M, WRONG_RAD = 0.05, np.deg2rad(3.0)
"""A pose called good that is farther than this from that of the undisturbed run is wrong."""


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


Disturbance = Callable[[Sequence[Shot], np.random.Generator], Iterator[Shot]]


def first(
    frames: int,
) -> Callable[[Callable[[int, Sequence[Shot], np.random.Generator], Shot]], Disturbance]:
    """Make a disturbance of the first frames from what becomes of frame k.

    The decorated function takes the index k of a frame among the undisturbed ones, all of these, and a
    source of noise; it returns the disturbed frame.

    Args:
        frames: how many are disturbed.
    """

    def of(becomes: Callable[[int, Sequence[Shot], np.random.Generator], Shot]) -> Disturbance:
        @functools.wraps(becomes)
        def disturbance(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
            for k, shot in enumerate(shots):
                yield replace(becomes(k, shots, rng), disturbed=True) if k < frames else shot

        return disturbance

    return of


def exposed(shot: Shot, gain: float) -> Shot:
    """With more or less light; bright pixels saturate.

    Args:
        shot: the frame.
        gain: factor of the image values.
    """
    return replace(shot, color=np.clip(gain * shot.color.astype(np.float32), 0, 255).astype(np.uint8))


@first(20)
def covered(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """The lens is covered for 20 frames: dark noise, no depth."""
    dark = rng.integers(0, 4, shots[k].color.shape, dtype=np.uint8)
    return replace(shots[k], color=dark, depth=np.zeros_like(shots[k].depth))


@first(20)
def hand(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames something 40 cm away that moves with the camera hides half of the view."""
    color, depth = shots[k].color.copy(), shots[k].depth.copy()
    half = slice(0, depth.shape[1] // 2)
    color[:, half], depth[:, half] = 30, 0.4
    return replace(shots[k], color=color, depth=depth)


def foreign(other: Sequence[Shot]) -> Callable[[Sequence[Shot], np.random.Generator], Iterator[Shot]]:
    """For 30 frames the images come from another room, in which a camera moves as well.

    Args:
        other: frames of the other room, of the same size.
    """

    def foreign_room(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
        for k, shot in enumerate(shots):
            if k >= 30:
                yield shot
                continue
            there = other[k % len(other)]
            yield replace(shot, color=there.color, depth=there.depth, disturbed=True, foreign=True)

    return foreign_room


@first(30)
def mirrored(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 30 frames the images are those of the room in a mirror: another place that looks much like this one."""
    color, depth = (
        np.ascontiguousarray(shots[k].color[:, ::-1]),
        np.ascontiguousarray(shots[k].depth[:, ::-1]),
    )
    return replace(shots[k], color=color, depth=depth, foreign=True)


def dropped(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """Every second frame is missing.

    Args:
        shots: the undisturbed frames.
        rng: not used.
    """
    yield from (replace(shot, disturbed=True) for shot in shots[1::2])


@first(20)
def frozen(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the depth image is frozen while the color goes on."""
    return replace(shots[k], depth=shots[0].depth)


@first(20)
def frozen_color(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the color image is frozen while the depth goes on."""
    return replace(shots[k], color=shots[0].color)


@first(30)
def flipped(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 30 frames the exposure jumps between a third and three times, every third frame; bright pixels saturate."""
    return exposed(shots[k], (0.33, 3.0)[k // 3 % 2])


@first(20)
def depthless(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the depth camera delivers nothing."""
    return replace(shots[k], depth=np.zeros_like(shots[k].depth))


@first(10)
def blurred(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 10 frames the color is smeared over a sixteenth of the image's width, in another direction each."""
    length = shots[k].color.shape[1] // 16 | 1
    line = np.zeros((length, length), dtype=np.float32)
    end = (length // 2 * np.array([np.cos(k), np.sin(k)])).round().astype(int)
    cv2.line(line, tuple((length // 2 - end).tolist()), tuple((length // 2 + end).tolist()), 1.0)
    color = cv2.filter2D(shots[k].color, -1, line / line.sum())
    return replace(shots[k], color=np.asarray(color, dtype=np.uint8))


def passer(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """In 30 frames something patterned, half as wide as the view and 1 m away, crosses it from left to right.

    Args:
        shots: the undisturbed frames.
        rng: source of the pattern.
    """
    h, w = shots[0].depth.shape
    pattern = rng.integers(20, 236, (h // 16 + 1, w // 32 + 1, 3), dtype=np.uint8)
    pattern = np.asarray(cv2.resize(pattern, (w // 2, h), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
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


@first(30)
def hunting(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 30 frames the automatic exposure swings between a third and three times, once in 12 frames."""
    return exposed(shots[k], 3.0 ** np.sin(2 * np.pi * (k + 1) / 12))


@first(20)
def dark(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the light is off: the depth camera goes on, the color is noise."""
    color = shots[k].color // 40 + rng.integers(0, 4, shots[k].color.shape, dtype=np.uint8)
    return replace(shots[k], color=color)


@first(20)
def half_depth(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the right half of the depth image is missing."""
    depth = shots[k].depth.copy()
    depth[:, depth.shape[1] // 2 :] = 0
    return replace(shots[k], depth=depth)


@first(30)
def late_depth(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 30 frames the depth image is that of two frames before."""
    return replace(shots[k], depth=shots[max(k - 2, 0)].depth)


@first(20)
def noisy_stuck(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the depth image is frozen, but something adds 0.3 % of noise to it, new in every frame."""
    noise = 1 + 0.003 * rng.standard_normal(shots[k].depth.shape, dtype=np.float32)
    return replace(shots[k], depth=shots[0].depth * noise)


def paused(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """25 frames are missing: the driver delivers nothing for most of a second."""
    yield from shots[25:]


def odd_stamps(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """For 30 frames every third stamp is 30 ms late, just before the next; then the clock jumps by 10 s.

    Args:
        shots: the undisturbed frames.
        rng: not used.
    """
    for k, shot in enumerate(shots):
        later_ns = (30_000_000 if k % 3 == 0 else 0) if k < 30 else 10_000_000_000
        yield replace(shot, stamp_ns=shot.stamp_ns + later_ns, disturbed=k <= 30)


def every(other: Sequence[Shot]) -> list[Disturbance]:
    """The nine disturbances of the documented table.

    Args:
        other: frames of a foreign room.
    """
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
    """Nine more."""
    return [blurred, passer, hunting, dark, half_depth, late_depth, noisy_stuck, paused, odd_stamps]


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


@dataclass(frozen=True)
class DisturbanceRow:
    """A tracked frame of a disturbed run.

    Attributes:
        shot: the frame.
        frame: as it was tracked.
        T_map_camera: [4, 4].
        moved_m: distance from the pose of the undisturbed run.
        turned_rad: the same of the rotation.
    """

    shot: Shot
    frame: TrackedFrame
    T_map_camera: NDArray[np.float64]
    moved_m: float
    turned_rad: float

    @property
    def good(self) -> bool:
        """Whether the tracker gave a pose."""
        return self.frame.status is not Status.LOST

    @property
    def wrong(self) -> bool:
        """Whether it gave one that is wrong."""
        far = self.moved_m > WRONG_M or self.turned_rad > WRONG_RAD
        return self.good and (self.shot.foreign or far)


def track(tracker: Tracker, shot: Shot) -> tuple[TrackedFrame, NDArray[np.float64]]:
    """The tracked frame and its pose T_map_camera [4, 4], before any optimization.

    Args:
        tracker: that takes the frame.
        shot: the frame.
    """
    image = shot.color.astype(np.float32) * np.float32(1 / 255)
    frame = tracker.track(shot.index, shot.stamp_ns, image, shot.depth)
    if not tracker.keyframes:
        return frame, np.eye(4)
    return frame, tracker.keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera


class Undisturbed:
    """A run over undisturbed frames, with copies of the tracker as it was before some of them."""

    def __init__(self, tracker: Tracker, shots: Sequence[Shot], starts: Sequence[int]) -> None:
        """Track all frames.

        Args:
            tracker: that has tracked nothing yet.
            shots: the frames.
            starts: indices of the frames before which a copy of the tracker is kept.
        """
        self.shots = shots
        self.frames: list[TrackedFrame] = []
        self.poses: list[NDArray[np.float64]] = []
        self._before: dict[int, Tracker] = {}
        for shot in shots:
            if shot.index in starts:
                self._before[shot.index] = tracker.copied()
            frame, pose = track(tracker, shot)
            self.frames.append(frame)
            self.poses.append(pose)

    def tracker(self, start: int, config: FrontendConfig | None = None) -> Tracker:
        """A tracker as it was before a frame.

        Args:
            start: index of the frame.
            config: of the tracker from now on; None: the same.
        """
        return self._before[start].copied(config)

    def disturbed(
        self,
        start: int,
        disturbance: Disturbance,
        frames: int = 45,
        config: FrontendConfig | None = None,
    ) -> list[DisturbanceRow]:
        """Track on from a frame with a disturbance that begins there.

        Args:
            start: index of the frame.
            disturbance: of the frames from there on.
            frames: number of frames.
            config: of the tracker from there on; None: the same.
        """
        tracker = self.tracker(start, config)
        rows = []
        for shot in disturbance(self.shots[start : start + frames], np.random.default_rng(start)):
            frame, pose = track(tracker, shot)
            moved_m, turned_rad = se3.distance(self.poses[shot.index], pose)
            rows.append(DisturbanceRow(shot, frame, pose, float(moved_m), float(turned_rad)))
        return rows
