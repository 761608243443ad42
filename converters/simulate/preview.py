"""A contact sheet of a simulated recording: the paths from above, and what every robot saw over time."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.files import encode_png, new_file
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends

Image = NDArray[np.uint8]

COLORS = (
    *((214, 39, 40), (31, 119, 180), (44, 160, 44), (255, 127, 14)),
    *((148, 103, 189), (23, 190, 207), (227, 119, 194), (188, 189, 34)),
)
THUMBS, THUMB_WIDTH = 6, 240
MAP_SIZE = (900, 720)  # at most
CUT_M = 0.35  # above the lowest camera: what is higher is not drawn
POINTS_PER_PIXEL = 4  # of the map, before it is enlarged
MARGIN, PAPER, INK = 12, (250, 250, 248), (40, 40, 44)


class Preview:
    """Collects what the sheet shows."""

    def __init__(
        self,
        title: str,
        names: list[str],
        trajectories: list[Array],
        walks: list[Array],
        *,
        kept: list[list[int]],
    ) -> None:
        """Choose the frames of each robot that are shown, evenly spread over the recorded ones.

        Args:
            title: one line over the sheet.
            names: of the robots.
            trajectories: T_world_camera [frames, 4, 4] of each.
            walks: poses [frames, 4, 4] of what moves besides.
            kept: indices of the frames of each that are recorded.
        """
        self.title, self.names, self.trajectories, self.walks = title, names, trajectories, walks
        spread = [evenly_spaced_to_ends(len(k), THUMBS) for k in kept]
        self.shown = {name: np.array(k)[s].tolist() for name, k, s in zip(names, kept, spread, strict=True)}
        self._thumbs: dict[tuple[str, int], Image] = {}

    def add(self, robot: str, index: int, png: bytes) -> None:
        """Keep a frame, if it is one of those that are shown.

        Args:
            robot: its name.
            index: of the frame, counted from 0 along the trajectory.
            png: the color image, encoded.
        """
        if index in self.shown[robot]:
            image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            height = round(THUMB_WIDTH * image.shape[0] / image.shape[1])
            small = cv2.resize(image, (THUMB_WIDTH, height), interpolation=cv2.INTER_AREA)
            self._thumbs[robot, index] = np.asarray(small[..., ::-1], dtype=np.uint8)

    def write(self, path: Path, points: Array, colors: NDArray[np.uint8]) -> None:
        """Write the sheet.

        Args:
            path: the PNG file to write.
            points: [n, 3], meters, world frame, the scene for the map.
            colors: [n, 3], RGB, of the points.
        """
        rows = [self._map(points, colors)] + [self._row(k) for k in range(len(self.names))]
        width = max(row.shape[1] for row in rows)
        sheet = [_line(self.title, width)]
        sheet += [_padded(row, width) for row in rows]
        png = encode_png(np.concatenate(sheet)[..., ::-1])
        with new_file(path) as part:
            part.write_bytes(png)

    def _row(self, k: int) -> Image:
        """The frames of one robot."""
        name, color = self.names[k], COLORS[k % len(COLORS)]
        pieces = []
        for index in self.shown[name]:
            thumb = self._thumbs[name, index].copy()
            cv2.rectangle(thumb, (0, 0), (thumb.shape[1] - 1, thumb.shape[0] - 1), color, 3)
            _write(thumb, f"{name} {index}", (8, 18), (0, 0, 0), thickness=3)
            _write(thumb, f"{name} {index}", (8, 18), (255, 255, 255))
            pieces.append(thumb)
        return np.concatenate(pieces, axis=1)

    def _map(self, points: Array, colors: NDArray[np.uint8]) -> Image:
        """The scene from above, cut below the ceiling, with all paths and where the cameras look."""
        cameras = np.concatenate([path[:, :3, 3] for path in self.trajectories])
        below = points[:, 2] < cameras[:, 2].min() + CUT_M
        points, colors = points[below], colors[below]
        low = np.percentile(points[:, :2], 0.2, axis=0) - 0.3
        high = np.percentile(points[:, :2], 99.8, axis=0) + 0.3
        scale = float(min(np.array(MAP_SIZE) / (high - low)))
        image = _from_above(points, colors, low, high, scale=scale)

        def pixel(p: Array) -> tuple[int, int]:
            return round(scale * (p[0] - low[0])), round(scale * (high[1] - p[1]))

        for walk in self.walks:
            dots = [pixel(p) for p in walk[:: max(1, len(walk) // 20), :2, 3]]
            for dot in dots:
                cv2.circle(image, dot, 3, INK, -1, cv2.LINE_AA)
        for k, path in enumerate(self.trajectories):
            color = COLORS[k % len(COLORS)]
            line = np.array([pixel(p) for p in path[:, :2, 3]], dtype=np.int32)[:, None]
            wide = 3 + round(
                6 * (len(self.trajectories) - 1 - k) / len(self.trajectories)
            )  # no path hides another
            cv2.polylines(image, [line], False, (255, 255, 255), wide + 2, cv2.LINE_AA)
            cv2.polylines(image, [line], False, color, wide, cv2.LINE_AA)
            for index in self.shown[self.names[k]]:
                at = path[index, :2, 3]
                for side in (-0.5, 0.5):  # half the opening angle of a camera, about
                    c, s = np.cos(side), np.sin(side)
                    end = at + 28 / scale * (np.array([[c, -s], [s, c]]) @ path[index, :2, 2])
                    cv2.line(image, pixel(at), pixel(end), color, 1, cv2.LINE_AA)
            cv2.circle(image, pixel(path[0, :2, 3]), 7, color, -1, cv2.LINE_AA)
            initial_px = pixel(path[0, :2, 3] + 10 / scale)
            _write(image, self.names[k][0], initial_px, color, scale=0.6, thickness=2)
        meters = 10.0 ** np.floor(np.log10(200 / scale))
        bottom = image.shape[0] - 14
        right = 14 + round(meters * scale)
        cv2.rectangle(
            image, (6, bottom - 26), (max(right, 60) + 8, bottom + 8), PAPER, -1
        )  # floors may be dark
        cv2.line(image, (14, bottom), (right, bottom), INK, 3)
        _write(image, f"{meters:g} m", (14, bottom - 8), INK)
        return image


def _from_above(points: Array, colors: NDArray[np.uint8], low: Array, high: Array, *, scale: float) -> Image:
    """Points seen from above, the highest of each place; places without one have the color of their surroundings."""
    whole = tuple(max(1, int(n)) for n in scale * (high - low))
    scale = min(scale, float(np.sqrt(len(points) / np.prod(high - low) / POINTS_PER_PIXEL)))
    width, height = (max(1, int(n)) for n in scale * (high - low))
    order = np.argsort(points[:, 2], kind="stable")
    u = (scale * (points[order, 0] - low[0])).astype(np.int64)
    v = (scale * (high[1] - points[order, 1])).astype(np.int64)
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    image = np.zeros((height, width, 3), dtype=np.uint8)
    known = np.zeros((height, width), dtype=np.uint8)
    image[v[inside], u[inside]] = colors[order][inside]  # the last one, the highest, stays
    known[v[inside], u[inside]] = 1
    window = np.ones((3, 3), dtype=np.uint8)
    for _ in range(2):
        grown, empty = cv2.dilate(image, window), known == 0
        image[empty] = grown[empty]
        known = np.asarray(cv2.dilate(known, window), dtype=np.uint8)
    image[known == 0] = PAPER
    return np.asarray(cv2.resize(image, whole, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def _write(
    image: Image,
    text: str,
    at_px: Sequence[int],
    color: Sequence[int],
    *,
    scale: float = 0.5,
    thickness: int = 1,
) -> None:
    font, smooth = cv2.FONT_HERSHEY_SIMPLEX, cv2.LINE_AA
    cv2.putText(image, text, at_px, font, scale, color, thickness=thickness, lineType=smooth)


def _line(text: str, width: int) -> Image:
    strip = np.full((36, width, 3), PAPER, dtype=np.uint8)
    _write(strip, text, (MARGIN, 24), INK, scale=0.6)
    return strip


def _padded(image: Image, width: int) -> Image:
    return np.pad(image, ((0, 4), (0, width - image.shape[1]), (0, 0)), constant_values=250)
