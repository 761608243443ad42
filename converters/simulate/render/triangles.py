"""A scene of boxes, cylinders and spheres as textured triangles, painted and lit once."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.render import bake, meshes
from duagc.converters.simulate.render.raycast import Caster
from duagc.converters.simulate.scenes.scene import Ball, Flat, Scene, Side, Surface
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.files import save_array

SIDES = 48  # of a cylinder, a disc and the equator of a sphere; no coarser than 3 mm at 0.7 m radius


def write(scene: Scene, texel_m: float, cache: Path) -> None:
    """Write a scene into a folder, to be read by `meshes.load`.

    Args:
        scene: the surfaces and lamps.
        texel_m: width of a texel of the texture, meters.
        cache: an empty folder.
    """
    vertices, coordinates, triangles, surface_of = _triangles(scene)
    atlas = bake.bake(scene, texel_m, Caster(unpainted(scene)).blocked)
    for k, level in enumerate(atlas.levels):
        save_array(cache / meshes.texture_file(0, k), level)
    texels = atlas.origin[surface_of][:, None] + coordinates[triangles] / texel_m
    arrays: dict[str, NDArray[np.generic]] = {
        "vertices": vertices,
        "triangles": triangles,
        "texels": texels.astype(np.float32),
        "texture_of": np.zeros(len(triangles), dtype=np.int32),
        "colors": np.zeros((len(vertices), 3), dtype=np.uint8),
    }
    for name, values in arrays.items():
        save_array(cache / f"{name}.npy", values)


def unpainted(scene: Scene) -> meshes.MeshScene:
    """The geometry alone, black.

    Args:
        scene: the surfaces.
    """
    vertices, _, triangles, _ = _triangles(scene)
    texels = np.zeros((len(triangles), 3, 2), dtype=np.float32)
    texture_of = np.full(len(triangles), meshes.NO_TEXTURE, dtype=np.int32)
    black = np.zeros((len(vertices), 3), dtype=np.uint8)
    return meshes.MeshScene(vertices, triangles, texels, texture_of, black, [])


def _triangles(scene: Scene) -> tuple[Array, Array, NDArray[np.int32], NDArray[np.int64]]:
    """Vertices [n, 3] (m), their surface coordinates [n, 2] (m), triangles [m, 3], and the surface of each [m]."""
    vertices, coordinates, triangles, surface_of = [], [], [], []
    first = 0
    for k, surface in enumerate(scene.surfaces):
        st, faces = _outline(surface)
        vertices.append(surface.points(st[:, 0], st[:, 1])[0])
        coordinates.append(st)
        triangles.append(faces + first)
        surface_of.append(np.full(len(faces), k))
        first += len(st)
    return (
        np.concatenate(vertices),
        np.concatenate(coordinates),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate(surface_of),
    )


def _outline(surface: Surface) -> tuple[Array, NDArray[np.int64]]:
    """Surface coordinates [n, 2] of a surface's vertices and its triangles [m, 3], counter-clockwise from its front."""
    if isinstance(surface, Side):
        return _grid(surface.size, SIDES, 1)
    if isinstance(surface, Ball):
        return _grid(surface.size, SIDES, SIDES // 2)
    assert isinstance(surface, Flat)
    if not surface.round:
        return _grid(surface.size, 1, 1)
    radius = surface.size[0] / 2
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    rim = radius + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    after = np.roll(np.arange(SIDES), -1)
    faces = np.stack([np.zeros(SIDES, dtype=np.int64), 1 + after, 1 + np.arange(SIDES)], axis=1)
    return np.concatenate([[(radius, radius)], rim]), faces


def _grid(size: tuple[float, float], columns: int, rows: int) -> tuple[Array, NDArray[np.int64]]:
    """A rectangle of surface coordinates cut into `columns` x `rows` pairs of triangles."""
    s, t = np.meshgrid(np.linspace(0, size[0], columns + 1), np.linspace(0, size[1], rows + 1))
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = a + columns + 1
    faces = np.concatenate([np.stack([a, below, below + 1], axis=1), np.stack([a, below + 1, a + 1], axis=1)])
    return np.stack([s.ravel(), t.ravel()], axis=1), faces
