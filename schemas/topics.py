"""Every topic that may stand in a log, in one table."""

import re
from dataclasses import dataclass
from enum import Enum


class Scope(Enum):
    """Who may read a topic."""

    SENSOR = "sensor"  # input of the estimator
    TRUTH = "truth"  # evaluation only
    ROBOT = "robot"  # the robot itself, and readers of finished runs
    TEAM = "team"  # written by the exchange; one log for all robots


@dataclass(frozen=True)
class Topic:
    """One topic.

    Attributes:
        pattern: name of the topic, with <robot> for the robot's name.
        schema: full name of the schema of its messages.
        producer: stage that writes it.
        scope: who may read it.
        meaning: in words.
    """

    pattern: str
    schema: str
    producer: str
    scope: Scope
    meaning: str

    def of(self, robot: str) -> str:
        """The topic of one robot, for example "/alpha/odometry".

        Args:
            robot: its name.
        """
        return self.pattern.replace("<robot>", robot)


COLOR = Topic(
    "/<robot>/camera/color",
    "foxglove.CompressedImage",
    "converters",
    Scope.SENSOR,
    "color image, JPEG or PNG as the source had it",
)
DEPTH = Topic(
    "/<robot>/camera/depth",
    "foxglove.RawImage",
    "converters",
    Scope.SENSOR,
    "16UC1 depth along z, registered to color, 0 = none; channel metadata depth_scale = meters per unit",
)
DEPTH_SIGMA = Topic(
    "/<robot>/camera/depth_sigma",
    "foxglove.RawImage",
    "converters",
    Scope.SENSOR,
    "16UC1 standard deviation of the registered depth of the same publish time, 0 = unknown; depth_scale as above",
)
MASK = Topic(
    "/<robot>/camera/mask",
    "foxglove.RawImage",
    "converters",
    Scope.SENSOR,
    "8UC1, pixels of the color image that may be used: 255 = yes, 0 = no, for example a moving object",
)
VALID = Topic(
    "/<robot>/camera/valid",
    "foxglove.CompressedImage",
    "converters",
    Scope.SENSOR,
    "PNG of 8 bits, of all color images of the log: pixels that show the scene: 255 = yes, 0 = no (rim, the robot)",
)
CALIBRATION = Topic(
    "/<robot>/camera/calibration",
    "foxglove.CameraCalibration",
    "converters",
    Scope.SENSOR,
    "K and D of color images; P of the pinhole camera that they are read as, which depth and masks belong to",
)
RAW_DEPTH = Topic(
    "/<robot>/depth_camera/depth",
    "foxglove.RawImage",
    "converters",
    Scope.SENSOR,
    "16UC1 depth along z of a camera of its own, read where there is no registered depth; depth_scale as above",
)
RAW_DEPTH_CALIBRATION = Topic(
    "/<robot>/depth_camera/calibration",
    "foxglove.CameraCalibration",
    "converters",
    Scope.SENSOR,
    "pinhole intrinsics of the depth camera",
)
RAW_DEPTH_TRANSFORM = Topic(
    "/<robot>/depth_camera/transform",
    "foxglove.FrameTransform",
    "converters",
    Scope.SENSOR,
    "pose of the depth camera in the color camera, constant",
)
LIDAR = Topic(
    "/<robot>/lidar/points",
    "foxglove.PointCloud",
    "converters",
    Scope.SENSOR,
    "points of one sweep, x y z in meters, read where there is no depth image; channel metadata range_sigma = meters",
)
LIDAR_TRANSFORM = Topic(
    "/<robot>/lidar/transform",
    "foxglove.FrameTransform",
    "converters",
    Scope.SENSOR,
    "pose of the LiDAR in the color camera, constant",
)
ODOMETRY_PRIOR = Topic(
    "/<robot>/odometry_prior",
    "foxglove.PoseInFrame",
    "converters",
    Scope.SENSOR,
    "pose of the color camera by another odometry (wheels, legs), in a frame of its own",
)
IMU = Topic("/<robot>/imu", "duagc.v1.Imu", "converters", Scope.SENSOR, "rates and accelerations of an IMU")
IMU_TRANSFORM = Topic(
    "/<robot>/imu/transform",
    "foxglove.FrameTransform",
    "converters",
    Scope.SENSOR,
    "pose of the IMU in the color camera, constant",
)
GROUNDTRUTH_POSE = Topic(
    "/<robot>/groundtruth/pose",
    "foxglove.PoseInFrame",
    "converters",
    Scope.TRUTH,
    "pose of the color camera in the common world frame",
)
GROUNDTRUTH_DEPTH = Topic(
    "/<robot>/groundtruth/depth",
    "foxglove.RawImage",
    "converters",
    Scope.TRUTH,
    "exact depth, 16UC1 with depth_scale, where the log's depth is noisy",
)
GROUNDTRUTH_MASK = Topic(
    "/<robot>/groundtruth/mask",
    "foxglove.RawImage",
    "converters",
    Scope.TRUTH,
    "8UC1, 255 where nothing moves, 0 elsewhere, where the log has no mask",
)
ODOMETRY = Topic("/<robot>/odometry", "duagc.v1.Odometry", "frontend", Scope.ROBOT, "pose of every frame")
KEYFRAME = Topic("/<robot>/keyframe", "duagc.v1.Keyframe", "frontend", Scope.ROBOT, "pose of every keyframe")
KEYFRAME_FACTOR = Topic(
    "/<robot>/keyframe_factor",
    "duagc.v1.KeyframeFactor",
    "frontend",
    Scope.ROBOT,
    "every registration between keyframes",
)
SUBMAP = Topic(
    "/<robot>/submap",
    "duagc.v1.Submap",
    "frontend",
    Scope.ROBOT,
    "a submap of a robot that was lost and began anew; none if it has a single one",
)
EXPOSURE = Topic(
    "/<robot>/exposure",
    "duagc.v1.FrameExposure",
    "frontend",
    Scope.ROBOT,
    "exposure of a frame, where exposures differ",
)
MAP_UPDATE = Topic(
    "/<robot>/map_update", "duagc.v1.MapUpdate", "frontend", Scope.ROBOT, "what one keyframe did to the map"
)
MAP = Topic("/<robot>/map", "duagc.v1.GaussianMap", "frontend", Scope.ROBOT, "the robot's own map")
UNREFINED_MAP = Topic(
    "/<robot>/map/unrefined",
    "duagc.v1.GaussianMap",
    "frontend",
    Scope.ROBOT,
    "the robot's own map before its final refinement, for comparison",
)
INFORMATION = Topic(
    "/<robot>/information",
    "duagc.v1.GaussianInformation",
    "information",
    Scope.ROBOT,
    "Fisher information of the robot's own map",
)
FUSED_MAP = Topic("/<robot>/fused_map", "duagc.v1.GaussianMap", "fusion", Scope.ROBOT, "the map after fusion")
REFINED_MAP = Topic(
    "/<robot>/refined_map",
    "duagc.v1.GaussianMap",
    "fusion",
    Scope.ROBOT,
    "the final map: the fused one trained on own images and peers' maps; information of what the fused one lacks",
)
CORRECTED_KEYFRAMES = Topic(
    "/<robot>/corrected_keyframes",
    "duagc.v1.CorrectedKeyframes",
    "fusion",
    Scope.ROBOT,
    "keyframe poses after consensus",
)
PEER_MAP_REPORT = Topic(
    "/<robot>/peer_map_report",
    "duagc.v1.PeerMapReport",
    "fusion",
    Scope.ROBOT,
    "check of a peer's map against own images, and whether it is used",
)
REJECTED_MATCHES = Topic(
    "/<robot>/rejected_matches",
    "duagc.v1.RejectedMatches",
    "fusion",
    Scope.ROBOT,
    "matches of a pair of robots that it did not use",
)
PEER_COLORS = Topic(
    "/<robot>/peer_colors",
    "duagc.v1.PeerColors",
    "fusion",
    Scope.ROBOT,
    "colors of every peer's camera relative to its own",
)
PEER_MESSAGE = Topic(
    "/<robot>/peer/message",
    "duagc.v1.PeerMessage",
    "exchange",
    Scope.TEAM,
    "every message it sent, once, with its bytes",
)
PEER_PACKET = Topic(
    "/<robot>/peer/packet",
    "duagc.v1.PeerPacket",
    "exchange",
    Scope.TEAM,
    "every packet it sent, with its fate",
)
EXCHANGE_SUMMARY = Topic(
    "/exchange/summary", "duagc.v1.ExchangeSummary", "exchange", Scope.TEAM, "what a session cost"
)
AGENT_ROUND = Topic(
    "/<robot>/consensus/agent",
    "duagc.v1.AgentRound",
    "exchange",
    Scope.TEAM,
    "what its agent holds and misses",
)
CONSENSUS_ROUND = Topic(
    "/<robot>/consensus/poses",
    "duagc.v1.ConsensusRound",
    "exchange",
    Scope.TEAM,
    "one round of the pose consensus",
)
LOOP_CLOSURE_DECISION = Topic(
    "/<robot>/consensus/loop_closure",
    "duagc.v1.LoopClosureDecision",
    "exchange",
    Scope.TEAM,
    "every candidate for a loop closure and what became of it",
)

