"""Images whose rows were taken one after the other, as a shutter would have taken them that opens for all at once.

A rolling shutter reads a row at a time: while the camera turns at 60 degrees a second and is read for 26 ms, the last
row sees the scene 1.6 degrees away from where the first row would have. A log may state how long its images are read
(`COLOR_READOUT_KEY`, `DEPTH_READOUT_KEY`); with the motion of the tracked camera every pixel is then looked up in the
row that saw its point. Where a log states nothing, the front end finds it (`frontend.readout_time`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.recording.depth_motion import DepthMotion
from duagc.pipeline.recording.depth_sources import DepthImage
from duagc.pipeline.recording.read import log_metadata
from duagc.pipeline.recording.stated_times import stated_seconds

Image = NDArray[np.float32]
COLOR_READOUT_KEY, DEPTH_READOUT_KEY = "rolling_shutter_s", "depth_rolling_shutter_s"
"""In the metadata of a log: seconds from the first to the last row of an image, the stamp in the middle of them; in
that of a front end's log, as it found them, negative where the last row was read first."""
LINES_KEY, COLUMNS = "rolling_shutter_lines", "columns"
"""In the metadata of a front end's log: columns are read one after the other, by a camera that is turned."""
LONGEST_S = 0.2
LEAST_MOVE_PX = 0.25  # of a pixel between the middle row and its own: less is not worth to interpolate for
STEP_PX = 16  # between the pixels whose motion is computed; that of the others is interpolated
LINES_APART = 8  # between the rows whose poses are computed; those of the others are interpolated
SAMPLE_PX = 4  # between the depths that a mean over a neighborhood is taken of
ROUNDS = 3  # of looking up the row of a pixel; each brings it nearer by as much as the motion changes by row


@dataclass(frozen=True)
class Readout:
    """How long the images of a log are read, seconds; 0: all rows at once.

    Attributes:
        color_s: of color.
        depth_s: of depth.
        by_columns: whether columns are read one after the other, and not rows.
    """

    color_s: float = 0.0
    depth_s: float = 0.0
    by_columns: bool = False

    @staticmethod
    def stated(metadata: Mapping[str, str], where: str) -> Readout | None:
        """As the metadata of a log states it; None if they do not.

        Args:
            metadata: of the log.
            where: its path, for errors.

        Raises:
            DuagError: a time that no camera takes.
        """
        return _parsed(metadata, where, 0.0)

    @staticmethod
    def found(frontend: Path) -> Readout | None:
        """As a front end found it; None where the log states it, or nothing was certain.

        Args:
            frontend: frontend.mcap of a robot, or of a component.

        Raises:
            DuagError: a time that no camera takes.
        """
        return _parsed(log_metadata(frontend), str(frontend), -LONGEST_S)

    def notes(self) -> dict[str, str]:
        """What the metadata of a log say of it."""
        notes = {COLOR_READOUT_KEY: repr(self.color_s), DEPTH_READOUT_KEY: repr(self.depth_s)}
        return notes | ({LINES_KEY: COLUMNS} if self.by_columns else {})

    def lines(self, camera: PinholeCamera) -> int:
        """How many rows, or columns, an image has.

        Args:
            camera: of the images.
        """
        return camera.width if self.by_columns else camera.height

    @property
    def rolls(self) -> bool:
        """Whether rows are read one after the other."""
        return self.color_s != 0 or self.depth_s != 0


def _parsed(metadata: Mapping[str, str], where: str, least_s: float) -> Readout | None:
    """The readout that metadata of a log say; None if they say nothing."""
    keys = COLOR_READOUT_KEY, DEPTH_READOUT_KEY
    if metadata.keys().isdisjoint(keys):
        return None
    color_s, depth_s = (
        stated_seconds(metadata, key, where, least_s=least_s, most_s=LONGEST_S) or 0.0 for key in keys
    )
    return Readout(color_s, depth_s, metadata.get(LINES_KEY) == COLUMNS)


@lru_cache(maxsize=4)
def known_lines(count: int) -> NDArray[np.int64]:
    """Rows, or columns, of an image whose poses are computed.

    Args:
        count: that it has.
    """
    lines = np.unique(np.r_[np.arange(0, count, LINES_APART), count - 1])
    lines.flags.writeable = False
    return lines


def share_of_readout(lines: Array | NDArray[np.int64], count: int) -> Array:
    """When rows, or columns, of an image are read, -0.5 to 0.5: from the middle of the readout, as a share of it.

    Args:
        lines: which, [...]; of places between them, fractions.
        count: that the image has.
    """
    return np.asarray(lines / max(count - 1, 1) - 0.5)


