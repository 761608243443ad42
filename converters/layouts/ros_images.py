"""Images as ROS messages hold them: color to encoded bytes, depth to meters."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from duagc.converters.layouts.rvl import decoded_rvl
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image, encode_png
from duagc.pipeline.recording.greatest_depth import without_saturated

Depth = NDArray[np.float32]
_COLOR_CODES = {  # encoding: channels, and the name of OpenCV's conversion to BGR
    "rgb8": (3, "COLOR_RGB2BGR"),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgba8": (4, "COLOR_RGBA2BGR"),
    "bgra8": (4, "COLOR_BGRA2BGR"),
    "mono8": (1, "COLOR_GRAY2BGR"),
    "8UC1": (1, "COLOR_GRAY2BGR"),
    "bayer_rggb8": (1, "COLOR_BayerBG2BGR"),  # OpenCV names a pattern by its second row
    "bayer_bggr8": (1, "COLOR_BayerRG2BGR"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2BGR"),
    "bayer_grbg8": (1, "COLOR_BayerGB2BGR"),
    "yuv422": (2, "COLOR_YUV2BGR_UYVY"),
    "uyvy": (2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2BGR_YUY2"),
    "yuyv": (2, "COLOR_YUV2BGR_YUY2"),
    "YUYV": (2, "COLOR_YUV2BGR_YUY2"),  # as RealSense's own software names it
}
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")


class UnusableImage(DuagError):  # noqa: N818 (the name says it)
    """An image of a log is empty, cut short or broken; others of its topic may be sound."""


def encoded_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a JPEG or PNG, without decoding; None if it is cut short or neither.

    Args:
        data: the encoded image.
    """
    if data.startswith(b"\x89PNG"):
        whole = len(data) > 24 and b"IEND" in data[-64:]
        return (int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")) if whole else None
    at = 2 if data.startswith(b"\xff\xd8") else len(data)
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of a frame
            if data.rfind(b"\xff\xd9", at) < 0:  # no end; some cameras write more behind it
                return None
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 1 if marker == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def is_cut_short(message: Any) -> bool:
    """Whether a CompressedImage lacks its end (JPEG, PNG, WebP); compressedDepth has 12 bytes before it.

    Args:
        message: an Image is never cut short by this test.
    """
    if not hasattr(message, "format"):
        return False
    data = bytes(message.data)
    data = data[12:] if data[12:].startswith(b"\x89PNG") else data
    if _is_webp(data):
        return len(data) < 8 + int.from_bytes(data[4:8], "little")
    return data.startswith((b"\xff\xd8\xff", b"\x89PNG")) and encoded_size(data) is None


def is_unusable(message: Any) -> bool:
    """Whether an Image or CompressedImage is empty, cut short or broken; one of a kind that is not read is not.

    Args:
        message: of ROS.
    """
    try:
        if is_depth(message):
            depth_values(message, "")
        elif hasattr(message, "format"):
            check_decodes(color_bytes(message, "")[0], "")
        elif message.encoding in _COLOR_CODES:
            rows_of(message, "", "uint8", _COLOR_CODES[message.encoding][0])
    except UnusableImage:
        return True
    except DuagError:
        return False
    return False


def check_decodes(data: bytes, where: str) -> None:
    """Read the pixels of an encoded image, in the cheapest way.

    Args:
        data: of a JPEG or PNG.
        where: begins the line of an error.
    Raises:
        UnusableImage: no decoder reads them.
    """
    import cv2

    if decode_image(data, cv2.IMREAD_REDUCED_GRAYSCALE_8) is None:
        raise UnusableImage(f"{where}: no decoder reads it, expected a color image")


def is_depth(message: Any) -> bool:
    """Whether an Image or CompressedImage holds depth, by what it says of itself.

    Args:
        message: an Image or CompressedImage.
    """
    if hasattr(message, "encoding"):
        return message.encoding in DEPTH_ENCODINGS
    head = bytes(message.data[:26])
    whole = _is_gray_png_of_16_bits(head) or (
        _is_tiff(head) and _encoding(message.format) in DEPTH_ENCODINGS[:2]
    )
    return "compressedDepth" in message.format or whole


def is_integer_depth(message: Any) -> bool:
    """Whether depth comes as integers, whose numbers can be kept; else as floats.

    Args:
        message: an Image or CompressedImage that holds depth.
    """
    encoding = message.encoding if hasattr(message, "encoding") else _encoding(message.format)
    return bool(encoding != "32FC1")


def _encoding(text: str) -> str:
    """What the format of a compressed image says of its pixels: "16UC1; png compressed" is "16UC1"."""
    return text.split(";")[0].strip()


def _is_tiff(head: bytes) -> bool:
    return head.startswith((b"II*\0", b"MM\0*"))


def _is_gray_png_of_16_bits(head: bytes) -> bool:
    """By the first chunk of a PNG: 16 bits, and gray (color type 0)."""
    return head.startswith(b"\x89PNG") and head[24:26] == b"\x10\x00"


def size_of(message: Any, where: str) -> tuple[int, int]:
    """Width and height of an Image or CompressedImage, pixels.

    Args:
        message: with color or depth.
        where: begins the line of an error.

    Raises:
        DuagError: no decoder reads it.
    """
    import cv2

    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    if is_depth(message):
        height, width = depth_m(message, where, 1.0).shape
        return width, height
    image = decode_image(color_bytes(message, where)[0], cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise DuagError(f"{where}: no decoder reads it, expected a color image")
    return int(image.shape[1]), int(image.shape[0])


def rows_of(message: Any, where: str, dtype: str, channels: int) -> NDArray[Any]:
    """Pixels [h, w, channels] of an Image, without the padding of its rows, in native byte order.

    Args:
        message: an Image.
        where: begins the line of an error.
        dtype: of a channel, without byte order.
        channels: per pixel.

    Raises:
        UnusableImage: it is empty, or has too few bytes.
    """
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    if not (message.width > 0 and message.height > 0):
        raise UnusableImage(f"{where}: is {message.width}x{message.height} pixels, expected an image")
    used = message.width * channels * kind.itemsize
    if message.step < used or len(message.data) < message.step * (message.height - 1) + used:
        raise UnusableImage(
            f"{where}: {len(message.data)} bytes with rows of {message.step}, expected {message.height} rows of at "
            f"least {used}"
        )
    data = np.frombuffer(message.data, np.uint8)  # the last row may come without its padding
    step = message.step if message.height > 1 else used  # of a single row, nothing bounds it
    rows = as_strided(data, (message.height, used), (step, 1), writeable=False).view(kind)
    return rows.reshape(message.height, message.width, channels).astype(dtype)


def color_bytes(message: Any, where: str) -> tuple[bytes, str]:
    """Encoded color and its format: the message's own JPEG or PNG, or a PNG of its raw pixels.

    Args:
        message: an Image or CompressedImage.
        where: begins the line of an error.

    Raises:
        DuagError: its encoding is none of color; UnusableImage: it is empty, cut short or of another format.
    """
    import cv2

    if hasattr(message, "format"):
        data = _whole(message, where)
        pattern = _encoding(message.format)
        if pattern.startswith("bayer_") and (colors := _bayer_as_png(data, pattern, where)) is not None:
            return colors, "png"
        if data.startswith(b"\xff\xd8\xff"):
            return data, "jpeg"
        if data.startswith(b"\x89PNG"):
            return data, "png"
        if _is_webp(data):
            return _webp_as_png(data, where), "png"
        raise UnusableImage(
            f"{where}: {len(data)} bytes of format {message.format!r}, expected JPEG, PNG or WebP"
        )
    if message.encoding not in _COLOR_CODES:
        known = ", ".join(_COLOR_CODES)
        raise DuagError(f"{where}: encoding {message.encoding!r}, expected one of {known}")
    channels, conversion = _COLOR_CODES[message.encoding]
    pixels = rows_of(message, where, "uint8", channels)
    if channels == 2 and message.width % 2:
        raise DuagError(
            f"{where}: {message.encoding} is {message.width} pixels wide, expected an even number"
        )
    if conversion is not None:
        pixels = cv2.cvtColor(pixels, getattr(cv2, conversion))
    return encode_png(pixels), "png"


def _whole(message: Any, where: str) -> bytes:
    """The data of a CompressedImage that has its end."""
    if is_cut_short(message):
        pattern = _encoding(message.format)
        raise UnusableImage(
            f"{where}: {len(message.data)} bytes of {pattern}, expected an image that has its end"
        )
    return bytes(message.data)


def _is_webp(data: bytes) -> bool:
    return data.startswith(b"RIFF") and data[8:12] == b"WEBP"


def _bayer_as_png(data: bytes, pattern: str, where: str) -> bytes | None:
    """The colors of a compressed mosaic, as PNG; None for one that had colors before it was compressed."""
    import cv2

    image = decode_image(data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is not None and image.ndim == 3:
        return None
    if image is None or image.dtype != np.uint8 or pattern not in _COLOR_CODES:
        found = "no image" if image is None else str(image.dtype)
        known = ", ".join(name for name in _COLOR_CODES if name.startswith("bayer_"))
        kind = UnusableImage if image is None else DuagError
        raise kind(f"{where}: {found} of {pattern}, expected a JPEG or PNG of one of {known}")
    colors = cv2.cvtColor(image, getattr(cv2, str(_COLOR_CODES[pattern][1])))
    return encode_png(np.asarray(colors))


def _webp_as_png(data: bytes, where: str) -> bytes:
    """The pixels of a WebP, which recordings do not hold, as PNG."""
    import cv2

    image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise UnusableImage(f"{where}: {len(data)} bytes of WebP that no decoder reads, expected an image")
    return encode_png(image)


def depth_m(message: Any, where: str, scale: float) -> Depth:
    """Depth [h, w] in meters, 0 where there is none.

    Args:
        message: an Image or CompressedImage that holds depth.
        where: begins the line of an error.
        scale: meters per unit of integer depth.
    """
    return in_meters(depth_values(message, where), scale)


def in_meters(values: NDArray[np.uint16] | Depth, scale: float, float_scale: float = 1.0) -> Depth:
    """What `depth_values` gives, in meters.

    Args:
        values: integers, or floats.
        scale: meters per unit of integers.
        float_scale: meters per unit of floats.
    """
    if values.dtype == np.uint16:
        return values.astype(np.float32) * np.float32(scale)
    floats = values.astype(np.float32, copy=False)
    return floats if float_scale == 1 else floats * np.float32(float_scale)


def depth_values(message: Any, where: str) -> NDArray[np.uint16] | Depth:
    """Depth [h, w], 0 where there is none: uint16 as it stands but for the largest, or meters, float32.

    Args:
        message: an Image or CompressedImage that holds depth.
        where: begins the line of an error.

    Raises:
        DuagError: its encoding is none of depth, or the image is broken.
    """
    if hasattr(message, "format"):
        return _compressed_depth(message.format, _whole(message, where), where)
    if message.encoding in ("16UC1", "mono16"):
        return without_saturated(rows_of(message, where, "uint16", 1)[..., 0])
    if message.encoding == "32FC1":
        return _sound(rows_of(message, where, "float32", 1)[..., 0])
    raise DuagError(f"{where}: encoding {message.encoding!r}, expected one of {', '.join(DEPTH_ENCODINGS)}")


def _sound(depth: NDArray[Any]) -> Depth:
    """Depth without NaN, infinity and negative numbers."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)


def _compressed_depth(text: str, data: bytes, where: str) -> NDArray[np.uint16] | Depth:
    """compressedDepth of image_transport: a header of 12 bytes, then PNG or RVL; plain PNG and TIFF too.

    A PNG of 32FC1 holds inverse depth, z = A / (v - B); the encoding in `format` decides, not the header.
    """
    import cv2

    if data.startswith(b"\xff\xd8\xff"):
        raise DuagError(f"{where}: depth as JPEG, expected 16-bit depth; eight bits of it are lost")
    plain = data.startswith(b"\x89PNG") or _is_tiff(data)
    if not plain and len(data) < 12:
        raise UnusableImage(f"{where}: {len(data)} bytes, expected compressed depth")
    body = data if plain else data[12:]
    encoding = _encoding(text)
    if not plain and not body.startswith(b"\x89PNG"):
        if (values := decoded_rvl(body)) is None:
            raise UnusableImage(f"{where}: broken RVL depth, expected columns, rows and runs")
    else:
        image = decode_image(body, cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint16 or image.ndim != 2:
            kind = UnusableImage if image is None else DuagError
            raise kind(f"{where}: no decoder finds 16-bit depth in it, expected a PNG or TIFF of 16 bits")
        values = image.astype(np.uint16)
    if encoding != "32FC1":
        return without_saturated(values)
    if plain:
        raise DuagError(f"{where}: inverse depth without its header of 12 bytes, expected compressedDepth")
    _, a, b = struct.unpack("<iff", data[:12])
    with np.errstate(divide="ignore", invalid="ignore"):
        return _sound(np.where(values > 0, a / (values.astype(np.float32) - np.float32(b)), 0.0))
