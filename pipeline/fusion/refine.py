"""A fused map trained again on what the robot itself saw, at its corrected poses.

Consensus moves keyframes and fusion moves Gaussians; nobody asks the images whether the result still draws them. Some
steps of the mapper's own kind do: colour and depth loss of the robot's keyframes and frames between them, never of
held-out ones. Only the robot's own Gaussians move; those taken over from neighbours stay, because the few own views
that see one of them, from afar or through a door, know less of it than its owner's many (trained too, a house looks
2 dB worse from where the neighbour stood). The information is that of before: what is learned here comes from the same
pixels and is not counted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import streams
from pipeline.fusion.config import RefineConfig
from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera
from pipeline.kernels import CompiledAdam, LossWeights, Rasterizer
from pipeline.splat.gaussians import DepthKind, Gaussians
from pipeline.splat.losses import depth_certainty


@dataclass(frozen=True)
class View:
    """An own image: colour uint8 [H, W, 3], depth (m, 0 = none) [H, W], T_world_camera [4, 4], pixels that count.

    depth_sigma_m: [H, W], standard deviation of the depth; None: not known pixel by pixel.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_world_camera: NDArray[np.float64]
    mask: NDArray[np.bool_] | None = None
    depth_sigma_m: NDArray[np.float32] | None = None


_TRAINED = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")


def refine(
    gaussians: Gaussians,
    own: NDArray[np.bool_],
    views: Sequence[View],
    camera: PinholeCamera,
    config: RefineConfig,
    thickness_floor_m: float,
    depth: DepthKind,
    seed: int,
    threads: int = 1,
) -> Gaussians:
    """The map after `config.steps_per_view` steps for each view, in random order, each once before any comes again.

    Args:
        gaussians: in the world frame of the views. own: [n], which of them may change.
        thickness_floor_m: none becomes thinner than this, or than it was.
        depth: as the map was made. threads: changes no bit.
    Returns:
        As many Gaussians, in the same order, with the same ids and anchors.
    """
    steps = min(config.steps_per_view * len(views), config.steps_max)
    if not steps or not len(gaussians):
        return gaussians
    rasterizer, adam = Rasterizer(threads=threads), CompiledAdam(len(gaussians), threads=threads)
    weights = LossWeights(**config.loss.model_dump())
    floor = np.minimum(
        gaussians.log_scales, np.float32(np.log(thickness_floor_m))
    )  # thinner ones stay as they are
    order = np.zeros(0, np.int64)
    for step in range(steps):
        position = step % len(views)
        if position == 0:
            order = streams.generator(seed, "fusion.refine", start=step).permutation(len(views))
        view = views[order[position]]
        certainty = None
        if view.depth_sigma_m is not None:
            certainty = depth_certainty(view.depth_sigma_m, config.loss.depth_huber_m)
        _, gradients = rasterizer.view_gradients(
            gaussians,
            camera,
            se3.inverse(view.T_world_camera),
            view.color.astype(np.float32) * np.float32(1 / 255),
            view.depth_m,
            weights,
            mask=view.mask,
            depth=depth,
            depth_certainty=certainty,
        )
        share = config.rate * config.rate_decay ** (step / max(steps - 1, 1))
        stepped = adam.step(gaussians, gradients, config.rates.times(share))
        stepped = stepped.replace(
            log_scales=np.maximum(stepped.log_scales, floor),
            opacity_logits=np.clip(stepped.opacity_logits, np.float32(-6), np.float32(6)),
        )
        gaussians = _where(own, stepped, gaussians)
    return gaussians


def _where(chosen: NDArray[np.bool_], a: Gaussians, b: Gaussians) -> Gaussians:
    """The Gaussians of `a` where chosen, else those of `b`."""
    values = {}
    for name in _TRAINED:
        x, y = getattr(a, name), getattr(b, name)
        values[name] = np.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), x, y)
    return b.replace(**values)
