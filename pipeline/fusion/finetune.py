"""A fused map trained again on what the robot saw, and on what its neighbors' maps show, at the corrected poses.

Consensus moves keyframes and fusion moves Gaussians; nobody asks the images whether the result still draws them. Some
steps of the mapper's own kind do: color and depth loss of the robot's keyframes and frames between them, never of
held-out ones. Own images alone would teach the map to look right from where the robot stood and from nowhere else, so
every few steps comes a view of a neighbor's map from where the neighbor stood (`peer_views`); own images, which are
no copies, have the last word. Without such views only the robot's own Gaussians move: the few own views that see one
taken over, from afar or through a door, know less of it than its owner's many. The information is that of before: what
is learned here comes from the same pixels and is not counted again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.fusion import RefineConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import CompiledAdam, LossWeights, Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import depth_certainty
from duagc.pipeline.splat.optimizer import falling


@dataclass(frozen=True)
class View:
    """An own image: color uint8 [H, W, 3], depth (m, 0 = none) [H, W], T_world_camera [4, 4], pixels that count.

    depth_sigma_m: [H, W], standard deviation of the depth; None: not known pixel by pixel.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_world_camera: NDArray[np.float64]
    mask: NDArray[np.bool_] | None = None
    depth_sigma_m: NDArray[np.float32] | None = None


PEERS_UNTIL = 0.6
"""Share of the steps after which only own images come."""
_TRAINED = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")


def steps_of(config: RefineConfig, own_views: int, peer_views: int) -> tuple[int, int]:
    """How many steps the training takes on own views and on those of neighbors' maps."""
    steps = min(config.steps_per_view * own_views, config.steps_max)
    return steps, round(config.peer_share * steps) if peer_views else 0


def refine(
    gaussians: Gaussians,
    trained: NDArray[np.bool_],
    views: Sequence[View],
    camera: PinholeCamera,
    config: RefineConfig,
    thickness_floor_m: float,
    depth: DepthKind,
    seed: int,
    threads: int = 1,
    *,
    peer_views: Sequence[View] = (),
) -> Gaussians:
    """The map after some steps, each on one view: own ones in random order, each once before any comes again, and
    neighbors' likewise, evenly spread among the first.

    Args:
        gaussians: in the world frame of the views. trained: [n], which of them may change.
        views: own images. peer_views: as neighbors' maps show them.
        thickness_floor_m: none becomes thinner than this, or than it was.
        depth: as the map was made. threads: changes no bit.
    Returns:
        As many Gaussians, in the same order, with the same ids and anchors.
    """
    own_steps, peer_steps = steps_of(config, len(views), len(peer_views))
    if not own_steps or not len(gaussians):
        return gaussians
    total = own_steps + peer_steps
    head = max(peer_steps, round(PEERS_UNTIL * total))
    rasterizer, adam = Rasterizer(threads=threads), CompiledAdam(len(gaussians), threads=threads)
    weights = LossWeights(**config.loss.of(depth).model_dump())
    floor = np.minimum(
        gaussians.log_scales, np.float32(np.log(thickness_floor_m))
    )  # thinner ones stay as they are
    own, peer = _in_turn(views, seed, "fusion.refine"), _in_turn(peer_views, seed, "fusion.refine.peers")
    for step in range(total):
        of_peer = step < head and (step + 1) * peer_steps // head > step * peer_steps // head
        view = next(peer if of_peer else own)
        certainty = None
        if view.depth_sigma_m is not None:
            certainty = depth_certainty(view.depth_sigma_m, weights.depth_huber_m)
        _, gradients = rasterizer.view_gradients(
            gaussians,
            camera,
            se3.inverse(view.T_world_camera),
            view.color.astype(np.float32) * np.float32(1 / 255),
            view.depth_m,
            weights,
            mask=view.mask,
            depth_kind=depth,
            depth_certainty=certainty,
        )
        share = config.rate * falling(step, total, config.rate_decay)
        stepped = adam.step(gaussians, gradients, config.rates.times(share))
        stepped = stepped.replace(
            log_scales=np.maximum(stepped.log_scales, floor),
            opacity_logits=np.clip(stepped.opacity_logits, np.float32(-6), np.float32(6)),
        )
        gaussians = _where(trained, stepped, gaussians)
    return gaussians


def _in_turn(views: Sequence[View], seed: int, stream: str) -> Iterator[View]:
    """The views for ever, in random order, each once before any comes again."""
    for start in itertools.count(step=max(1, len(views))):
        for k in random_streams.generator(seed, stream, start=start).permutation(len(views)):
            yield views[k]


def _where(chosen: NDArray[np.bool_], a: Gaussians, b: Gaussians) -> Gaussians:
    """The Gaussians of `a` where chosen, else those of `b`."""
    values = {}
    for name in _TRAINED:
        x, y = getattr(a, name), getattr(b, name)
        values[name] = np.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), x, y)
    return b.replace(**values)
