"""Training steps that leave out what costs more than it brings.

Half of the 4x4 blocks of an image, in a checkerboard, tell as much as all of them. And where hardly any light is left
at a pixel, the Gaussians that share it say little; until the training nears its end, the one that takes the light below
a limit stops it all. Views whose camera moves while its shutter is open are drawn as if it stood still at first: drawn
from several places they take several times as long.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.training import SparseStepsConfig
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.training import TrainingView

BLOCK_PX = 4
"""Side of a block, as the kernels list them."""


@dataclass(frozen=True)
class LookedAt:
    """What a step looks at.

    Attributes:
        pixels: bool [H, W]; None: all.
        closing: of `Rasterizer.view_gradients`.
        of_moving: bool [H, W], pixels of a view whose camera moves; None: it is looked at as if the camera stood still.
    """

    pixels: NDArray[np.bool_] | None = None
    closing: float = 0.0
    of_moving: NDArray[np.bool_] | None = None

    def of(self, view: TrainingView) -> TrainingView:
        """A view with these pixels alone.

        Args:
            view: the whole.
        """
        pixels = self.pixels
        if view.T_camera_moment is not None:
            if self.of_moving is None:
                view = replace(view, T_camera_moment=None)
            else:
                pixels = self.of_moving
        if pixels is None:
            return view
        return replace(view, mask=pixels if view.mask is None else pixels & view.mask)


EVERYTHING = LookedAt()


class SparseSteps:
    """What each step of a training looks at."""

    def __init__(self, config: SparseStepsConfig, camera: PinholeCamera, steps: int) -> None:
        """Compute until which step `closing` holds, and from which one views are drawn with their motion.

        Args:
            config: what is left out, and until when.
            camera: of the views.
            steps: of the training, in all.
        """
        self._config = config
        self._closing_until = round(config.closing_until * steps)
        self._moving_from = config.moving_from * steps
        self._camera = camera

    def at(self, step: int, visit: int, camera: PinholeCamera | None = None) -> LookedAt:
        """What a step looks at.

        Args:
            step: from 0.
            visit: number that differs by one from one look at a view to the next, which sees the other half.
            camera: of the view; None: that of the views.
        """
        seen = camera or self._camera
        board = checkerboards(seen.height, seen.width)[visit % 2]
        return LookedAt(
            pixels=board if self._config.checkerboard else None,
            closing=self._config.closing if step < self._closing_until else 0.0,
            of_moving=board if step >= self._moving_from else None,
        )


@lru_cache(maxsize=16)
def checkerboards(height: int, width: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The black and the white blocks of an image, bool [height, width] both.

    Args:
        height: pixels.
        width: pixels.
    """
    row, column = np.arange(height) // BLOCK_PX, np.arange(width) // BLOCK_PX
    black = (row[:, None] + column) % 2 == 0
    boards = black, ~black
    for board in boards:
        board.setflags(write=False)
    return boards
