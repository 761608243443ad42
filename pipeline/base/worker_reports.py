"""What worker processes report to the process that started them, while they are at work."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.queues import SimpleQueue
from typing import TypeVar

from duagc.pipeline.base.stop_signals import start_resource_tracker

Item = TypeVar("Item")
Step = tuple[str, str, int, int]
"""Of a robot: its name, what is done of it, steps done, steps in all; 0 of 0: it is done."""
OF_TEAM = ""
"""In the place of a robot's name: a step of what is done for all robots together."""
KEYFRAMES = {"blended": "keyframes", "ray_plane": "keyframes with exact depth"}
"""Part of a front end that says how many keyframes there are, by how the depth of Gaussians is drawn."""
Hear = Callable[[Step], None]
"""Gets steps."""
_queues: list[SimpleQueue[Step | None]] = []


def keep_queue(queue: SimpleQueue[Step | None]) -> None:
    """Where this worker process reports its steps: a queue can be handed to a process only while it starts.

    Args:
        queue: of the process that started it.
    """
    _queues.append(queue)


def tell(step: Step) -> None:
    """Report a step to the process that started this one, if it listens.

    Args:
        step: of a robot.
    """
    if _queues:
        _queues[0].put(step)


@contextmanager
def listening(hear: Callable[[Item], None]) -> Iterator[SimpleQueue[Item | None]]:
    """A queue for worker processes; what they tell is heard in a thread while the block runs.

    An error of `hear` is raised at the end of the block. Until then what comes is dropped: no process waits at a full
    queue.

    Args:
        hear: gets everything.
    """
    start_resource_tracker()
    queue: SimpleQueue[Item | None] = multiprocessing.get_context("spawn").SimpleQueue()
    failed: list[Exception] = []

    def relay() -> None:
        while (item := queue.get()) is not None:
            if not failed:
                try:
                    hear(item)
                except Exception as error:
                    failed.append(error)

    relaying = threading.Thread(target=relay, daemon=True)
    relaying.start()
    try:
        yield queue
    finally:
        queue.put(None)
        relaying.join(timeout=5.0)
    if failed:
        raise failed[0]
