"""Versions of installed libraries, by the names of their modules."""

from __future__ import annotations

import sys
from importlib import metadata
from importlib.util import find_spec

PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "google": "protobuf",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "rerun": "rerun-sdk",
    "open3d": "open3d-cpu",
}
"""Distributions of the modules that are not named as they are."""


def library_version(library: str) -> str:
    """Version of an installed library; "" if it is not installed.

    Args:
        library: name of its module. It may be of another distribution than is usual, which then is named, or of none.
    """
    try:
        return metadata.version(DISTRIBUTIONS.get(library, library))
    except metadata.PackageNotFoundError:
        if find_spec(library) is None:
            return ""
    names = sorted(set(metadata.packages_distributions().get(library, ())))
    return ", ".join(f"{name} {metadata.version(name)}" for name in names) or "unknown"
