"""A robot's own evidence on its Gaussians, in the flat chart of method section 1, and its change of frame.

theta [13] and information [31] are laid out as in `splat.information`. The cross terms between mean and covariance,
which the Fisher sums of the information stage hold, are dropped: fusion works per block.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import row_blocks
from duagc.pipeline.geometry import se3, spd
from duagc.pipeline.geometry.spd import add_covariance
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import (
    COLOR_INFORMATION,
    INFORMATION_SIZE,
    LOG_COVARIANCE,
    LOG_COVARIANCE_INFORMATION,
    MEAN,
    MEAN_INFORMATION,
    OPACITY_INFORMATION,
    THETA_SIZE,
    information_of_geometry,
    log_covariance_block,
    mean_block,
    pack_symmetric,
    theta_of,
)

SHAPE_FLOOR = 0.1
"""Least standard deviation of a coordinate of vec log Sigma: 5 % of a scale."""
LEAST_DEVIATION_M = 1e-4
"""Least deviation of a mean from the measured surface that is assumed."""


class MapInformation(Protocol):
    """What the information stage hands over, in the map frame: see `messages.GaussianInformation`."""

    @property
    def ids(self) -> NDArray[np.int64]: ...

    @property
    def geometry(self) -> NDArray[Any]:
        """[n, 45], upper triangle, row by row, of the 9x9 of (mean, vec log Sigma)."""

    @property
    def color(self) -> NDArray[Any]:
        """[n, 3]."""

    @property
    def opacity(self) -> NDArray[Any]:
        """[n]."""

    @property
    def observations(self) -> NDArray[Any]:
        """[n], views that saw the Gaussian."""

    @property
    def deviation_m(self) -> NDArray[Any]:
        """[n]."""

    @property
    def overlap(self) -> float:
        """Gaussians drawn in a pixel."""


@dataclass(frozen=True)
class PlacedGaussians:
    """Gaussians of one robot in a common frame, as they are compared with those of another.

    Attributes:
        ids: int64 [n].
        theta: float64 [n, 13].
        color: [n, 3], information on the color of each.
    """

    ids: NDArray[np.int64]
    theta: Array
    color: NDArray[np.floating]

    def __len__(self) -> int:
        return len(self.ids)

    def color_information(self) -> NDArray[np.floating]:
        """[n, 3]."""
        return self.color


@dataclass(frozen=True)
class Evidence:
    """A robot's own evidence on n of its Gaussians. It never contains what came from a peer.

    Attributes:
        owner: the robot.
        ids: int64 [n].
        anchors: int32 [n], index of the owner's keyframe that each is anchored to.
        theta: float64 [n, 13], in the frame of the anchor (or of the world, after `in_world`).
        information: float64 [n, 31], likewise.
    """

    owner: str
    ids: NDArray[np.int64]
    anchors: NDArray[np.int32]
    theta: Array
    information: Array

    def __post_init__(self) -> None:
        n = len(self.ids)
        shapes: dict[str, tuple[type, tuple[int, ...]]] = {
            "ids": (np.int64, (n,)),
            "anchors": (np.int32, (n,)),
            "theta": (np.float64, (n, THETA_SIZE)),
            "information": (np.float64, (n, INFORMATION_SIZE)),
        }
        for name, (dtype, shape) in shapes.items():
            array: NDArray[Any] = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if array.shape != shape:
                raise ValueError(f"Evidence.{name} has shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)

    @staticmethod
    def from_map(
        owner: str, gaussians: Gaussians, information: MapInformation | None, T_map_keyframe: ArrayLike
    ) -> Evidence:
        """Evidence on a robot's own map for its peers, each Gaussian in the frame of its anchor.

        The sums of the images hold everything but one Gaussian fixed; peers need the position of the surface. By the
        depth images it lies within the measured deviation of the mean, across the disc, however little information the
        sums have on one splat among many. That is also the limit: the square of the deviation is added to the mean's
        covariance, and `SHAPE_FLOOR` squared to that of the shape. No information stays none.

        Args:
            owner: the robot.
            gaussians: its map, in its map frame.
            information: Fisher sums in the map frame, by id; a Gaussian without has no information, nor has
                any if None.
            T_map_keyframe: [k, 4, 4], by anchor.
        """
        return _in_blocks(owner, gaussians, T_map_keyframe, partial(_shared, information=information))

    @staticmethod
    def from_rendering(
        owner: str, gaussians: Gaussians, information: MapInformation | None, T_map_keyframe: ArrayLike
    ) -> Evidence:
        """Information of a robot's own splats as parts of one rendering: the loss of its images if all move a little.

        Splats of a pixel compensate for each other, so the loss is no sum over splats; `overlap` times the Fisher sums
        is a sum over splats that is never less (|sum of n numbers|^2 <= n times the sum of their squares).

        Args:
            owner: as of `from_map`.
            gaussians: as of `from_map`.
            information: as of `from_map`.
            T_map_keyframe: as of `from_map`.
        """
        return _in_blocks(owner, gaussians, T_map_keyframe, partial(_rendered, information=information))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Evidence:
        """Pick Gaussians.

        Args:
            index: mask [n], slice or indices; the order of the result is that of the index.
        """
        return Evidence(
            self.owner, self.ids[index], self.anchors[index], self.theta[index], self.information[index]
        )

    def in_world(self, T_world_keyframe: ArrayLike) -> Evidence:
        """Move the evidence from the frames of its anchors into the world frame.

        Args:
            T_world_keyframe: poses of the owner's keyframes, by anchor, [k, 4, 4].
        """
        return self._moved(np.asarray(T_world_keyframe, dtype=np.float64))

    def _moved(self, T_new_anchor: Array) -> Evidence:
        """theta and information with every anchor's frame moved by its T [k, 4, 4]."""
        if not len(self):
            return self
        theta = moved_parameters(self.theta, T_new_anchor, self.anchors)
        information = self.information.copy()
        D_of_anchor = spd.sym_rotation(T_new_anchor[:, :3, :3])
        for rows in row_blocks(len(self)):
            R, D = T_new_anchor[self.anchors[rows], :3, :3], D_of_anchor[self.anchors[rows]]
            before = self.information[rows]
            information[rows, MEAN_INFORMATION] = pack_symmetric(R @ mean_block(before) @ R.swapaxes(-1, -2))
            information[rows, LOG_COVARIANCE_INFORMATION] = pack_symmetric(
                D @ log_covariance_block(before) @ D.swapaxes(-1, -2)
            )
        return Evidence(self.owner, self.ids, self.anchors, theta, information)

    def position_information(self) -> Array:
        """[n, 3, 3], 1/m^2."""
        return mean_block(self.information)

    def shape_information(self) -> Array:
        """[n, 6, 6], over vec log Sigma."""
        return log_covariance_block(self.information)

    def color_information(self) -> Array:
        """[n, 3]."""
        return self.information[:, COLOR_INFORMATION]

    def opacity_information(self) -> Array:
        """[n], over the logit."""
        return self.information[:, OPACITY_INFORMATION]


