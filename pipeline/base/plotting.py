"""matplotlib as it is on every machine, without settings of the user."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

FOLDER = "MPLCONFIGDIR"
BACKEND = "MPLBACKEND"


def matplotlib() -> ModuleType:
    """The library, with a folder for what it knows of fonts.

    Without one that it may write, every process would make one more in the temporary folder, and print lines about it.
    The environment may name a backend that the library does not know; it is left out, for figures need none.
    """
    if FOLDER not in os.environ and not _is_own(_usual_folder()):
        shared = Path(tempfile.gettempdir()) / f"duagc-matplotlib-{os.getuid()}"
        if _is_own(shared):
            os.environ[FOLDER] = str(shared)  # also of the processes that this one starts
    if "matplotlib" in sys.modules:
        return sys.modules["matplotlib"]
    backend = os.environ.pop(BACKEND, "")  # the import would fail for a name that it does not know
    try:
        import matplotlib as library
    finally:
        if backend:
            os.environ[BACKEND] = backend
    if backend:
        with suppress(ValueError):
            library.rcParams["backend"] = backend
    return library


@contextmanager
def style(settings: Mapping[str, Any]) -> Iterator[None]:
    """Draw with these settings and the library's own, whatever files of users and folders say.

    Args:
        settings: by their names in matplotlib.
    """
    library = matplotlib()
    with library.rc_context():
        library.rcdefaults()
        library.rcParams.update(settings)
        yield


def _usual_folder() -> Path:
    """Where matplotlib keeps what it knows, unless said otherwise."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path("~/.config").expanduser()) / "matplotlib"


def _is_own(folder: Path) -> bool:
    """Whether a folder is there, or could be made, belongs to this user and can be written."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK)
    except (OSError, RuntimeError):  # nobody has no home
        return False
