"""Reads meshes into plain arrays, in a process of its own that `duagc.converters.simulate.render.mesh_process` starts.

The C++ libraries behind Open3D crash on some damaged meshes, wait at pipes, and unpack a small texture to any size.
Here they have limits of memory and of processor time, which grow with the file, and the process ends with its parent.
"""

import fcntl
import io
import json
import os
import re
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import save_array
from duagc.pipeline.base.open3d_import import import_open3d

LEVELS = 6
NO_TEXTURE = -1
WHITE = 255
MAX_VERTICES = 2**31 - 1
LINUX = sys.platform == "linux"  # elsewhere, address space is not limited
MAX_PIXELS = 1 << 26  # of a texture, as of any image here
MAX_SIDE = 32766  # pixels of a texture: OpenCV looks nothing up in larger ones
MAX_EXTENT_M = 400.0  # in each direction; robots walk on a grid of 0.2 m

NOT_READ = ("failed for file", "Unsupported", "undecodable", "I/O error", "unknown file signature")
HARMLESS = re.compile(
    r"[a-z]\w{3}: |.*extraneous bytes"
)  # PNG chunks that say how, not what; bytes between others

MEMORY_BYTES, MEMORY_PER_BYTE = (
    1 << 30,
    32,
)  # for a file, and more for each byte of it; a JPEG unpacks to 10 or 20
CPU_S, BYTES_PER_S = 8, 2_000_000  # for a file, and more for a large one


def main() -> None:
    """Do the job on standard input, one line of JSON, and tell in such lines, on the file that it names, how it goes.

    The job: `tell` (a file descriptor), `files` (pairs of a path and of the bytes that belong to it), `up`, `cache`.
    Answers: {} after each file and at the end, or "error" with a line for the user, or "bug" with a traceback.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to handle
    job = json.loads(sys.stdin.readline())
    _end_with_parent()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with open(job["tell"], "w") as tell:

        def say(**words: str) -> None:
            tell.write(json.dumps(words) + "\n")
            tell.flush()

        try:
            for _ in _read(
                [(Path(name), size) for name, size in job["files"]], job["up"], Path(job["cache"])
            ):
                say()
        except DuagError as error:
            say(error=str(error))
        except Exception:
            say(bug=traceback.format_exc())
        else:
            say()


def _end_with_parent() -> None:
    """Standard input is a pipe that only the parent holds: its end raises a signal that ends the process.

    A thread that waits for it would not do: C++ code may keep the interpreter's lock.
    """
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([0], [], [], 0)[0]:  # it has ended before that
        sys.exit(1)


def _read(files: list[tuple[Path, int]], up: str, cache: Path) -> Iterator[Path]:
    """Read meshes and write them into `cache` as one scene; yields each file when it is read."""
    import_open3d()  # before the limits
    folder = files[0][0].parent
    parts: list[_Part] = []
    textures = 0
    for path, size in files:
        most = _limit(size)
        try:
            for part, image in _parts(path):
                if image is not None:
                    _store_texture(cache, textures, image)
                    part = replace(part, texture=textures)
                    textures += 1
                parts.append(part)
        except UnicodeDecodeError as error:
            raise DuagError(
                f"{path}: its reader finds a name that is no UTF-8, expected a sound mesh"
            ) from error
        except MemoryError as error:
            raise DuagError(
                f"{path}: takes more than {most / 1e6:.0f} MB of memory to read, expected a sound mesh with textures "
                f"of at most {MAX_PIXELS} pixels"
            ) from error
        yield path
    _limit(None)
    if sum(len(part.triangles) for part in parts) == 0:
        raise DuagError(f"{folder}: found no triangle, expected meshes")
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    if starts[-1] > MAX_VERTICES:
        raise DuagError(f"{folder}: found {starts[-1]} vertices, expected at most {MAX_VERTICES}")
    vertices = np.concatenate([part.vertices for part in parts])
    _check_extent(folder, "the scene", vertices)
    if up == "y":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    arrays = {
        "vertices": vertices,
        "triangles": np.concatenate([p.triangles + s for p, s in zip(parts, starts[:-1], strict=True)]),
        "texels": np.concatenate([p.texels for p in parts]),
        "texture_of": np.concatenate([np.full(len(p.triangles), p.texture) for p in parts]),
        "colors": np.concatenate([p.colors for p in parts]),
    }
    kinds = {"triangles": np.int32, "texels": np.float32, "texture_of": np.int32, "colors": np.uint8}
    for name, values in arrays.items():
        save_array(cache / f"{name}.npy", values.astype(kinds.get(name, np.float64)))


def _limit(size: int | None) -> int:
    """Limits for reading the next file of so many bytes, None for no file; returns the bytes of memory."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() if LINUX else 0
    memory = MEMORY_BYTES + MEMORY_PER_BYTE * (size or 0)
    seconds = CPU_S + (size or 0) // BYTES_PER_S
    for kind, most in (
        (resource.RLIMIT_AS, used + memory if LINUX else resource.RLIM_INFINITY),
        (resource.RLIMIT_CPU, int(time.process_time()) + 1 + seconds),
    ):
        _, hard = resource.getrlimit(kind)
        soft = hard if size is None else most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (soft, hard))
    return memory