def moved_parameters(theta: Array, T_new_anchor: Array, anchors: NDArray[np.integer]) -> Array:
    """Parameters [n, 13] in another frame.

    Args:
        theta: [n, 13], each in the frame of its anchor.
        T_new_anchor: [k, 4, 4], poses of the anchors in the other frame.
        anchors: [n], the anchor of each.
    """
    moved = theta.astype(np.float64)
    D_of_anchor = spd.sym_rotation(T_new_anchor[:, :3, :3])
    for rows in row_blocks(len(theta)):
        T, D, block = T_new_anchor[anchors[rows]], D_of_anchor[anchors[rows]], moved[rows]
        block[:, MEAN] = (T[:, :3, :3] @ block[:, MEAN, None])[..., 0] + T[:, :3, 3]
        block[:, LOG_COVARIANCE] = (D @ block[:, LOG_COVARIANCE, None])[..., 0]
    return moved


def _in_blocks(
    owner: str, gaussians: Gaussians, T_map_keyframe: ArrayLike, packed: Callable[[Gaussians], Array]
) -> Evidence:
    """Evidence of a map in the frames of its anchors, with the information [n, 31] that `packed` gives of Gaussians."""
    theta = np.empty((len(gaussians), THETA_SIZE))
    information = np.empty((len(gaussians), INFORMATION_SIZE))
    for rows in row_blocks(len(gaussians)):
        some = gaussians.select(rows)
        theta[rows], information[rows] = theta_of(some), packed(some)
    in_map = Evidence(owner, gaussians.ids, gaussians.anchors, theta, information)
    return in_map._moved(se3.inverse(T_map_keyframe))