def line_times_ns(lines: NDArray[np.int64], count: int, readout_s: float) -> NDArray[np.int64]:
    """Times of rows, or columns, of an image from that of its middle.

    Args:
        lines: which.
        count: that it has.
        readout_s: from the first to the last.
    """
    return np.rint(1e9 * readout_s * share_of_readout(lines, count)).astype(np.int64)


def all_lines(T_middle_line: Array, count: int) -> Array:
    """Poses [count, 4, 4] of all rows, or columns; elements between those that are known are interpolated.

    Args:
        T_middle_line: [k, 4, 4], of `known_lines`.
        count: of the image.
    """
    known = len(T_middle_line)
    at = np.interp(np.arange(count), known_lines(count), np.arange(known))
    before = np.minimum(at.astype(np.int64), max(known - 2, 0))
    share = (at - before)[:, None, None]
    return np.asarray(
        (1 - share) * T_middle_line[before] + share * T_middle_line[np.minimum(before + 1, known - 1)]
    )


class SeenPoints:
    """Points that some pixels of an image show, by which it is known how far its rows moved: parallax by depth.

    Attributes:
        camera: of the image.
        u: columns [k, l] of the pixels, every `STEP_PX` from one beyond either border.
        v: rows [k, l].
        points: [k, l, 3], meters, camera frame.
    """

    def __init__(self, camera: PinholeCamera, depth_m: Image) -> None:
        """Back-project a coarse grid of pixels by the mean inverse depth around each.

        Args:
            camera: of the image.
            depth_m: depth [h, w] of about its time, 0 = unknown: that of a point is the mean over a neighborhood.
        """
        rows, columns = _steps(camera.height), _steps(camera.width)
        self.camera = camera
        self.u, self.v = np.meshgrid(columns, rows)
        self.points = camera.rays_at(self.u, self.v) / _mean_inverse(depth_m, rows, columns)[..., None]


