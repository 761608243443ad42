"""Messages of Gaussian maps, their information and their growth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from duagc import schemas
from duagc.pipeline.base.arrays import array_bytes
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.messages.parts import (
    map_frame,
    pack_stamp,
    unpack_array,
    unpack_stamp,
)
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians


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
        """From duagc.v1.MapUpdate.

        Args:
            m: the protobuf message.
        """
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


def _pack_gaussians(gaussians: Gaussians, m: Any) -> None:
    """Set a duagc.v1.GaussianArrays, array by array: those of a long log take hundreds of megabytes."""
    m.count = len(gaussians)
    for name, field, dtype, _ in _GAUSSIAN_FIELDS:
        setattr(m, field, array_bytes(getattr(gaussians, name), dtype))


def unpack_gaussians(m: Any) -> Gaussians:
    """Gaussians of a duagc.v1.GaussianArrays.

    Args:
        m: the protobuf message.

    Raises:
        DuagError: an array of another length than the number of Gaussians asks for.
    """
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
    overlap: Gaussians drawn in a pixel, mean over the views. stated_scale: factor on the standard deviations of
    positions that is in `geometry`, by peers' Gaussians and own depth images; 1 where nothing says any.
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
    stated_scale: float = 1.0
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
        message = schemas.new("GaussianInformation")
        self.pack_into(message)
        return message

    def pack_into(self, m: Any) -> None:
        """Set a duagc.v1.GaussianInformation, array by array: those of a long log take hundreds of megabytes.

        Args:
            m: without values.
        """
        pack_stamp(m, self.stamp_ns)
        m.frame_id = self.frame_id or map_frame(self.robot)
        m.robot, m.kind, m.window = self.robot, self.kind, self.window
        m.count = len(self.ids)
        for field, array, dtype in (
            ("ids_int64", self.ids, "int64"),
            ("geometry_float32", self.geometry, "float32"),
            ("color_float32", self.color, "float32"),
            ("opacity_float32", self.opacity, "float32"),
            ("observations_uint32", self.observations, "uint32"),
            ("deviation_m_float32", self.deviation_m, "float32"),
        ):
            setattr(m, field, array_bytes(array, dtype))
        m.color_sigma, m.depth_sigma = float(self.color_sigma), self.depth_sigma
        m.color_pixels_per_sample = float(self.color_pixels_per_sample)
        m.depth_pixels_per_sample = float(self.depth_pixels_per_sample)
        m.overlap, m.stated_scale = float(self.overlap), float(self.stated_scale)

    @staticmethod
    def unpack(m: Any) -> GaussianInformation:
        """From duagc.v1.GaussianInformation.

        Args:
            m: the protobuf message.

        Raises:
            DuagError: an array of another length than the number of Gaussians asks for.
        """

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
            stated_scale=m.stated_scale or 1.0,  # 0 in older logs
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
        message = schemas.new("GaussianMap", frame_id=self.frame_id, robot=self.robot, depth=self.depth)
        pack_stamp(message, self.stamp_ns)
        _pack_gaussians(self.gaussians, message.gaussians)
        if self.information is not None:
            self.information.pack_into(message.information)
        return message

    @staticmethod
    def unpack(m: Any) -> GaussianMap:
        """From duagc.v1.GaussianMap.

        Args:
            m: the protobuf message.

        Raises:
            DuagError: an array of another length than the number of Gaussians asks for, or an unknown kind of
                depth.
        """
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
