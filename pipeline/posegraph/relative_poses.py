"""Measured relative poses: one, many as arrays, and loop closures between two robots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.spd import add_covariance

Index = NDArray[np.int64]


@dataclass(frozen=True)
class RelativePose:
    """One measured motion between two keyframes of one robot.

    Attributes:
        i: index of the keyframe that it is seen from.
        j: index of the keyframe that is seen.
        T_i_j: [4, 4], coordinates of keyframe j to those of keyframe i.
        information: [6, 6], right tangent (translation, rotation) of T_i_j, 1/m^2 and 1/rad^2.
    """

    i: int
    j: int
    T_i_j: Array
    information: Array


@dataclass(frozen=True)
class RelativePoses:
    """m measured relative poses between the variables of some solver, as arrays.

    Attributes:
        i: int64 [m], index of the variable that each is seen from.
        j: int64 [m], index of the variable that is seen.
        T_i_j: float64 [m, 4, 4], variable j's frame to variable i's.
        information: float64 [m, 6, 6], right tangent (translation, rotation) of T_i_j, 1/m^2 and 1/rad^2; zero where
            nothing is known.
        whitening: float64 [m, 6, 6], A with r = A e for the error e of `least_squares`.
    """

    i: Index
    j: Index
    T_i_j: Array
    information: Array
    whitening: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        m = len(self.i)
        shapes: dict[str, tuple[type, tuple[int, ...]]] = {
            "i": (np.int64, (m,)),
            "j": (np.int64, (m,)),
            "T_i_j": (np.float64, (m, 4, 4)),
            "information": (np.float64, (m, 6, 6)),
        }
        for name, (dtype, shape) in shapes.items():
            array: NDArray[Any] = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if array.shape != shape:
                raise ValueError(f"RelativePoses.{name} has shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "whitening", _whitening(self.T_i_j, self.information))

    @staticmethod
    def of(poses: Sequence[RelativePose]) -> RelativePoses:
        """Collect single relative poses into arrays.

        Args:
            poses: the relative poses; their order is kept.
        """
        return RelativePoses(
            np.array([p.i for p in poses], dtype=np.int64),
            np.array([p.j for p in poses], dtype=np.int64),
            np.array([p.T_i_j for p in poses], dtype=np.float64).reshape(-1, 4, 4),
            np.array([p.information for p in poses], dtype=np.float64).reshape(-1, 6, 6),
        )

    @staticmethod
    def empty() -> RelativePoses:
        """None at all."""
        return RelativePoses.of([])

    def __len__(self) -> int:
        return len(self.i)

    def select(self, index: NDArray[np.bool_] | Index | slice) -> RelativePoses:
        """Pick relative poses.

        Args:
            index: mask [n], slice or indices; the order of the result is that of the index.
        """
        return RelativePoses._of_arrays(
            self.i[index],
            self.j[index],
            self.T_i_j[index],
            self.information[index],
            whitening=self.whitening[index],
        )

    def renamed(self, new_index: ArrayLike) -> RelativePoses:
        """Rename the variables.

        Args:
            new_index: new index of every variable, int [variables].
        """
        names = np.asarray(new_index, dtype=np.int64)
        return RelativePoses._of_arrays(
            names[self.i], names[self.j], self.T_i_j, self.information, whitening=self.whitening
        )

    @staticmethod
    def concatenate(parts: Sequence[RelativePoses]) -> RelativePoses:
        """Put sets of relative poses together.

        Args:
            parts: the sets; their order is kept.
        """
        if not parts:
            return RelativePoses.empty()
        return RelativePoses._of_arrays(
            np.concatenate([p.i for p in parts]),
            np.concatenate([p.j for p in parts]),
            np.concatenate([p.T_i_j for p in parts]),
            np.concatenate([p.information for p in parts]),
            whitening=np.concatenate([p.whitening for p in parts]),
        )

    @staticmethod
    def _of_arrays(
        i: Index, j: Index, T_i_j: Array, information: Array, *, whitening: Array
    ) -> RelativePoses:
        """From arrays of others: the square roots of their information are known.

        They are laid out in memory as `_whitening` lays them out: products round by it.
        """
        out = object.__new__(RelativePoses)
        whitening = np.ascontiguousarray(np.swapaxes(whitening, -1, -2)).swapaxes(-1, -2)
        for name, array in (
            ("i", i),
            ("j", j),
            ("T_i_j", T_i_j),
            ("information", information),
            ("whitening", whitening),
        ):
            object.__setattr__(out, name, array)
        return out


@dataclass(frozen=True)
class LoopClosure:
    """One verified relative pose between a keyframe of the robot that holds it and a keyframe of a peer.

    Reversing a loop closure for the other end keeps the measured motion, so that the objective does not depend on
    which robot holds it.

    Attributes:
        own_keyframe: index of the holder's keyframe.
        peer_keyframe: index of the peer's keyframe.
        T_own_peer: [4, 4], coordinates of the peer's keyframe to those of the own one.
        information: [6, 6], right tangent (translation, rotation) of the measured motion, 1/m^2 and 1/rad^2.
        measured_from_peer: the measured motion is T_peer_own, otherwise T_own_peer.
        alike: share of the texture that both keyframes see that looks alike, known to who verified it.
        texture: [p, 4], likewise: centers of textured parts that both see, meters, frame of the own keyframe, and 1
            where they look alike, else 0.
    """

    own_keyframe: int
    peer_keyframe: int
    T_own_peer: Array
    information: Array
    measured_from_peer: bool = False
    alike: float = 1.0
    texture: Array = field(default_factory=lambda: np.zeros((0, 4)), repr=False, compare=False)

    def reversed(self) -> LoopClosure:
        """The same measurement from the peer's side."""
        T_peer_own = se3.inverse(self.T_own_peer)
        ends = self.peer_keyframe, self.own_keyframe
        turned = not self.measured_from_peer
        texture = np.column_stack([se3.transform(T_peer_own, self.texture[:, :3]), self.texture[:, 3]])
        return LoopClosure(*ends, T_peer_own, self.information, turned, alike=self.alike, texture=texture)


