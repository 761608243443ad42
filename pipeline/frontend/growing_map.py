"""The Gaussians of a map that grows: with the state of their optimizer and what each contributes to images.

A tile of a large map is taken out and optimized alone. Gaussians in it that belong to other tiles are its guests: no
tile removes them for want of contribution, and the final optimization leaves them as they are.
"""

from __future__ import annotations

from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import LearningRates
from duagc.pipeline.geometry.view_extent import radii_m
from duagc.pipeline.kernels import CompiledAdam, Gradients
from duagc.pipeline.kernels.training import ScaleLimits, step_in_place
from duagc.pipeline.splat.gaussians import Gaussians

Indices = NDArray[np.int64]
FADING = 0.9
"""Share of its last contribution that a Gaussian keeps where it is not measured again."""


class GrowingMap:
    """Gaussians, the state of Adam and the last measured contribution of each, kept in step.

    Attributes:
        gaussians: in the map frame.
        adam: state of their optimizer.
        contribution: of each, as last measured; infinite if never.
        next_id: of the next Gaussian that is made.
        guests: the first so many Gaussians belong to other tiles of the map.
        uncounted: guests that count for no cap.
        guests_begun: centers [m, 3] and radii [m], meters, that the guests had when the tile was taken out.
    """

    def __init__(self, config: MappingConfig, *, threads: SupportsIndex = 1) -> None:
        """Begin with no Gaussian.

        Args:
            config: what is pruned.
            threads: of the optimizer; changes no bit.
        """
        self.config = config
        self.gaussians = Gaussians.empty()
        self.adam = CompiledAdam(threads=threads)
        self.contribution = np.zeros(0)
        self.next_id = 0
        self.guests = self.uncounted = 0
        self.guests_begun = _balls(self.gaussians)

    def __len__(self) -> int:
        return len(self.gaussians)

    def state(self) -> tuple[Any, ...]:
        """All that it knows; `go_on` takes it."""
        counts = self.next_id, self.guests, self.uncounted
        return self.gaussians, self.contribution, counts, self.guests_begun, self.adam.state()

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self.gaussians, self.contribution, counts, self.guests_begun, adam = state
        self.next_id, self.guests, self.uncounted = counts
        self.adam.go_on(adam)

    @property
    def cap(self) -> int:
        """Most Gaussians while the map grows; half of the configured cap is there for own ones in any case."""
        return self.guests + max(self.config.max_gaussians // 2, self._own_cap)

    @property
    def room(self) -> int:
        """How many Gaussians may be added where the map is drawn worst."""
        return max(0, self._own_cap - (len(self) - self.guests))

    @property
    def _own_cap(self) -> int:
        """Most own Gaussians: the configured cap, as long as all that the views see is not too much."""
        return min(self.config.max_gaussians, self.config.seen_gaussians - (self.guests - self.uncounted))

    def take(self, guests: NDArray[np.int64], own: NDArray[np.int64], uncounted: int) -> GrowingMap:
        """Take Gaussians out, into a map of their own, where new ones are made.

        Args:
            guests: rows of those that belong to other tiles.
            own: rows of the others.
            uncounted: how many of the guests count for no cap.
        """
        rows = np.concatenate([guests, own])
        part = GrowingMap(self.config, threads=self.adam.threads)
        part.go_on(self._selected(rows, (self.next_id, len(guests), uncounted)))
        rest = np.ones(len(self), bool)
        rest[rows] = False
        self.keep(rest)
        return part

    def shelve(self) -> None:
        """Lay all that it knows into a file: until it is looked at again, it takes no memory."""
        self.go_on(SHELF.put(self.state()))
        SHELF.sweep(heap=True)

    def put_back(self, part: GrowingMap) -> None:
        """Put Gaussians back that were taken out, after those that stayed.

        Args:
            part: that was taken out of this map.
        """
        self.next_id = part.next_id
        self.gaussians = Gaussians.concatenate([self.gaussians, part.gaussians])
        self.contribution = np.concatenate([self.contribution, part.contribution])
        self.adam.append(part.adam)

    def _selected(self, rows: Indices, counts: tuple[int, int, int]) -> tuple[Any, ...]:
        """The state of a map of some of the Gaussians."""
        adam = CompiledAdam(threads=self.adam.threads)
        adam.go_on(self.adam.state())
        adam.select(rows)
        adam.freeze_after(None)
        gaussians = self.gaussians.select(rows)
        begun = _balls(gaussians.select(slice(counts[1])))
        return gaussians, self.contribution[rows], counts, begun, adam.state()

    def append(self, new: Gaussians) -> None:
        """Add Gaussians, whose contribution is not measured yet.

        Args:
            new: with ids from `next_id` on.
        """
        self.next_id += len(new)
        self.gaussians = Gaussians.concatenate([self.gaussians, new])
        self.adam.extend(len(new))
        self.contribution = np.concatenate([self.contribution, np.full(len(new), np.inf)])

    def update_contributions(self, found: NDArray[np.float64], seen: NDArray[np.bool_]) -> None:
        """Take in contributions to some views.

        Views that are left out may still need a Gaussian: its last contribution decays by a tenth at a time. A
        Gaussian that was never measured counts as needed.

        Args:
            found: [n], to these views.
            seen: [n], whether any of them saw the Gaussian; the others keep theirs.
        """
        faded = np.where(np.isinf(self.contribution), 0.0, FADING * self.contribution)
        self.contribution = np.where(seen, np.maximum(found, faded), self.contribution)

    def prune_least(self, count: int) -> int:
        """Remove the Gaussians with the least contribution; ties go by position. Guests stay.

        Args:
            count: how many.

        Returns:
            How many were removed.
        """
        order = self.guests + np.argsort(self.contribution[self.guests :], kind="stable")
        keep = np.ones(len(self), bool)
        keep[order[:count]] = False
        return self.keep(keep)

    def prune_transparent(self) -> int:
        """Remove Gaussians that are transparent, and no guests; how many there were."""
        config = self.config
        logit = np.log(config.min_opacity / (1 - config.min_opacity))
        return self.keep((self.gaussians.opacity_logits >= logit) | self.is_guest)

    def seen_with(self, guests: Indices) -> Gaussians:
        """Some guests, and all own Gaussians after them.

        Args:
            guests: rows [m] of the guests.
        """
        return Gaussians.concatenate([self.gaussians.select(rows) for rows in (guests, self._own)])

    def step(
        self,
        guests: Indices,
        gradients: Gradients,
        rates: LearningRates,
        *,
        limits: ScaleLimits,
        keep_guests: bool,
    ) -> None:
        """Take an optimization step of what a view may see, in place.

        Args:
            guests: rows [m] of the guests that it may see.
            gradients: of a loss by `seen_with(guests)`.
            rates: step lengths.
            limits: of the log-scales.
            keep_guests: whether guests stay as they are.
        """
        rows = np.arange(self.guests, len(self))
        if keep_guests:
            gradients = gradients.of_rows(slice(len(guests), None))
        else:
            rows = np.concatenate([guests, rows])
        step_in_place(self.gaussians, self.adam, gradients, rates=rates, limits=limits, rows=rows)

    def step_all(self, gradients: Gradients, rates: LearningRates, *, limits: ScaleLimits) -> None:
        """Take an optimization step of all Gaussians, in place.

        Args:
            gradients: of a loss by them.
            rates: step lengths.
            limits: of the log-scales.
        """
        step_in_place(self.gaussians, self.adam, gradients, rates=rates, limits=limits)

    def own_arrays(self) -> None:
        """Before steps in place: whoever has the Gaussians of now keeps them as they are."""
        self.gaussians = self.gaussians.copy()

    @property
    def _own(self) -> slice:
        return slice(self.guests, None)

    @property
    def is_guest(self) -> NDArray[np.bool_]:
        """[n], which Gaussians belong to other tiles of the map."""
        return np.arange(len(self)) < self.guests

    def keep(self, mask: NDArray[np.bool_]) -> int:
        """Remove Gaussians.

        Args:
            mask: [n], False for those that go.

        Returns:
            How many were removed.
        """
        if not mask.all():
            self.gaussians = self.gaussians.select(mask)
            self.adam.select(mask)
            self.contribution = self.contribution[mask]
        return int(np.count_nonzero(~mask))


def _balls(gaussians: Gaussians) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Centers [n, 3] and radii [n] of Gaussians, meters."""
    return gaussians.means.copy(), radii_m(gaussians.log_scales)
