"""Exposures of a robot's frames: gain and offset of each channel, from what frames show of the same surfaces.

A camera that sets its exposure and white balance itself shows a surface of color s as gain * s + offset in a frame.
Tracked frames are compared with their keyframe, and keyframes with each other, at their optimized poses
(`geometry.color_comparison`). Gains and offsets of all frames are the least-squares solution of all pairs, with a weak
prior that every gain is one and every offset zero. The prior is the anchor too: pairs determine gains but for a common
factor, and with it their geometric mean is one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.config.exposure import ExposureConfig
from duagc.pipeline.frontend.color_blocks import ColorBlocks
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.color_comparison import ComparedColors, compare_colors
from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.geometry.statistics import evenly_spaced, huber_divisor

Pair = tuple[int, int]
FRAMES_TO_DECIDE = 40
"""Frames between keyframes that are compared before the others, if those differ."""
MIN_BLOCKS = 100
"""Blocks that two frames must share to be compared."""
BLOCKS_PER_SAMPLE = 30.0
"""Blocks that say together what one would say alone: neighbors share their errors."""
ROUNDS_OF_PAIR = 8
"""Of reweighting, for the colors of a pair."""
ROUNDS = 8
"""Of linearization and reweighting, for all frames."""
HUBER_SIGMAS = 2.0
"""Residuals of pairs beyond count linearly."""


@dataclass(frozen=True)
class ComparedPair:
    """What two frames show of the same surfaces.

    Attributes:
        first: index of the frame in the log.
        second: the same of the other.
        colors: of both, the first's as `own`.
    """

    first: int
    second: int
    colors: ComparedColors


@dataclass(frozen=True)
class ExposureEstimation:
    """What frames show, and how they are compared.

    Attributes:
        blocks: of a frame of the log, by its index; asked for once.
        config: settings.
        checkpoints: of the stage.
        part: its name there.
    """

    blocks: Callable[[int], ColorBlocks]
    config: ExposureConfig
    checkpoints: Checkpoints = NO_CHECKPOINTS
    part: str = "exposures"

    def run(
        self,
        keyframes: Sequence[int],
        T_map_keyframe: Array,
        pairs: Iterable[Pair],
        frames: Sequence[TrackedFrame],
    ) -> ExposureTrack:
        """Exposures of the keyframes and of the frames anchored to them; none if they do not differ.

        Frames that are held out, lost or followed by one of their images alone are left out.

        Args:
            keyframes: index in the log of every keyframe.
            T_map_keyframe: [k, 4, 4], optimized.
            pairs: keyframes that see each other.
            frames: of the log.
        """
        if self.config.mode == "off":
            return ExposureTrack()
        blocks = ShelvedList(map(self.blocks, keyframes))

        def of_pair(pair: Pair) -> list[ComparedPair]:
            i, j = pair
            T_i_j = se3.inverse(T_map_keyframe[i]) @ T_map_keyframe[j]
            return compare((keyframes[i], blocks[i]), (keyframes[j], blocks[j]), T_i_j, self.config)

        of_pairs = self.checkpoints.each(f"{self.part}.keyframes", sorted(set(pairs)), of_pair)
        compared = list(chain.from_iterable(of_pairs))
        usable = _usable(frames, keyframes)
        first = set(evenly_spaced(len(usable), min(FRAMES_TO_DECIDE, len(usable))))
        compared += self._compared("some", [usable[k] for k in sorted(first)], keyframes, blocks)
        if self.config.mode == "auto" and not differ(compared, self.config):
            return ExposureTrack()
        others = [frame for k, frame in enumerate(usable) if k not in first]
        return solve_exposures([*compared, *self._compared("frames", others, keyframes, blocks)], self.config)

    def _compared(
        self,
        which: str,
        frames: Sequence[TrackedFrame],
        keyframes: Sequence[int],
        blocks: Sequence[ColorBlocks],
    ) -> list[ComparedPair]:
        """Frames compared with their keyframes."""

        def of_frame(frame: TrackedFrame) -> list[ComparedPair]:
            k, own = frame.keyframe_index, self.blocks(frame.frame_index)
            ends = (keyframes[k], blocks[k]), (frame.frame_index, own)
            return compare(*ends, frame.T_keyframe_camera, self.config)

        return list(chain.from_iterable(self.checkpoints.each(f"{self.part}.{which}", frames, of_frame)))


def _usable(frames: Sequence[TrackedFrame], keyframes: Sequence[int]) -> list[TrackedFrame]:
    """Frames that the map may be made of, keyframes excepted."""
    taken = set(keyframes)
    return [
        frame
        for frame in frames
        if frame.status is not Status.LOST
        and frame.reason is Reason.NONE
        and frame.frame_index not in taken
        and not is_held_out(frame.frame_index)
    ]


def compare(
    first: tuple[int, ColorBlocks],
    second: tuple[int, ColorBlocks],
    T_first_second: Array,
    config: ExposureConfig,
) -> list[ComparedPair]:
    """Two frames compared; nothing if they share too little.

    Args:
        first: index in the log, and colors.
        second: the same of the other.
        T_first_second: [4, 4].
        config: noise.
    """
    own, other = first[1].shared_with(second[1], T_first_second)
    if len(own) < MIN_BLOCKS:
        return []
    colors = compare_colors(
        own,
        other,
        per_sample=BLOCKS_PER_SAMPLE,
        sigma_floor=config.sigma_gain,
        sigma_floor_middle=config.sigma_color,
        rounds=ROUNDS_OF_PAIR,
    )
    return [ComparedPair(first[0], second[0], colors)]


def differ(pairs: Sequence[ComparedPair], config: ExposureConfig) -> bool:
    """Whether enough pairs of frames show the same surfaces in different colors.

    Args:
        pairs: of frames.
        config: how many, and how different.
    """
    if not pairs:
        return False
    different = [
        bool(
            np.any(
                np.abs(p.colors.middle_other - p.colors.middle_own)
                > config.min_sigmas * np.sqrt(p.colors.variance_middle)
            )
        )
        for p in pairs
    ]
    return float(np.mean(different)) > config.min_share


def solve_exposures(pairs: Sequence[ComparedPair], config: ExposureConfig) -> ExposureTrack:
    """Gains and offsets of all frames by robust least squares of all pairs, each channel by itself.

    With a the log gain and b the offset of a frame, a pair says by how much its log gains differ, and that the middles
    c of its colors show one color s = (c - b) / exp(a).

    Args:
        pairs: of frames.
        config: priors.
    """
    frames = sorted({index for pair in pairs for index in (pair.first, pair.second)})
    if not frames:
        return ExposureTrack()
    i, j = np.searchsorted(frames, np.array([(pair.first, pair.second) for pair in pairs])).T
    log_gain, offset = np.zeros((len(frames), 3)), np.zeros((len(frames), 3))
    for channel in range(3):
        of_pairs = np.array(
            [
                (
                    c.log_ratio[channel],
                    c.variance[channel],
                    c.middle_own[channel],
                    c.middle_other[channel],
                    c.variance_middle[channel],
                )
                for c in (pair.colors for pair in pairs)
            ]
        )
        log_gain[:, channel], offset[:, channel] = _solve_channel(len(frames), (i, j), of_pairs.T, config)
    return ExposureTrack.of(frames, np.exp(log_gain), offset)


def _solve_channel(
    count: int, pairs: tuple[NDArray[np.int64], NDArray[np.int64]], of_pairs: Array, config: ExposureConfig
) -> tuple[Array, Array]:
    """Log gains [n] and offsets [n] of one channel; of_pairs [5, m] in the order of `ComparedColors`."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    (i, j), (log_ratio, variance, own, other, variance_middle) = pairs, of_pairs
    m, rows, one = len(i), np.arange(len(i)), np.ones(len(i))
    row = np.concatenate([rows, rows, m + rows, m + rows, m + rows, m + rows])
    column = np.concatenate([i, j, i, j, count + i, count + j])
    prior = np.repeat([config.prior_gain**-2.0, config.prior_offset**-2.0], count)
    weight = np.concatenate([1 / variance, 1 / variance_middle])
    x = np.zeros(2 * count)
    for _ in range(ROUNDS):
        a, b = x[:count], x[count:]
        shrink_i, shrink_j = np.exp(-a[i]), np.exp(-a[j])
        s_i, s_j = (own - b[i]) * shrink_i, (other - b[j]) * shrink_j
        residual = np.concatenate([a[j] - a[i] - log_ratio, s_j - s_i])
        values = np.concatenate([-one, one, s_i, -s_j, shrink_i, -shrink_j])
        J = coo_array((values, (row, column)), shape=(2 * m, 2 * count)).tocsr()
        robust = weight / huber_divisor(residual * np.sqrt(weight), HUBER_SIGMAS)
        H = (J.T @ diags_array(robust) @ J + diags_array(prior)).tocsc()
        x = x - spsolve(H, J.T @ (robust * residual) + prior * x)
    return x[:count], x[count:]
