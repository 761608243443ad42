"""What this machine has left."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_UNLIMITED = 1 << 60  # a control group without a limit says a number like this


def memory_bytes() -> tuple[int | None, int | None]:
    """Memory that this process may have in all, and what is free of it; None: unknown."""
    total = free = None
    with suppress(OSError, ValueError):
        rows = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        total, free = (int(rows[name].split()[0]) * 1024 for name in ("MemTotal", "MemAvailable"))
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        with suppress(OSError, ValueError):
            most, now = int(Path(limit).read_text()), int(Path(used).read_text())
            if most < min(total or _UNLIMITED, _UNLIMITED):
                total, free = most, min(most - now, free if free is not None else most)
    return total, free


def processors() -> int:
    """Processors that this process may use; every thread of a core is one."""
    return len(os.sched_getaffinity(0))
