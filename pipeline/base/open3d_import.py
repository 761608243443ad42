"""Open3D on machines without the system libraries of windows and USB cameras.

Its wheels link them, and do not start without them; nothing here opens a window or a camera. In the place of one that
is not installed comes a stand-in, a library of the same name whose functions stop the process (`stand_ins/`).
"""

import ctypes
import importlib
import re
from pathlib import Path
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
_NOT_FOUND = re.compile(r"(\S+): cannot open shared object file")

_kept: dict[str, ctypes.CDLL] = {}  # the linker takes a library of that name that is loaded already


def import_open3d() -> Any:
    """Import Open3D.

    Returns:
        The module `open3d`.
    Raises:
        DuagError: it is not installed, or lacks a library that has no stand-in.
    """
    while True:  # each time, the linker names one library that it lacks
        try:
            return importlib.import_module("open3d")
        except ImportError as error:
            missing = _NOT_FOUND.match(str(error))
            if missing is None or not _load_stand_in(missing[1]):
                raise DuagError(_advice(str(error))) from error


def _load_stand_in(library: str) -> bool:
    """Load the stand-in of a library that is not installed; False if there is none, or it did not help."""
    path = STAND_INS / f"{library.partition('.so')[0]}.so"
    if library in _kept or not path.exists():
        return False
    _kept[library] = ctypes.CDLL(str(path))
    return True


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
