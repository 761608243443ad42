"""Times and counts of the calls of named functions, while they run as they always do."""

from __future__ import annotations

import functools
import inspect
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Calls:
    """Processor and wall time of every call of a function, seconds."""

    cpu_s: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)


class Stopwatch:
    """Times every call of named functions for as long as it is open; a function that is not there is an error."""

    def __init__(self, functions: Mapping[str, tuple[Any, str]]) -> None:
        """Take the functions; they are replaced when it is opened.

        Args:
            functions: by label: module or class, and name of the function in it.
        """
        self.calls = {label: Calls() for label in functions}
        self._functions = dict(functions)
        self._open = ExitStack()

    def __enter__(self) -> Stopwatch:
        with ExitStack() as stack:
            for label, (owner, name) in self._functions.items():
                stack.enter_context(replaced(owner, name, functools.partial(_timed, self.calls[label])))
            self._open = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()


@contextmanager
def replaced(
    owner: Any, name: str, change: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Iterator[None]:
    """Put `change` of a function in its place, for as long as the context is open.

    Args:
        owner: module or class.
        name: of the function in it.
        change: makes the function that stands in its place.
    """
    original = inspect.getattr_static(owner, name)
    if isinstance(original, staticmethod | classmethod):
        setattr(owner, name, type(original)(change(original.__func__)))
    else:
        setattr(owner, name, change(original))
    try:
        yield
    finally:
        setattr(owner, name, original)


def _timed(calls: Calls, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            calls.cpu_s.append(time.process_time() - cpu)
            calls.wall_s.append(time.perf_counter() - wall)

    return call


def summary(calls: Calls) -> dict[str, float]:
    """Milliseconds of a call: mean, median, 95th percentile and the means of the first and the last quarter.

    Means are those of processor time; `wall_ms` is the mean of wall time.

    Args:
        calls: one at least, seconds.
    """
    ms = 1000 * np.array(calls.cpu_s)
    quarter = max(1, len(ms) // 4)
    return {
        "calls": len(ms),
        "cpu_ms": float(ms.mean()),
        "cpu_ms_median": float(np.median(ms)),
        "cpu_ms_p95": float(np.quantile(ms, 0.95)),
        "cpu_ms_first_quarter": float(ms[:quarter].mean()),
        "cpu_ms_last_quarter": float(ms[-quarter:].mean()),
        "wall_ms": float(1000 * np.mean(calls.wall_s)),
    }


@dataclass
class Work:
    """What is counted besides time: it is the same on every machine. Totals after each call of the whole."""

    total: int = 0
    after: list[int] = field(default_factory=list)

    def summary(self, name: str) -> dict[str, float]:
        """Mean per call, in the first and in the last quarter of the calls.

        Args:
            name: of what is counted; begins the names of the result.
        """
        counts = np.diff(np.array([0, *self.after]))
        quarter = max(1, len(counts) // 4)
        return {
            name: float(counts.mean()),
            f"{name}_first_quarter": float(counts[:quarter].mean()),
            f"{name}_last_quarter": float(counts[-quarter:].mean()),
        }


@contextmanager
def counted(
    whole: tuple[Any, str], part: tuple[Any, str], amount: Callable[..., int] = lambda *_: 1
) -> Iterator[Work]:
    """Add up `amount` of the calls of a part, their result and arguments, while the whole runs; noted when it ends.

    Args:
        whole: module or class, and name of the function during which is counted.
        part: the same of the function that is counted.
        amount: by result and arguments of a call of the part.

    Yields:
        The counts, which grow while the context is open.
    """
    work = Work()

    def counting(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            result = function(*args, **kwargs)
            work.total += amount(result, *args)
            return result

        return call

    def noting(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            work.total = work.after[-1] if work.after else 0  # what happens between the calls is not counted
            result = function(*args, **kwargs)
            work.after.append(work.total)
            return result

        return call

    with replaced(*part, counting), replaced(*whole, noting):
        yield work


def shares(whole: Calls, parts: Mapping[str, Calls]) -> dict[str, float]:
    """Milliseconds of processor time that parts of a call take of it on average, and what is left.

    Args:
        whole: calls of the whole, one at least.
        parts: calls of its parts, by label.
    """
    found = {label: 1000 * sum(calls.cpu_s) / len(whole.cpu_s) for label, calls in parts.items()}
    return found | {"other": 1000 * sum(whole.cpu_s) / len(whole.cpu_s) - sum(found.values())}
