"""Images in files: kept as they are only where a decoder reads them, depth without the values that mean none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.layouts.image_files import kept_color, read_color, read_depth
from duagc.pipeline.base.errors import DuagError

SIZE = WIDTH, HEIGHT = 53, 30  # no multiple of eight


def reason(read: object, path: Path) -> str:
    """Why a file is refused; empty: it is not."""
    try:
        read(path, SIZE)  # type: ignore[operator]
    except DuagError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_what_is_kept_is_refused_where_it_could_not_be_read(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    whole = cv2.imencode(f".{kind}", image)[1].tobytes()
    path = tmp_path / f"image.{kind}"
    path.write_bytes(whole)
    assert kept_color(path, SIZE) == (whole, "jpeg" if kind == "jpg" else "png")
    refused = 0
    for k in range(300):
        data = bytearray(whole)
        if k % 3 == 0:
            data = data[: rng.integers(len(data))]
        else:
            for at in rng.integers(0, 200 if k % 3 == 1 else len(data), 3):
                data[at] = rng.integers(256)
        path.write_bytes(data)
        said = reason(kept_color, path)
        assert said == reason(read_color, path)
        refused += bool(said)
    assert refused > 20


def test_values_that_mean_no_depth_are_zero(tmp_path: Path) -> None:
    depth = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), depth)
    np.testing.assert_array_equal(read_depth(path, SIZE), depth)
    found = read_depth(path, SIZE, no_depth=(0, 7, 1000))
    np.testing.assert_array_equal(found, np.where((depth == 7) | (depth == 1000), 0, depth))


def test_the_largest_number_is_no_depth_in_any_image(tmp_path: Path) -> None:
    """Also where it comes late or seldom, so that it could not be found in the first images."""
    depth = np.full((HEIGHT, WIDTH), 1200, dtype=np.uint16)
    depth[0, :3] = 65534, 65535, 0
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    expected = np.where(depth == 65535, 0, depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.png", SIZE), expected)
