"""Progress with time left, on standard error: a bar on a terminal, a plain line now and then elsewhere."""

import multiprocessing
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from duagc.pipeline.base.said_lines import say_line

Item = TypeVar("Item")
PLAIN_LINE_EVERY_S = 10.0


def track(iterable: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items of `iterable` and show how far it is.

    Args:
        iterable: what to walk through.
        description: what is being done, in a few words.
        total: number of items, if the iterable has no `len`.
    """
    if total is None:
        total = len(iterable) if isinstance(iterable, Sized) else None
    alone = multiprocessing.parent_process() is None  # several workers cannot share one bar
    if alone and sys.stderr.isatty():
        yield from _bar(iterable, description, total)
    else:
        yield from _lines(iterable, description, total)


def _bar(iterable: Iterable[Item], description: str, total: int | None) -> Iterator[Item]:
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    columns = (SpinnerColumn(), *Progress.get_default_columns()[:3], TimeRemainingColumn(), TextColumn(""))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        yield from progress.track(iterable, total=total, description=description)


def _lines(iterable: Iterable[Item], description: str, total: int | None) -> Iterator[Item]:
    start = last = time.monotonic()
    for count, item in enumerate(iterable):
        yield item
        now = time.monotonic()
        if now - last >= PLAIN_LINE_EVERY_S:
            last = now
            done = count + 1
            left = f", {(now - start) * (total - done) / done:.0f} s left" if total else ""
            say_line(f"{description}: {done}{f'/{total}' if total else ''}{left}")
