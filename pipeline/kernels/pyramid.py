"""Image pyramids and surface normals: compiled kernels behind checked numpy arrays.

`registration.definition` defines what they compute, to the bit, on every instruction set.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import floats_of
from duagc.pipeline.kernels.outputs import NOTHING

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
_NO_MASK = np.zeros(0, dtype=np.uint8)


def _empty(*shape: int) -> Image:
    return np.empty(shape, dtype=np.float32)


def gray_of_color(color: NDArray[Any], *, isa: str = "auto") -> Image:
    """Gray values [h, w] of a color image.

    Args:
        color: [h, w, 3], RGB, uint8 0..255 or float 0..1.
        isa: instruction set, as of `Rasterizer`.
    """
    if color.ndim != 3 or color.shape[2] != 3:
        raise ValueError(f"color has shape {color.shape}, expected (h, w, 3)")
    gray = _empty(*color.shape[:2])
    if color.dtype == np.uint8:
        _raster.gray_of_bytes(isa, np.ascontiguousarray(color), gray)
    else:
        _raster.gray_of_floats(isa, np.ascontiguousarray(color, dtype=np.float32), gray)
    return gray


def inverse_depth_of(
    depth_m: NDArray[Any], mask: Mask | None = None, sigma_m: NDArray[Any] | None = None, *, isa: str = "auto"
) -> tuple[Image, Image | None]:
    """Inverse depth [h, w], 1/m, 0 where the depth is unknown or may not be used; and sigma there.

    Args:
        depth_m: [h, w], meters; 0, negative or not finite means unknown.
        mask: bool [h, w], pixels that may be used; None: all.
        sigma_m: [h, w], meters; None: not known.
        isa: instruction set, as of `Rasterizer`.
    """
    depths = np.ascontiguousarray(depth_m, dtype=np.float32)
    inverse = _empty(*depths.shape)
    sigma = NOTHING if sigma_m is None else floats_of("sigma_m", sigma_m, depths.shape)
    known = NOTHING if sigma_m is None else _empty(*depths.shape)
    _raster.invert_depth(isa, depths, _bytes(mask, depths.shape), sigma, inverse, known)
    return inverse, None if sigma_m is None else known


def halved(
    gray: Image,
    inverse_depth: Image,
    sigma_m: Image | None = None,
    half_mask: Mask | None = None,
    *,
    chance: float = 0.0,
    isa: str = "auto",
) -> tuple[Image, Image, Image | None]:
    """The next coarser images: gray, inverse depth, sigma.

    Args:
        gray: [h, w].
        inverse_depth: [h, w], 1/m, 0 where unknown.
        sigma_m: [h, w], meters; None: not known.
        half_mask: bool [h // 2, w // 2], pixels that may be used; None: all.
        chance: by which two inverse depths of one surface differ at most by their noise, 1/m.
        isa: instruction set, as of `Rasterizer`.
    """
    shape = gray.shape[0] // 2, gray.shape[1] // 2
    half_gray, half_depth = _empty(*shape), _empty(*shape)
    sigma = NOTHING if sigma_m is None else floats_of("sigma_m", sigma_m, gray.shape)
    half_sigma = NOTHING if sigma_m is None else _empty(*shape)
    images = floats_of("gray", gray, gray.shape), floats_of("inverse_depth", inverse_depth, gray.shape)
    out = half_gray, half_depth, half_sigma
    _raster.halve(isa, *images, sigma, _bytes(half_mask, shape), chance, *out)
    return half_gray, half_depth, None if sigma_m is None else half_sigma


def surface_normals(
    inverse_depth: Image,
    camera: PinholeCamera,
    rows: NDArray[np.integer],
    columns: NDArray[np.integer],
    *,
    isa: str = "auto",
) -> NDArray[np.float32]:
    """Unit normals [r, c, 3] at the pixels of a grid, facing the camera; zero where unknown.

    Args:
        inverse_depth: [h, w], 1/m, 0 where unknown.
        camera: of the image.
        rows: of the grid, [r].
        columns: of the grid, [c].
        isa: instruction set, as of `Rasterizer`.
    """
    height, width = inverse_depth.shape
    for name, chosen, size in (("rows", rows, height), ("columns", columns, width)):
        if len(chosen) and (chosen.min() < 0 or chosen.max() >= size):
            raise ValueError(f"{name} are {chosen.min()} to {chosen.max()}, expected 0 to {size - 1}")
    normals = _empty(len(rows), len(columns), 3)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32)
    grid = (np.ascontiguousarray(chosen, dtype=np.int32) for chosen in (rows, columns))
    _raster.surface_normals(
        isa, floats_of("inverse_depth", inverse_depth, inverse_depth.shape), *grid, intrinsics, normals
    )
    return normals


def _bytes(mask: Mask | None, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if mask is None:
        return _NO_MASK
    if mask.shape != shape or mask.dtype != np.bool_:
        raise ValueError(f"mask is {mask.dtype} {mask.shape}, expected bool {shape}")
    return np.ascontiguousarray(mask).view(np.uint8)