@dataclass(frozen=True)
class HeldLoopClosures:
    """Loop closures of a pair of robots at the end that holds them.

    Attributes:
        robot: the robot that holds them.
        peer: the other robot.
        loop_closures: m of them, from the holder's side.
        weights: [m], robust weights, 0 to 1.
    """

    robot: str
    peer: str
    loop_closures: Sequence[LoopClosure]
    weights: Sequence[float]


def closures_as_relative_poses(
    closures: Sequence[LoopClosure],
    own_variable: ArrayLike,
    peer_variable: ArrayLike,
    config: LoopClosureConfig,
) -> RelativePoses:
    """Loop closures as relative poses between a solver's variables, with the sigma floor of `config` added.

    Args:
        closures: of one pair of robots, m in number.
        own_variable: int [m], the solver's variable of each own keyframe.
        peer_variable: int [m], the solver's variable of each peer keyframe.
        config: gives the floor.
    Returns:
        As they were measured: those measured by the peer lead from its variable to the own one.
    """
    own, peer = np.asarray(own_variable, dtype=np.int64), np.asarray(peer_variable, dtype=np.int64)
    reverse = np.array([c.measured_from_peer for c in closures], dtype=bool)
    T_own_peer = np.array([c.T_own_peer for c in closures], dtype=np.float64).reshape(-1, 4, 4)
    information = np.array([c.information for c in closures], dtype=np.float64).reshape(-1, 6, 6)
    floor = np.repeat([config.sigma_floor_m**2, config.sigma_floor_rad**2], 3)
    return RelativePoses(
        np.where(reverse, peer, own),
        np.where(reverse, own, peer),
        np.where(reverse[:, None, None], se3.inverse(T_own_peer), T_own_peer),
        add_covariance(information, floor * np.eye(6)),
    )


def isotropic_information(kappa: ArrayLike, tau: ArrayLike) -> Array:
    """Information of SE-Sync's weights.

    Args:
        kappa: [m], weight of |R|_F^2; 1/rad^2 is 2 kappa.
        tau: [m], weight of |t|^2, 1/m^2.
    Returns:
        [m, 6, 6], right tangent (translation, rotation).
    """
    tau, kappa = np.asarray(tau, dtype=np.float64), np.asarray(kappa, dtype=np.float64)
    diagonal = np.stack([tau, tau, tau, 2 * kappa, 2 * kappa, 2 * kappa], axis=-1)
    return diagonal[..., None] * np.eye(6)


def _whitening(T_i_j: Array, information: Array) -> Array:
    """A [m, 6, 6] with r = A e: the square root of the information, its translation columns turned to frame i.

    By eigenvalues and not by Cholesky, so that a measurement that does not know some direction is allowed.
    """
    values, vectors = np.linalg.eigh(information)
    if len(values) and values[:, 0].min() < -1e-6 * max(float(values.max()), 1e-300):
        raise ValueError("the information of a relative pose is not positive semidefinite")
    A = np.sqrt(np.maximum(values, 0.0))[..., None] * np.swapaxes(vectors, -1, -2)
    A[..., :3] = A[..., :3] @ np.swapaxes(T_i_j[..., :3, :3], -1, -2)  # v_j = Rij' v_i
    return A
