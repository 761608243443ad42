"""Configuration of the mapping."""

import math
from itertools import pairwise
from typing import Literal, NamedTuple

from pydantic import Field, PositiveInt, field_validator

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.training import DepthKind, LearningRates, MapLossConfig, SparseStepsConfig

THICKNESS_FLOOR_M = 1e-3
"""Thickness below which no splat differs from a plane: log-scales stop here, and have no information there."""


EXACT_DEPTH_OF_DISTANCE = 1e-3
"""Noise of exact depth is below this share of the distance: images of near things are less noisy, but not exact."""


class TrainingSteps(NamedTuple):
    """Steps of one view each.

    Attributes:
        keyframe: at a keyframe.
        final: of the final optimization, for every keyframe.
        final_view: the same for every view; the larger number of steps counts.
    """

    keyframe: int
    final: int
    final_view: int


STEPS: dict[DepthKind, TrainingSteps] = {
    "ray_plane": TrainingSteps(keyframe=32, final=56, final_view=14),
    "blended": TrainingSteps(keyframe=8, final=72, final_view=18),
}
"""Where nothing else is set. On exact depth a step at a keyframe is worth more than one at the end; on noisy depth it
is worth little (docs/lab, half-of-the-blocks)."""


class SeedingConfig(Config):
    """Where Gaussians are inserted and what they look like at first."""

    cell_sizes_px: tuple[PositiveInt, ...] = (8, 4, 2)
    """Sides of the quadtree's cells, coarse to fine, each half of the one before."""
    detail: float = Field(default=0.02, gt=0.0)
    """Standard deviation of gray (0..1) in a cell above which it is split; raised until the budget holds."""
    min_alpha: float = 0.6
    """Rendered opacity below which a pixel is not explained."""
    color_error: float = 0.1
    """Mean color error (0..1), smoothed over a cell, above which a pixel is not explained."""
    worst_color_error: float = 0.02
    """Root mean square color error (0..1) of a cell up to which no disc is added where images are drawn worst."""
    depth_error_m: float = 0.04
    """Depth error above which a pixel is not explained, plus depth_error_relative times the depth."""
    depth_error_relative: float = 0.02
    """Share of the depth that is added to `depth_error_m`."""
    opacity: float = Field(default=0.7, gt=0.0, lt=1.0)
    """Initial opacity."""
    spread: float = 0.85
    """Standard deviation of a disc in units of its cell's side on the surface."""
    shape: Literal["disc", "ball"] = "disc"
    """What a Gaussian is at first: a disc on the surface; to compare with, a ball as wide as the disc."""
    thickness_m: float = Field(default=THICKNESS_FLOOR_M, gt=0.0)
    """Standard deviation of a disc across the surface at first; also the floor of every log-scale while mapping. A
    log-scale at the floor carries no information, and counts for nothing where maps are matched."""
    min_depth_m: float = 0.1
    """Nearer depth gets no Gaussian."""
    max_depth_m: float = 100.0
    """Farther depth gets no Gaussian."""

    @field_validator("cell_sizes_px")
    @classmethod
    def _halves(cls, sides: tuple[int, ...]) -> tuple[int, ...]:
        if not sides or any(coarse != 2 * fine for coarse, fine in pairwise(sides)):
            raise ValueError(
                f"frontend.mapping.seeding.cell_sizes_px is {list(sides)}, expected each half of the one before"
            )
        return sides


class FarDepthConfig(Config):
    """Depth of what is beyond the range of the depth camera, by the color images of other keyframes: maps are seeded
    there too. It is no measurement, and takes part in nothing else."""

    keyframes: int = Field(default=4, ge=0)
    """Most other keyframes that one is compared with; 0: no such depth."""
    planes: int = Field(default=128, ge=2)
    """Most depths that are compared."""
    least_missing: float = Field(default=0.03, ge=0.0, le=1.0)
    """Share of an image without depth from which on it is looked for."""
    alike: float = Field(default=0.7, ge=0.0, le=1.0)
    """Least correlation of what is the same surface."""
    clearer: float = Field(default=0.05, ge=0.0, le=1.0)
    """By which it exceeds the correlation at any other depth."""
    filled_px: float = Field(default=8.0, ge=0.0)
    """Pixels of a small image around what is found that get its depth."""


