"""The Gaussians of a map that grows: with the state of their optimizer and what each contributes to images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.kernels import CompiledAdam
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

    def __len__(self) -> int:
        return len(self.gaussians)

    def state(self) -> tuple[Any, ...]:
        """All that it knows; `go_on` takes it."""
        return self.gaussians, self.contribution, self.next_id, self.adam.state()

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self.gaussians, self.contribution, self.next_id, adam = state
        self.adam.go_on(adam)

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
        """Remove the Gaussians with the least contribution; ties go by position.

        Args:
            count: how many.

        Returns:
            How many were removed.
        """
        order = np.argsort(self.contribution, kind="stable")
        keep = np.ones(len(self), bool)
        keep[order[:count]] = False
        return self.keep(keep)

    def prune_degenerate(self) -> int:
        """Remove Gaussians that are transparent or huge; how many there were."""
        config = self.config
        logit = np.log(config.min_opacity / (1 - config.min_opacity))
        huge = self.gaussians.log_scales.max(axis=1, initial=-np.inf) > np.log(config.max_scale_m)
        return self.keep((self.gaussians.opacity_logits >= logit) & ~huge)

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
