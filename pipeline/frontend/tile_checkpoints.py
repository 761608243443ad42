"""Checkpoints of the optimization of one tile of a map, with what is known of the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from duagc.pipeline.base.checkpoints import Checkpoints, Shown


class TileCheckpoints(Checkpoints):
    """Saves where a tile is as where the whole map is."""

    def __init__(
        self, of_map: Checkpoints, others: Any, *, found: tuple[int, Any] | None, before: int, total: int
    ) -> None:
        """Take no folder: states are saved by the checkpoints of the map.

        Args:
            of_map: checkpoints that are saved to.
            others: what is known of the other tiles.
            found: where the tile was, steps and state; None: it begins.
            before: steps of the tiles before.
            total: steps of all tiles.
        """
        super().__init__()
        self._of_map, self._others, self._found = of_map, others, found
        self._steps_before, self._total = before, total

    def resume(self, name: str) -> tuple[int, Any] | None:
        """Where the tile was: steps done, and its state; None: it begins.

        Args:
            name: of the part.
        """
        return self._found

    def at(
        self, name: str, done: int, total: int, state: Callable[[], Any], *, shown: Shown | None = None
    ) -> None:
        """Say where the tile is, after a step of it; saved if that is due.

        Args:
            name: of the part.
            done: steps.
            total: steps.
            state: from which the tile can go on; asked for only if it is saved.
            shown: gives what can be shown of it.
        """

        def of_all() -> tuple[Any, int, Any]:
            return self._others, done, state()

        self._of_map.at(name, self._steps_before + done, self._total, of_all, shown=shown)