class MappingConfig(Config):
    """How the map is grown and optimized."""

    max_gaussians: int = 60_000
    """Hard cap of a tile's own Gaussians. When a keyframe would exceed it, the Gaussians whose removal changes the
    keyframes least go first."""
    seen_gaussians: int = 600_000
    """Most Gaussians of all tiles that the keyframes of a tile see; half of its own cap is there in any case."""
    whole_keyframes: int = Field(default=64, ge=1)
    """A map of at most so many keyframes is one tile."""
    tile_keyframes: int = Field(default=40, ge=2)
    """Most keyframes of a tile of a larger map; each tile is optimized with the images of its keyframes."""
    border_keyframes: int = Field(default=24, ge=0)
    """Most keyframes of other tiles that look into a tile whose images take part in its optimization."""
    first_share: float = 0.35
    """Share of the cap that the first keyframe may fill."""
    keyframe_share: float = 0.12
    """Share of the cap that any later keyframe may add."""
    window: int = 8
    """Keyframes optimized together: the newest and those that see most of what it sees."""
    candidates: int = 24
    """Most older keyframes, by the places they look at, whose overlap with a new one is computed."""
    random_keyframes: int = 2
    """Older keyframes added to the window at random, against forgetting."""
    iterations: int | None = Field(default=None, ge=0)
    """Optimization steps (one view each) at a keyframe; every second one is on the newest keyframe. None: 8, or
    32 where depth is exact."""
    iterations_level: int = 0
    """Image pyramid level of these steps: 0 full size, 1 half size."""
    final_iterations: int | None = Field(default=None, ge=0)
    """Steps of the final optimization for every keyframe, at full size, shared by all views. None: 72, or 56 where
    depth is exact."""
    final_iterations_view: int | None = Field(default=None, ge=0)
    """The same for every view, keyframe or supporting frame; the larger number of steps counts. None: 18, or 14 where
    depth is exact."""
    final_iterations_max: int = 6000
    """Most steps of the final optimization of a tile."""
    keyframe_megapixels_s: float | None = Field(default=None, ge=0.0)
    """Most megapixels that the steps at keyframes look at, per second of log since the keyframe before; None: any."""
    final_megapixels_s: float | None = Field(default=None, ge=0.0)
    """Most megapixels that the final optimization looks at, per second of log; None: any. Budgets count pixels, not
    time: no clock changes a result. What they leave out is said."""
    support_views: int = 40
    """Most tracked frames between keyframes that take part in the final optimization, per tile; 0: keyframes only."""
    pose_rate: float = Field(default=0.25, ge=0.0)
    """Largest step of the pose of a view in the final optimization, in standard deviations by tracking, where depth is
    not exact; it falls as the learning rates do. 0: poses stay where tracking and pose graph put them."""
    support_choice: Literal["auto", "steady", "spread", "random", "information", "reversed"] = "auto"
    """Which ones. steady: of equal parts of the log those during which images move least, which are the sharpest;
    spread: the middles of these parts; auto: steady where depth is not exact. To compare with, drawn at random, or
    those by which the map, as it is before the final optimization, would know most (information), or least (reversed),
    more than by the keyframes."""
    support_seeds: bool = True
    """Whether supporting frames insert Gaussians where no keyframe saw anything."""
    densify_rounds: int = 2
    """Times, in the first half of the final optimization, that Gaussians that contribute nothing are pruned and the
    room below the cap is seeded where the keyframes are drawn worst; 0: never. The last round fills the cap."""
    rates: LearningRates = LearningRates()
    final_rate_decay: float = 0.03
    """The final optimization's learning rates fall to this share: slowly, fast, slowly."""
    joint_share: float = Field(default=0.5, ge=0.0, lt=1.0)
    """Last share of the final optimization of a map of tiles in which the views of all tiles take part in random order,
    each with all Gaussians that it may see; before, tile by tile."""
    sparse: SparseStepsConfig = SparseStepsConfig()
    """Of the steps at a keyframe, and of the final optimization."""
    shutter: Literal["stated", "estimated"] = "stated"
    """How long the shutter is open, for views with motion blur where depth is not exact: as the log states it, else
    not at all; or, where it states nothing, estimated from the images, which takes about a third longer."""
    stable_steps: int = Field(default=0, ge=0, le=1023)
    """Steps after which a Gaussian is stable: frozen until the final optimization; 0: never."""
    depth: Literal[DepthKind, "auto"] = "auto"
    """Depth of a Gaussian at a pixel: that of its center (`blended`), or of its disc along the ray (`ray_plane`).
    `auto`: `ray_plane` where the measured noise of the depth images is below `exact_depth_m`."""
    exact_depth_m: float = Field(default=0.002, ge=0.0)
    """Depth that agrees this well from frame to frame, and to 0.1 % of its distance, determines the surface of every
    single Gaussian."""
    loss: MapLossConfig = MapLossConfig()
    seeding: SeedingConfig = SeedingConfig()
    far: FarDepthConfig = FarDepthConfig()
    min_opacity: float = Field(default=0.03, gt=0.0, lt=1.0)
    """Gaussians below are pruned."""
    max_scale_m: float = Field(default=0.25, gt=0.0)
    """Greatest standard deviation of a Gaussian, unless `max_scale_of_depth` allows more."""
    max_scale_of_depth: float = Field(default=0.06, ge=0.0)
    """The same as a share of the median depth of the keyframes."""
    sweep_keyframes: int = 6
    """Keyframes, the newest and those that see most of what it sees, in whose images the contributions of the Gaussians
    are measured at every keyframe."""
    min_contribution: float = 1.0
    """Gaussians whose removal changes all keyframes together by less are pruned in the first half of the final
    optimization: the squared change of images, in units of the noise below."""
    contribution_pixels: int = Field(default=20_000, ge=64)
    """It is measured in images that are halved, at least once, until they have no more pixels."""
    contribution_color_sigma: float = Field(default=0.03, gt=0.0)
    """Noise of colors (0..1) by which a change of an image is measured."""
    contribution_depth_sigma_m: float = Field(default=0.02, gt=0.0)
    """Noise of depth by which a change of an image is measured."""

    def depth_kind(self, depth_noise_m: float | None, median_depth_m: float = math.inf) -> DepthKind:
        """How the depth of the Gaussians is drawn.

        Args:
            depth_noise_m: standard deviation of the depth images in meters; None: unknown.
            median_depth_m: of what they show.
        """
        if self.depth != "auto":
            return self.depth
        limit_m = min(self.exact_depth_m, EXACT_DEPTH_OF_DISTANCE * median_depth_m)
        return "ray_plane" if depth_noise_m is not None and depth_noise_m < limit_m else "blended"

    def steps(self, depth: DepthKind) -> TrainingSteps:
        """Steps of the optimization, without a budget.

        Args:
            depth: of the Gaussians, as it is drawn.
        """
        given = self.iterations, self.final_iterations, self.final_iterations_view
        return TrainingSteps(
            *(usual if n is None else n for n, usual in zip(given, STEPS[depth], strict=True))
        )

    def for_depth(self, median_depth_m: float) -> "MappingConfig":
        """The settings of a map of what is so far away.

        Args:
            median_depth_m: of what the keyframes see; infinite: unknown.
        """
        if not math.isfinite(median_depth_m):
            return self
        largest_m = max(self.max_scale_m, self.max_scale_of_depth * median_depth_m)
        return self.model_copy(update={"max_scale_m": largest_m})

    def final_steps(self, keyframes: float, views: float, depth: DepthKind) -> float:
        """Steps of the final optimization of a tile, without a budget.

        Args:
            keyframes: of the tile.
            views: that it is optimized with, keyframes too.
            depth: of the Gaussians, as it is drawn.
        """
        steps = self.steps(depth)
        return min(max(steps.final * keyframes, steps.final_view * views), self.final_iterations_max)