def _shared(gaussians: Gaussians, information: MapInformation | None) -> Array:
    """Information [n, 31] of `Evidence.from_map`, in the map frame."""
    packed, rows = _sums_of(gaussians, information)
    if information is not None and len(rows):
        deviation_m = np.zeros(len(gaussians))
        deviation_m[rows >= 0] = information.deviation_m[rows[rows >= 0]]
        position = stated_positions(gaussians, mean_block(packed), deviation_m)
        shape = add_covariance(log_covariance_block(packed), SHAPE_FLOOR**2 * np.eye(6))
        packed[:, MEAN_INFORMATION], packed[:, LOG_COVARIANCE_INFORMATION] = (
            pack_symmetric(position),
            pack_symmetric(shape),
        )
    return packed


def stated_positions(gaussians: Gaussians, sums: Array, deviation_m: Array) -> Array:
    """Information [n, 3, 3], 1/m^2, of the positions of a robot's own Gaussians as `Evidence.from_map` states it.

    Args:
        gaussians: its map.
        sums: position blocks of the Fisher sums [n, 3, 3], in the same frame; none stays none.
        deviation_m: of the means from the measured surface [n].
    """
    known = (sums != 0).any(axis=(1, 2), keepdims=True)
    across = known * _across_surface(gaussians, deviation_m)
    return add_covariance(sums + across, deviation_m[:, None, None] ** 2 * np.eye(3))


def _rendered(gaussians: Gaussians, information: MapInformation | None) -> Array:
    """Information [n, 31] of `Evidence.from_rendering`, in the map frame."""
    packed, _ = _sums_of(gaussians, information)
    return packed if information is None else packed * information.overlap


def _across_surface(gaussians: Gaussians, deviation_m: Array) -> Array:
    """Information [n, 3, 3], 1/m^2, of surfaces within the deviation [n] of means, along the discs' normals."""
    normal = gaussians.normals() / np.maximum(deviation_m, LEAST_DEVIATION_M)[:, None]
    return np.asarray(normal[:, :, None] * normal[:, None, :], dtype=np.float64)


def _sums_of(gaussians: Gaussians, information: MapInformation | None) -> tuple[Array, NDArray[np.int64]]:
    """The block diagonal of the sums [n, 31] in the map frame, by Gaussian, and the row of each there, -1 without."""
    packed = np.zeros((len(gaussians), INFORMATION_SIZE))
    if information is None:
        return packed, np.full(len(gaussians), -1, dtype=np.int64)
    rows = rows_by_id(gaussians.ids, information.ids)
    found, row = rows >= 0, rows[rows >= 0]
    packed[found] = information_of_geometry(
        information.geometry[row], information.color[row], information.opacity[row]
    )
    return packed, rows


def rows_by_id(wanted: NDArray[np.int64], ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """The row of each wanted id in `ids`, -1 where it is not there.

    Args:
        wanted: int64 [n].
        ids: int64 [m], in any order.

    Returns:
        int64 [n].
    """
    if not len(ids):
        return np.full(len(wanted), -1, dtype=np.int64)
    order = np.argsort(ids, kind="stable")
    at = order[np.minimum(np.searchsorted(ids[order], wanted), len(order) - 1)]
    return np.where(ids[at] == wanted, at, -1).astype(np.int64)
