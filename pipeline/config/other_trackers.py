"""Settings of other trackers, to compare with."""

from typing import Literal

from pydantic import Field

from duagc.pipeline.config.base import Config


class StatedInformationConfig(Config):
    """What a tracker without a covariance says of the motion between a keyframe and a frame."""

    sigma_m: float = Field(default=0.01, gt=0.0)
    """Standard deviation of the translation between a keyframe and a frame, which this tracker does not estimate."""
    sigma_rad: float = Field(default=0.01, gt=0.0)
    """The same of the rotation."""


class RenderingTrackerConfig(StatedInformationConfig):
    """Tracking by rendering: gradient steps on the pose of a frame, by a map that grows with the keyframes."""

    steps: int = Field(default=100, ge=0)
    """Steps of Adam on pose and exposure for every frame, from constant velocity; the pose of the least loss counts."""
    rate_m: float = Field(default=1e-3, ge=0.0)
    """Length of a step of the translation, while its gradient keeps its sign."""
    rate_rad: float = Field(default=3e-3, ge=0.0)
    """The same of the rotation."""
    rate_exposure: float = Field(default=0.01, ge=0.0)
    """The same of log gain and offset."""
    last_rate: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of these lengths that they fall to until the last step of a frame."""
    min_alpha: float = Field(default=0.9, ge=0.0, lt=1.0)
    """Opacity of the drawn map at the first pose from which a pixel counts; SplaTAM has 0.99, which this project's maps
    reach in few pixels."""
    min_share: float = Field(default=0.05, ge=0.0, le=1.0)
    """Share of the pixels that must count; with fewer a frame is lost."""
    max_pixels: int = Field(default=160_000, ge=1)
    """Images are halved until they have no more pixels."""
    keyframe_steps: int = Field(default=60, ge=0)
    """Optimization steps of the map at a keyframe."""
    max_gaussians: int = Field(default=60_000, ge=1)
    """Most Gaussians of this map; the map that a robot writes is made afterwards, as with any tracker."""


class Open3dTrackerConfig(StatedInformationConfig):
    """Open3D's dense SLAM: frames registered to a view of a truncated signed distance function."""

    method: Literal["point_to_plane", "hybrid"] = "point_to_plane"
    """By depth alone, which is what Open3D's example does, or by depth and gray values."""
    voxel_m: float = Field(default=3.0 / 512, gt=0.0)
    """Edge of a voxel, as in Open3D's example."""
    blocks: int = Field(default=10_000, ge=1)
    """Blocks of 16 voxels to each side that there is room for at first; it grows."""
    truncation_voxels: float = Field(default=8.0, gt=0.0)
    """Distance from a surface up to which voxels change."""
    min_depth_m: float = Field(default=0.1, ge=0.0)
    """Surfaces nearer than this are not drawn."""
    max_depth_m: float = Field(default=10.0, gt=0.0)
    """Farther depth is not used; the example has 3 m."""
    max_distance_m: float = Field(default=0.07, gt=0.0)
    """Distance up to which points correspond."""
    min_fitness: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of the pixels that must correspond; with fewer a frame is lost, as in the example."""
    max_translation_m: float = Field(default=0.15, gt=0.0)
    """Translation from the predicted pose above which a frame is lost, as in the example."""
