"""Who may read and write which topic: every log asks here before it gives out or takes a message.

Nothing is limited outside of a `limited` block. `pipeline/runs/stages.py` opens one around every stage. The limit is
kept in a context variable: it holds in the thread that opened the block, and threads started inside read no logs.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Protocol


class Access(Protocol):
    """What limits the code that runs now; a method raises if the topic is none of those declared."""

    def check_read(self, path: Path, topic: str) -> None:
        """Refuse to read messages of `topic` from `path` unless that was declared.

        Args:
            path: of the log.
            topic: full name.

        Raises:
            DuagError: it was not declared.
        """

    def check_write(self, path: Path, topic: str) -> None:
        """Refuse to write messages of `topic` to `path` unless that was declared.

        Args:
            path: of the log.
            topic: full name.

        Raises:
            DuagError: it was not declared.
        """


_access: ContextVar[Access | None] = ContextVar("access", default=None)


@contextmanager
def limited(access: Access) -> Iterator[None]:
    """Limit all logs that are read and written inside the block.

    Args:
        access: asked before every topic is read or written.
    """
    token = _access.set(access)
    try:
        yield
    finally:
        _access.reset(token)


def check_read(path: Path, topic: str) -> None:
    """Raise if the code that runs now may not read `topic`.

    Args:
        path: of the log.
        topic: full name.

    Raises:
        DuagError: it was not declared.
    """
    access = _access.get()
    if access is not None:
        access.check_read(path, topic)


def check_write(path: Path, topic: str) -> None:
    """Raise if the code that runs now may not write `topic`.

    Args:
        path: of the log.
        topic: full name.

    Raises:
        DuagError: it was not declared.
    """
    access = _access.get()
    if access is not None:
        access.check_write(path, topic)