@dataclass(frozen=True)
class _Part:
    """A part of a file with one texture or none; as in `MeshScene`, in the axes of the file."""

    vertices: Array
    triangles: NDArray[np.int32]
    texels: NDArray[np.float32]
    texture: int
    colors: NDArray[np.uint8]


def _parts(path: Path) -> Iterator[tuple[_Part, NDArray[np.uint8] | None]]:
    """The parts of a file, each with its texture, uint8 [h, w, 3], if it has one."""
    o3d = import_open3d()
    materials: list[Any] = []
    complaints = _Complaints()
    try:
        if path.suffix.lower() == ".ply":  # the reader of models knows no PLY, the other one few textures
            meshes = [(o3d.io.read_triangle_mesh(path), -1, "the mesh")]
        else:
            model = o3d.io.read_triangle_model(path)
            meshes = [(part.mesh, part.material_idx, f"part {part.mesh_name!r}") for part in model.meshes]
            materials = model.materials
    except RuntimeError as error:
        raise DuagError(f"{path}: {str(error).splitlines()[0]}, expected a mesh") from error
    meshes = [each for each in meshes if len(each[0].triangles)]
    if not meshes:
        raise DuagError(f"{path}: found no triangle, or a file that cannot be read; expected a mesh")
    images = [_texture(path, materials, index) for _, index, _ in meshes]
    complaints.check(path, any(image is None for image in images))
    painted = any(image is not None for image in images) or any(m.has_vertex_colors() for m, _, _ in meshes)
    for (mesh, index, name), image in zip(meshes, images, strict=True):
        flat = _flat_color(path, materials, index) if painted else None
        yield _part(path, name, mesh, image, flat=flat), image


class _Complaints:
    """What libraries have written since this was made: nothing else reports a texture that is torn or missing."""

    def __init__(self) -> None:
        sys.stdout = self.open3d = io.StringIO()
        self.others = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115  ends with this object
        os.dup2(self.others.fileno(), 2)

    def check(self, path: Path, unpainted: bool) -> None:
        """Raises DuagError for a texture that was not read whole.

        Args:
            path: of the mesh, for messages.
            unpainted: a part has no texture; if all have, one that was not read is of a kind that is not
                used.
        """
        self.others.seek(0)
        for line in [*self.open3d.getvalue().splitlines(), *self.others.read().splitlines()]:
            text = re.sub(r"\x1b\[[\d;]*m|\[Open3D WARNING\]", "", line).strip()
            unused = not unpainted and any(words in text for words in NOT_READ)
            if text and not unused and not HARMLESS.match(text):
                raise DuagError(f"{path}: its reader says {text!r}, expected a sound mesh and sound textures")


def _check_extent(path: Path, name: str, vertices: Array) -> None:
    extent = np.ptp(vertices, axis=0) if len(vertices) else np.zeros(3)
    if extent.max() > MAX_EXTENT_M:
        size = " x ".join(f"{x:.4g}" for x in extent)
        raise DuagError(
            f"{path}: {name} is {size} m large, expected at most {MAX_EXTENT_M:.0f} m; is it in meters?"
        )


