"""The passes over one view of the room, and what they have to do, counted.

What a pair of pixel and Gaussian needs is counted by hand (`FLOPS`), arrays and scratch memory of a pass once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from duagc.pipeline.bench.made_room import make_room, view_of_room
from duagc.pipeline.config.training import LossConfig
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.types import FisherSums, Gradients, LossWeights, Statistics
from duagc.pipeline.splat.losses import rgbd_loss

Size = tuple[int, int]

# Floating-point operations per pair, counted in the source; a multiply-add counts as two, min, compare as one. What the
# four pixels of a row of a block share counts a quarter.
LOG2_ALPHA = 10  # pixel - center 2, e = M d 4, log2 opacity - |e|^2 4
ALPHA = 17  # 2^t and 1 - 2^t 15: three to split off the exponent, five multiply-adds, two for the rest; two clamps
REPLAY = LOG2_ALPHA + ALPHA + 3  # transmittance before, from that behind by a division; weight
E_AGAIN = 3  # e for the sums
OWN = 8 + 3 + 2  # cotangent of the own value, of what lies behind; w, zero where alpha is clamped
MOMENTS = E_AGAIN + 5 + 9 / 4  # six, of w
SCREEN_MOMENTS = E_AGAIN + 9 + 23 / 4  # thirteen, of w^2
DEPTH_MOMENTS = E_AGAIN + 5 + 8 / 4  # five
SWEEP = OWN + MOMENTS + 4 * 2  # weight times the four cotangents
FLOPS = {
    "forward": ALPHA + 3 + 4 * 2,  # weight, transmittance, closed?; three colors and depth
    "backward": REPLAY + SWEEP,
    "backward_fisher": REPLAY + SWEEP + (1 + SCREEN_MOMENTS) + (2 + DEPTH_MOMENTS) + (1 + 4 * 2),
    "gauss_newton": REPLAY + 4 * 3 + 13 + SCREEN_MOMENTS + DEPTH_MOMENTS + (1 + 2 * 2) + 2 * 2,
    "contributions": REPLAY + 1,
}
FLOPS["view_gradients"] = (
    FLOPS["forward"] + SWEEP
)  # alpha and weight are there; the loss is of pixels, not of pairs
EVALUATED_FLOPS = (
    LOG2_ALPHA + 1
)  # of the pairs that a forward looks at, drawn or not: is alpha at least 1/255?
TITLES = {
    "forward": "forward",
    "backward": "backward",
    "backward_fisher": "backward + empirical",
    "gauss_newton": "gauss_newton",
    "contributions": "contributions",
    "forward_loss_backward": "forward, loss, backward",
    "view_gradients": "view_gradients",
}


def draws(name: str) -> bool:
    """Whether a pass draws the view itself, rather than refer to what was drawn.

    Args:
        name: of the pass.
    """
    return name in ("forward", "view_gradients")


class RasterView:
    """The room in one camera, with what the passes over it take."""

    def __init__(self, size: Size, gaussians: int) -> None:
        """Make the room, and measured images near what is drawn.

        Args:
            size: of the images, px.
            gaussians: their number.
        """
        width, height = size
        self.room, self.T_camera_map = make_room(gaussians), view_of_room()
        self.camera = PinholeCamera(width, height, width / 2, width / 2, width / 2 - 0.5, height / 2 - 0.5)
        shape, rng = (height, width), np.random.default_rng(1)
        self.d_color = np.sign(rng.normal(size=(*shape, 3))).astype(np.float32)
        self.d_depth = np.sign(rng.normal(size=shape)).astype(np.float32)
        self.precision, self.sums = np.ones(shape, dtype=np.float32), FisherSums(gaussians)
        render = Rasterizer().forward(self.room, self.camera, self.T_camera_map)
        noise = rng.normal(0, 0.05, (*shape, 4)).astype(np.float32)
        self.color = (render.color + noise[..., :3]).clip(0, 1)
        self.depth_m = np.where(render.alpha > 0.5, render.depth / render.alpha.clip(0.5) + noise[..., 3], 0)
        self.weights = LossConfig()

    def passes(self, rasterizer: Rasterizer) -> dict[str, Callable[[], object]]:
        """The calls to time, in this order: each but the first refers to the view that is drawn last.

        Args:
            rasterizer: that draws.
        """
        d, view = (self.d_color, self.d_depth), (self.room, self.camera, self.T_camera_map)
        weights = LossWeights(**self.weights.model_dump())

        def forward_loss_backward() -> Gradients:
            loss = rgbd_loss(rasterizer.forward(*view), self.color, self.depth_m, self.weights)
            return rasterizer.backward(loss.d_color, loss.d_depth, loss.d_alpha, pose=True)

        return {
            "forward": lambda: rasterizer.forward(*view),
            "backward": lambda: rasterizer.backward(*d, pose=True),
            "backward_fisher": lambda: rasterizer.backward(*d, pose=True, fisher=True),
            "gauss_newton": lambda: rasterizer.fisher(self.precision, self.precision, self.sums),
            "contributions": rasterizer.contributions,
            "forward_loss_backward": forward_loss_backward,
            "view_gradients": lambda: rasterizer.view_gradients(
                *view, color=self.color, depth_m=self.depth_m, loss=weights, pose=True
            ),
        }

    def array_bytes(self, name: str, visible: int) -> int:
        """Arrays of the caller that a pass reads or writes once; the sums of the Gaussians in sight both.

        Args:
            name: of the pass.
            visible: number of Gaussians in sight.
        """
        n, pixels, floats = len(self.room), self.camera.width * self.camera.height, 4
        a_sum = 8 * (45 + 3 + 1 + 1 + 1) + 4
        return {
            "forward": floats * (14 * n + 5 * pixels),
            "backward": floats * (28 * n + 4 * pixels),
            "backward_fisher": floats * (42 * n + 4 * pixels),
            "gauss_newton": floats * (14 * n + 2 * pixels) + 2 * a_sum * visible,
            "contributions": floats * 2 * n,
            "view_gradients": floats * (28 * n + 4 * pixels),
        }[name]


class RasterWork:
    """What the passes over one view have to do, counted; the same on every instruction set and number of threads."""

    def __init__(self, isa: str, view: RasterView) -> None:
        """Carry out every pass once.

        Args:
            isa: instruction set.
            view: that is drawn.
        """
        self.moved_bytes: dict[str, float] = {}
        for name in FLOPS:
            rasterizer = Rasterizer(isa)  # a new one, whose memory shows what the pass needs
            passes = view.passes(rasterizer)
            passes["forward"]()
            self.seen: Statistics = rasterizer.statistics()
            passes[name]()
            drawn = self.seen.scratch_bytes
            added = rasterizer.statistics().scratch_bytes - drawn
            # what a pass adds is written once and read once, what the forward left is read once more
            scratch = 2 * (drawn + added) if draws(name) else drawn + 2 * added
            self.moved_bytes[name] = scratch + view.array_bytes(name, self.seen.visible)

    def flops(self) -> dict[str, float]:
        """Of each pass, by `FLOPS`."""
        counts = {name: flops * self.seen.blended_pairs for name, flops in FLOPS.items()}
        for name in filter(draws, FLOPS):
            counts[name] += EVALUATED_FLOPS * self.seen.evaluated_pairs
        return counts
