"""Messages of what a robot estimates: poses, keyframes, maps and their information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from duagc import schemas
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.messages.parts import (
    WORLD_FRAME,
    Array,
    map_frame,
    numbers,
    pack_array,
    pack_information,
    pack_pose,
    pack_stamp,
    unpack_array,
    unpack_pose,
    unpack_stamp,
)
from duagc.pipeline.messages.peers import PeerColors, PeerMapReport
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians

_STATUS = {"ok": 1, "lost": 2, "relocalized": 3}
_STATUS_NAME = {number: name for name, number in _STATUS.items()}


@dataclass(frozen=True, eq=False)
class Odometry:
    """Pose of one frame, as the front end had it when the frame had been tracked.

    stamp_ns: time of the frame. frame_index: position in the log, from 0. held_out: tracked but never mapped.
    keyframe_index: keyframe it was tracked against. T_map_camera, T_keyframe_camera: [4, 4].
    information: [6, 6] of T_keyframe_camera, right tangent (translation m, rotation rad); zero when lost.
    status: "ok", "lost" or "relocalized". overlap: share of the reference seen, 0..1.
    rms_depth_m, rms_color: residuals, meters and image units. reason: why it is lost, or tracked by one
    image alone, else "".
    """

    schema: ClassVar[str] = "duagc.v1.Odometry"

    stamp_ns: int
    robot: str
    frame_index: int
    held_out: bool
    keyframe_index: int
    T_map_camera: Array
    T_keyframe_camera: Array
    information: Array
    status: str
    overlap: float
    rms_depth_m: float
    rms_color: float
    reason: str = ""

    def pack(self) -> Any:
        """duagc.v1.Odometry."""
        message = schemas.new(
            "Odometry",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            frame_index=int(self.frame_index),
            held_out=bool(self.held_out),
            keyframe_index=int(self.keyframe_index),
            pose_map_camera=pack_pose(self.T_map_camera),
            pose_keyframe_camera=pack_pose(self.T_keyframe_camera),
            information=pack_information(self.information),
            status=_STATUS[self.status],
            overlap=float(self.overlap),
            rms_depth_m=float(self.rms_depth_m),
            rms_color=float(self.rms_color),
            reason=self.reason,
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> Odometry:
        """From duagc.v1.Odometry."""
        if m.status not in _STATUS_NAME:
            raise DuagError(f"Odometry.status is {m.status}, expected one of {sorted(_STATUS_NAME)}")
        return Odometry(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            frame_index=m.frame_index,
            held_out=m.held_out,
            keyframe_index=m.keyframe_index,
            T_map_camera=unpack_pose(m.pose_map_camera, "Odometry.pose_map_camera"),
            T_keyframe_camera=unpack_pose(m.pose_keyframe_camera, "Odometry.pose_keyframe_camera"),
            information=numbers(m.information, (6, 6), "Odometry.information"),
            status=_STATUS_NAME[m.status],
            overlap=m.overlap,
            rms_depth_m=m.rms_depth_m,
            rms_color=m.rms_color,
            reason=m.reason,
        )


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that carries part of the map.

    stamp_ns: time of the frame. keyframe_index: from 0. frame_index: position in the log. T_map_camera: [4, 4].
    previous_index: keyframe it was tracked against, -1 for the first. T_previous_keyframe: [4, 4], identity for the
    first. information: [6, 6] of T_previous_keyframe, right tangent (translation m, rotation rad), zero for the
    first. exposure: (a, b) of the frame relative to the map, as the tracker defines it.
    """

    schema: ClassVar[str] = "duagc.v1.Keyframe"

    stamp_ns: int
    robot: str
    keyframe_index: int
    frame_index: int
    T_map_camera: Array
    previous_index: int
    T_previous_keyframe: Array
    information: Array
    exposure: tuple[float, float]

    def pack(self) -> Any:
        """duagc.v1.Keyframe."""
        message = schemas.new(
            "Keyframe",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            keyframe_index=int(self.keyframe_index),
            frame_index=int(self.frame_index),
            pose_map_camera=pack_pose(self.T_map_camera),
            previous_index=int(self.previous_index),
            pose_previous_keyframe=pack_pose(self.T_previous_keyframe),
            information=pack_information(self.information),
            exposure_a=float(self.exposure[0]),
            exposure_b=float(self.exposure[1]),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> Keyframe:
        """From duagc.v1.Keyframe."""
        return Keyframe(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            keyframe_index=m.keyframe_index,
            frame_index=m.frame_index,
            T_map_camera=unpack_pose(m.pose_map_camera, "Keyframe.pose_map_camera"),
            previous_index=m.previous_index,
            T_previous_keyframe=unpack_pose(m.pose_previous_keyframe, "Keyframe.pose_previous_keyframe"),
            information=numbers(m.information, (6, 6), "Keyframe.information"),
            exposure=(m.exposure_a, m.exposure_b),
        )


@dataclass(frozen=True, eq=False)
class KeyframeFactor:
    """A registration between two keyframes, with the weight that the refinement of their poses gave it.

    stamp_ns: time of the later keyframe. first_index, second_index: keyframes i < j. T_first_second: [4, 4] as
    registered. information: [6, 6] of it, right tangent (translation m, rotation rad), without the weight, lowered
    if the registrations contradict each other. weight: robust weight, 0..1.
    """

    schema: ClassVar[str] = "duagc.v1.KeyframeFactor"

    stamp_ns: int
    robot: str
    first_index: int
    second_index: int
    T_first_second: Array
    information: Array
    weight: float

    def pack(self) -> Any:
        """duagc.v1.KeyframeFactor."""
        message = schemas.new(
            "KeyframeFactor",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            first_index=int(self.first_index),
            second_index=int(self.second_index),
            pose_first_second=pack_pose(self.T_first_second),
            information=pack_information(self.information),
            weight=float(self.weight),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> KeyframeFactor:
        """From duagc.v1.KeyframeFactor."""
        return KeyframeFactor(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            first_index=m.first_index,
            second_index=m.second_index,
            T_first_second=unpack_pose(m.pose_first_second, "KeyframeFactor.pose_first_second"),
            information=numbers(m.information, (6, 6), "KeyframeFactor.information"),
            weight=m.weight,
        )


@dataclass(frozen=True)
class MapUpdate:
    """What the mapping of one keyframe did: Gaussians inserted, pruned and then present; loss before and after."""

    schema: ClassVar[str] = "duagc.v1.MapUpdate"

    stamp_ns: int
    robot: str
    keyframe_index: int
    inserted: int
    pruned: int
    total: int
    loss_before: float
    loss_after: float

    def pack(self) -> Any:
        """duagc.v1.MapUpdate."""
        message = schemas.new(
            "MapUpdate",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            keyframe_index=int(self.keyframe_index),
            inserted=int(self.inserted),
            pruned=int(self.pruned),
            total=int(self.total),
            loss_before=float(self.loss_before),
            loss_after=float(self.loss_after),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> MapUpdate:
        """From duagc.v1.MapUpdate."""
        return MapUpdate(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            keyframe_index=m.keyframe_index,
            inserted=m.inserted,
            pruned=m.pruned,
            total=m.total,
            loss_before=m.loss_before,
            loss_after=m.loss_after,
        )


# field of Gaussians, field of duagc.v1.GaussianArrays, element type, shape after n
_GAUSSIAN_FIELDS = (
    ("ids", "ids_int64", "int64", ()),
    ("anchors", "anchors_int32", "int32", ()),
    ("means", "means_float32", "float32", (3,)),
    ("quats_wxyz", "quats_wxyz_float32", "float32", (4,)),
    ("log_scales", "log_scales_float32", "float32", (3,)),
    ("colors", "colors_float32", "float32", (3,)),
    ("opacity_logits", "opacity_logits_float32", "float32", ()),
)


def pack_gaussians(gaussians: Gaussians) -> Any:
    """duagc.v1.GaussianArrays."""
    arrays = {
        field: pack_array(getattr(gaussians, name), dtype) for name, field, dtype, _ in _GAUSSIAN_FIELDS
    }
    return schemas.new("GaussianArrays", count=len(gaussians), **arrays)


def unpack_gaussians(m: Any) -> Gaussians:
    """Gaussians of a duagc.v1.GaussianArrays."""
    return Gaussians(
        **{
            name: unpack_array(getattr(m, field), dtype, (m.count, *tail), f"GaussianArrays.{field}")
            for name, field, dtype, tail in _GAUSSIAN_FIELDS
        }
    )


@dataclass(frozen=True, eq=False)
class GaussianInformation:
    """Fisher information of n Gaussians of one robot, in the frame of its map.

    kind: which approximation. window: which views were summed, in words. ids: int64 [n].
    geometry: float32 [n, 45], upper triangle, row-major, of the 9x9 over (mean 3, vec log covariance 6).
    color: float32 [n, 3], diagonal over RGB. opacity: float32 [n], over the logit. observations: uint32 [n], views.
    color_sigma: noise of a color channel, image units. depth_sigma: noise of depth, as a formula of z in meters.
    deviation_m: float32 [n], how far the mean is from the surface that the robot's depth images measured; the sums
    hold everything but one Gaussian fixed and do not know of it. color_pixels_per_sample, depth_pixels_per_sample:
    pixels that say together what one would say alone, because their residuals are alike; the sums are divided by them.
    overlap: Gaussians drawn in a pixel, mean over the views.
    """

    schema: ClassVar[str] = "duagc.v1.GaussianInformation"

    stamp_ns: int
    robot: str
    kind: str
    window: str
    ids: NDArray[np.int64]
    geometry: NDArray[np.float32]
    color: NDArray[np.float32]
    opacity: NDArray[np.float32]
    observations: NDArray[np.uint32]
    color_sigma: float
    depth_sigma: str
    deviation_m: NDArray[np.float32]
    color_pixels_per_sample: float
    depth_pixels_per_sample: float
    overlap: float
    frame_id: str = ""  # empty: the robot's map

    def __post_init__(self) -> None:
        n = len(self.ids)
        shapes = {
            "geometry": (n, 45), "color": (n, 3), "opacity": (n,), "observations": (n,), "deviation_m": (n,)
        }  # fmt: skip
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"GaussianInformation.{name} has {np.shape(getattr(self, name))}, expected {shape}"
                )

    def pack(self) -> Any:
        """duagc.v1.GaussianInformation."""
        message = schemas.new(
            "GaussianInformation",
            frame_id=self.frame_id or map_frame(self.robot),
            robot=self.robot,
            kind=self.kind,
            window=self.window,
            count=len(self.ids),
            ids_int64=pack_array(self.ids, "int64"),
            geometry_float32=pack_array(self.geometry, "float32"),
            color_float32=pack_array(self.color, "float32"),
            opacity_float32=pack_array(self.opacity, "float32"),
            observations_uint32=pack_array(self.observations, "uint32"),
            color_sigma=float(self.color_sigma),
            depth_sigma=self.depth_sigma,
            deviation_m_float32=pack_array(self.deviation_m, "float32"),
            color_pixels_per_sample=float(self.color_pixels_per_sample),
            depth_pixels_per_sample=float(self.depth_pixels_per_sample),
            overlap=float(self.overlap),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> GaussianInformation:
        """From duagc.v1.GaussianInformation."""

        def array(field: str, dtype: str, *tail: int) -> NDArray[Any]:
            return unpack_array(getattr(m, field), dtype, (m.count, *tail), f"GaussianInformation.{field}")

        return GaussianInformation(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            kind=m.kind,
            window=m.window,
            ids=array("ids_int64", "int64"),
            geometry=array("geometry_float32", "float32", 45),
            color=array("color_float32", "float32", 3),
            opacity=array("opacity_float32", "float32"),
            observations=array("observations_uint32", "uint32"),
            color_sigma=m.color_sigma,
            depth_sigma=m.depth_sigma,
            deviation_m=array("deviation_m_float32", "float32"),
            color_pixels_per_sample=m.color_pixels_per_sample,
            depth_pixels_per_sample=m.depth_pixels_per_sample,
            overlap=m.overlap,
            frame_id=m.frame_id,
        )


@dataclass(frozen=True, eq=False)
class GaussianMap:
    """A complete map in the frame `frame_id`, with the information of its Gaussians where it is known.

    depth: which depth of a Gaussian at a pixel the map was made with (DepthKind).
    """

    schema: ClassVar[str] = "duagc.v1.GaussianMap"

    stamp_ns: int
    robot: str
    frame_id: str
    gaussians: Gaussians
    information: GaussianInformation | None = None
    depth: DepthKind = "blended"

    def pack(self) -> Any:
        """duagc.v1.GaussianMap."""
        message = schemas.new(
            "GaussianMap",
            frame_id=self.frame_id,
            robot=self.robot,
            gaussians=pack_gaussians(self.gaussians),
            information=None if self.information is None else self.information.pack(),
            depth=self.depth,
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> GaussianMap:
        """From duagc.v1.GaussianMap."""
        return GaussianMap(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            frame_id=m.frame_id,
            gaussians=unpack_gaussians(m.gaussians),
            information=GaussianInformation.unpack(m.information) if m.HasField("information") else None,
            depth=_depth_kind(m.depth),
        )


def _depth_kind(name: str) -> DepthKind:
    """The kind of depth of a map; maps written before it was recorded are blended."""
    for kind in DEPTH_KINDS:
        if kind == (name or "blended"):
            return kind
    raise DuagError(f"GaussianMap.depth is {name!r}, expected one of {', '.join(DEPTH_KINDS)}")


@dataclass(frozen=True, eq=False)
class CorrectedKeyframes:
    """All keyframe poses of one robot after consensus, by its own estimate.

    component: names of the robots that share this world, sorted. keyframe_indices: int32 [k], ascending.
    T_world_keyframe: [k, 4, 4].
    """

    schema: ClassVar[str] = "duagc.v1.CorrectedKeyframes"

    stamp_ns: int
    robot: str
    component: list[str]
    keyframe_indices: NDArray[np.int32]
    T_world_keyframe: Array

    def pack(self) -> Any:
        """duagc.v1.CorrectedKeyframes."""
        poses = np.asarray(self.T_world_keyframe, dtype=np.float64)
        if poses.shape != (len(self.keyframe_indices), 4, 4):
            raise ValueError(
                f"T_world_keyframe is {poses.shape}, expected {(len(self.keyframe_indices), 4, 4)}"
            )
        message = schemas.new(
            "CorrectedKeyframes",
            frame_id=WORLD_FRAME,
            robot=self.robot,
            component=list(self.component),
            count=len(poses),
            keyframe_indices_int32=pack_array(self.keyframe_indices, "int32"),
            poses_world_keyframe_float64=pack_array(poses[:, :3], "float64"),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> CorrectedKeyframes:
        """From duagc.v1.CorrectedKeyframes."""
        field = "CorrectedKeyframes.poses_world_keyframe_float64"
        rows = unpack_array(m.poses_world_keyframe_float64, "float64", (m.count, 3, 4), field)
        poses = np.tile(np.eye(4), (m.count, 1, 1))
        poses[:, :3] = rows
        indices = unpack_array(
            m.keyframe_indices_int32, "int32", (m.count,), "CorrectedKeyframes.keyframe_indices_int32"
        )
        return CorrectedKeyframes(unpack_stamp(m), m.robot, list(m.component), indices, poses)


_UNPACK: dict[str, Callable[[Any], Any]] = {
    c.schema: c.unpack
    for c in (
        Odometry,
        Keyframe,
        KeyframeFactor,
        MapUpdate,
        GaussianMap,
        GaussianInformation,
        CorrectedKeyframes,
        PeerColors,
        PeerMapReport,
    )
}


def unpack(message: Any) -> Any:
    """The dataclass of a protobuf message that has one here; any other message as it is."""
    function = _UNPACK.get(message.DESCRIPTOR.full_name)
    return message if function is None else function(message)
