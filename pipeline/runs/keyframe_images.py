"""Images of a robot's keyframes, from its sensor log, which is opened when the first one is asked for."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from duagc.pipeline.recording import RgbdLog


class Images(NamedTuple):
    """Images of a keyframe: RGB [h, w, 3], depth [h, w] (m, 0 = unknown), its sigma (m) where the log has it, and the
    pixels that may be used, bool [h, w]; None: all."""

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    depth_sigma_m: NDArray[np.float32] | None = None
    mask: NDArray[np.bool_] | None = None


class KeyframeImages:
    """Gives images by the number of the keyframe."""

    def __init__(self, log: Path, frontend: Path, frames: Sequence[int]) -> None:
        """Keep the paths; the logs are read when the first image is asked for.

        Args:
            log: of the robot's sensors.
            frontend: log of its front end, by which depth of another time is moved into that of its image.
            frames: index in the log of every keyframe.
        """
        self._path, self._frontend, self._frames = log, frontend, tuple(frames)
        self._log: RgbdLog | None = None

    def __call__(self, keyframe: int) -> Images:
        """Images of a keyframe.

        Args:
            keyframe: its number.
        """
        from duagc.pipeline.recording import open_rgbd

        if self._log is None:
            self._log = open_rgbd(self._path)
            weakref.finalize(self, self._log.close)
            self._log.move_depth_by(self._frontend)
        frame = self._log.frame(self._frames[keyframe])
        return Images(frame.color, frame.usable_depth, frame.depth_sigma, frame.mask)
