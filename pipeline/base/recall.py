"""Slow results of a computation that begins again from its start: it takes them instead of computing them.

For computations of which only some steps are slow and depend on nothing but their inputs; what is between them, such
as rounds of messages, is done again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from duagc.pipeline.base.checkpoints import Checkpoints

Value = TypeVar("Value")
WORTH_S = 0.02
"""What took less is not kept."""


class Recalling(Protocol):
    """Gives a result, computed now or earlier."""

    def __call__(self, name: str, compute: Callable[[], Value]) -> Value:
        """A result.

        Args:
            name: of the result, different for different inputs.
            compute: does it; it must depend on nothing that another process would have otherwise.
        """


def computed(name: str, compute: Callable[[], Value]) -> Value:
    """A result, computed now: nothing is kept.

    Args:
        name: of the result.
        compute: does it.
    """
    return compute()


class Recall:
    """Results by name. They are shared: nobody may change one."""

    def __init__(self, checkpoints: Checkpoints, part: str) -> None:
        """Begin, with what an earlier process has saved.

        Args:
            checkpoints: of the computation.
            part: under which results are saved.
        """
        self._checkpoints, self._part = checkpoints, part
        self._known: dict[str, Any] = (checkpoints.resume(part) or (0, {}))[1]

    def __call__(self, name: str, compute: Callable[[], Value]) -> Value:
        """As `Recalling`.

        Args:
            name: of the result.
            compute: does it.
        """
        if name in self._known:
            known: Value = self._known[name]
            return known
        began_s = time.perf_counter()
        value = compute()
        if time.perf_counter() - began_s >= WORTH_S:
            self._known[name] = value
            count = len(self._known)
            self._checkpoints.at(self._part, count, count, lambda: self._known)
        return value
