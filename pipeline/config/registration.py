"""Settings of dense RGB-D registration."""

from typing import Literal

from pydantic import Field

from duagc.pipeline.config.base import Config


class RegistrationConfig(Config):
    """Joint point-to-plane and photometric registration."""

    residuals: Literal["joint", "depth", "gray"] = "joint"
    """Which residuals count: both, point-to-plane only, or gray values only (for comparisons)."""
    iterations: tuple[int, ...] = (4, 5, 6)
    """Gauss-Newton steps per pyramid level, finest first."""
    depth_gate_m: float = 0.1
    """Smallest limit of the distance between a sample and the surface it falls on; farther ones do not count."""
    depth_gate_relative: float = 0.05
    """The same as a fraction of the depth; the larger limit holds."""
    normal_gate_rad: float = 0.0
    """Largest angle between the normals of a sample and of the surface it falls on; 0 = no test, the default, because
    normals of a structured-light camera scatter by more than any useful limit."""
    huber_sigmas: float = Field(default=1.5, gt=0.0)
    """Residuals beyond this many sigmas count linearly."""
    depth_sigma_base_m: float = 0.0012
    """Depth noise sigma(z) = base + slope * (z - 0.4)^2, where the log does not hold it pixel by pixel; only its shape
    counts, its scale is estimated."""
    depth_sigma_quadratic_per_m: float = 0.0019
    """See depth_sigma_base_m (Nguyen, Izadi and Lovell 2012)."""
    depth_sigma_floor: float = 0.05
    """Smallest estimated scale of the depth noise at the finest level, as a multiple of sigma(z). Four times more at
    each coarser one, where edges are blurred: without noise the depth would else outweigh the gray values so far
    that the path to the minimum becomes a narrow valley, which takes hundreds of steps."""
    gray_sigma_floor: float = 0.002
    """Smallest estimated noise of gray values (about half a step of 8 bits)."""
    gray_sigma_of_depth: float = 0.03
    """Smallest estimated noise of gray values as a multiple of the scale of the depth noise, where the reference has
    usual contrast; less in proportion where it has less, and to the share of samples at whose depth noise exceeds the
    depth gate. Poor depth is often registered to color only to a pixel, and texture turns that into a gray error that
    is the same in all frames. With less, depth of another time is not found out."""
    gray_noise_of_depth: bool = False
    """Count the error of a sample's depth in the noise of its gray value: it shifts the sample in the target along its
    epipolar line, by pixels where the views are meters apart, and by next to nothing between following frames."""
    weights_by_correlation: bool = True
    """Divide the weights of depth and of gray values each by how much its neighbors share errors, before both decide
    together, at the finest level: depth that is wrong over a whole wall counts less, however many samples lie on it."""
    min_gradient: float = 0.0
    """Gray gradient (1/px) below which a sample's gray value is not used."""
    min_samples: int = 100
    """Fewer agreeing samples are LOW_OVERLAP."""
    min_overlap: float = 0.3
    """Smaller overlap is LOW_OVERLAP."""
    max_conflict: float = 0.3
    """Largest fraction of seen samples that lie in space which the target saw to be free."""
    max_depth_scale: float = 8.0
    """Largest estimated scale of the depth noise, as a multiple of sigma(z); more is RESIDUAL."""
    max_gray_rms: float = 0.15
    """Largest weighted gray residual; more is RESIDUAL."""
    max_gain: float = 2.0
    """The gain must lie between 1 / max_gain and max_gain; else RESIDUAL (covered lens, other scene). It may be smaller
    where both views show the same textures: noise in the dark and a lamp on the camera make it too small."""
    max_sigma_m: float = 0.03
    """Directions with a larger standard deviation at the median depth are weak: they stay at the guess, or where the
    prior pulls them, and carry no information. The outcome is ILL_CONDITIONED unless the prior knows better. As limits
    of distances, it grows with this depth beyond 6 m."""
    max_translation_m: float = 0.3
    """Largest correction of the guess; more is JUMP."""
    max_rotation_rad: float = 0.35
    """Largest correction of the guess; more is JUMP."""


class GeometricVerificationConfig(Config):
    """Whether two views show one place: matched features, RANSAC, registration (`registration.geometric_verification`).

    Loop closures within a robot's path and between robots, and relocalization, extend it.
    """

    ratio: float = Field(default=0.8, gt=0.0, lt=1.0)
    """Nearest over second-nearest distance of descriptors below which a match counts."""
    hypotheses: int = Field(default=300, ge=1)
    """Three-point samples of RANSAC."""
    inlier_m: float = Field(default=0.05, gt=0.0)
    """Distance below which a match agrees with a motion, at one meter of depth; grows with depth."""
    min_inliers: int = Field(default=12, ge=4)
    """Matches that must agree on one motion."""
    min_inlier_share: float = Field(default=0.25, ge=0.0, le=1.0)
    """The same as a share of the matches; the larger number holds."""
    min_overlap: float = Field(default=0.3, ge=0.0, le=1.0)
    """Overlap that the registration must find."""
    min_covered: float | None = Field(default=None, gt=0.0, le=1.0)
    """Share of its own image in which a view must see samples of the other one for less overlap to be enough: a camera
    that stands nearer sees few of them, and nothing else. None: no share is enough."""
    max_disagreement_m: float = Field(default=0.03, gt=0.0)
    """Largest distance between the registrations in the two directions, where both views' images are at hand. As the
    limit below, it grows with the median depth beyond 6 m."""
    max_disagreement_rad: float = Field(default=0.03, gt=0.0)
    """The same for the rotation."""
    max_refinement_m: float = Field(default=0.3, gt=0.0)
    """Largest translation by which the registration may change what RANSAC found: of the camera or, if less, of the
    matches that agree."""
    max_refinement_rad: float = Field(default=0.35, gt=0.0)
    """The same for the rotation."""


class GicpConfig(Config):
    """Registration of points by generalized ICP, to compare with."""

    voxel_m: float = Field(default=0.03, gt=0.0)
    """Edge of the voxels that either view's points are thinned to."""
    distances_m: tuple[float, ...] = (1.0, 0.3, 0.1)
    """Distances below which points correspond, one run each."""
    iterations: int = Field(default=30, ge=1)
    """Most steps of each run."""


class MovingConfig(Config):
    """Finding moving objects by depth alone."""

    enabled: bool = True
    """Look for moving objects and keep them out of the map."""
    gate_m: float = 0.15
    """A point nearer by this than all that another view measured around its place stands in free space."""
    gate_relative: float = 0.1
    """The same as a fraction of the depth; the larger limit holds."""
    views: int = 16
    """Other views compared at most, those that look at the nearest places."""
    min_views: int = 2
    """Views that must have looked through a point; and they must be more than those that saw it there."""
    min_region: float = 0.002
    """Smallest connected region, as a share of the image: smaller ones are noise at edges."""
    grow_px: int = 8
    """Pixels, of the whole image, by which a region is enlarged: edges of what moves are mixed with what is behind."""
    halvings: int = 2
    """Times the images are halved before they are compared."""