TOPICS: tuple[Topic, ...] = (
    COLOR,
    DEPTH,
    DEPTH_SIGMA,
    MASK,
    VALID,
    CALIBRATION,
    RAW_DEPTH,
    RAW_DEPTH_CALIBRATION,
    RAW_DEPTH_TRANSFORM,
    LIDAR,
    LIDAR_TRANSFORM,
    ODOMETRY_PRIOR,
    IMU,
    IMU_TRANSFORM,
    GROUNDTRUTH_POSE,
    GROUNDTRUTH_DEPTH,
    GROUNDTRUTH_MASK,
    ODOMETRY,
    KEYFRAME,
    KEYFRAME_FACTOR,
    SUBMAP,
    EXPOSURE,
    MAP_UPDATE,
    MAP,
    UNREFINED_MAP,
    INFORMATION,
    FUSED_MAP,
    REFINED_MAP,
    CORRECTED_KEYFRAMES,
    PEER_MAP_REPORT,
    REJECTED_MATCHES,
    PEER_COLORS,
    PEER_MESSAGE,
    PEER_PACKET,
    EXCHANGE_SUMMARY,
    AGENT_ROUND,
    CONSENSUS_ROUND,
    LOOP_CLOSURE_DECISION,
)

ROBOT_NAME = r"[a-z][a-z0-9_]*"
COMPONENT_NAME = ROBOT_NAME + r"(?:-[1-9][0-9]*)?"
"""A robot, or a component of it that did not join the largest one: "alpha-2". No robot of a recording is named so."""
_MATCHERS = tuple(
    (re.compile(t.pattern.replace("<robot>", f"(?P<robot>{COMPONENT_NAME})")), t) for t in TOPICS
)


def find(topic: str) -> tuple[Topic, str] | None:
    """The row of a topic and the robot in it ("" if it names none); None if the table does not have it.

    Args:
        topic: its name, for example "/alpha/odometry".
    """
    for matcher, row in _MATCHERS:
        match = matcher.fullmatch(topic)
        if match:
            return row, match.groupdict().get("robot", "")
    return None
