"""Open3D on machines without the system libraries of windows and USB cameras.

Its wheels link them, and do not start without them; nothing here opens a window or a camera. In the place of one that
is not installed comes a stand-in, a library of the same name whose functions stop the process (`stand_ins/`).
"""

import ctypes
import importlib
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from duagc.pipeline.base.errors import DuagError

STAND_INS = Path(__file__).parent / "stand_ins"
PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
_WEB_VIEWER = "open3d.visualization.draw_plotly"
_WEB_VIEWER_FUNCTIONS = ("draw_plotly", "draw_plotly_server", "get_plotly_fig")
_NOT_FOUND = re.compile(r"(\S+): cannot open shared object file")

_kept: dict[str, ctypes.CDLL] = {}  # the linker takes a library of that name that is loaded already


def import_open3d() -> Any:
    """Import Open3D.

    Returns:
        The module `open3d`.
    Raises:
        DuagError: it is not installed, or lacks a library that has no stand-in.
        KeyboardInterrupt: the user stopped it.
    """
    while True:  # each time, the linker names one library that it lacks
        try:
            with _web_viewer_by_need():
                return _imported()
        except ImportError as error:
            if _is_interrupt(error):
                raise KeyboardInterrupt from error
            missing = _NOT_FOUND.match(str(error))
            if missing is None or not _load_stand_in(missing[1]):
                raise DuagError(_advice(str(error))) from error


def _imported() -> Any:
    import open3d  # a statement, which says that results depend on its version

    return open3d


@contextmanager
def _web_viewer_by_need() -> Iterator[None]:
    """Let Open3D import its viewer in a browser when that is called first.

    Dash and plotly, which only that viewer needs, take longer to import than all the rest, in every process.
    """
    if "open3d" in sys.modules:
        yield
        return
    viewer = ModuleType(_WEB_VIEWER)

    def imported_by_need(name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            if sys.modules.get(_WEB_VIEWER) is viewer:
                del sys.modules[_WEB_VIEWER]
            return getattr(importlib.import_module(_WEB_VIEWER), name)(*arguments, **named)

        return call

    for name in _WEB_VIEWER_FUNCTIONS:
        setattr(viewer, name, imported_by_need(name))
    sys.modules[_WEB_VIEWER] = viewer
    try:
        yield
    except BaseException:
        sys.modules.pop(_WEB_VIEWER, None)
        raise


def _load_stand_in(library: str) -> bool:
    """Load the stand-in of a library that is not installed; False if there is none, or it did not help."""
    path = STAND_INS / f"{library.partition('.so')[0]}.so"
    if library in _kept or not path.exists():
        return False
    _kept[library] = ctypes.CDLL(str(path))
    return True


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is what an import failed of: a compiled module says only that its initialization failed."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _advice(complaint: str) -> str:
    """The line for what an import said."""
    missing = _NOT_FOUND.match(complaint)
    lacking = [missing[1]] if missing else list(_kept)
    if not lacking:
        return f"open3d: {complaint}, expected what `pip install duagc` installs"
    found = f"{lacking[0]} not found" if missing else complaint
    packages = " ".join(PACKAGES[library] for library in lacking if library in PACKAGES)
    advice = f"on Debian: apt-get install {packages}" if packages else "expected it installed"
    return f"open3d: {found}; {advice}"