def _texture(path: Path, materials: Any, index: int) -> NDArray[np.uint8] | None:
    """The base color texture of a material, uint8 [h, w, 3], or None."""
    if not 0 <= index < len(materials) or materials[index].albedo_img is None:
        return None
    image = np.asarray(materials[index].albedo_img)
    if image.size == 0:
        return None
    height, width = image.shape[:2]
    if height * width > MAX_PIXELS:
        raise DuagError(f"{path}: has a texture of {width} x {height} pixels, expected at most {MAX_PIXELS}")
    if max(height, width) > MAX_SIDE:
        raise DuagError(
            f"{path}: has a texture of {width} x {height} pixels, expected sides of at most {MAX_SIDE}"
        )
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[2] < 3:
        image = np.repeat(image[..., :1], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def _flat_color(path: Path, materials: list[Any], index: int) -> NDArray[np.uint8] | None:
    """The one color of a material, uint8 [3]; for parts without texture among others that have one."""
    if not 0 <= index < len(materials):
        return None
    color = np.clip(np.asarray(materials[index].base_color, dtype=np.float64)[:3], 0, 1)
    if path.suffix.lower() in (".glb", ".gltf"):  # linear there, everything else here is sRGB
        color = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    return np.rint(255 * color).astype(np.uint8)


def _part(
    path: Path, name: str, mesh: Any, image: NDArray[np.uint8] | None, *, flat: NDArray[np.uint8] | None
) -> _Part:
    """A part as arrays; `flat` is its color if it has neither a texture nor colors of its vertices."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    triangles = np.asarray(mesh.triangles, dtype=np.int32)
    if not np.isfinite(vertices).all():
        raise DuagError(f"{path}: {name} has vertices that are not finite, expected meters")
    _check_extent(path, name, vertices)
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise DuagError(
            f"{path}: {name} has triangles of vertices {triangles.min()} to {triangles.max()}, "
            f"expected 0 to {len(vertices) - 1}"
        )
    texels = np.zeros((len(triangles), 3, 2), dtype=np.float32)
    colors = np.full(vertices.shape, WHITE, dtype=np.uint8)
    if image is not None:
        uvs = np.asarray(mesh.triangle_uvs)
        if len(uvs) != 3 * len(triangles):
            raise DuagError(
                f"{path}: {name} has a texture and {len(uvs)} texture coordinates, expected {3 * len(triangles)}"
            )
        height, width = image.shape[:2]
        u, v = uvs.reshape(-1, 3, 2).transpose(2, 0, 1)
        texels = np.stack([u * width - 0.5, (1 - v) * height - 0.5], axis=-1).astype(np.float32)
        if not np.isfinite(texels).all():
            raise DuagError(f"{path}: {name} has texture coordinates that are not finite, expected 0 to 1")
    elif mesh.has_vertex_colors():
        colors = np.clip(np.rint(255 * np.asarray(mesh.vertex_colors)), 0, 255).astype(np.uint8)
    elif flat is not None:
        colors[:] = flat
    else:
        raise DuagError(f"{path}: {name} has neither a texture nor colors of its vertices, expected one")
    return _Part(vertices, triangles, texels, NO_TEXTURE, colors)


def texture_file(texture: int, level: int) -> str:
    """Name of the file with one mip level of a texture.

    Args:
        texture: its index.
        level: of the mip levels; 0: the finest.
    """
    return f"texture-{texture}-{level}.npy"


def _store_texture(cache: Path, texture: int, image: NDArray[np.uint8]) -> None:
    """Write a texture and its mip levels, each the mean of 2 x 2 texels of the one before."""
    level = image
    for k in range(LEVELS):
        save_array(cache / texture_file(texture, k), level)
        height, width = level.shape[:2]
        if min(height, width) < 2:
            return
        level = np.asarray(
            cv2.resize(level, (width // 2, height // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )


if __name__ == "__main__":
    main()
