"""The Gaussians of a map that grows: with the state of their optimizer and what each contributes to images.

A tile of a large map is taken out and optimized alone. Gaussians in it that belong to other tiles are its guests: no
tile removes them for want of contribution, and the final optimization leaves them as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.kernels import CompiledAdam, Gradients
from duagc.pipeline.splat.gaussians import Gaussians

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
    """

    def __init__(self, config: MappingConfig, *, threads: int = 1) -> None:
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

    def __len__(self) -> int:
        return len(self.gaussians)

    def state(self) -> tuple[Any, ...]:
        """All that it knows; `go_on` takes it."""
        counts = self.next_id, self.guests, self.uncounted
        return self.gaussians, self.contribution, counts, self.adam.state()

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self.gaussians, self.contribution, counts, adam = state
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
        """Most own Gaussians: the configured cap, as long as all that the views see is at most twice that."""
        most, counted = self.config.max_gaussians, self.guests - self.uncounted
        return min(most, 2 * most - counted)

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

    def put_back(self, part: GrowingMap) -> None:
        """Put Gaussians back that were taken out, after those that stayed.

        Args:
            part: that was taken out of this map.
        """
        self.next_id = part.next_id
        self.gaussians = Gaussians.concatenate([self.gaussians, part.gaussians])
        self.contribution = np.concatenate([self.contribution, part.contribution])
        self.adam.append(part.adam)

    def _selected(self, rows: NDArray[np.int64], counts: tuple[int, int, int]) -> tuple[Any, ...]:
        """The state of a map of some of the Gaussians."""
        adam = CompiledAdam(threads=self.adam.threads)
        adam.append(self.adam)
        adam.select(rows)
        return self.gaussians.select(rows), self.contribution[rows], counts, adam.state()

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

    def prune_degenerate(self) -> int:
        """Remove Gaussians that are transparent or huge, and no guests; how many there were."""
        config = self.config
        logit = np.log(config.min_opacity / (1 - config.min_opacity))
        huge = self.gaussians.log_scales.max(axis=1, initial=-np.inf) > np.log(config.max_scale_m)
        return self.keep((self.gaussians.opacity_logits >= logit) & ~huge | self.is_guest)

    def step_own(
        self, gradients: Gradients, take: Callable[[Gaussians, Gradients, CompiledAdam], Gaussians]
    ) -> None:
        """Take an optimization step of all Gaussians but guests, in place.

        Args:
            gradients: of a loss by all Gaussians.
            take: gives the own ones after the step, from them, their gradients and the state of their optimizer.
        """
        own = slice(self.guests, None)
        first, second, steps, corrections = self.adam.state()
        adam = CompiledAdam(threads=self.adam.threads)  # on the same memory
        parts = (
            {name: moments[own] for name, moments in moments_of.items()} for moments_of in (first, second)
        )
        adam.go_on((*parts, steps[own], corrections))
        of_own = {name: getattr(gradients, name)[own] for name in first}
        stepped = take(self.gaussians.select(own), replace(gradients, **of_own), adam)
        for name in first:
            getattr(self.gaussians, name)[own] = getattr(stepped, name)

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
