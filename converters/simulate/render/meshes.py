"""Textured meshes from a folder, put together into one scene.

Every GLB, glTF, OBJ and PLY file of the folder is a part of the scene, in coordinates that all of them share. The
world of the recording is x east, y north, z up; a file that is y up is turned about x. Colors come from the base
color texture of a part, or from the colors of its vertices; lamps, gloss and transparency are ignored, and both
sides of a triangle look the same.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.mesh_reader import LEVELS, NO_TEXTURE, texture_file
from duagc.converters.simulate.render import mesh_process
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file, digest_of_bytes

UP_OF_SUFFIX = {".glb": "y", ".gltf": "y", ".obj": "y", ".ply": "z"}  # glTF says so, the others by custom
UPS = ("auto", "y", "z")
ARRAYS = ("vertices", "triangles", "texels", "texture_of", "colors")


@dataclass(frozen=True)
class MeshScene:
    """A scene of n vertices and m triangles.

    Attributes:
        vertices: float64 [n, 3], m, world.
        triangles: int32 [m, 3].
        texels: float32 [m, 3, 2], where the corners of a triangle lie in its texture (x right, y down; the
            center of the first texel is 0).
        texture_of: int32 [m], index into `textures`, or NO_TEXTURE for the colors of the vertices.
        colors: uint8 [n, 3] RGB.
        textures: per texture its mip levels, uint8 [h, w, 3] RGB each, the finest first.
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
        """Colors [k, 3], 0 to 255, of points on triangles.

        Args:
            triangle: [k].
            weights: of the second and the third corner, [k, 2].
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
        few = len(self.textures) * LEVELS <= np.iinfo(np.int16).max  # 16 bits are sorted faster
        place = np.where(of == NO_TEXTURE, -1, of * LEVELS + whole).astype(np.int16 if few else np.int32)
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
    """Colors [n, 3] between level k and, by `share` [n], the next one, at texels xy [n, 2] of the finest."""
    fine = _bilinear(levels, min(k, len(levels) - 1), xy)
    if k + 1 >= len(levels) or not share.any():
        return fine
    return fine + share[:, None] * (_bilinear(levels, k + 1, xy) - fine)


def _bilinear(levels: list[NDArray[np.uint8]], k: int, xy: NDArray[np.float32]) -> NDArray[np.float32]:
    """Colors [n, 3] between the texels of level k; a texture goes on periodically beyond its border."""
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

    Args:
        folder: with GLB, glTF, OBJ or PLY files.

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
    for path in files:
        check_file(path, "a mesh")
    return files


def _suffixes() -> str:
    return ", ".join(UP_OF_SUFFIX)


def digests(files: list[Path]) -> dict[str, str]:
    """SHA-256 of every file by its name.

    Args:
        files: paths of the meshes.

    Raises:
        DuagError: a file cannot be read.
    """
    try:
        return {path.name: digest_of_bytes(path) for path in files}
    except OSError as error:
        raise DuagError(f"{error.filename}: {error.strerror or error}, expected a mesh") from error


def check_up(up: str) -> None:
    """Refuse an axis that cannot be up.

    Args:
        up: as it was asked for.

    Raises:
        DuagError: it is none of UPS.
    """
    if up not in UPS:
        raise DuagError(f"simulate: up is {up!r}, expected one of {', '.join(UPS)}")


def up_axis(files: list[Path], up: str) -> str:
    """ "y" or "z": what was asked for, or the custom of the format.

    Args:
        files: paths of the meshes.
        up: "y", "z" or "auto": by the custom of the format.

    Raises:
        DuagError: the files are of formats with different customs.
    """
    check_up(up)
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
        cache: an empty folder; everything is written there and read back when needed, so that processes share
            it.
    Raises:
        DuagError: no folder, no mesh, a file that cannot be read, or one with neither texture nor colors.
    """
    mesh_process.read(mesh_files(folder), up, cache)
    return load(cache)


def load(cache: Path) -> MeshScene:
    """The scene that `read` has written into a folder, mapped into memory.

    Args:
        cache: the folder.
    """
    arrays = {name: np.asarray(np.load(cache / f"{name}.npy", mmap_mode="r")) for name in ARRAYS}
    textures: list[list[NDArray[np.uint8]]] = []
    while (cache / texture_file(len(textures), 0)).exists():
        files = [cache / texture_file(len(textures), k) for k in range(LEVELS)]
        textures.append([np.asarray(np.load(path, mmap_mode="r")) for path in files if path.exists()])
    return MeshScene(**arrays, textures=textures)


def surface_points(
    scene: MeshScene, areas: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Points spread evenly over the triangles: points (m, world), unit normals, colors (RGB), [n, 3] each.

    A normal points to the side from which the corners run counter-clockwise.

    Args:
        scene: the triangles and their textures.
        areas: of the triangles, [m], square meters.
        count: how many points; those that fall on triangles without area are left out.
        rng: source of the positions.
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
