"""Settings of fusion."""

from typing import Literal, NamedTuple

from pydantic import Field, field_validator

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.training import DepthKind, LearningRates, MapLossConfig, SparseStepsConfig


class FinetuneSteps(NamedTuple):
    """Steps of the finetuning of a fused map.

    Attributes:
        per_view: for each own view.
        rate: first learning rates as a share of the mapper's.
    """

    per_view: int
    rate: float


FINETUNE: dict[DepthKind, FinetuneSteps] = {
    "ray_plane": FinetuneSteps(per_view=8, rate=0.25),
    "blended": FinetuneSteps(per_view=5, rate=0.35),
}
"""Where nothing else is set (docs/lab, layer-with-the-image)."""


class FinetuneConfig(Config):
    """Finetuning of the fused map on the robot's own images and on renders of its peers' maps."""

    keyframes: int = Field(default=48, ge=1)
    """Own keyframes up to which steps and views are at most those below; of a longer log, in proportion more."""
    steps_per_view: int | None = Field(default=None, ge=0)
    """Steps for each own view; 0: the fused map stays as fusion left it. None: 5, or 8 where depth is exact."""
    steps_max: int = Field(default=600, ge=0)
    """Most steps on own views."""
    peer_share: float = Field(default=0.25, ge=0.0, le=1.0)
    """Steps on views of peers' maps for every step on an own view; 0: none, and only own Gaussians are trained."""
    peer_views: int = Field(default=40, ge=1)
    """Most views of peers' maps."""
    peer_pixels: Literal["covered", "random", "certain", "uncertain"] = "covered"
    """Pixels of these views that are trained on: all that the peer's map covers; to compare with, half of them, drawn
    at random, or those whose depth its information states best, or worst."""
    support_views: int = Field(default=40, ge=0)
    """Most tracked frames between keyframes that take part."""
    rate: float | None = Field(default=None, gt=0.0)
    """First learning rates as a share of the mapper's. None: 0.35, or 0.25 where depth is exact."""
    rate_decay: float = Field(default=0.1, gt=0.0, le=1.0)
    """They fall to this share: slowly, fast, slowly."""
    sparse: SparseStepsConfig = SparseStepsConfig()
    rates: LearningRates = LearningRates()
    loss: MapLossConfig = MapLossConfig()

    def steps(self, depth: DepthKind) -> FinetuneSteps:
        """Steps for each own view, and their rates.

        Args:
            depth: of the Gaussians, as it is drawn.
        """
        usual = FINETUNE[depth]
        return FinetuneSteps(
            usual.per_view if self.steps_per_view is None else self.steps_per_view,
            usual.rate if self.rate is None else self.rate,
        )

    def at_most(self, count: int, keyframes: int) -> int:
        """A number of steps or views, of a longer log in proportion more.

        Args:
            count: of a log with `keyframes` of the configuration.
            keyframes: of the log.
        """
        return count * max(keyframes, self.keyframes) // self.keyframes


class PeerValidationConfig(Config):
    """The check of peers' maps against the robot's own images, before anything of them is used."""

    min_opacity: float = Field(default=0.5, gt=0.0, le=1.0)
    """Opacity from which on a pixel shows a peer's surface."""
    min_explained_variance: float = Field(default=0.3, ge=0.0, le=1.0)
    """Share of the variance of own pixels that a peer's map must explain to be used at all; honest maps explain two
    thirds and more, one constant color explains nothing."""
    min_color_variance: float = Field(default=0.01, gt=0.0)
    """Least variance of own colors (0..1) that is assumed: where images show one color, errors of maps and
    poses dominate."""
    min_gaussian_px: float = Field(default=4.0, gt=0.0)
    """Blending weight, in pixels, from which on a single Gaussian is judged."""
    min_overlap: float = Field(default=0.01, ge=0.0, le=1.0)
    """Share of the own pixels from which on a peer's map is judged as a whole."""
    max_contradicted: float = Field(default=0.2, ge=0.0, le=1.0)
    """Share of the Gaussians that own images judge, up to which a map that explains too little because of those that
    they contradict is judged without these."""
    max_in_free_space: float = Field(default=0.3, ge=0.0, le=1.0)
    """Share of the Gaussians where own depth images reach, up to which those that own depth images see through are
    left out of a map that explains too little."""
    min_explained_by_rest: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the variance that it must explain then."""
    min_correlated: float = Field(default=0.25, ge=0.0, le=1.0)
    """Share of the blocks of own images that correlate with what a map shows there, from which on it is used however
    little of the variance it explains: 0.38 and more of honest maps, also of those seen from behind; at most 0.14 of
    made-up colors, or of a map that is moved by 3 cm."""
    min_blocks: int = Field(default=50, ge=1)
    """Blocks that this takes; `pipeline/fusion/correlated_blocks.py` says how large they are."""
    passes: int = Field(default=2, ge=1)
    """Times that the map is rendered; Gaussians behind a contradicted one are judged in the next pass."""
    max_size_ratio: float = Field(default=2.0, gt=0.0)
    """Largest Gaussian of a peer, in units of the largest of the own map, but at least `max_size_m`."""
    max_size_m: float = Field(default=0.5, ge=0.0)
    """Size up to which no Gaussian is too large, however small the own ones are: twice the largest that a mapper makes
    (`frontend.mapping.max_scale_m`)."""
    match_radius_factor: float = Field(default=2.0, gt=0.0)
    """Matched Gaussians may be this many matching radii apart, so that rounding rejects no match of an honest robot."""
    match_distance_factor: float = Field(default=1.5, gt=0.0)
    """Matched Gaussians may differ by this many times tau_G of the own map."""


class StatedScaleConfig(Config):
    """The factor on the stated deviations of a fused map, at least 1: peers' Gaussians compared with own depth."""

    enabled: bool = True
    """Else deviations stay as each robot states them of its own Gaussians."""
    gate_m: float = Field(default=0.1, gt=0.0)
    """A surface measured farther than this from a Gaussian is another one's."""
    min_views: int = Field(default=3, ge=1)
    """Own depth images that must have measured a surface near a Gaussian."""
    min_gaussians: int = Field(default=100, ge=1)
    """Such Gaussians that a peer needs to be asked; the factor is the median of those that peers ask for."""
    views: int = Field(default=24, ge=1)
    """Most own depth images that are looked at, evenly spaced."""
    most: float = Field(default=5.0, ge=1.0)
    """Largest factor: where a peer asks for more, it is wrong rather than the cameras."""
    share: float = Field(default=0.9, gt=0.0, lt=1.0)
    """Of the ratios of distance to stated deviation, the share whose quantile is compared with that of normal errors;
    the largest ratios are of other surfaces behind the Gaussians."""


