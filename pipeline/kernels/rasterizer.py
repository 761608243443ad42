"""The rasterizer of the pipeline: compiled kernels behind checked numpy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry.camera import PinholeCamera
from pipeline.kernels import _raster
from pipeline.kernels.types import FISHER_DIAGONAL_COLUMNS, GEOMETRY_COLUMNS, FisherSums, Gradients, Render
from pipeline.splat.gaussians import Gaussians

MAX_SIDE_PX = 16384
MAX_THREADS = 1024
MAX_GAUSSIANS = 2**30
LARGEST_LOG_SCALE = 40.0  # of metres; as in visibility.h
ROTATION_TOLERANCE = 1e-4  # of R^T R - I; a pose read from six decimals passes

Image = NDArray[np.float32]

_OK, _BAD_GAUSSIANS, _BAD_FIRST, _BAD_SECOND, _BAD_THIRD, _TOO_MANY = range(6)  # enum Status of frame.h


def available_isas() -> list[str]:
    """Builds that this processor can run, fastest first: "avx512", "avx2", "portable"."""
    return list(_raster.available_isas())


class Rasterizer:
    """Draws Gaussians into a camera, and takes derivatives back to them.

    `backward`, `fisher` and `contributions` refer to the last `forward`; the arrays of its Gaussians must not have
    changed since. Scratch memory stays between calls. One Rasterizer serves one thread at a time; the GIL is released.
    All results are the same bits for any number of threads and on every instruction set.
    """

    def __init__(self, isa: str = "auto", threads: int = 1) -> None:
        if isa != "auto" and isa not in available_isas():
            raise ValueError(f"isa is {isa!r}, available here: auto, {', '.join(available_isas())}")
        if not 1 <= threads <= MAX_THREADS:
            raise ValueError(f"threads is {threads}, expected 1 to {MAX_THREADS}")
        self.threads = int(threads)
        self._raster = _raster.Raster(isa)
        self._gaussians: Gaussians | None = None
        self._size = (0, 0)

    @property
    def isa(self) -> str:
        """The instruction set in use: "avx512", "avx2" or "portable"."""
        return self._raster.isa

    def forward(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        background: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Render:
        """Draw the Gaussians (frame map) into the camera at T_camera_map [4, 4].

        background: RGB seen where the Gaussians let light through; its depth is 0.
        Raises ValueError, naming the argument, for what no camera or Gaussian can be.
        """
        height, width, intrinsics = _checked_camera(camera)
        pose = _checked_pose("T_camera_map", T_camera_map)
        behind = _checked_background(background)
        if len(gaussians) > MAX_GAUSSIANS:
            raise ValueError(f"gaussians are {len(gaussians)}, expected at most {MAX_GAUSSIANS}")
        self._gaussians = None
        color, depth, alpha = _empty(height, width, 3), _empty(height, width), _empty(height, width)
        status = self._raster.forward(
            *_arrays(gaussians), pose, intrinsics, behind, width, height, self.threads, color, depth, alpha
        )
        if status == _BAD_GAUSSIANS:
            raise ValueError(_complaint_about(gaussians))
        if status == _TOO_MANY:
            raise ValueError(
                f"gaussians: {len(gaussians)} are so large on the screen that their tiles do not fit into memory"
            )
        self._gaussians, self._size = gaussians, (height, width)
        return Render(color, depth, alpha)

    def backward(
        self,
        d_color: Image,
        d_depth: Image | None = None,
        d_alpha: Image | None = None,
        pose: bool = False,
        fisher: bool = False,
    ) -> Gradients:
        """Derivatives of L from those of L by the images: float32 [H, W, 3], [H, W], [H, W]; None is zero.

        pose: also by the right tangent of T_map_camera. fisher: also the `empirical` diagonal, the sum over pixels
        of (d L_p / d theta)^2 with L_p = <d_color_p, color_p> + d_depth_p depth_p + d_alpha_p alpha_p: pass
        cotangents without a 1/N in front.
        """
        gaussians, (height, width) = self._last_forward()
        n = len(gaussians)
        nothing = np.zeros((0, 0), dtype=np.float32)
        images = (
            _checked_image("d_color", d_color, (height, width, 3)),
            nothing if d_depth is None else _checked_image("d_depth", d_depth, (height, width)),
            nothing if d_alpha is None else _checked_image("d_alpha", d_alpha, (height, width)),
        )
        out = [_zeros(*array.shape) for array in _arrays(gaussians)]
        by_pose = np.zeros(6 if pose else 0)
        diagonal = _zeros(n if fisher else 0, FISHER_DIAGONAL_COLUMNS)
        status = self._raster.backward(*_arrays(gaussians), *images, *out, diagonal, by_pose)
        _refuse_bad_image(status, ("d_color", "d_depth", "d_alpha"), "a NaN or an infinity")
        means, quats, log_scales, colors, logits = out
        return Gradients(
            means, quats, log_scales, colors, logits, by_pose if pose else None, diagonal if fisher else None
        )

    def fisher(self, inv_var_color: Image, inv_var_depth: Image, sums: FisherSums) -> None:
        """Add the `gauss_newton` information of the last view, sum over pixels of J^T R^-1 J, to `sums`.

        inv_var_color: float32 [H, W], 1/sigma^2 of every colour channel; 0 leaves the pixel out.
        inv_var_depth: float32 [H, W], 1/sigma^2 of the blended depth, 1/m^2; 0 leaves it out.
        """
        gaussians, size = self._last_forward()
        n = len(gaussians)
        color = _checked_image("inv_var_color", inv_var_color, size)
        depth = _checked_image("inv_var_depth", inv_var_depth, size)
        expected = {
            "geometry": ((n, GEOMETRY_COLUMNS), np.float64),
            "color": ((n, 3), np.float64),
            "opacity": ((n,), np.float64),
            "observations": ((n,), np.uint32),
        }
        for name, (shape, dtype) in expected.items():
            _check_array(f"sums.{name}", getattr(sums, name), shape, dtype)
        status = self._raster.fisher(
            *_arrays(gaussians), color, depth, sums.geometry, sums.color, sums.opacity, sums.observations
        )
        _refuse_bad_image(
            status, ("inv_var_color", "inv_var_depth"), "a NaN, an infinity or a negative number"
        )

    def contributions(self) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """What each Gaussian gave to the last view: sum of its blending weights [n] and number of its pixels [n]."""
        gaussians, _ = self._last_forward()
        weights = np.zeros(len(gaussians), dtype=np.float32)
        pixels = np.zeros(len(gaussians), dtype=np.uint32)
        self._raster.contributions(weights, pixels)
        return weights, pixels

    def _last_forward(self) -> tuple[Gaussians, tuple[int, int]]:
        if self._gaussians is None:
            raise RuntimeError("forward has not drawn anything yet")
        return self._gaussians, self._size


def _empty(*shape: int) -> NDArray[np.float32]:
    """An array in memory that earlier outputs gave back, holding anything."""
    return _raster.empty(int(np.prod(shape))).reshape(shape)


def _zeros(*shape: int) -> NDArray[np.float32]:
    array = _empty(*shape)
    array.fill(0.0)
    return array


def _arrays(gaussians: Gaussians) -> tuple[NDArray[np.float32], ...]:
    return (
        gaussians.means,
        gaussians.quats_wxyz,
        gaussians.log_scales,
        gaussians.colors,
        gaussians.opacity_logits,
    )


def _checked_camera(camera: PinholeCamera) -> tuple[int, int, NDArray[np.float32]]:
    for name in ("width", "height"):
        side = getattr(camera, name)
        if int(side) != side or not 1 <= side <= MAX_SIDE_PX:
            raise ValueError(f"camera.{name} is {side}, expected 1 to {MAX_SIDE_PX} pixels")
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64)
    for name, value in zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True):
        if not abs(value) < 1e9 or (name in ("fx", "fy") and value < 1e-3):
            raise ValueError(
                f"camera.{name} is {value}, expected a finite number of pixels, positive for a focal length"
            )
    return int(camera.height), int(camera.width), intrinsics.astype(np.float32)


def _checked_pose(name: str, T: ArrayLike) -> NDArray[np.float32]:
    pose = np.asarray(T, dtype=np.float64)
    if pose.shape != (4, 4):
        raise ValueError(f"{name} has shape {pose.shape}, expected (4, 4)")
    R = pose[:3, :3]
    if not np.isfinite(pose).all():
        raise ValueError(f"{name} holds a NaN or an infinity")
    if (
        np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE
        or np.linalg.det(R) < 0
        or np.abs(pose[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE
    ):
        raise ValueError(f"{name} is not a rigid motion")
    return np.ascontiguousarray(pose, dtype=np.float32)


def _checked_background(background: ArrayLike) -> NDArray[np.float32]:
    color = np.asarray(background, dtype=np.float32)
    if color.shape != (3,) or not np.isfinite(color).all():
        raise ValueError(f"background is {background!r}, expected three finite numbers")
    return np.ascontiguousarray(color)


def _check_array(name: str, array: object, shape: tuple[int, ...], dtype: type) -> None:
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{name} is {found}, expected an array of {np.dtype(dtype)}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not array.flags.c_contiguous or not array.flags.writeable:
        raise ValueError(f"{name} is not a contiguous, writeable array")


def _checked_image(name: str, image: object, shape: tuple[int, ...]) -> Image:
    if not isinstance(image, np.ndarray) or image.dtype != np.float32:
        found = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{name} is {found}, expected an array of float32")
    if image.shape != shape:
        raise ValueError(f"{name} has shape {image.shape}, expected {shape}, the size of the last forward")
    return np.ascontiguousarray(image)


def _refuse_bad_image(status: int, names: tuple[str, ...], what: str) -> None:
    for code, name in zip((_BAD_FIRST, _BAD_SECOND, _BAD_THIRD), names, strict=False):
        if status == code:
            raise ValueError(f"{name} holds {what}")


def _complaint_about(gaussians: Gaussians) -> str:
    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    for name, array in zip(names, _arrays(gaussians), strict=True):
        bad = np.flatnonzero(~np.isfinite(array.reshape(len(gaussians), -1)).all(axis=1))
        if len(bad):
            return f"gaussians.{name} holds a NaN or an infinity, first in row {bad[0]}"
    largest = gaussians.log_scales.max(axis=1)
    if largest.max() > LARGEST_LOG_SCALE:
        row = int(np.argmax(largest))
        return (
            f"gaussians.log_scales is {largest[row]:.3g} in row {row}, expected at most {LARGEST_LOG_SCALE}"
        )
    norm2 = (gaussians.quats_wxyz.astype(np.float64) ** 2).sum(axis=1)
    row = int(np.argmax(np.maximum(norm2, 1.0 / np.maximum(norm2, 1e-300))))
    return f"gaussians.quats_wxyz has length {np.sqrt(norm2[row]):.3g} in row {row}, expected 1e-15 to 1e15"
