"""Disturbances of a camera, applied to undisturbed frames: for tests and experiments on tracking."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from duagc.pipeline.experiments.shots import Shot

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
    """The lens is covered for 20 frames: dark noise, no depth.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: source of the noise.
    """
    dark = rng.integers(0, 4, shots[k].color.shape, dtype=np.uint8)
    return replace(shots[k], color=dark, depth=np.zeros_like(shots[k].depth))


@first(20)
def hand(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames something 40 cm away that moves with the camera hides half of the view.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
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
    """For 30 frames the images are those of the room in a mirror: another place that looks much like this one.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
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
    """For 20 frames the depth image is frozen while the color goes on.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    return replace(shots[k], depth=shots[0].depth)


@first(20)
def frozen_color(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the color image is frozen while the depth goes on.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    return replace(shots[k], color=shots[0].color)


@first(30)
def flipped(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 30 frames the exposure jumps between a third and three times, every third frame; bright pixels saturate.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    return exposed(shots[k], (0.33, 3.0)[k // 3 % 2])


@first(20)
def depthless(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the depth camera delivers nothing.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    return replace(shots[k], depth=np.zeros_like(shots[k].depth))


@first(10)
def blurred(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 10 frames the color is smeared over a sixteenth of the image's width, in another direction each.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
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
    """For 30 frames the automatic exposure swings between a third and three times, once in 12 frames.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    return exposed(shots[k], 3.0 ** np.sin(2 * np.pi * (k + 1) / 12))


@first(20)
def dark(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the light is off: the depth camera goes on, the color is noise.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: source of the noise.
    """
    color = shots[k].color // 40 + rng.integers(0, 4, shots[k].color.shape, dtype=np.uint8)
    return replace(shots[k], color=color)


@first(20)
def half_depth(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the right half of the depth image is missing.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    depth = shots[k].depth.copy()
    depth[:, depth.shape[1] // 2 :] = 0
    return replace(shots[k], depth=depth)


@first(30)
def late_depth(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 30 frames the depth image is that of two frames before.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: not used.
    """
    return replace(shots[k], depth=shots[max(k - 2, 0)].depth)


@first(20)
def noisy_stuck(k: int, shots: Sequence[Shot], rng: np.random.Generator) -> Shot:
    """For 20 frames the depth image is frozen, but something adds 0.3 % of noise to it, new in every frame.

    Args:
        k: which frame.
        shots: the undisturbed frames.
        rng: source of the noise.
    """
    noise = 1 + 0.003 * rng.standard_normal(shots[k].depth.shape, dtype=np.float32)
    return replace(shots[k], depth=shots[0].depth * noise)


def paused(shots: Sequence[Shot], rng: np.random.Generator) -> Iterator[Shot]:
    """25 frames are missing: the driver delivers nothing for most of a second.

    Args:
        shots: the undisturbed frames.
        rng: not used.
    """
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
