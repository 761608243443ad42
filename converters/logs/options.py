"""What the user may say about the logs of a robot."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from duagc.converters.layouts.stereo import StereoOptions
from duagc.converters.layouts.tum_layout import AssociationOptions


class LogOptions(AssociationOptions, StereoOptions):
    """Topics, times and cameras; whatever is empty is found by type and name."""

    @property
    def keeps_depth_time(self) -> bool:
        """As of `AssociationOptions`; eyes and sweeps are of one time with the color, and cannot be moved."""
        return super().keeps_depth_time and self.depth_from == "image"

    color: str = ""
    """Topic of the color images."""
    depth_from: Literal["image", "stereo", "lidar"] = "image"
    """Where depth comes from: depth images, a stereo pair with color as its left eye, or points of a LiDAR."""
    depth: str = ""
    """Topic of the depth images; of the right images, or of the points, by `depth_from`."""
    color_info: str = ""
    """Topic of the color camera's CameraInfo."""
    depth_info: str = ""
    """Topic of the depth camera's CameraInfo, or the right camera's."""
    color_camera: str = ""
    """Camera of color where the log has no CameraInfo: `fx fy cx cy` (px) and, if it distorts, `k1 k2 p1 p2 k3`."""
    depth_camera: str = ""
    """The same of depth images; that of color if `registered=yes`."""
    imu: str = ""
    """Topic of an IMU on the robot; its turning rates help tracking. None if empty."""
    odometry: str = ""
    """Topic of another odometry (wheels, legs: Odometry or PoseStamped) that helps tracking. None if empty."""
    truth: str = ""
    """Topic of true poses (Odometry, PoseStamped, TransformStamped), or a transform that changes as "/tf PARENT CHILD",
    for evaluation; none if empty."""
    truth_file: str = ""
    """File of true poses as of TUM, `time x y z qx qy qz qw` in seconds and meters, instead of a topic."""
    truth_offset_s: float = Field(default=0.0, allow_inf_nan=False)
    """Seconds to add to the times of true poses, if their clock is another one; see `truth_lag_s` in recording.json."""
    truth_frame: str = ""
    """Frame that the true poses are of; by default what the message says, which /tf_static must tie to the camera."""
    namespaces: str = ""
    """Namespaces of several robots in one log, separated by commas, for example "/acl_jackal,/sparkal1"; they name the
    robots, and stand for {namespace} in the names of other topics."""
    registered: Literal["auto", "yes", "no"] = "auto"
    """Whether depth is seen from the color camera; auto: by frame and camera, or by name with one of them."""
    T_color_depth: str = ""
    """Extrinsics "x y z qw qx qy qz" (m) of a depth camera, right camera or LiDAR that /tf_static does not know;
    x_color = T x_depth."""
    T_color_imu: str = ""
    """Extrinsics of the IMU, likewise, where /tf_static does not know them."""
    T_odometry_color: str = ""
    """Pose of the color camera in the body that the odometry is of, likewise."""
    T_truth_color: str = ""
    """Pose of the color camera in the body that the true poses are of, likewise."""
    depth_scale: float = Field(default=0.001, gt=0)
    """Meters per unit of 16-bit depth."""
    depth_along: Literal["z", "ray"] = "z"
    """What depth images state: depth along z, or the distance from the camera along the ray of each pixel."""
    farthest_m: float = Field(default=0.0, ge=0.0)
    """Depth from here on is none; 0: found where a camera gives its greatest distance for what it does not measure."""
    range_sigma_m: float = Field(default=0.03, gt=0)
    """Standard deviation of the LiDAR's ranges."""
    time_source: Literal["header", "log", "publish"] = "header"
    """Times of the headers, those of recording, or those of publication (which only MCAP knows)."""
    clock_offset_s: float = Field(default=0.0, allow_inf_nan=False)
    """Seconds to add to all times of the robot, for clocks that differ between robots."""
    clocks: Literal["as_recorded", "estimated", "from_zero"] = "as_recorded"
    """What becomes of the robots' clocks: kept (their difference is estimated and reported), corrected by the estimated
    difference where it matters, or every robot starts at time 0."""
    pieces: bool = False
    """All logs of the folder belong to one robot, or to several in different namespaces."""
    undistort: bool = True
    """Take the distortion out of color, on reading."""
