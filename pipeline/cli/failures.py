"""What ends a command and a user can fix, though it is no `DuagError`: limits of the machine, and files."""

from __future__ import annotations

import errno

COMPILED = ("duagc.pipeline.kernels._raster", "duagc.converters.simulate.render._flat_surfaces")
"""Modules that a source tree lacks before they are built."""
ROOM = ", expected room for the output"
FILES = ", expected more files to be open at the same time (ulimit -n)"
DISK = ", expected a file that can be read to its end: its disk or network is broken"
MEMORY = ", expected more memory (ulimit -v), or fewer --workers"
PROCESSES = ", expected more processes and threads (ulimit -u), or fewer --workers"
LIMITS = {
    errno.ENOSPC: ROOM,  # the disk, the user's share of it, a limit on files
    errno.EDQUOT: ROOM,
    errno.EFBIG: ROOM,
    errno.EMFILE: FILES,  # of this process, of the machine
    errno.ENFILE: FILES,
    errno.EIO: DISK,
    errno.ENOMEM: MEMORY,
    errno.EAGAIN: PROCESSES,
}
NO_MEMORY = ("failed to map segment", "cannot allocate memory")  # of the loader, for a library
NO_THREAD = "can't start new thread"
OPENCV_NO_MEMORY = -4


def line_of(error: BaseException) -> str | None:
    """One line about an error that a user can fix; None if it is a bug.

    Args:
        error: that ended a command.
    """
    if isinstance(error, ImportError):
        if any(words in str(error).lower() for words in NO_MEMORY):
            return f"{error}{MEMORY}"
        return str(error) if error.name in COMPILED else None
    if isinstance(error, OSError):
        expected = LIMITS.get(error.errno or 0, "")
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}{expected}" if expected or where else None
    if isinstance(error, MemoryError) or _is_memory_of_opencv(error):
        return f"{' '.join(str(error).split()) or 'out of memory'}{MEMORY}"
    if isinstance(error, RuntimeError) and NO_THREAD in str(error):
        return f"{error}{PROCESSES}"
    return None


def _is_memory_of_opencv(error: BaseException) -> bool:
    return type(error).__module__ == "cv2" and getattr(error, "code", None) == OPENCV_NO_MEMORY
