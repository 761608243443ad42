"""A set of Gaussians as a structure of arrays (paper eq. (1))."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import rows_of
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import se3, so3

DEPTH_KINDS: tuple[DepthKind, ...] = ("blended", "ray_plane")

_SHAPES: dict[str, tuple[type, tuple[int, ...]]] = {
    "ids": (np.int64, ()),
    "anchors": (np.int32, ()),
    "means": (np.float32, (3,)),
    "quats_wxyz": (np.float32, (4,)),
    "log_scales": (np.float32, (3,)),
    "colors": (np.float32, (3,)),
    "opacity_logits": (np.float32, ()),
}


@dataclass(frozen=True)
class Gaussians:
    """n Gaussians with covariance R(q) diag(exp 2 s) R(q)^T, in one frame.

    Attributes:
        ids: int64 [n], unique within their owner and stable.
        anchors: int32 [n], index of the owner's keyframe that each is anchored to.
        means: float32 [n, 3], meters.
        quats_wxyz: float32 [n, 4], any non-zero length.
        log_scales: float32 [n, 3], log of meters.
        colors: float32 [n, 3], RGB as in the image, 0..1 (training may leave the range).
        opacity_logits: float32 [n].
    """

    ids: NDArray[np.int64]
    anchors: NDArray[np.int32]
    means: NDArray[np.float32]
    quats_wxyz: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    colors: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.ids)
        for name, (dtype, tail) in _SHAPES.items():
            array: NDArray[Any] = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if array.shape != (n, *tail):
                raise ValueError(f"Gaussians.{name} has shape {array.shape}, expected {(n, *tail)}")
            object.__setattr__(self, name, array)

    @staticmethod
    def empty() -> Gaussians:
        """No Gaussians."""
        return Gaussians(**{name: np.zeros((0, *tail), dtype) for name, (dtype, tail) in _SHAPES.items()})

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, index: ArrayLike | slice) -> Gaussians:
        """Pick Gaussians.

        Args:
            index: mask [n], slice or indices; the order of the result is that of the index.
        """
        if isinstance(index, slice):
            return Gaussians(**{f.name: getattr(self, f.name)[index] for f in fields(self)})
        rows = rows_of(index)
        return Gaussians(**{f.name: getattr(self, f.name).take(rows, axis=0) for f in fields(self)})

    def copy(self) -> Gaussians:
        """The same in arrays of its own, which may be changed."""
        return Gaussians(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    def replace(self, **arrays: Any) -> Gaussians:
        """Exchange some arrays.

        Args:
            arrays: new arrays by the name of their attribute, shapes as before.
        """
        return replace(self, **arrays)

    @staticmethod
    def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
        """Put sets of Gaussians of one frame together.

        Args:
            parts: the sets; their order is kept.
        """
        if not parts:
            return Gaussians.empty()
        return Gaussians(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in _SHAPES})

    def transformed(self, T_b_a: ArrayLike) -> Gaussians:
        """Express the Gaussians of frame a in frame b.

        Args:
            T_b_a: pose of frame a in frame b, [4, 4] for all Gaussians or [n, 4, 4], one for each.
        """
        T = np.asarray(T_b_a, dtype=np.float64)
        means = (T[..., :3, :3] @ self.means.astype(np.float64)[..., None])[..., 0] + T[..., :3, 3]
        quats = so3.multiply_quat_wxyz(so3.to_quat_wxyz(T[..., :3, :3]), self.quats_wxyz)
        return self.replace(means=means.astype(np.float32), quats_wxyz=quats.astype(np.float32))

    def normals(self) -> NDArray[np.float64]:
        """Unit normals [n, 3] of the discs: the axes of the smallest scales; their signs say nothing."""
        axes = so3.from_quat_wxyz(self.quats_wxyz.astype(np.float64))
        return np.asarray(axes[np.arange(len(self)), :, np.argmin(self.log_scales, axis=1)])

    def opacities(self) -> NDArray[np.float64]:
        """Peak opacities [n], 0..1."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.opacity_logits.astype(np.float64))))

    def moved(self, T_old_keyframe: ArrayLike, T_new_keyframe: ArrayLike) -> Gaussians:
        """Move every Gaussian with its anchor.

        Args:
            T_old_keyframe: poses of the keyframes before, by anchor, [k, 4, 4].
            T_new_keyframe: the same after.
        """
        change = np.asarray(T_new_keyframe) @ se3.inverse(T_old_keyframe)
        return self.transformed(change[self.anchors]) if len(self) else self