class FusionConfig(Config):
    """From evidence to a robot's fused map."""

    coverage: Literal["all", "overlap"] = "all"
    """Import what only peers saw (all), or only fuse what is matched (overlap)."""
    association: Literal["neighbors", "members"] = "neighbors"
    """Whose values carry the association variance (where on the surface a robot happened to put its splats): only the
    peers', so that a robot estimates its own splat at its own place, or every member's alike, so that all robots end
    with one and the same Gaussian, as method and paper have it (see `docs/explanation/fusion.md`)."""
    spacing_per_sigma: float = Field(default=1.8, ge=0.0)
    """Local spacing of splats, in units of their standard deviation along the surface: its median is 1.5 to 1.9 in
    trained maps."""
    scatter_position_m: float = Field(default=0.01, gt=0.0)
    """Standard deviation by which two robots' splats of one place are expected to differ across the surface. It counts
    as much as `scatter_support` matched Gaussians, the rest is measured (association = neighbors)."""
    scatter_log_covariance: float = Field(default=1.0, gt=0.0)
    """The same for a coordinate of vec log Sigma."""
    scatter_color: float = Field(default=0.07, gt=0.0)
    """The same for color channels, 0..1."""
    scatter_opacity: float = Field(default=0.5, gt=0.0)
    """The same for opacity logits."""
    scatter_support: int = Field(default=50, ge=1)
    """Matched Gaussians that the expectation is worth."""
    explained_m: float = Field(default=0.10, ge=0.0)
    """A peer's Gaussian this far behind a surface that an own keyframe measured still counts as explained..."""
    explained_relative: float = Field(default=0.03, ge=0.0)
    """... plus this share of its depth."""
    explained_px: int = Field(default=4, ge=0)
    """The farthest surface within so many pixels counts: at outlines the two robots' poses and depths never agree."""
    explained_opacity: float = Field(default=0.9, ge=0.0, le=1.0)
    """A keyframe explains only where the own map is at least this opaque; where depth is missing, the rendered one is
    used."""
    final_start: Literal["finest", "drawn"] = "finest"
    """What the final map begins with. finest: the fused map, with peers' Gaussians by `finer`; drawn: of the fused map
    and all that peers' maps have beyond it, as many Gaussians as the fused map has, those that draw most of the views
    that are trained on."""
    most_final: int | None = Field(default=None, ge=1)
    """Most Gaussians that a start by `drawn` has; None: as many as the fused map."""
    finer: float = Field(default=1.3, ge=0.0)
    """In the final map a peer's Gaussians replace own ones where the peer's keyframes saw the surface at so many times
    the resolution of own ones, at least 1; 0: never. With coverage = overlap, or max_added, nothing is replaced or
    begun by `drawn`."""
    own_pixel_steps: int = Field(default=3, ge=0)
    """Gauss-Newton steps on the opacities of imported Gaussians, by the robot's own images; 0: their owners' values."""
    added_need_information: bool = True
    """Import only Gaussians with information on their position."""
    peer_validation: PeerValidationConfig = PeerValidationConfig()
    stated_scale: StatedScaleConfig = StatedScaleConfig()
    finetune: FinetuneConfig = FinetuneConfig()
    max_added: int | None = Field(default=None, ge=0)
    """Most Gaussians of peers that are imported, those of most position information first."""

    @field_validator("finer")
    @classmethod
    def _finer_or_never(cls, finer: float) -> float:
        if 0.0 < finer < 1.0:
            raise ValueError(f"fusion.finer is {finer:g}, expected 0 or at least 1")
        return finer

    @property
    def imports_all(self) -> bool:
        """Whether all that only peers saw is imported, however much it is."""
        return self.coverage == "all" and self.max_added is None
