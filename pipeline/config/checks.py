"""Settings of `duagc check`: from which value on a recording is reported."""

from pydantic import Field

from duagc.pipeline.config.base import Config


class TimeChecks(Config):
    """Times of the images."""

    gap_ratio: float = Field(default=1.5, gt=1.0)
    """An interval this many times the median one is a gap."""
    long_gap_s: float = Field(default=0.5, gt=0.0)
    """A longer gap is a warning: in this time a robot turns out of its last view."""
    rates_hz: tuple[float, float] = (0.5, 400.0)
    """Rates of cameras; outside, times are more likely in a wrong unit."""
    min_paired: float = Field(default=0.95, ge=0.0, le=1.0)
    """Share of the color images that should have a depth image of their own."""
    late_s: float = Field(default=0.01, gt=0.0)
    """Depth that is usually farther from its color has to be moved."""


class ImageChecks(Config):
    """What the images show."""

    frames: int = Field(default=16, ge=1)
    """Frames of a robot whose pixels are counted, spread over its log."""
    repeats_in_a_row: int = Field(default=5, ge=2)
    """Equal images in a row that are a warning."""
    max_repeated: float = Field(default=0.4, ge=0.0, le=1.0)
    """Share of the images that may repeat the one before."""
    min_depth: float = Field(default=0.2, ge=0.0, le=1.0)
    """Share of the pixels that should have depth."""
    max_saturated: float = Field(default=0.005, ge=0.0, le=1.0)
    """Share of the known depth that may be the largest number."""
    other_colors: float = Field(default=0.15, ge=0.0, le=1.0)
    """Squared Hellinger distance of two robots' color histograms from which on their order is examined."""
    swapped_ratio: float = Field(default=0.5, gt=0.0, le=1.0)
    """The order differs if the distance falls to this share of it when red and blue are exchanged."""


class CameraChecks(Config):
    """Intrinsics."""

    max_off_center: float = Field(default=0.1, gt=0.0)
    """Distance of the principal point from the middle, as a share of the image's width or height."""
    max_focal_difference: float = Field(default=0.05, gt=0.0)
    """Relative difference of the two focal lengths."""
    views_deg: tuple[float, float] = (15.0, 150.0)
    """Horizontal fields of view of cameras."""


class MotionChecks(Config):
    """Depth moved into a later frame, and the scale of the motion between the two."""

    pairs: int = Field(default=8, ge=1)
    """Pairs of frames that are registered, spread over the log."""
    pair_s: float = Field(default=0.15, gt=0.0)
    """Longest time between the frames of a pair; the next frame, if that is later."""
    max_residual: float = Field(default=0.03, gt=0.0)
    """Median difference of moved depth, as a share of the depth."""
    min_registered: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the pairs that should be registered."""
    max_scale: float = Field(default=1.6, gt=1.0)
    """Lengths by registration relative to those by another sensor, or the other way round."""
    mistaken_share: float = Field(default=0.02, ge=0.0)
    """Share of a rotation that may look like a translation, at the distance of what is seen: what a focal length
    does that is wrong by so much."""
    reference_sigma_m: float = Field(default=0.002, gt=0.0)
    """Standard deviation of a length by another sensor."""
    observable_sigmas: float = Field(default=3.0, gt=0.0)
    """Scale is observable from a pair if its length is this many times its standard deviation."""
    median_depth_m: tuple[float, float] = (0.1, 100.0)
    """Half of the depth lies before some distance between these."""
    max_depth_m: float = Field(default=14.0, gt=0.0)
    """Depth (99 %) of a camera with its own light."""
    max_speed_m_per_s: float = Field(default=4.0, gt=0.0)
    """Median speed of a camera."""


class EdgeChecks(Config):
    """Edges of depth, which should lie on edges of color."""

    step: float = Field(default=0.06, gt=0.0)
    """Relative step of depth that is an edge."""
    min_pixels: int = Field(default=200, ge=1)
    """Pixels on edges that an image needs to be compared."""
    frames: int = Field(default=8, ge=1)
    """Frames that are compared, spread over the log; half of them must have enough edges."""
    shift_frames: int = Field(default=4, ge=1)
    """Depth is also compared this many frames earlier and later."""
    shift_px: int = Field(default=24, ge=1)
    """Depth is also compared this far to the left and to the right."""
    clear_ratio: float = Field(default=1.15, gt=1.0)
    """Mean gradient under the edges, relative to that at their own place, from which on a shift fits better."""


class KeyframeChecks(Config):
    """Places of a log from which its number of keyframes is estimated."""

    places: int = Field(default=24, ge=1)
    """Most frames from which the next keyframe is looked for, spread over the log; four are read for each."""
    frames_per_place: int = Field(default=8, ge=1)
    """A short log has one such frame in so many."""
    max_width: int = Field(default=160, ge=32)
    """Pixels; wider images are halved until they are not."""


class ChecksConfig(Config):
    """Settings of `duagc check`."""

    sure: float = Field(default=0.95, gt=0.5, le=1.0)
    """Confidence from which on a finding has its full severity; below, it has one level less."""
    likely: float = Field(default=0.7, ge=0.5, le=1.0)
    """Confidence below which nothing is reported."""

    times: TimeChecks = TimeChecks()
    images: ImageChecks = ImageChecks()
    camera: CameraChecks = CameraChecks()
    motion: MotionChecks = MotionChecks()
    edges: EdgeChecks = EdgeChecks()
    keyframes: KeyframeChecks = KeyframeChecks()
