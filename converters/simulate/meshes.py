"""Textured meshes from a folder, put together into one scene.

Every GLB, glTF, OBJ and PLY file of the folder is a part of the scene, in coordinates that all of them share. The
world of the recording is x east, y north, z up; a file that is y up is turned about x. Colours come from the base
colour texture of a part, or from the colours of its vertices; lamps, gloss and transparency are ignored, and both
sides of a triangle look the same.
"""

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import DuagError
from pipeline.progress import track

Array = NDArray[np.float64]

UP_OF_SUFFIX = {".glb": "y", ".gltf": "y", ".obj": "y", ".ply": "z"}  # glTF says so, the others by custom
UPS = ("auto", "y", "z")
LEVELS = 6
NO_TEXTURE = -1
WHITE = 255
ARRAYS = ("vertices", "triangles", "texels", "texture_of", "colors")
MAX_VERTICES = 2**31 - 1


@dataclass(frozen=True)
class MeshScene:
    """A scene of n vertices and m triangles.

    vertices: float64 [n, 3], m, world. triangles: int32 [m, 3]. texels: float32 [m, 3, 2], where the corners of a
    triangle lie in its texture (x right, y down; the centre of the first texel is 0). texture_of: int32 [m], index
    into `textures`, or NO_TEXTURE for the colours of the vertices. colors: uint8 [n, 3] RGB. textures: per texture
    its mip levels, uint8 [h, w, 3] RGB each, the finest first.
    """

    vertices: Array
    triangles: NDArray[np.int32]
    texels: NDArray[np.float32]
    texture_of: NDArray[np.int32]
    colors: NDArray[np.uint8]
    textures: list[list[NDArray[np.uint8]]]

    @property
    def corners(self) -> Array:
        """Corners of the triangles, [m, 3, 3]."""
        return np.asarray(self.vertices[self.triangles])

    def areas(self) -> Array:
        """Areas of the triangles, m^2, [m]."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))

    def sample(
        self, triangle: NDArray[np.integer], weights: NDArray[np.float32], level: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Colours [k, 3], 0 to 255, of points on triangles.

        Args:
            triangle: [k]. weights: of the second and the third corner, [k, 2].
            level: mip level, [k], between 0 (finest) and LEVELS - 1; in between, both levels are blended.
        """
        colors = np.empty((len(triangle), 3), dtype=np.float32)
        of = self.texture_of[triangle]
        plain = np.flatnonzero(of == NO_TEXTURE)
        if plain.size:
            corners = self.colors[self.triangles[triangle[plain]]].astype(np.float32)
            colors[plain] = _between(corners, weights[plain])
        if plain.size == len(triangle):
            return colors
        whole = np.minimum(level, LEVELS - 1.001).astype(np.int32)
        place = np.where(of == NO_TEXTURE, -1, of * LEVELS + whole).astype(np.int16)
        order = np.argsort(place, kind="stable")
        values, first = np.unique(place[order], return_index=True)
        for value, some in zip(values.tolist(), np.split(order, first[1:]), strict=True):
            if value >= 0:
                texture, k = divmod(value, LEVELS)
                xy = _between(self.texels[triangle[some]], weights[some])
                colors[some] = _blended(self.textures[texture], k, level[some] - k, xy)
        return colors


