"""Configuration of the mapping."""

from typing import Literal

from pydantic import Field

from pipeline.config import Config
from pipeline.splat.gaussians import DepthKind
from pipeline.splat.losses import MapLossConfig
from pipeline.splat.optimiser import LearningRates
from pipeline.splat.seeding import SeedingConfig


class MappingConfig(Config):
    """How the map is grown and optimised."""

    max_gaussians: int = 60_000
    """Hard cap. When a keyframe would exceed it, the Gaussians whose removal changes the keyframes least go first."""
    first_share: float = 0.35
    """Share of the cap that the first keyframe may fill."""
    keyframe_share: float = 0.12
    """Share of the cap that any later keyframe may add."""
    window: int = 8
    """Keyframes optimised together: the newest and those that see most of what it sees."""
    candidates: int = 24
    """Most older keyframes, by the places they look at, whose overlap with a new one is computed."""
    random_keyframes: int = 2
    """Older keyframes added to the window by lot, against forgetting."""
    iterations: int = 24
    """Optimisation steps (one view each) at a keyframe; every second one is on the newest keyframe."""
    iterations_level: int = 0
    """Image pyramid level of these steps: 0 full size, 1 half size."""
    final_iterations: int = 90
    """Steps of the final refinement for every keyframe, at full size, shared by all views."""
    final_iterations_max: int = 6000
    """Most steps of the final refinement in all."""
    support_views: int = 40
    """Most tracked frames between keyframes that take part in the final refinement; 0: keyframes only."""
    densify_rounds: int = 4
    """Times, in the first half of the final refinement, that Gaussians that contribute nothing are pruned and the
    room below the cap is seeded where the keyframes are drawn worst; 0: never. The last round fills the cap."""
    rates: LearningRates = LearningRates()
    final_rate_decay: float = 0.03
    """The final refinement's learning rates fall to this share: slowly, fast, slowly."""
    stable_steps: int = 0
    """Steps after which a Gaussian is stable: frozen until the final refinement; 0: never."""
    depth: DepthKind | Literal["auto"] = "auto"
    """Depth of a Gaussian at a pixel: that of its centre (`blended`), or of its disc along the ray (`ray_plane`).
    `auto`: `ray_plane` where the measured noise of the depth images is below `exact_depth_m`."""
    exact_depth_m: float = Field(default=0.002, ge=0.0)
    """Depth that agrees this well from frame to frame tells the surface of every single Gaussian."""
    loss: MapLossConfig = MapLossConfig()
    seeding: SeedingConfig = SeedingConfig()
    min_opacity: float = 0.03
    """Gaussians below are pruned."""
    max_scale_m: float = 0.5
    """Gaussians that grew beyond are pruned."""
    sweep_keyframes: int = 6
    """Keyframes, the newest and those that see most of what it sees, in whose images every keyframe measures again
    what the Gaussians contribute."""
    min_contribution: float = 0.25
    """Gaussians whose removal changes all keyframes together by less are pruned in the first half of the final
    refinement: the squared change of half-size images, in units of the noise below."""
    contribution_color_sigma: float = 0.03
    contribution_depth_sigma_m: float = 0.02
    exposure: bool = False
    """Fit a gain and an offset per view; the map ends in the mean exposure of its keyframes."""
    exposure_rate: float = 2e-3

    def depth_kind(self, depth_noise_m: float | None) -> DepthKind:
        """How the Gaussians' depth is drawn; depth_noise_m: of the depth images, None: nobody knows."""
        if self.depth != "auto":
            return self.depth
        return "ray_plane" if depth_noise_m is not None and depth_noise_m < self.exact_depth_m else "blended"
