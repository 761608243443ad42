"""Ground truth of a recording. Only this module (and the converters that write it) opens these files.

Every file is optional even where recording.json lists it: what is missing is Absent, with the reason.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.ply_points import read_points
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.messages import unpack_depth, unpack_mask, unpack_pose_in_frame
from duagc.pipeline.recording import DEPTH_SCALE_KEY, Recording, read_log, verify
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics


def trajectory(recording: Recording, robot: str) -> Trajectory | Absent:
    """T_gt_camera of the robot's color camera, in the ground-truth world that all robots share.

    Args:
        recording: with or without ground truth.
        robot: name, or the name of one of its components.

    Returns:
        Poses [n, 4, 4] by stamp in ns; Absent if there is no file, or no pose in it.

    Raises:
        DuagError: the recording has no such robot, or the file is damaged.
    """
    path = recording.groundtruth(robot)
    if path is None:
        return Absent(f"the recording has no ground truth of {robot}")
    records = list(read_log(path, topics=[topics.GROUNDTRUTH_POSE.of(robot_of(robot))]))
    if not records:
        return Absent(f"the ground truth of {robot} has no poses")
    stamps_ns = np.array([r.publish_time_ns for r in records], dtype=np.int64)
    return Trajectory(stamps_ns, np.array([unpack_pose_in_frame(r.message()) for r in records]))


def exact_depths(
    recording: Recording, robot: str, stamps_ns: Collection[int]
) -> dict[int, NDArray[np.float32]] | Absent:
    """Exact depth images [h, w] in meters by time stamp, for those of the wanted stamps that have one.

    Args:
        recording: with or without ground truth.
        robot: name, or the name of one of its components.
        stamps_ns: of the wanted images.

    Raises:
        DuagError: the recording has no such robot, or the file is damaged.
    """
    path, topic = recording.groundtruth(robot), topics.GROUNDTRUTH_DEPTH.of(robot_of(robot))
    if path is None:
        return Absent(f"the recording has no ground truth of {robot}")
    scale, found = None, {}
    for record in read_log(path, topics=[topic]):
        if scale is None:
            scale = _depth_scale(path, topic)
        if record.publish_time_ns in stamps_ns:
            raw = unpack_depth(record.message(), f"{path}: {topic} at {record.publish_time_ns} ns")
            found[record.publish_time_ns] = raw.astype(np.float32) * np.float32(scale)
    return found or Absent("the recording has no exact depth")


def static_masks(
    recording: Recording, robot: str, stamps_ns: Collection[int]
) -> dict[int, NDArray[np.bool_]]:
    """Where nothing moves [h, w], by time stamp, of the wanted stamps; none where the log has the masks itself.

    Args:
        recording: with or without ground truth.
        robot: name, or the name of one of its components.
        stamps_ns: of the wanted masks.

    Raises:
        DuagError: the recording has no such robot, or the file is damaged.
    """
    path, topic = recording.groundtruth(robot), topics.GROUNDTRUTH_MASK.of(robot_of(robot))
    if path is None:
        return {}
    return {
        record.publish_time_ns: unpack_mask(record.proto(), f"{path}: {topic} at {record.publish_time_ns} ns")
        for record in read_log(path, topics=[topic])
        if record.publish_time_ns in stamps_ns
    }


def recorded_depth_is_exact(recording: Recording, robot: str) -> bool:
    """Whether the depth in the robot's log is the true one: a simulated sensor without noise.

    Such depth may still be late, in steps or seen through a lens; then the ground truth has the exact depth apart.

    Args:
        recording: with or without ground truth.
        robot: name, or the name of one of its components.

    Raises:
        DuagError: the recording has no such robot, or its file of ground truth is damaged.
    """
    sensors = recording.description["robots"][robot_of(robot)].get("sensors") or {}
    if sensors.get("depth_noise") != "none":
        return False
    path, topic = recording.groundtruth(robot), topics.GROUNDTRUTH_DEPTH.of(robot_of(robot))
    if path is None:
        return True
    with LogFile(path) as log:
        return topic not in log.channels


def knows_rotations(recording: Recording, robot: str) -> bool:
    """Whether the rotations of the true poses mean anything; satellite positions, for example, have none.

    Args:
        recording: whose description says it.
        robot: name, or the name of one of its components.
    """
    sensors = recording.description["robots"][robot_of(robot)].get("sensors") or {}
    return sensors.get("truth") != "position"


def _depth_scale(path: Path, topic: str) -> float:
    """Meters per unit of a depth topic, from the metadata of its channel."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    channels = summary.channels.values() if summary else ()
    text = next((c.metadata.get(DEPTH_SCALE_KEY, "missing") for c in channels if c.topic == topic), "missing")
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not scale > 0.0:
        raise DuagError(f"{path}: {topic}: {DEPTH_SCALE_KEY} is {text!r}, expected meters per unit")
    return scale


