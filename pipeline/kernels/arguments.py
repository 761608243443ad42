"""Checks of the arguments that the compiled kernels take.

Every complaint is a ValueError that names the argument, what was found and what was expected.
"""

from __future__ import annotations

import math
import operator
import reprlib
from enum import IntEnum
from numbers import Real
from typing import Any, SupportsIndex, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.types import FISHER_DIAGONAL_COLUMNS, FisherSums
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import GEOMETRY_SIZE

Image = NDArray[np.float32]
Element = TypeVar("Element", bound=np.generic)
MAX_SIDE_PX = 16384
MAX_THREADS = 1024
LARGEST_LOG_SCALE = 40.0  # of meters; as in visibility.h
ROTATION_TOLERANCE = 1e-4  # of R^T R - I; a pose read from six decimals passes
NOT_FINITE = "a NaN or an infinity"
NEGATIVE = "a NaN, an infinity or a negative number"


class KernelStatus(IntEnum):
    """What a kernel returns; `enum Status` of frame.h."""

    OK = 0
    BAD_GAUSSIANS = 1
    BAD_FIRST = 2
    BAD_SECOND = 3
    BAD_THIRD = 4
    TOO_MANY = 5


def check_wanted(pose: bool, parameters: bool, fisher: bool) -> None:
    """Refuse derivatives that exclude each other.

    Args:
        pose: whether the derivative by the pose is wanted.
        parameters: whether those by the parameters of the Gaussians are.
        fisher: whether the diagonal of the information is.

    Raises:
        ValueError: without parameters, there is no pose, or the diagonal is wanted.
    """
    if not parameters and (fisher or not pose):
        raise ValueError("parameters is False, expected pose=True and fisher=False with it")


def arrays_of(gaussians: Gaussians) -> tuple[NDArray[np.float32], ...]:
    """The parameters in the order in which the kernels take them.

    Args:
        gaussians: n Gaussians.
    """
    return (
        gaussians.means,
        gaussians.quats_wxyz,
        gaussians.log_scales,
        gaussians.colors,
        gaussians.opacity_logits,
    )


def check_type(name: str, value: object, expected: type) -> None:
    """Refuse a value of another type.

    Args:
        name: of the argument.
        value: of the argument.
        expected: its type.

    Raises:
        ValueError: it has another type.
    """
    if not isinstance(value, expected):
        raise ValueError(f"{name} is {type(value).__name__}, expected {expected.__name__}")


def checked_camera(camera: PinholeCamera) -> tuple[int, int, NDArray[np.float32]]:
    """Height, width and (fx, fy, cx, cy) of a camera.

    Args:
        camera: pinhole camera, in pixels.

    Raises:
        ValueError: no camera, or a size, focal length or center out of range.
    """
    check_type("camera", camera, PinholeCamera)
    for name in ("width", "height"):
        side = getattr(camera, name)
        if not isinstance(side, Real) or not 1 <= float(side) <= MAX_SIDE_PX or float(side) % 1:
            raise ValueError(
                f"camera.{name} is {side!r}, expected a whole number of 1 to {MAX_SIDE_PX} pixels"
            )
    names = ("fx", "fy", "cx", "cy")
    for name in names:
        value, smallest = getattr(camera, name), 1e-3 if name in ("fx", "fy") else -1e9
        if not isinstance(value, Real) or not smallest <= float(value) < 1e9:
            raise ValueError(
                f"camera.{name} is {value!r}, expected a finite number of pixels, positive for a focal length"
            )
    intrinsics = np.array([getattr(camera, name) for name in names], dtype=np.float32)
    return int(camera.height), int(camera.width), intrinsics


