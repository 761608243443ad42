"""Open3D's dense SLAM, to compare with: a truncated signed distance function, and frames registered to a view of it.

Every frame is registered point-to-plane, on three image sizes, to what the volume shows from the pose predicted by
constant velocity, and then integrated, unless it is held out for evaluation. What Open3D makes of it stands: no pose is
tested, and none is optimized later.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.open3d_import import import_open3d
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.other_tracker import OtherTracker, Placed, ReadFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.masks import masked_depth
from duagc.pipeline.registration.search import orthonormal

METERS = 1.0  # of a unit of depth
BLOCK_VOXELS = 16
ITERATIONS = (6, 3, 1)  # from the smallest image size to the largest, as in the example
MOST_NEEDED = 3  # frames that must have seen a surface, once there are as many
RANGE_MAP_WIDTH = 160
"""Pixels across the map of nearest and farthest depths. Open3D makes room for as many blocks as this has pixels for,
and draws nothing where there are more: an eighth of the image, as in its example, is too little for small images."""


class Open3dTracker(OtherTracker):
    """Tracks frames by Open3D's dense SLAM."""

    def __init__(self, camera: PinholeCamera, config: FrontendConfig, read: ReadFrame) -> None:
        """Begin with an empty volume.

        Args:
            camera: of all frames.
            config: of the front end.
            read: gives a frame of the log by its index.

        Raises:
            DuagError: Open3D is not installed, or cannot be loaded.
        """
        self.settings = config.tracking.open3d
        super().__init__(camera, config, read, self.settings)
        with _one_processor():
            self._o3d = import_open3d()
            self._begin_threads()
        core, odometry = self._o3d.core, self._o3d.t.pipelines.odometry
        self._volume = self._o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1), (1), (3)),
            voxel_size=self.settings.voxel_m,
            block_resolution=BLOCK_VOXELS,
            block_count=self.settings.blocks,
            device=core.Device("CPU:0"),
        )
        self._intrinsics = self._tensor(camera.matrix())
        self._method = {
            "point_to_plane": odometry.Method.PointToPlane,
            "hybrid": odometry.Method.Hybrid,
        }[self.settings.method]
        self._criteria = [odometry.OdometryConvergenceCriteria(count) for count in ITERATIONS]
        self._integrated: list[tuple[int, Array]] = []  # frames and their T_map_camera

    def place(self, images: RgbdImages, T_map_predicted: Array) -> Placed | Reason:
        """Where Open3D registers the frame to the volume.

        Args:
            images: of the frame.
            T_map_predicted: [4, 4], by constant velocity.
        """
        seen = self._rgbd(images)
        if seen is None:
            return Reason.NO_DEPTH
        odometry, settings = self._o3d.t.pipelines.odometry, self.settings
        try:
            found = odometry.rgbd_odometry_multi_scale(
                seen,
                self._drawn(seen, T_map_predicted),
                self._intrinsics,
                self._tensor(np.eye(4)),
                depth_scale=METERS,
                depth_max=settings.max_depth_m,
                criteria_list=self._criteria,
                method=self._method,
                params=odometry.OdometryLossParams(settings.max_distance_m),
            )
        except RuntimeError:  # a singular system: nothing corresponds, or only one plane does
            return Reason.ILL_CONDITIONED
        T_predicted_camera = found.transformation.numpy()
        if not np.isfinite(T_predicted_camera).all():
            return Reason.ILL_CONDITIONED
        if found.fitness < settings.min_fitness:
            return Reason.LOW_OVERLAP
        if np.linalg.norm(T_predicted_camera[:3, 3]) > settings.max_translation_m:
            return Reason.JUMP
        return Placed(orthonormal(T_map_predicted @ T_predicted_camera))

    def take(self, images: RgbdImages, T_map_camera: Array, keyframe: int | None) -> None:
        """Integrate a frame.

        Args:
            images: of the frame.
            T_map_camera: [4, 4].
            keyframe: its index if it became one.
        """
        seen = self._rgbd(images)
        if seen is None:
            return
        self._integrated.append((images.frame_index, T_map_camera))
        settings = self.settings
        self._volume.integrate(
            self._blocks(seen, T_map_camera),
            seen.depth,
            seen.color,
            self._intrinsics,
            self._extrinsics(T_map_camera),
            depth_scale=METERS,
            depth_max=settings.max_depth_m,
            trunc_voxel_multiplier=settings.truncation_voxels,
        )

    def map_state(self) -> Any:
        """Frames that were integrated, and where: the volume follows from them."""
        return self._integrated

    def go_on_with(self, state: Any) -> None:
        """Integrate all frames of another one again.

        Args:
            state: of `map_state`.
        """
        for frame_index, T_map_camera in state:
            self.take(RgbdImages.of(self.read(frame_index)), T_map_camera, None)

    def _begin_threads(self) -> None:
        """Compute something, so that Open3D begins as many threads as there are processors now, for good."""
        core, odometry = self._o3d.core, self._o3d.t.pipelines.odometry
        plane, normals = core.Tensor.ones((8, 8, 3), core.float32), core.Tensor.ones((8, 8, 3), core.float32)
        with suppress(RuntimeError):  # one plane determines nothing
            odometry.compute_odometry_result_point_to_plane(
                plane,
                plane,
                normals,
                self._tensor(self.camera.matrix()),
                self._tensor(np.eye(4)),
                depth_outlier_trunc=1.0,
                depth_huber_delta=1.0,
            )

    def _drawn(self, seen: Any, T_map_camera: Array) -> Any:
        """Color and depth of the volume from a pose, where it may have what is seen."""
        settings, camera = self.settings, self.camera
        least = min(MOST_NEEDED, max(1, len(self._integrated)))
        drawn = self._volume.ray_cast(
            self._blocks(seen, T_map_camera),
            self._intrinsics,
            self._extrinsics(T_map_camera),
            camera.width,
            camera.height,
            render_attributes=["depth", "color"],
            depth_scale=METERS,
            depth_min=settings.min_depth_m,
            depth_max=settings.max_depth_m,
            weight_threshold=float(least),
            trunc_voxel_multiplier=settings.truncation_voxels,
            range_map_down_factor=max(1, camera.width // RANGE_MAP_WIDTH),
        )
        image = self._o3d.t.geometry.Image
        return self._o3d.t.geometry.RGBDImage(image(drawn["color"]), image(drawn["depth"]))

    def _blocks(self, seen: Any, T_map_camera: Array) -> Any:
        """Coordinates of the blocks around what is seen."""
        settings = self.settings
        return self._volume.compute_unique_block_coordinates(
            seen.depth,
            self._intrinsics,
            self._extrinsics(T_map_camera),
            METERS,
            settings.max_depth_m,
            settings.truncation_voxels,
        )

    def _rgbd(self, images: RgbdImages) -> Any:
        """The images of a frame as Open3D takes them; None without depth."""
        depth_m = masked_depth(images.depth_m, images.mask)
        if not depth_m.any():
            return None
        image = self._o3d.t.geometry.Image
        color = images.image * np.float32(1 / 255)  # with depth in meters Open3D takes no bytes
        return self._o3d.t.geometry.RGBDImage(
            image(self._tensor(color)), image(self._tensor(depth_m[..., None]))
        )

    def _extrinsics(self, T_map_camera: Array) -> Any:
        return self._tensor(se3.inverse(T_map_camera))

    def _tensor(self, array: NDArray[Any]) -> Any:
        return self._o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


@contextmanager
def _one_processor() -> Iterator[None]:
    """Let this thread see one processor, where the system can.

    Sums of Open3D differ in the last bits from run to run with more than one thread, and poses with them.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, processors)
