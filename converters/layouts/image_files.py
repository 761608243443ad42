"""Reading what datasets keep in single files: images, depth, poses; every complaint names the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from duagc.converters.layouts.ros_images import encoded_size
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import decode_image, read_bytes
from duagc.pipeline.config.base import NO_NUMBER, Config, booleans_for_numbers, expected_of, short
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording.greatest_depth import without_saturated

COLOR = "a color image"
PNG, JPEG = b"\x89PNG", b"\xff\xd8\xff"  # the first bytes
FAR_M = 1e9  # from the origin of a world; geocentric coordinates are 6e6
MAX_ROTATION_DEFECT = 0.01  # largest entry of |R - nearest rotation|
Options = TypeVar("Options", bound=Config)


def options_of(model: type[Options], values: Mapping[str, Any], dataset: str) -> Options:
    """The options of a converter.

    Args:
        model: their type.
        values: by name.
        dataset: named in the error.

    Raises:
        DuagError: names a wrong one.
    """
    for name in booleans_for_numbers(model, values):
        raise DuagError(f"{dataset}: {name} {NO_NUMBER}")
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            hint = closest(name, list(model.model_fields), "options")
            raise DuagError(f"{dataset}: {name} is no option; {hint}") from error
        if not first["loc"]:  # of several options together
            raise DuagError(f"{dataset}: {first['ctx']['error']}") from error
        raise DuagError(f"{dataset}: {name} = {short(repr(first['input']))}: {expected_of(first)}") from error


def add_numbered(found: dict[int, Path], number: int, path: Path) -> None:
    """Add a file or folder by its number.

    Args:
        found: by number; gets the new one.
        number: of the new one.
        path: of the new one.

    Raises:
        DuagError: another has that number, as `1.jpg` and `00001.jpg` have.
    """
    other = found.setdefault(number, path)
    if other != path:
        raise DuagError(f"{path}: found together with {other.name}, expected one of them")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a color image, pixels.

    Args:
        path: of the image.

    Raises:
        DuagError: the file cannot be read, or no decoder reads it.
    """
    import cv2

    image = decode_image(read_bytes(path, COLOR), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise DuagError(f"{path}: no decoder reads it, expected a color image")
    return int(image.shape[1]), int(image.shape[0])


def read_color(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """A color image, BGR [h, w, 3].

    Args:
        path: of the image.
        size: width and height that it must have, pixels.

    Raises:
        DuagError: no decoder reads it, or it has another size.
    """
    return _whole_color(path, read_bytes(path, COLOR), size)


def kept_color(path: Path, size: tuple[int, int]) -> tuple[bytes, str]:
    """The bytes of a color image, which a decoder reads, and their format, "jpeg" or "png".

    Args:
        path: of the image.
        size: width and height that it must have, pixels.

    Raises:
        DuagError: no decoder reads it, or it has another size.
    """
    import cv2

    data = read_bytes(path, COLOR)
    # at an eighth of its size a JPEG takes half the time, and the same is wrong with it
    flags = cv2.IMREAD_REDUCED_COLOR_8 | cv2.IMREAD_IGNORE_ORIENTATION
    is_jpeg = data.startswith(JPEG) and encoded_size(data) == size
    if not is_jpeg or decode_image(data, flags) is None:
        _whole_color(path, data, size)
    return data, "jpeg" if data.startswith(JPEG) else "png"


def _whole_color(path: Path, data: bytes, size: tuple[int, int]) -> NDArray[np.uint8]:
    import cv2

    image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise DuagError(f"{path}: {len(data)} bytes that no decoder reads, expected a color image")
    check_size(path, image.shape, size)
    if not data.startswith((PNG, JPEG)):
        raise DuagError(f"{path}: is neither JPEG nor PNG, expected one of them")
    return np.asarray(image, dtype=np.uint8)


def read_depth(
    path: Path, size: tuple[int, int], unit: str = "depth", no_depth: Sequence[int] = ()
) -> NDArray[np.uint16]:
    """A 16-bit depth image [H, W], in the units of its file, 0 where there is none; the largest number is none.

    Args:
        path: of the file.
        size: width and height that it should have.
        unit: what an error calls its values.
        no_depth: values that mean none, which become 0.
    """
    import cv2

    data = read_bytes(path, "a depth image")
    raw = decode_image(data, cv2.IMREAD_UNCHANGED)
    if raw is None:
        raise DuagError(f"{path}: {len(data)} bytes that no decoder reads, expected a depth image")
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise DuagError(f"{path}: is {raw.dtype} with {raw.ndim} axes, expected 16-bit {unit}")
    check_size(path, raw.shape, size)
    depth = without_saturated(raw)
    for value in no_depth:
        if value:
            depth[depth == value] = 0
    return depth


def check_size(path: Path, shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """Refuse an image of another size.

    Args:
        path: of the image.
        shape: (height, width, ...) of its array.
        size: width and height that it must have, pixels.

    Raises:
        DuagError: it has another size.
    """
    if (shape[1], shape[0]) != size:
        raise DuagError(f"{path}: is {shape[1]}x{shape[0]}, expected {size[0]}x{size[1]}")


def rigid(T: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """A pose [4, 4] with its rotation made exactly orthonormal.

    Args:
        T: [4, 4], as it was read.
        where: begins the line of an error.

    Raises:
        DuagError: `where` holds something that is no rigid motion, or goes beyond `FAR_M`.
    """
    if T.shape != (4, 4):
        raise DuagError(f"{where}: is a matrix {T.shape}, expected (4, 4)")
    if not np.all(np.isfinite(T)):
        raise DuagError(f"{where}: found numbers that are not finite, expected a pose")
    R = so3.project(T[:3, :3])
    defect = float(np.abs(T[:3, :3] - R).max())
    if defect > MAX_ROTATION_DEFECT or not np.allclose(T[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise DuagError(
            f"{where}: its rotation is off by {defect:.2g}, expected a rigid motion (within {MAX_ROTATION_DEFECT})"
        )
    check_near(T[:3, 3], where)
    return se3.from_rotation_translation(R, T[:3, 3])


def check_near(position_m: ArrayLike, where: str) -> None:
    """Refuse a position beyond `FAR_M`.

    Args:
        position_m: [3], meters.
        where: begins the line of an error.

    Raises:
        DuagError: it is as far away.
    """
    far_m = float(np.abs(position_m).max())
    if not far_m < FAR_M:
        raise DuagError(f"{where}: is {far_m:.3g} m away, expected less than {FAR_M:.0e} m")
