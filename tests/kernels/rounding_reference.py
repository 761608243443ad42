"""What rounding may do to what the reference computes; tests of the compiled rasterizer allow for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.kernels.definition import (
    ALPHA_MAX,
    ALPHA_MIN,
    SCREEN_NUMBERS,
    TRANSMITTANCE_MIN,
    Channels,
    color_and_depth,
    derivatives_by_inputs,
)
from duagc.pipeline.kernels.reference import ReferenceRasterizer

# Relative distance from a threshold within which float32 may decide otherwise; see `decided`.
UNSURE_ALPHA = 1e-4  # alpha and transmittance
UNSURE_PLACE = 1e-6  # depths and directions


class RoundingReference(ReferenceRasterizer):
    """The reference; it also gives, of its last view, where float32 may decide otherwise, and what cancels in sums."""

    def gate_margin(self) -> float:
        """Smallest relative distance of any pair of pixel and Gaussian from the thresholds of alpha and transmittance.

        Near zero, rounding decides whether the pair is drawn, and another precision may differ visibly.
        """
        return float(self._margins().min(initial=1.0))

    def decided(self) -> NDArray[np.bool_]:
        """Pixels [H, W] in which no threshold of the definition is so near that float32 may decide otherwise.

        The thresholds are those of `gate_margin`, the order of two depths, and the clamp of J. At each of them the
        image or its derivative jumps, so that no precision makes two implementations agree there.
        """
        seen, z = self._painting.weights.detach().numpy() > 0, self._screen.depths.detach().numpy()
        nearer = np.maximum.accumulate(np.where(seen, z, 0.0), axis=1)[:, :-1]  # the last one seen before
        gap = 1 - nearer / z[1:]
        mixed_up = (seen[:, 1:] & (gap > 0) & (gap < UNSURE_PLACE)).any(axis=1)
        at_clamp = (seen & (self._from_clamp.numpy() < UNSURE_PLACE)).any(axis=1)
        out = np.zeros(self._drawn.shape, dtype=bool)
        out[self._drawn] = (self._margins() > UNSURE_ALPHA) & ~mixed_up & ~at_clamp
        return out

    def gradient_terms(
        self, d_color: ArrayLike, d_depth: ArrayLike | None = None, d_alpha: ArrayLike | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What `backward` adds up to the gradients [n, 14] and the pose [6], with all signs taken away.

        They are sums over pixels of sums over screen numbers. Where these cancel, rounding leaves an error in
        proportion to this.

        Args:
            d_color: dL/dcolor [H, W, 3].
            d_depth: dL/ddepth [H, W]; None is zero.
            d_alpha: dL/dalpha [H, W]; None is zero.
        """
        terms = self._terms(self._dot(d_color, d_depth, d_alpha)).sum((0, 1))
        return terms[:, :14], terms[:, 14:].sum(axis=0)

    def empirical_terms(
        self, d_color: ArrayLike, d_depth: ArrayLike | None = None, d_alpha: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        """The same of `fisher_diagonal` [n, 14], whose squares are those of sums over screen numbers.

        Args:
            d_color: as in `gradient_terms`.
            d_depth: as in `gradient_terms`.
            d_alpha: as in `gradient_terms`.
        """
        return (self._terms(self._dot(d_color, d_depth, d_alpha))[..., :14] ** 2).sum((0, 1))

    def information_terms(self, inv_var_color: ArrayLike, inv_var_depth: ArrayLike) -> NDArray[np.float64]:
        """The same of the diagonal that `fisher` adds up.

        Args:
            inv_var_color: as in `full_fisher`.
            inv_var_depth: as in `full_fisher`.
        """
        precision = self._precision(inv_var_color, inv_var_depth)
        return np.einsum("cm,cmni->ni", precision, self._terms(color_and_depth)[..., :14] ** 2)

    def _margins(self) -> NDArray[np.float64]:
        """The `gate_margin` of every drawn pixel [m], over the Gaussians up to the one that closes it."""
        raw, left = (gate.numpy() for gate in self._painting.gates)
        closed = np.logical_or.accumulate(left < TRANSMITTANCE_MIN, axis=1)
        mattering = np.ones_like(closed)
        mattering[:, 1:] = ~closed[:, :-1]
        margins = np.ones(len(raw))
        for distance in (raw / ALPHA_MIN - 1, raw / ALPHA_MAX - 1, left / TRANSMITTANCE_MIN - 1):
            margins = np.minimum(margins, np.where(mattering, np.abs(distance), 1.0).min(axis=1, initial=1.0))
        return margins

    def _terms(self, channels: Channels) -> NDArray[np.float64]:
        """The Jacobian [c, m, n, 14 and pose 6] with every product of the chain rule taken as positive.

        Through screen numbers without long and short directions: M center, M^-T C^-1 M^-1 (which is 1) and
        M^-T slope, with C^-1 = M^T M.
        """
        M = np.swapaxes(np.linalg.cholesky(self._screen.conics.detach().numpy()), 1, 2)
        back = np.swapaxes(np.linalg.inv(M), 1, 2)
        change = np.tile(np.eye(SCREEN_NUMBERS), (len(M), 1, 1))
        change[:, 0:2, 0:2], change[:, 7:9, 7:9] = M, back
        change[:, 2:6, 2:6] = np.einsum("kij,klm->kiljm", back, back).reshape(-1, 4, 4)
        by_screen = self._by_screen(channels, self._screen)
        by_inputs = derivatives_by_inputs(self._screen, [*self._parameters.values(), self._xi], self._order)
        by_screen = np.abs(np.einsum("cmks,kst->cmkt", by_screen, np.linalg.inv(change)))
        return self._by_gaussian(np.einsum("cmks,ksp->cmkp", by_screen, np.abs(change @ by_inputs)))
