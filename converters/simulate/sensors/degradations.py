"""Degradations of a color and depth camera that a recording can be simulated with, each with a dial of its own.

At zero a dial changes nothing, and it changes nothing but what it names: the scene, the paths, the noise of a frame and
what the other dials draw stay the same. In the room alone, dials that need triangles have paths of their own. Rolling
shutter has its dial in `Rig`, as it had before.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.errors import DuagError

FRAME_RATE_HZ = 30
EXPOSURE_LAG_S = 0.3


@dataclass(frozen=True)
class Degradations:
    """What makes a camera worse than an ideal one.

    Attributes:
        auto_exposure: largest change of the gain by automatic exposure if it had no lag, a share: 0.3 is 1/1.3 to
            1.3 of the light.
        exposure_lag_s: time constant of the automatic exposure.
        white_balance: largest drift of red, and the other way of blue, against green, a share of the light.
        vignette: share of the light that the corners lose.
        blur_px: motion blur: how far the median pixel moves while the shutter is open (pixels), by the median frame.
        lens_k1: first coefficient of the radial distortion; images are undistorted again, which leaves a rim.
        depth_step_m: distance between neighboring measurable depths at 1 m (m); it grows with the square of depth.
        depth_delay_s: how much earlier than its time says depth was measured.
        missing: share of the frames that are missing.
        rate_hz: frames a second.
    """

    auto_exposure: float = 0.0
    exposure_lag_s: float = EXPOSURE_LAG_S
    white_balance: float = 0.0
    vignette: float = 0.0
    blur_px: float = 0.0
    lens_k1: float = 0.0
    depth_step_m: float = 0.0
    depth_delay_s: float = 0.0
    missing: float = 0.0
    rate_hz: float = FRAME_RATE_HZ

    @property
    def needs_triangles(self) -> bool:
        """Whether rays leave from more than one point or in other directions than those of a pinhole camera."""
        return self.blur_px > 0 or self.lens_k1 != 0

    @property
    def of_depth_or_lens(self) -> bool:
        """Whether it degrades what only a camera with depth of its own has."""
        return self.lens_k1 != 0 or self.depth_step_m > 0 or self.depth_delay_s > 0

    def check(self) -> None:
        """Refuse a dial out of range.

        Raises:
            DuagError: names the dial, its value and what was expected.
        """
        for name, value, low, high in (
            ("auto exposure", self.auto_exposure, 0.0, 3.0),
            ("exposure lag", self.exposure_lag_s, 0.0, 10.0),
            ("white balance drift", self.white_balance, 0.0, 1.0),
            ("vignette", self.vignette, 0.0, 0.95),
            ("motion blur", self.blur_px, 0.0, 64.0),
            ("k1 of the lens", self.lens_k1, -0.6, 0.6),
            ("depth step", self.depth_step_m, 0.0, 0.2),
            ("depth delay", self.depth_delay_s, 0.0, 0.2),
            ("share of missing frames", self.missing, 0.0, 0.9),
            ("frame rate", self.rate_hz, 0.5, FRAME_RATE_HZ),
        ):
            if not low <= value <= high:
                raise DuagError(f"simulate: {name} is {value:g}, expected {low:g} to {high:g}")

    def kept_frames(self, frames: int, seed: int, robot: str) -> NDArray[np.int64]:
        """Which frames of a path, 1 / FRAME_RATE_HZ apart, are recorded: every one is at its own true time.

        The rate is met by leaving out frames evenly. Of those that remain, as many as the share says are missing, drawn
        without replacement; the first and the last never are.

        Args:
            frames: of the path.
            seed: of the draw.
            robot: whose frames.
        """
        due = np.floor(np.arange(frames) * (self.rate_hz / FRAME_RATE_HZ) + 1e-9)
        kept = np.flatnonzero(np.diff(due, prepend=-1.0) > 0)
        lost = min(round(self.missing * len(kept)), max(len(kept) - 2, 0))
        if lost:
            rng = random_streams.generator(seed, "simulate.missing", robot=robot)
            kept = np.delete(kept, 1 + rng.choice(len(kept) - 2, lost, replace=False))
        return kept