def _between(corners: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values [k, c] inside triangles from those at their corners [k, 3, c] and the weights [k, 2] of the last two."""
    first = corners[:, 0]
    return np.asarray(
        first + weights[:, :1] * (corners[:, 1] - first) + weights[:, 1:] * (corners[:, 2] - first),
        dtype=np.float32,
    )


def _blended(
    levels: list[NDArray[np.uint8]], k: int, share: NDArray[np.float32], xy: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Colours [n, 3] between level k and, by `share` [n], the next one, at texels xy [n, 2] of the finest."""
    fine = _bilinear(levels, min(k, len(levels) - 1), xy)
    if k + 1 >= len(levels) or not share.any():
        return fine
    return fine + share[:, None] * (_bilinear(levels, k + 1, xy) - fine)


def _bilinear(levels: list[NDArray[np.uint8]], k: int, xy: NDArray[np.float32]) -> NDArray[np.float32]:
    """Colours [n, 3] between the texels of level k; a texture goes on periodically beyond its border."""
    row = 1024  # OpenCV wants images no larger than 32767 pixels
    n = len(xy)
    maps = np.zeros((2, -(-n // row) * row), dtype=np.float32)
    for axis in range(2):
        scale = np.float32(levels[k].shape[1 - axis] / levels[0].shape[1 - axis])
        maps[axis, :n] = (xy[:, axis] + np.float32(0.5)) * scale - np.float32(0.5)
    mx, my = maps.reshape(2, -1, row)
    colors = cv2.remap(levels[k], mx, my, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(colors, dtype=np.float32).reshape(-1, 3)[:n]


def mesh_files(folder: Path) -> list[Path]:
    """The mesh files of a folder by name.

    Raises:
        DuagError: there is no such folder, or no mesh in it.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise DuagError(f"{folder}: found {found}, expected a folder of meshes ({_suffixes()})")
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in UP_OF_SUFFIX)
    except OSError as error:
        raise DuagError(f"{folder}: {error.strerror or error}, expected a folder of meshes") from error
    if not files:
        raise DuagError(f"{folder}: found no mesh, expected files {_suffixes()}")
    return files


def _suffixes() -> str:
    return ", ".join(UP_OF_SUFFIX)


def digests(files: list[Path]) -> dict[str, str]:
    """SHA-256 of every file by its name."""
    try:
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    except OSError as error:
        raise DuagError(f"{error.filename}: {error.strerror or error}, expected a mesh") from error


def up_axis(files: list[Path], up: str) -> str:
    """ "y" or "z": what was asked for, or the custom of the format.

    Raises:
        DuagError: the files are of formats with different customs.
    """
    if up not in UPS:
        raise DuagError(f"simulate: up is {up!r}, expected one of {', '.join(UPS)}")
    if up != "auto":
        return up
    customs = {UP_OF_SUFFIX[path.suffix.lower()]: path.name for path in files}
    if len(customs) > 1:
        raise DuagError(
            f"{files[0].parent}: {customs['y']} is y up by custom and {customs['z']} is z up, expected one; "
            "give --up y or --up z"
        )
    return next(iter(customs))


def read(folder: Path, up: str, cache: Path) -> MeshScene:
    """Read all meshes of a folder.

    Args:
        folder: of the meshes.
        up: the axis that is up in the files, "y" or "z".
        cache: an empty folder; everything is written there and read back when needed, so that processes share it.
    Raises:
        DuagError: no folder, no mesh, a file that cannot be read, or one with neither texture nor colours.
    """
    files = mesh_files(folder)
    parts: list[_Part] = []
    textures = 0
    for path in track(files, "read meshes"):
        for part, image in _parts(path):
            if image is not None:
                _store_texture(cache, textures, image)
                part = _Part(part.vertices, part.triangles, part.texels, textures, part.colors)
                textures += 1
            parts.append(part)
    if sum(len(part.triangles) for part in parts) == 0:
        raise DuagError(f"{folder}: found no triangle, expected meshes")
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    if starts[-1] > MAX_VERTICES:
        raise DuagError(f"{folder}: found {starts[-1]} vertices, expected at most {MAX_VERTICES}")
    vertices = np.concatenate([part.vertices for part in parts])
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
        np.save(cache / f"{name}.npy", values.astype(kinds.get(name, np.float64)))
    return load(cache)


def load(cache: Path) -> MeshScene:
    """The scene that `read` has written into a folder, mapped into memory."""
    arrays = {name: np.asarray(np.load(cache / f"{name}.npy", mmap_mode="r")) for name in ARRAYS}
    textures: list[list[NDArray[np.uint8]]] = []
    while (cache / texture_file(len(textures), 0)).exists():
        files = [cache / texture_file(len(textures), k) for k in range(LEVELS)]
        textures.append([np.asarray(np.load(path, mmap_mode="r")) for path in files if path.exists()])
    return MeshScene(**arrays, textures=textures)


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
    import open3d as o3d

    materials: list[Any] = []
    try:
        with _silence():
            if path.suffix.lower() == ".ply":  # the reader of models knows no PLY, the other one few textures
                meshes = [(o3d.io.read_triangle_mesh(path), -1, "the mesh")]
            else:
                model = o3d.io.read_triangle_model(path)  # type: ignore[arg-type]
                meshes = [(part.mesh, part.material_idx, f"part {part.mesh_name!r}") for part in model.meshes]
                materials = model.materials
    except RuntimeError as error:
        raise DuagError(f"{path}: {str(error).splitlines()[0]}, expected a mesh") from error
    meshes = [each for each in meshes if len(each[0].triangles)]
    if not meshes:
        raise DuagError(f"{path}: found no triangle, or a file that cannot be read; expected a mesh")
    images = [_texture(materials, index) for _, index, _ in meshes]
    painted = any(image is not None for image in images) or any(m.has_vertex_colors() for m, _, _ in meshes)
    for (mesh, index, name), image in zip(meshes, images, strict=True):
        flat = _flat_color(path, materials, index) if painted else None
        yield _part(path, name, mesh, image, flat), image


@contextmanager
def _silence() -> Iterator[None]:
    """Keep the words of C libraries from standard error: what is wrong with a file is said in one line."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _texture(materials: Any, index: int) -> NDArray[np.uint8] | None:
    """The base colour texture of a material, uint8 [h, w, 3], or None."""
    if not 0 <= index < len(materials) or materials[index].albedo_img is None:
        return None
    image = np.asarray(materials[index].albedo_img)
    if image.size == 0:
        return None
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[2] < 3:
        image = np.repeat(image[..., :1], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def _flat_color(path: Path, materials: list[Any], index: int) -> NDArray[np.uint8] | None:
    """The one colour of a material, uint8 [3]; for parts without texture beside others that have one."""
    if not 0 <= index < len(materials):
        return None
    color = np.clip(np.asarray(materials[index].base_color, dtype=np.float64)[:3], 0, 1)
    if path.suffix.lower() in (".glb", ".gltf"):  # linear there, everything else here is sRGB
        color = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    return np.rint(255 * color).astype(np.uint8)


def _part(
    path: Path, name: str, mesh: Any, image: NDArray[np.uint8] | None, flat: NDArray[np.uint8] | None
) -> _Part:
    """A part as arrays; `flat` is its colour if it has neither a texture nor colours of its vertices."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    triangles = np.asarray(mesh.triangles, dtype=np.int32)
    if not np.isfinite(vertices).all():
        raise DuagError(f"{path}: {name} has vertices that are not finite, expected metres")
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
        raise DuagError(f"{path}: {name} has neither a texture nor colours of its vertices, expected one")
    return _Part(vertices, triangles, texels, NO_TEXTURE, colors)


def texture_file(texture: int, level: int) -> str:
    """Name of the file with one mip level of a texture."""
    return f"texture-{texture}-{level}.npy"


def _store_texture(cache: Path, texture: int, image: NDArray[np.uint8]) -> None:
    """Write a texture and its mip levels, each the mean of 2 x 2 texels of the one before."""
    level = image
    for k in range(LEVELS):
        np.save(cache / texture_file(texture, k), level)
        height, width = level.shape[:2]
        if min(height, width) < 2:
            return
        level = np.asarray(
            cv2.resize(level, (width // 2, height // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )


def surface_points(
    scene: MeshScene, areas: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """`count` points spread evenly over the triangles: points (m), unit normals, colours, [n, 3] each.

    A normal points to the side from which the corners run counter-clockwise.
    """
    share = np.cumsum(areas) / areas.sum()
    triangle = np.searchsorted(share, (np.arange(count) + rng.random(count)) / count).clip(0, len(areas) - 1)
    triangle = triangle[areas[triangle] > 0]
    fold = rng.random((len(triangle), 2))
    weights = np.where(fold.sum(axis=1, keepdims=True) > 1, 1 - fold, fold)
    a, b, c = np.moveaxis(scene.vertices[scene.triangles[triangle]], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)
    colors = scene.sample(triangle, weights.astype(np.float32), np.zeros(len(triangle), dtype=np.float32))
    return points, normals, np.clip(np.rint(colors), 0, 255).astype(np.uint8)
