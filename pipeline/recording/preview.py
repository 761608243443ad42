"""What some frames of a robot show: reach of the depth as numbers, color and depth as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import encode_png, new_file
from duagc.pipeline.geometry.masks import checkered
from duagc.pipeline.recording.rgbd import RgbdLog, open_rgbd
from duagc.pipeline.recording.rgbd_frame import RgbdFrame

SHOWN = 6  # frames of a robot
TILE_PX = 240  # width of a picture
CHECKER_PX = 16  # side of the squares where a pixel is masked, before it is shrunk
LINE_PX = 22  # height of a line of text
Picture = NDArray[np.uint8]


def some_frames(log: RgbdLog, count: int = SHOWN) -> list[RgbdFrame]:
    """Frames spread evenly over a log.

    Args:
        log: of the robot.
        count: number of frames, fewer if the log has fewer.
    """
    chosen = np.unique(np.linspace(0, len(log) - 1, count).astype(int))
    return [log.frame(index) for index in chosen.tolist()]


def reach(frames: Sequence[RgbdFrame]) -> dict[str, Any]:
    """Depth of some frames: "depth_m" at 1, 50 and 99 % of the known pixels (None if there is none), and the share
    "with_depth"; every 4th row and column counts.

    Args:
        frames: one at least; depth [h, w], meters, 0 = unknown.
    """
    depth = np.concatenate([frame.depth[::4, ::4].ravel() for frame in frames])
    known = depth[depth > 0]
    percentiles = np.percentile(known, (1, 50, 99)).tolist() if len(known) else None
    return {"depth_m": percentiles, "with_depth": len(known) / len(depth)}


def write_preview(logs: Sequence[Path], out: Path) -> None:
    """Write a PNG: of every robot a line of text, a row of color and a row of depth, evenly spread over its log.

    Args:
        logs: of robots with a camera.
        out: must not exist.
    """

    if out.exists():
        raise DuagError(f"{out}: exists already, expected the name of a new picture")
    rows = []
    for path in logs:
        with open_rgbd(path) as log:
            rows += _rows_of(log)
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    with new_file(out) as part:
        part.write_bytes(encode_png(sheet[:, :, ::-1]))


def _rows_of(log: RgbdLog) -> list[Picture]:
    frames = some_frames(log)
    depth_m = reach(frames)["depth_m"]
    near, far = (depth_m[0], max(depth_m[2], depth_m[0] + 1e-3)) if depth_m else (0.0, 1.0)
    colors = np.concatenate(
        [_tile(checkered(frame.color, frame.mask, CHECKER_PX)) for frame in frames], axis=1
    )
    depths = np.concatenate([_tile(_painted(frame.depth, near, far)) for frame in frames], axis=1)
    times = ", ".join(f"{frame.stamp_ns * 1e-9:.1f}" for frame in frames)
    words = f"{log.robot}: {len(log)} frames, at {times} s; depth {near:.2f} m (blue) to {far:.2f} m (red)"
    return [_line(words, colors.shape[1]), colors, depths]


def _tile(image: Picture) -> Picture:
    import cv2

    height = max(1, round(image.shape[0] * TILE_PX / image.shape[1]))
    return np.asarray(cv2.resize(image, (TILE_PX, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _painted(depth_m: NDArray[np.float32], near: float, far: float) -> Picture:
    """Depth as colors; black where there is none."""
    import cv2

    gray = np.rint(255 * np.clip((depth_m - near) / (far - near), 0, 1)).astype(np.uint8)
    painted = cv2.applyColorMap(gray, cv2.COLORMAP_TURBO)[:, :, ::-1]
    return np.where(depth_m[..., None] > 0, painted, 0).astype(np.uint8)


def _line(words: str, width: int) -> Picture:
    import cv2

    line = np.zeros((LINE_PX, width, 3), dtype=np.uint8)
    cv2.putText(
        line,
        words,
        (4, LINE_PX - 7),
        fontFace=cv2.FONT_HERSHEY_SIMPLEX,
        fontScale=0.45,
        color=(255, 255, 255),
        thickness=1,
        lineType=cv2.LINE_AA,
    )
    return line
