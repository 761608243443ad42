"""Text of files from outside, and images in them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image, encode_png, read_text


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"])
def test_a_byte_order_mark_is_no_text(mark: bytes, tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_bytes(mark + "1.0 rgb/ä.png\n".encode())
    assert read_text(path, "a list") == "1.0 rgb/ä.png\n"


def test_what_is_no_text_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_bytes(b"\xff\xfe1\0")
    with pytest.raises(DuagError, match=r"list\.txt: is not text in UTF-8, expected a list"):
        read_text(path, "a list")


@pytest.mark.parametrize("shape", [(12, 17), (12, 17, 3)])
def test_png_keeps_pixels_in_whatever_order_they_lie(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)[:, ::-1]
    assert np.array_equal(decode_image(encode_png(image), cv2.IMREAD_UNCHANGED), image)
