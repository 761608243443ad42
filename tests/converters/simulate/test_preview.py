"""The contact sheet of a simulated recording can be read whatever it shows."""

from pathlib import Path

import cv2
import numpy as np

from duagc.converters.simulate.preview import Preview


def test_the_scale_of_the_map_is_seen_on_a_dark_floor(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    floor_m = np.column_stack([rng.uniform(0, 40, (200_000, 2)), np.zeros(200_000)])
    path = np.tile(np.eye(4), (5, 1, 1))
    path[:, :3, 3] = np.column_stack([np.linspace(1, 2, 5), np.full(5, 2.0), np.ones(5)])
    sheet = Preview("dark", ["alpha"], [path], [], kept=[list(range(5))])
    _, png = cv2.imencode(".png", np.zeros((72, 96, 3), np.uint8))
    for k in range(5):
        sheet.add("alpha", k, png.tobytes())
    sheet.write(tmp_path / "sheet.png", floor_m, np.full((len(floor_m), 3), 30, np.uint8))
    image = cv2.imread(str(tmp_path / "sheet.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    bottom = image.shape[0] - 184 - 4  # of the map: the row of images is 180 high, and rows are 4 apart
    around = image[bottom - 38 : bottom - 18, 8:66]  # of the label, inside of the map
    assert np.count_nonzero(around > 240) > 0.7 * around.size
    assert np.count_nonzero(around < 120) > 20
