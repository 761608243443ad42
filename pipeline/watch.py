"""What a run reports while it is computed: to whoever waits for it, and to whoever follows it in Rerun."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from duagc.pipeline.base import worker_reports
from duagc.pipeline.base.checkpoints import Shown, StepReport
from duagc.pipeline.base.worker_reports import Hear

if TYPE_CHECKING:
    from duagc.pipeline.viewing.follow import Follower

EVERY_S = 0.5


@dataclass(frozen=True)
class Watch:
    """Hears of the steps of a run in one process.

    Attributes:
        tell: gets steps of front ends, and of the evaluation.
        follower: shows them in Rerun; None: nobody follows.
    """

    tell: Hear = lambda step: None
    follower: Follower | None = None

    def frontend(self, robot: str, number: int) -> StepReport:
        """Hears of the steps of a front end.

        Args:
            robot: its name.
            number: of the robot, from 0.
        """
        show = None if self.follower is None else self.follower.frontend(robot, number)
        told_s, last = 0.0, ""

        def report(part: str, done: int, total: int, shown: Shown | None) -> None:
            nonlocal told_s, last
            now = time.monotonic()
            if now - told_s >= EVERY_S or part != last or done == total:
                told_s, last = now, part
                self.tell((robot, part, done, total))
            if show is not None:
                show(part, done, total, shown)

        return report

    @property
    def round(self) -> Callable[[int, Mapping[str, int]], None] | None:
        """Hears of the rounds of the exchange."""
        return None if self.follower is None else self.follower.round


UNWATCHED = Watch()


def in_worker(where: Any) -> Watch:
    """What a worker process reports to the process that started it.

    Args:
        where: of the server that shows the run; None: nobody follows.
    """
    if where is None:
        return Watch(worker_reports.tell)
    from duagc.pipeline.viewing.follow import Follower

    return Watch(worker_reports.tell, Follower.connected(where))


@contextmanager
def ticking(tick: Callable[[], None], every_s: float) -> Iterator[None]:
    """Do something now and then, in a thread, while the block runs.

    Args:
        tick: what is done.
        every_s: time between.
    """
    ended = threading.Event()

    def loop() -> None:
        while not ended.wait(every_s):
            tick()

    ticker = threading.Thread(target=loop, daemon=True)
    ticker.start()
    try:
        yield
    finally:
        ended.set()
        ticker.join()
