"""Files that appear whole under their name, also where several processes write the same one: by rename only."""

from __future__ import annotations

import os
import uuid
from contextlib import suppress
from pathlib import Path


def temporary(path: Path) -> Path:
    """A name next to `path` that no other process has.

    Args:
        path: the name that it will get.
    """
    return path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")


def publish(path: Path, data: bytes) -> None:
    """Write a file whole; what stood there is replaced.

    Args:
        path: of the file; its folder is made.
        data: its content.

    Raises:
        OSError: it cannot be written there; nothing is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = temporary(path)
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