class Unrolling:
    """Where in a rolling image each pixel of a still one is."""

    def __init__(self, seen: SeenPoints, T_middle_line: Array, *, by_columns: bool = False) -> None:
        """Invert the motions of the lines; where pixels lie is computed when it is first needed.

        Args:
            seen: in the image.
            T_middle_line: [h, 4, 4], from the camera when a row was taken to the camera in the middle of the readout;
                by columns [w, 4, 4].
            by_columns: whether columns were read one after the other.
        """
        self._seen, self._camera, self._by_columns = seen, seen.camera, by_columns
        self._T_line_middle = se3.inverse(T_middle_line)

    @cached_property
    def _moved(self) -> Array:
        """How far [k, l, 2] the seen points are in the rolling image from where they are in the still one."""
        seen, found_u, found_v = self._seen, self._seen.u, self._seen.v
        for _ in range(ROUNDS):
            line = np.rint(found_u if self._by_columns else found_v).astype(np.int64)
            T = self._T_line_middle[np.clip(line, 0, len(self._T_line_middle) - 1)]
            there = np.einsum("...ij,...j->...i", T[..., :3, :3], seen.points) + T[..., :3, 3]
            found_u, found_v = np.moveaxis(self._camera.project(there), -1, 0)
        return np.stack([found_u - seen.u, found_v - seen.v], axis=-1)

    @cached_property
    def move_px(self) -> float:
        """How far the median point moves."""
        return float(np.median(np.hypot(self._moved[..., 0], self._moved[..., 1])))

    @cached_property
    def _pixels(self) -> tuple[Image, Image]:
        """Columns and rows [h, w] in the rolling image."""
        moved = self._moved.astype(np.float32)
        return _interpolated(moved, self._camera.height, self._camera.width)

    @property
    def is_needed(self) -> bool:
        """Whether pixels move by more than interpolation costs."""
        return self.move_px >= LEAST_MOVE_PX

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colors [h, w, 3], interpolated; beyond the border those at the border.

        Args:
            image: as it was read.
        """
        import cv2

        four = cv2.cvtColor(image, cv2.COLOR_RGB2RGBA)  # interpolated in half the time of three channels
        moved = cv2.remap(four, *self._pixels, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.cvtColor(moved, cv2.COLOR_RGBA2RGB), dtype=np.uint8)

    def usable(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        """Pixels [h, w] that the rolling image shows, all of whose neighbors there may be used.

        Args:
            mask: bool [h, w]; None: all may.
        """
        import cv2

        camera = self._camera
        u, v = self._pixels
        inside = cv2.inRange(u, 0.0, camera.width - 1.0), cv2.inRange(v, 0.0, camera.height - 1.0)
        shown = cv2.bitwise_and(*inside)
        if mask is not None:
            usable = cv2.remap(mask.astype(np.float32), u, v, cv2.INTER_LINEAR)
            shown = cv2.bitwise_and(shown, cv2.inRange(usable, 0.999, 2.0))
        return np.asarray(shown > 0)

    def depth(self, depth: DepthImage) -> DepthImage:
        """Depth along z of the camera in the middle of the readout; that of the nearest pixel, which mixes no surfaces.

        Args:
            depth: as it was read.
        """
        import cv2

        camera = self._camera

        def nearest(image: Image) -> Image:
            return np.asarray(cv2.remap(image, *self._pixels, cv2.INTER_NEAREST), dtype=np.float32)

        x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)[None]
        y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)[:, None]
        # z when the row was read, of a point now
        third = self._T_line_middle[:, 2].astype(np.float32)
        by_x, by_y, by_z, ahead = np.moveaxis(third[None] if self._by_columns else third[:, None], -1, 0)
        per_z = by_y * y + (by_x * x + by_z) if self._by_columns else by_x * x + (by_y * y + by_z)
        read_m = nearest(depth.depth_m)
        z = read_m - ahead
        z /= per_z
        found = np.where((read_m > 0) & (z > 0), z, np.float32(0))
        sigma = None if depth.sigma_m is None else np.where(found > 0, nearest(depth.sigma_m), np.float32(0))
        return DepthImage(found, sigma)


def unrollings(
    motion: DepthMotion | None,
    camera: PinholeCamera,
    times_ns: tuple[int, int],
    readout: Readout,
    *,
    seen: Callable[[], SeenPoints],
) -> tuple[Unrolling | None, Unrolling | None]:
    """How color and depth of a frame are made still; None where rows are of one time, or nothing says how it moved.

    Args:
        motion: of the camera; None: not known.
        camera: of both.
        times_ns: of color and of depth, each in the middle of its readout.
        readout: of both.
        seen: gives what the frame shows, by its depth as it was read; asked for only if rows are of other times.
    """
    if motion is None or not readout.rolls:
        return None, None
    count, by_columns = readout.lines(camera), readout.by_columns
    lines = known_lines(count)
    readouts_s = readout.color_s, readout.depth_s
    times = [t + line_times_ns(lines, count, s) for t, s in zip(times_ns, readouts_s, strict=True)]
    T_color_then = motion.at(times_ns[0], np.concatenate([*times, times_ns]))
    if T_color_then is None:
        return None, None
    points, T_color_middle = seen(), T_color_then[-2:]
    found: list[Unrolling | None] = []
    for T_middle, T_line, readout_s in zip(
        T_color_middle, np.split(T_color_then[:-2], 2), readouts_s, strict=True
    ):
        T_middle_line = all_lines(se3.inverse(T_middle) @ T_line, count)
        found.append(Unrolling(points, T_middle_line, by_columns=by_columns) if readout_s else None)
    return found[0], found[1]


def _steps(size: int) -> Array:
    """Rows or columns whose motion is computed: as `cv2.resize` takes them, from one beyond either border."""
    count = -(-(size + STEP_PX // 2) // STEP_PX) + 1
    return np.asarray(STEP_PX * (np.arange(count, dtype=np.float64) - 0.5) - 0.5)


@lru_cache(maxsize=4)
def _pixels(height: int, width: int) -> tuple[Image, Image]:
    """Columns [1, w] and rows [h, 1] of all pixels."""
    return np.arange(width, dtype=np.float32)[None], np.arange(height, dtype=np.float32)[:, None]


def _interpolated(moved: Image, height: int, width: int) -> tuple[Image, Image]:
    """Columns and rows [h, w] in the rolling image of all pixels, by the motion [k, l, 2] of some."""
    import cv2

    size = moved.shape[1] * STEP_PX, moved.shape[0] * STEP_PX
    found = [
        whole + cv2.resize(part, size, interpolation=cv2.INTER_LINEAR)[STEP_PX:, STEP_PX:][:height, :width]
        for whole, part in zip(_pixels(height, width), cv2.split(moved), strict=True)
    ]
    return found[0], found[1]


def _mean_inverse(depth_m: Image, rows: Array, columns: Array) -> Array:
    """Mean inverse depth around some pixels; where there is none that of the image, and of 1 m without any."""
    import cv2

    sampled = depth_m[::SAMPLE_PX, ::SAMPLE_PX]
    side = (2 * STEP_PX // SAMPLE_PX + 1,) * 2
    known = sampled > 0
    inverse = inverse_or_zero(sampled).astype(np.float32)
    share = cv2.blur(known.astype(np.float32), side)
    mean = cv2.blur(inverse, side) / np.maximum(share, 1e-6)
    middle = float(np.median(inverse[known])) if known.any() else 1.0
    places = [
        np.clip(at / SAMPLE_PX, 0, count - 1).astype(np.int64)
        for at, count in zip((rows, columns), mean.shape, strict=True)
    ]
    around = np.ix_(*places)
    return np.where(share > 0.05, mean, middle)[around].astype(np.float64)
