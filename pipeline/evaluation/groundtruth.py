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


NEIGHBOURS = 8


@dataclass(frozen=True)
class Surface:
    """Geometry of the scene in the ground-truth world.

    vertices: float32 [n, 3], metres. triangles: uint32 [m, 3], indices; none for a cloud of points.
    normals: float32 [n, 3] of the vertices, unit length; none if they are not known.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    normals: NDArray[np.float32]

    def closest(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance (m) [n] of every point [n, 3] from the surface, and unit normal [n, 3] of the surface there.

        Triangles: exact. Points with normals: each stands for a disc as wide as the points are apart, and the
        nearest disc counts, so that the distance is not blurred by the sampling. Points alone: the nearest point,
        and the direction from it for a normal.
        """
        if len(self.triangles):
            return self._closest_on_triangles(points)
        if len(self.normals):
            return self._closest_on_discs(points)
        from scipy.spatial import cKDTree

        distance, index = cKDTree(self.vertices.astype(np.float64)).query(points)
        return distance, _unit(points - self.vertices[index])

    def _closest_on_discs(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        from scipy.spatial import cKDTree

        vertices, normals = self.vertices.astype(np.float64), _unit(self.normals.astype(np.float64))
        tree = cKDTree(vertices)
        radius_m = float(np.quantile(tree.query(vertices, k=2)[0][:, 1], 0.95))
        _, index = tree.query(points, k=min(NEIGHBOURS, len(vertices)))
        index = index.reshape(len(points), -1)
        offset = points[:, None, :] - vertices[index]
        across = np.sum(offset * normals[index], axis=2)
        along = np.sqrt(np.maximum(np.sum(offset**2, axis=2) - across**2, 0.0))
        distance = np.hypot(across, np.maximum(along - radius_m, 0.0))
        best = np.argmin(distance, axis=1)[:, None]
        return np.take_along_axis(distance, best, 1)[:, 0], normals[np.take_along_axis(index, best, 1)[:, 0]]

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

    none = np.zeros((0, 3))
    if _has_faces(path):
        mesh = o3d.io.read_triangle_mesh(path)
        vertices, triangles, normals = np.asarray(mesh.vertices), np.asarray(mesh.triangles), none
    else:
        cloud = o3d.io.read_point_cloud(path)
        vertices, triangles, normals = np.asarray(cloud.points), none, np.asarray(cloud.normals)
    if not len(vertices):
        raise DuagError(f"{path}: found no vertices, expected a mesh or a point cloud")
    return Surface(vertices.astype(np.float32), triangles.astype(np.uint32), normals.astype(np.float32))


def _has_faces(path: Path) -> bool:
    """Whether the header of a .ply file announces faces."""
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0]
    words = [line.split() for line in head.splitlines()]
    return any(w[:2] == [b"element", b"face"] and w[2:] != [b"0"] for w in words)