def _real_numbers(name: str, value: ArrayLike, expected: str) -> NDArray[np.float64]:
    """`value` as an array; refuses what is text, complex, ragged or no array at all."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # ragged, or a tensor that cannot be read
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        found = f"an array of {array.dtype}" if isinstance(value, np.ndarray) else reprlib.repr(value)
        raise ValueError(f"{name} is {found}, expected {expected}")
    return array.astype(np.float64)


def checked_pose(name: str, T: ArrayLike) -> NDArray[np.float32]:
    """A rigid motion [4, 4] in the precision of the kernels.

    Args:
        name: of the argument.
        T: [4, 4].

    Raises:
        ValueError: not [4, 4], not finite, or no rigid motion.
    """
    pose = _real_numbers(name, T, "an array of numbers")
    if pose.shape != (4, 4):
        raise ValueError(f"{name} has shape {pose.shape}, expected (4, 4)")
    R = pose[:3, :3]
    if not (np.abs(pose) < 1e30).all():
        raise ValueError(f"{name} holds a NaN, an infinity or a number beyond 1e30")
    if (
        np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE
        or np.linalg.det(R) < 0
        or np.abs(pose[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE
    ):
        raise ValueError(f"{name} is not a rigid motion")
    return np.ascontiguousarray(pose, dtype=np.float32)


def checked_background(background: ArrayLike) -> NDArray[np.float32]:
    """RGB [3].

    Args:
        background: RGB, three numbers.

    Raises:
        ValueError: other than three numbers within +-1e9.
    """
    expected = "three numbers within +-1e9"
    color = _real_numbers("background", background, expected)
    if color.shape != (3,) or not (np.abs(color) <= 1e9).all():
        raise ValueError(f"background is {reprlib.repr(background)}, expected {expected}")
    return color.astype(np.float32)


def checked_mask(mask: object, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """A mask [H, W] as bytes.

    Args:
        mask: bool [H, W].
        shape: (H, W), size of the camera in pixels.

    Raises:
        ValueError: no array of bool, or of another shape.
    """
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        found = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
        raise ValueError(f"mask is {found}, expected an array of bool")
    if mask.shape != shape:
        raise ValueError(f"mask has shape {mask.shape}, expected {shape}, the size of the camera")
    return np.ascontiguousarray(mask).view(np.uint8)


def checked_exposure(exposure: tuple[float, float]) -> tuple[float, float]:
    """Gain and offset of an exposure (a, b).

    Args:
        exposure: (a, b), log gain and offset.

    Raises:
        ValueError: other than two numbers within +-80 and +-1e9.
    """
    expected = "two numbers within +-80 and +-1e9"
    pair = _real_numbers("exposure", exposure, expected)
    if pair.shape != (2,) or not (np.abs(pair) <= (80.0, 1e9)).all():
        raise ValueError(f"exposure is {reprlib.repr(exposure)}, expected {expected}")
    return math.exp(pair[0]), float(pair[1])


def check_share(name: str, value: object) -> None:
    """Refuse what is no number from 0 to 0.5.

    Args:
        name: of the argument.
        value: of the argument.

    Raises:
        ValueError: it is none.
    """
    if not (isinstance(value, Real) and 0 <= float(value) <= 0.5):
        raise ValueError(f"{name} is {value!r}, expected a number from 0 to 0.5")


def check_array(name: str, array: object, shape: tuple[int, ...], dtype: type) -> None:
    """Refuse what the kernels cannot add to in place.

    Args:
        name: of the argument.
        array: of the argument.
        shape: expected.
        dtype: expected.

    Raises:
        ValueError: another type or shape, not contiguous, or not writeable.
    """
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{name} is {found}, expected an array of {np.dtype(dtype)}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not array.flags.c_contiguous or not array.flags.writeable:
        raise ValueError(f"{name} is not a contiguous, writeable array")


def check_sums(sums: object, n: int) -> None:
    """Refuse sums that are not of n Gaussians.

    Args:
        sums: the argument.
        n: number of Gaussians.
    """
    check_type("sums", sums, FisherSums)
    assert isinstance(sums, FisherSums)  # for mypy
    expected: dict[str, tuple[tuple[int, ...], type]] = {
        "geometry": ((n, GEOMETRY_SIZE), np.float64),
        "color": ((n, 3), np.float64),
        "opacity": ((n,), np.float64),
        "weight": ((n,), np.float64),
        "residual": ((n,), np.float64),
        "observations": ((n,), np.uint32),
    }
    if sums.diagonal is not None:
        expected["diagonal"] = ((n, FISHER_DIAGONAL_COLUMNS), np.float64)
    for name, (shape, dtype) in expected.items():
        check_array(f"sums.{name}", getattr(sums, name), shape, dtype)


def available_isas() -> list[str]:
    """Builds that this processor can run, fastest first: "avx512", "avx2", "neon", "portable"."""
    return list(_raster.available_isas())


def checked_isa(isa: object) -> str:
    """The name of an instruction set that this processor has, or "auto".

    Args:
        isa: as it was given.
    """
    if not isinstance(isa, str) or isa not in ("auto", *available_isas()):
        raise ValueError(f"isa is {isa!r}, available here: auto, {', '.join(available_isas())}")
    return isa


def checked_threads(threads: object) -> int:
    """A number of threads.

    Args:
        threads: as it was given.
    """
    if not isinstance(threads, SupportsIndex) or not 1 <= operator.index(threads) <= MAX_THREADS:
        raise ValueError(f"threads is {threads!r}, expected a whole number from 1 to {MAX_THREADS}")
    return operator.index(threads)


def checked_image(
    name: str, image: object, shape: tuple[int, ...], given_by: str = "the last forward"
) -> Image:
    """A contiguous image of float32.

    Args:
        name: of the argument, for the message.
        image: as it was given.
        shape: expected.
        given_by: what the shape comes from, for the message.
    """
    return _checked_array(name, image, np.float32, shape, meaning=f"the size of {given_by}")


def checked_bytes(name: str, image: object, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A contiguous image of uint8.

    Args:
        name: of the argument, for the message.
        image: as it was given.
        shape: expected, that of the camera.
    """
    return _checked_array(name, image, np.uint8, shape, meaning="the size of the camera")


def floats_of(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Numbers of any type as a contiguous array of float32.

    Args:
        name: of the argument, for the message.
        array: as it was given.
        shape: expected.
    """
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    return np.ascontiguousarray(array, dtype=np.float32)


def _checked_array(
    name: str, array: object, dtype: type[Element], shape: tuple[int, ...], *, meaning: str
) -> NDArray[Element]:
    """A contiguous array of a type and a shape, whose meaning the message says."""
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{name} is {found}, expected an array of {np.dtype(dtype)}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}, {meaning}")
    return np.ascontiguousarray(array)


def refuse_bad_image(status: int, faults: dict[str, str]) -> None:
    """Refuse an image in which a kernel found what it cannot hold.

    Args:
        status: of the kernel.
        faults: what a bad image holds, by its name, in the order of the kernel's arguments.
    """
    for code, (name, fault) in zip(
        (KernelStatus.BAD_FIRST, KernelStatus.BAD_SECOND, KernelStatus.BAD_THIRD),
        faults.items(),
        strict=False,
    ):
        if status == code:
            raise ValueError(f"{name} holds {fault}")


def complaint_about(gaussians: Gaussians) -> str:
    """Why a kernel refused these Gaussians.

    Args:
        gaussians: one at least, refused.
    """
    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    for name, array in zip(names, arrays_of(gaussians), strict=True):
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
