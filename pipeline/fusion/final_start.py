"""What the training of the final map begins with, and what is stated of the Gaussians in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import in_blocks
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.messages import WORLD_FRAME, GaussianInformation
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import (
    COLOR_INFORMATION,
    INFORMATION_SIZE,
    MEAN_INFORMATION,
    OPACITY_INFORMATION,
    geometry_of_information,
)

FUSED_KIND = "gauss_newton"


@dataclass(frozen=True)
class FinalStart:
    """Gaussians in the world frame: those that stay of the fused map, then those that only peers' maps have.

    Attributes:
        gaussians: n.
        information: float64 [m, 31] as in `splat.information`, of the last m: the evidence of their owners.
    """

    gaussians: Gaussians
    information: Array

    @classmethod
    def of_fused(cls, fused: FusedMap) -> FinalStart:
        """The fused map as it is.

        Args:
            fused: the map.
        """
        return cls(fused.gaussians, np.empty((0, INFORMATION_SIZE)))

    @property
    def taken(self) -> NDArray[np.int64]:
        """Ids [m] of the Gaussians that only peers' maps have."""
        return self.gaussians.ids[len(self.gaussians) - len(self.information) :]


def stated_of_fused(robot: str, fused: FusedMap, stamp_ns: int) -> GaussianInformation:
    """The summed information of the fused Gaussians as a message.

    Args:
        robot: whose map it is.
        fused: the map.
        stamp_ns: of the message.
    """
    return _stated(
        robot,
        fused.gaussians.ids,
        fused.information,
        members=fused.members,
        window="sum over the robots whose evidence was fused; observations count those robots",
        stated_scale=fused.stated_scale,
        stamp_ns=stamp_ns,
    )


def stated_of_taken(
    robot: str, start: FinalStart, stamp_ns: int, *, stated_scale: float
) -> GaussianInformation | None:
    """What their owners know of the Gaussians that the final map has and the fused map has not, as a message.

    Args:
        robot: whose map it is.
        start: of the training.
        stamp_ns: of the message.
        stated_scale: of the fused map.

    Returns:
        None if there are no such Gaussians.
    """
    if not len(start.taken):
        return None
    return _stated(
        robot,
        start.taken,
        start.information,
        members=np.ones(len(start.taken), np.int32),
        window="evidence of the owners of Gaussians that are not in the fused map; observations count those robots",
        stated_scale=stated_scale,
        stamp_ns=stamp_ns,
    )


def _stated(
    robot: str,
    ids: NDArray[np.int64],
    information: Array,
    *,
    members: NDArray[np.int32],
    window: str,
    stated_scale: float,
    stamp_ns: int,
) -> GaussianInformation:
    """Information [n, 31] of Gaussians as a message; no cross terms between mean and covariance."""

    def geometry(rows: Array) -> NDArray[np.float32]:
        stated = rows.copy()
        stated[:, MEAN_INFORMATION] /= stated_scale**2
        return geometry_of_information(stated).astype(np.float32)

    return GaussianInformation(
        stamp_ns=stamp_ns,
        robot=robot,
        kind=FUSED_KIND,
        window=window,
        ids=ids,
        geometry=in_blocks(geometry, information),
        color=information[:, COLOR_INFORMATION].astype(np.float32),
        opacity=information[:, OPACITY_INFORMATION].astype(np.float32),
        observations=members.astype(np.uint32),
        color_sigma=0.0,
        depth_sigma="as in the map of each member",
        deviation_m=np.zeros(len(ids), np.float32),  # included in the members' information
        color_pixels_per_sample=1.0,
        depth_pixels_per_sample=1.0,
        overlap=1.0,
        stated_scale=stated_scale,
        frame_id=WORLD_FRAME,
    )