NEIGHBORS = 8


@dataclass(frozen=True)
class Surface:
    """Geometry of the scene in the ground-truth world: points on the surfaces, each standing for a disc.

    points: float64 [n, 3], meters. normals: float64 [n, 3], unit length.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    def closest(self, queries: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance [m] of every query from the surface, meters, and unit normal [m, 3] of the surface there.

        A disc is as wide as the points are apart, and the nearest disc counts, so that the distance is not
        blurred by the sampling.

        Args:
            queries: points [m, 3], meters, ground-truth world.
        """
        index, _, distance = self._nearest_disc(queries)
        return distance, self.normals[index]

    def nearest(self, queries: NDArray[np.float64]) -> NDArray[np.float64]:
        """Queries, each moved along the normal into the plane of the disc that is nearest to it.

        Args:
            queries: points [m, 3], meters, ground-truth world.
        """
        index, across, _ = self._nearest_disc(queries)
        return queries - across[:, None] * self.normals[index]

    def _nearest_disc(
        self, queries: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Index of the nearest disc [m], and the distances from its plane, with their sign, and from the disc."""
        tree, radius_m = self._discs
        neighbors = min(NEIGHBORS, len(self.points))
        _, index = tree.query(queries, k=neighbors)
        index = index.reshape(len(queries), neighbors)
        offset = queries[:, None, :] - self.points[index]
        across = np.sum(offset * self.normals[index], axis=2)
        along = np.sqrt(np.maximum(np.sum(offset**2, axis=2) - across**2, 0.0))
        distance = np.hypot(across, np.maximum(along - radius_m, 0.0))
        best = np.argmin(distance, axis=1)[:, None]
        found, plane, away = (np.take_along_axis(each, best, 1)[:, 0] for each in (index, across, distance))
        return found, plane, away

    @cached_property
    def _discs(self) -> tuple[Any, float]:
        """The points by place, and the radius of a disc; the same for every map that is compared."""
        from scipy.spatial import cKDTree

        tree = cKDTree(self.points)
        return tree, float(np.quantile(tree.query(self.points, k=2)[0][:, 1], 0.95))


def surface(recording: Recording) -> Surface | Absent:
    """The geometry of the scene, from groundtruth.ply next to the logs.

    Args:
        recording: with or without geometry.

    Raises:
        DuagError: not a binary .ply of points with normals, cut short, or values that are not finite.
    """
    path = recording.geometry()
    if path is None:
        return Absent("the recording has no geometry of the scene (groundtruth.ply)")
    rows = read_points(path)
    normals = np.stack([rows[name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64)
    points = np.stack([rows[name] for name in ("x", "y", "z")], axis=1).astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if len(points) < 2 or not (
        np.isfinite(points).all() and np.isfinite(normals).all() and (length > 0).all()
    ):
        raise DuagError(f"{path}: {len(points)} vertices, expected two or more, finite, each with a normal")
    return Surface(points, normals / length)


def check(recording: Recording) -> None:
    """Look at every file of ground truth once, before hours are spent on a run that could not be evaluated.

    Args:
        recording: with or without ground truth.

    Raises:
        DuagError: a file that is there is damaged.
    """
    for robot in recording.robots:
        path = recording.groundtruth(robot)
        if path is not None:
            verify(path)
    surface(recording)
