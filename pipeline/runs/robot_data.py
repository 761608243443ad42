"""One robot: its own files and what its front end made of them, and what it takes home from a session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.messages import GaussianInformation, GaussianMap, Keyframe, KeyframeFactor
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.runs.keyframe_images import Images, KeyframeImages
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics


@dataclass(frozen=True)
class AgentInput:
    """The files of one robot, or of a component of it.

    Attributes:
        robot: its name, or that of the component.
        log: of its sensors.
        frontend: log of its front end.
        information: log of the information of its map.
        thickness_floor_m: least standard deviation of a Gaussian that the maps of the run were made with.
    """

    robot: str
    log: Path
    frontend: Path
    information: Path
    thickness_floor_m: float


@dataclass(frozen=True)
class RobotData:
    """One robot's own results in memory.

    Attributes:
        T_map_keyframe: [n, 4, 4] by keyframe index.
        odometry: from the keyframe that each was tracked against, refined, with its marginal information.
        registrations: the measurements behind it, independent of each other.
        images: gives color uint8 RGB [h, w, 3] and depth float32 [h, w] (m, 0 = unknown) of a keyframe.
        information: of the Gaussians, in the map frame, by the same ids.
        depth: of a Gaussian at a pixel, as the map was made.
        thickness_floor_m: least standard deviation of a Gaussian, as the maps of the run were made.
    """

    robot: str
    camera: PinholeCamera
    T_map_keyframe: Array
    odometry: list[RelativePose]
    registrations: list[RelativePose]
    images: Callable[[int], Images]
    gaussians: Gaussians
    information: GaussianInformation
    depth: DepthKind = "blended"
    thickness_floor_m: float = THICKNESS_FLOOR_M

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self.T_map_keyframe)


@dataclass(frozen=True)
class LoopClosureRecord:
    """One candidate for a closure between two keyframes, and what became of it.

    Attributes:
        robot: the end that decided.
        score: matches of compact descriptors.
        T_own_peer: [4, 4] if it was measured, with its information [6, 6] (right tangent, as measured,
            without floor).
        weight: robust weight at the end, 0 on a link that was revoked; None if it took no part in the pose
            consensus.
    """

    robot: str
    peer: str
    own_keyframe: int
    peer_keyframe: int
    score: int
    verdict: str
    matches: int
    inliers: int
    detail: str
    weight: float | None
    T_own_peer: Array | None
    information: Array | None


@dataclass(frozen=True)
class SessionResult:
    """One robot after a session, by its own estimate.

    Attributes:
        component: names of the robots that share its world frame, sorted; only itself if it met no other robot.
        T_world_keyframe: [n, 4, 4], own keyframes in the map frame of component[0]; exactly those of its own
            map if it is alone.
        T_world_keyframe_of: the same of every member, itself included, as far as their poses arrived.
        own_evidence: as it was sent, sorted by id.
        evidence: of the other members whose poses arrived, by name, as far as it arrived.
        depth_of: of a Gaussian at a pixel, as their maps were made, by name.
        camera_of: that took their keyframes, by name.
        arrived: share of their evidence that is here, by name.
        pairs: ids of matched Gaussians, int64 [n, 2], by (lower, higher) name.
        closures: every candidate that this robot decided on.
        agreed: its poses are final.
        converged: it also has everything it should have; a robot that is alone has.
        rounds: ticks it took part in.
        rounds_to_agreement: None if its poses were not agreed.
        refused: reasons of packets that could not be used, and how many.
    """

    robot: str
    component: tuple[str, ...]
    T_world_keyframe: Array
    T_world_keyframe_of: dict[str, Array]
    own_evidence: Evidence
    evidence: dict[str, Evidence]
    depth_of: dict[str, DepthKind]
    camera_of: dict[str, PinholeCamera]
    arrived: dict[str, float]
    pairs: dict[tuple[str, str], NDArray[np.int64]]
    closures: tuple[LoopClosureRecord, ...]
    agreed: bool
    converged: bool
    rounds: int
    rounds_to_agreement: int | None
    refused: dict[str, int]


def odometry_of(keyframes: Sequence[Keyframe]) -> list[RelativePose]:
    """Odometry of a robot, in order of its keyframes: each to the one that it was registered to.

    Args:
        keyframes: of one robot, in order.
    """
    return [
        RelativePose(k.previous_index, k.keyframe_index, k.T_previous_keyframe, k.information)
        for k in keyframes
        if k.previous_index >= 0
    ]


def registrations_of(
    frontend: Path, keyframes: Sequence[Keyframe], factors: Sequence[KeyframeFactor]
) -> list[RelativePose]:
    """Registrations between a robot's keyframes as its refinement weighed them, in order of the log.

    Args:
        frontend: file that both come from, for the complaint.
        keyframes: in order of their index.
        factors: the registrations.
    Raises:
        DuagError: a registration of no keyframe, or a keyframe that no chain of registrations ties to the first.
    """
    known = range(len(keyframes))
    for f in factors:
        if not (f.first_index in known and f.second_index in known and f.first_index < f.second_index):
            raise DuagError(
                f"{frontend}: a registration ties keyframes {f.first_index} and {f.second_index}, expected two of "
                f"{len(keyframes)}, the earlier one first"
            )
    loose = sorted(set(known) - _tied(factors))
    if loose:
        raise DuagError(
            f"{frontend}: registrations tie keyframe {loose[0]} to no other, expected all to keyframe 0"
        )
    return [
        RelativePose(f.first_index, f.second_index, f.T_first_second, f.weight * f.information)
        for f in factors
    ]


def _tied(factors: Sequence[KeyframeFactor]) -> set[int]:
    """Keyframes that chains of registrations tie to keyframe 0, itself included."""
    neighbors: dict[int, list[int]] = {}
    for f in factors:
        neighbors.setdefault(f.first_index, []).append(f.second_index)
        neighbors.setdefault(f.second_index, []).append(f.first_index)
    reached, border = {0}, [0]
    while border:
        new = set(neighbors.get(border.pop(), ())) - reached
        reached |= new
        border += sorted(new)
    return reached


def load(source: AgentInput) -> RobotData:
    """One robot's files in memory; its sensor log is opened when an image is asked for.

    Args:
        source: the files.

    Raises:
        DuagError: a file lacks what it should hold, or two files do not belong together.
    """
    from duagc.pipeline.recording import open_rgbd, read_log

    robot = source.robot
    wanted = (topics.KEYFRAME.of(robot), topics.MAP.of(robot), topics.KEYFRAME_FACTOR.of(robot))
    keyframes: list[Keyframe] = []
    factors: list[KeyframeFactor] = []
    gaussian_map: GaussianMap | None = None
    for record in read_log(source.frontend, wanted):
        message = record.message()
        if isinstance(message, Keyframe):
            keyframes.append(message)
        elif isinstance(message, KeyframeFactor):
            factors.append(message)
        else:
            gaussian_map = message
    if gaussian_map is None:
        raise DuagError(f"{source.frontend}: {wanted[1]} not found, expected the final map")
    if [k.keyframe_index for k in keyframes] != list(range(len(keyframes))):
        raise DuagError(f"{source.frontend}: {wanted[0]} is not numbered 0, 1, 2, ...")
    information: GaussianInformation | None = None
    for record in read_log(source.information, (topics.INFORMATION.of(robot),)):
        information = record.message()
    if information is None:
        raise DuagError(f"{source.information}: {topics.INFORMATION.of(robot)} not found")
    if not np.array_equal(information.ids, gaussian_map.gaussians.ids):
        raise DuagError(
            f"{source.information}: is about other Gaussians than {source.frontend}, expected the same ids"
        )
    registrations = registrations_of(source.frontend, keyframes, factors)
    poses = np.array([k.T_map_camera for k in keyframes], dtype=np.float64).reshape(-1, 4, 4)
    with open_rgbd(source.log) as log:
        camera = log.camera
        log.check_robot(robot_of(robot))

    return RobotData(
        robot,
        camera,
        poses,
        odometry=odometry_of(keyframes),
        registrations=registrations,
        images=KeyframeImages(source.log, source.frontend, [k.frame_index for k in keyframes]),
        gaussians=gaussian_map.gaussians,
        information=information,
        depth=gaussian_map.depth,
        thickness_floor_m=source.thickness_floor_m,
    )
