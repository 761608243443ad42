"""Ground truth of a recording. Only this module (and the converters that write it) opens these files.

Every file is optional even where recording.json lists it: what is missing is Absent, with the reason.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import DuagError
from pipeline.evaluation.results import Absent
from pipeline.geometry.trajectory import Trajectory
from pipeline.messages import unpack_depth, unpack_pose_in_frame
from pipeline.recording import DEPTH_SCALE_KEY, Recording, read_log
from schemas import topics


def trajectory(recording: Recording, robot: str) -> Trajectory | Absent:
    """T_gt_camera of the robot's colour camera, in the ground-truth world that all robots share."""
    path = recording.groundtruth(robot)
    if path is None:
        return Absent(f"the recording has no ground truth of {robot}")
    records = list(read_log(path, topics=[topics.GROUNDTRUTH_POSE.of(robot)]))
    if not records:
        return Absent(f"the ground truth of {robot} has no poses")
    stamps_ns = np.array([r.publish_time_ns for r in records], dtype=np.int64)
    return Trajectory(stamps_ns, np.array([unpack_pose_in_frame(r.message()) for r in records]))


def exact_depths(
    recording: Recording, robot: str, stamps_ns: Collection[int]
) -> dict[int, NDArray[np.float32]] | Absent:
    """Exact depth images [h, w] in metres by time stamp, for those of the wanted stamps that have one."""
    path, topic = recording.groundtruth(robot), topics.GROUNDTRUTH_DEPTH.of(robot)
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


def recorded_depth_is_exact(recording: Recording, robot: str) -> bool:
    """Whether recording.json says that the depth in the robot's log has no noise: a simulated sensor."""
    sensors = recording.description["robots"][robot].get("sensors") or {}
    return sensors.get("depth_noise") == "none"


def _depth_scale(path: Path, topic: str) -> float:
    """Metres per unit of a depth topic, from the metadata of its channel."""
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
        raise DuagError(f"{path}: {topic}: {DEPTH_SCALE_KEY} is {text!r}, expected metres per unit")
    return scale


@dataclass(frozen=True)
class Surface:
    """Geometry of the scene in the ground-truth world, as triangles or, where it has none, as points."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]

    def closest(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance (m) [n] of every point [n, 3] from the surface, and unit direction [n, 3] from surface to point.

        With triangles the distance is exact and the direction is the normal of the nearest triangle. With points
        alone it is the distance from the nearest point, and the direction that of the difference.
        """
        if len(self.triangles):
            return self._closest_on_triangles(points)
        from scipy.spatial import cKDTree

        distance, index = cKDTree(self.vertices.astype(np.float64)).query(points)
        return distance, _unit(points - self.vertices[index])

    def _closest_on_triangles(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        import open3d as o3d

        tensor = o3d.core.Tensor.from_numpy
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(tensor(self.vertices), tensor(self.triangles))
        answer = scene.compute_closest_points(tensor(points.astype(np.float32)))
        distance = np.linalg.norm(points - answer["points"].numpy().astype(np.float64), axis=1)
        return distance, _unit(answer["primitive_normals"].numpy().astype(np.float64))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors of length one; z for a vector of no length."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), np.array([0.0, 0.0, 1.0]))


def surface(recording: Recording) -> Surface | Absent:
    """The geometry of the scene, from groundtruth.ply beside the logs."""
    path = recording.geometry()
    if path is None:
        return Absent("the recording has no geometry of the scene (groundtruth.ply)")
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(path)
    vertices = np.asarray(mesh.vertices, dtype=np.float32)
    if not len(vertices):
        vertices = np.asarray(o3d.io.read_point_cloud(path).points, dtype=np.float32)
    if not len(vertices):
        raise DuagError(f"{path}: found no vertices, expected a mesh or a point cloud")
    return Surface(vertices, np.asarray(mesh.triangles, dtype=np.uint32))
