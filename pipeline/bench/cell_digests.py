"""What a cell of `duagc bench robustness` is made from, as digests: code, and meshes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from duagc.converters.simulate.render import mesh_process, meshes
from duagc.converters.simulate.scenes.catalog import SCENES
from duagc.pipeline.base.files import digest_of_bytes
from duagc.pipeline.base.library_versions import PYTHON, library_version

LIBRARIES = (
    "cryptography",
    "cv2",
    "google",
    "mcap",
    "numpy",
    "open3d",
    "pyarrow",
    "pydantic",
    "scipy",
    "small_gicp",
    "torch",
)
"""Modules of libraries that the simulator and the stages up to the evaluation import."""


def code_digest() -> str:
    """Digest of all code that a cell runs through, and of the versions of the libraries that it imports."""
    from duagc import converters, pipeline, schemas

    digest = hashlib.sha256(json.dumps(library_versions()).encode())
    for package in (converters, pipeline, schemas):
        root = Path(next(iter(package.__path__)))
        for path in _files(root, (".py", ".so", ".binpb")):
            digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def library_versions() -> dict[str, str]:
    """Versions of the libraries, by module, and that of Python."""
    return {"python": PYTHON} | {name: library_version(name) for name in LIBRARIES}


def mesh_digest(scene: str) -> dict[str, str]:
    """Digest of the meshes of a scene and of what they may refer to, by name; empty for a scene without a folder.

    Args:
        scene: as of `duagc simulate`.
    """
    folder = Path(scene)
    if scene in SCENES or not folder.is_dir():
        return {}
    digest = hashlib.sha256()
    for path in _files(folder, (*meshes.UP_OF_SUFFIX, *mesh_process.OTHERS)):
        digest.update(f"{path.relative_to(folder).as_posix()}\0{digest_of_bytes(path)}\n".encode())
    return {"meshes": digest.hexdigest()}


def _files(root: Path, suffixes: Iterable[str]) -> list[Path]:
    """Files below a folder that end so, in order."""
    wanted = set(suffixes)
    return sorted(path for path in root.rglob("*") if path.suffix.lower() in wanted and path.is_file())
