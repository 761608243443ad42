"""Derivatives of every pixel by the parameters of some Gaussians of a large map, in float64.

Only the pixels of a Gaussian's footprint depend on it, so only these are drawn, with all Gaussians that they see. What
`ReferenceRasterizer` computes for small scenes; the tests compare the two.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.definition import (
    ALPHA_MAX,
    ALPHA_MIN,
    SCREEN_NUMBERS,
    TRANSMITTANCE_MIN,
    Screen,
    derivatives_by_inputs,
    matrix_exp,
    screen_of,
    sigma_of,
    tensor,
)
from duagc.pipeline.splat.gaussians import Gaussians

BLOCK_PX = 16  # side of the blocks of pixels that are drawn together
_CENTER, _CONIC, _DEPTH, _SLOPE, _OPACITY, _COLOR = (
    slice(0, 2),
    slice(2, 6),
    6,
    slice(7, 9),
    9,
    slice(10, 13),
)
"""Places in the numbers of a `Screen`."""


class Footprint(NamedTuple):
    """The m pixels of one view in which one Gaussian is drawn.

    Attributes:
        row: of the Gaussian, among those that were asked for.
        pixels: int [m, 2], x and y.
        weights: [m], its blending weights.
        depth_m: of its center.
        color: [m, 3], of all Gaussians.
        depth: [m], m, not divided by alpha.
        alpha: [m].
        by_screen: [4, m, s], derivatives of red, green, blue and depth by its screen numbers.
        by_parameters: [s, 14], of these by mean 3, quaternion 4, log-scale 3, color 3, logit 1.
        by_chart: [s, 13], of these by mean 3, vec log Sigma 6, color 3, logit 1.
    """

    row: int
    pixels: NDArray[np.int64]
    weights: Array
    depth_m: float
    color: Array
    depth: Array
    alpha: Array
    by_screen: Array
    by_parameters: Array
    by_chart: Array


class PixelJacobians:
    """Footprints of some Gaussians of a map, view by view; background black."""

    def __init__(
        self,
        gaussians: Gaussians,
        rows: NDArray[np.int64],
        camera: PinholeCamera,
        depth_kind: DepthKind = "blended",
    ) -> None:
        """Take the map.

        Args:
            gaussians: the whole map, in the frame `map`.
            rows: [r], of the Gaussians whose footprints are wanted.
            camera: of all views.
            depth_kind: depth of a Gaussian at a pixel.
        """
        self._camera, self._depth_kind, self._rows = camera, depth_kind, rows
        some = gaussians.select(rows)
        self._all = [
            tensor(gaussians.means),
            sigma_of(tensor(gaussians.quats_wxyz), tensor(gaussians.log_scales)),
            tensor(gaussians.opacity_logits),
            tensor(gaussians.colors),
        ]
        self._means, self._quats, self._scales, self._colors, self._logits = (
            tensor(a).requires_grad_()
            for a in (some.means, some.quats_wxyz, some.log_scales, some.colors, some.opacity_logits)
        )
        self._log_covariances = tensor(spd.log_covariance(some.quats_wxyz, some.log_scales)).requires_grad_()

    def view(self, T_camera_map: ArrayLike, mask: NDArray[np.bool_] | None = None) -> Iterator[Footprint]:
        """Footprints of those Gaussians that a view draws, in the order of their distance.

        Args:
            T_camera_map: [4, 4].
            mask: bool [H, W], pixels that count; None: all.
        """
        import torch

        T = tensor(T_camera_map)
        shared = {"W": T[:3, :3], "t": T[:3, 3], "camera": self._camera, "depth_kind": self._depth_kind}
        with torch.no_grad():
            order, screen, _ = screen_of(*self._all, **shared)
        drawn = _Drawn(order.numpy(), Screen(*(a.numpy() for a in screen)), self._camera)
        usable = np.ones((self._camera.height, self._camera.width), bool) if mask is None else mask
        order_of_some, by_parameters = self._by_inputs(shared, chart=False)
        _, by_chart = self._by_inputs(shared, chart=True)
        place = np.full(len(self._all[0]), -1)
        place[drawn.order] = np.arange(len(drawn.order))
        for k, row in enumerate(order_of_some.tolist()):
            found = drawn.footprint(int(place[self._rows[row]]), usable)
            if found is not None:
                yield Footprint(row, **found, by_parameters=by_parameters[k], by_chart=by_chart[k])

    def _by_inputs(self, shared: dict[str, Any], *, chart: bool) -> tuple[NDArray[np.int64], Array]:
        """Indices [k] of the Gaussians asked for, nearest first, and derivatives [k, s, p] of their screen numbers."""
        if chart:
            sigma = matrix_exp(self._log_covariances)
            shape = [self._log_covariances]
        else:
            sigma = sigma_of(self._quats, self._scales)
            shape = [self._quats, self._scales]
        order, screen, _ = screen_of(self._means, sigma, self._logits, self._colors, **shared)
        # `derivatives_by_inputs` takes the inputs of all and the rows of the screen
        inputs = [self._means, *shape, self._colors, self._logits]
        return order.numpy(), derivatives_by_inputs(screen, inputs, order.numpy())


class _Drawn:
    """One view of the map: its Gaussians on the screen, nearest first, and the boxes that they can reach."""

    def __init__(self, order: NDArray[np.int64], screen: Screen, camera: PinholeCamera) -> None:
        self.order, self.screen, self._camera = order, screen, camera
        with np.errstate(divide="ignore"):
            self._power = 2 * np.log(np.maximum(screen.opacities / ALPHA_MIN, 0.0))  # at the edge
        xx, xy, yy = screen.conics[:, 0, 0], screen.conics[:, 0, 1], screen.conics[:, 1, 1]
        reach = np.sqrt(np.maximum(self._power, 0.0) / (xx * yy - xy * xy))
        half = np.stack([reach * np.sqrt(yy), reach * np.sqrt(xx)], axis=1) + 1e-6
        self._low, self._high = screen.centers - half, screen.centers + half

    def footprint(self, k: int, usable: NDArray[np.bool_]) -> dict[str, Any] | None:
        """What a `Footprint` says of Gaussian k of the screen, without its inputs; None: no pixel draws it."""
        if not self._power[k] > 0:
            return None
        size = np.array([self._camera.width, self._camera.height])
        first = np.maximum(np.ceil(self._low[k]), 0).astype(int)
        last = np.minimum(np.floor(self._high[k]), size - 1).astype(int)
        if (last < first).any():
            return None
        part = usable[first[1] : last[1] + 1, first[0] : last[0] + 1]
        pixels = np.argwhere(part)[:, ::-1] + first
        pixels = pixels[self._raw(pixels, np.array([k]))[0][:, 0] >= ALPHA_MIN]
        blocks = pixels // BLOCK_PX
        near = self._reaching(first, last, np.arange(len(self.order)))
        parts = [
            self._block(k, pixels[(blocks == block).all(axis=1)], near) for block in np.unique(blocks, axis=0)
        ]
        if not any(len(part["pixels"]) for part in parts):
            return None
        joined: dict[str, Any] = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
        joined["by_screen"] = joined["by_screen"].swapaxes(0, 1)
        return {**joined, "depth_m": float(self.screen.depths[k])}

    def _raw(self, pixels: NDArray[np.int64], rows: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Alpha before its clamp [m, k] of Gaussians at pixels, and the pixels from their centers in x and y."""
        x = pixels[:, :1] - self.screen.centers[rows, 0]
        y = pixels[:, 1:] - self.screen.centers[rows, 1]
        Q = self.screen.conics[rows]
        power = Q[:, 0, 0] * x * x + 2 * Q[:, 0, 1] * x * y + Q[:, 1, 1] * y * y
        return self.screen.opacities[rows] * np.exp(-0.5 * power), x, y

    def _reaching(self, low: Array, high: Array, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of the Gaussians that may be drawn between two pixels [2]."""
        below, above = self._low[rows], self._high[rows]
        inside = (below[:, 0] <= high[0]) & (below[:, 1] <= high[1])
        inside &= (above[:, 0] >= low[0]) & (above[:, 1] >= low[1])
        return rows[inside & (self._power[rows] > 0)]

    def _block(self, k: int, pixels: NDArray[np.int64], near: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """The pixels that draw Gaussian k, of some close together: `footprint`, pixels first in all arrays."""
        rows = self._reaching(pixels.min(axis=0), pixels.max(axis=0), near)
        raw, x, y = self._raw(pixels, rows)
        a = np.where(raw >= ALPHA_MIN, np.minimum(raw, ALPHA_MAX), 0.0)
        left = np.cumprod(1 - a, axis=1)
        a = np.where(left >= TRANSMITTANCE_MIN, a, 0.0)  # what is left only falls
        before = np.cumprod(np.concatenate([np.ones((len(a), 1)), 1 - a[:, :-1]], axis=1), axis=1)
        w = a * before
        s = self.screen
        depths = s.depths[rows] + s.slopes[rows, 0] * x + s.slopes[rows, 1] * y
        channels = [np.broadcast_to(c, w.shape) for c in s.colors[rows].T] + [depths]
        j = int(np.searchsorted(rows, k))
        images = [(w * c).sum(axis=1) for c in channels]
        by_alpha = np.stack(
            [
                before[:, j] * c[:, j] - (w[:, j + 1 :] * c[:, j + 1 :]).sum(axis=1) / (1 - a[:, j])
                for c in channels
            ]
        )
        kept = a[:, j] > 0
        moving = raw[:, j] * (raw[:, j] <= ALPHA_MAX)
        dx, dy, Q = x[:, j], y[:, j], s.conics[k]
        of_alpha = np.zeros((len(pixels), SCREEN_NUMBERS))  # of a by the screen numbers
        of_alpha[:, 0] = moving * (Q[0, 0] * dx + Q[0, 1] * dy)
        of_alpha[:, 1] = moving * (Q[0, 1] * dx + Q[1, 1] * dy)
        of_alpha[:, _CONIC] = (
            -0.5 * moving[:, None] * np.stack([dx * dx, 2 * dx * dy, 0 * dx, dy * dy], axis=1)
        )
        of_alpha[:, _OPACITY] = moving / s.opacities[k]
        out = by_alpha[:, :, None] * of_alpha
        weight = w[:, j]
        for channel in range(3):
            out[channel, :, _COLOR.start + channel] += weight
        out[3, :, _DEPTH] += weight
        out[3, :, _SLOPE] += weight[:, None] * np.stack([dx, dy], axis=1)
        out[3, :, _CENTER] -= weight[:, None] * s.slopes[k]
        found = {
            "pixels": pixels,
            "weights": weight,
            "color": np.stack(images[:3], axis=1),
            "depth": images[3],
            "alpha": w.sum(axis=1),
            "by_screen": out.swapaxes(0, 1),
        }
        return {name: array[kept] for name, array in found.items()}
