"""Depth of what lies beyond the range of the depth camera, from the color images of other keyframes: a plane sweep.

Without a depth of its own, what is far is drawn by Gaussians at the end of what was measured: right in the views that
they were trained on, and from elsewhere veils in front of everything. Planes across the optical axis of a keyframe, at
inverse depths that are one pixel of parallax apart, map the images of other keyframes into its own (Collins, "A
space-sweep approach to true multi-image matching", 1996). Where a plane is the surface, they look alike there, whatever
their exposures: their normalized correlation is high, and clearly higher than on any plane elsewhere.

Such depth says where a map is seeded. It is no measurement: it takes part in no loss, in no information and in no pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.mapping import FarDepthConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.image_sampling import sampled
from duagc.pipeline.geometry.projection import NEAR_M, inside, visible

Image = NDArray[np.float32]
WIDTH_PX = 160
"""Of the images that are compared, about."""
WINDOW_PX = 7
LEAST_SIGMA = 2.0
"""Of gray values 0 to 255 in a window: what varies less is all noise."""
FARTHEST_APART = 0.25
"""Distance of two keyframes in units of the range, beyond which they see too little alike."""
MOST_TURNED_RAD = math.radians(35)
NEAREST_FOUND = 0.9
"""In units of the range: what is nearer was measured, or is a hole of another kind."""
BORDER = 0.8
"""In units of the range: from here on what is not measured may be too far."""
NEAREST_PLANE = 0.3
"""Likewise, of what is compared: a hole of another kind is most alike at a plane that is nearer."""
NEAR_STEPS = 2.5
"""Pixels of parallax between those planes."""
HIDDEN = 0.9
"""A surface measured at less than this share of a depth hides it."""
ALIKE_AROUND = 5
"""Pixels of 3x3, itself included, that are on the same plane or on the next ones."""


class FarDepth:
    """Small images of keyframes, and depth from them."""

    def __init__(self, camera: PinholeCamera, config: FarDepthConfig) -> None:
        """Begin without a keyframe.

        Args:
            camera: of all of them.
            config: what is compared, and when it is alike.
        """
        self._config, self._size = config, (camera.height, camera.width)
        self._step = max(1, round(camera.width / WIDTH_PX))
        h, w = (length // self._step for length in self._size)
        whole = PinholeCamera(w * self._step, h * self._step, camera.fx, camera.fy, camera.cx, camera.cy)
        self._camera = whole.scaled(w, h)
        self._small: list[tuple[NDArray[np.uint8], Image]] = []  # gray and depth of each
        self._ranges_m: list[float] = []
        self._poses: list[Array] = []
        self._found: dict[int, Image | None] = {}  # small ones too

    def add(self, color: NDArray[np.uint8], depth_m: Image, T_map_camera: Array) -> None:
        """Take in the next keyframe.

        Args:
            color: RGB [H, W, 3].
            depth_m: meters [H, W], 0 where there is none.
            T_map_camera: [4, 4].
        """
        import cv2

        h, w, s = self._camera.height, self._camera.width, self._step
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[: h * s, : w * s].reshape(h, s, w, s)
        sums = gray.sum(axis=(1, 3), dtype=np.uint32)
        mean = ((sums + s * s // 2) // (s * s)).astype(np.uint8)
        self._small.append(SHELF.put((mean, depth_m[: h * s, : w * s].reshape(h, s, w, s).max(axis=(1, 3)))))
        near = depth_m[::8, ::8]
        if (near > 0).any():
            self._ranges_m.append(float(np.percentile(near[near > 0], 95)))
        self._poses.append(np.asarray(T_map_camera, dtype=np.float64))

    def of(self, keyframe: int) -> Image | None:
        """Depth along z, meters [H, W], where a keyframe measured none; 0 where it is not found either.

        Args:
            keyframe: number in order of arrival.
        Returns:
            None if next to nothing is missing, or nothing is found.
        """
        if keyframe not in self._found:
            searched = self._searched(keyframe)
            self._found[keyframe] = None if searched is None else SHELF.put(searched)
        found = self._found[keyframe]
        if found is None:
            return None
        whole = np.zeros(self._size, np.float32)
        large = found.repeat(self._step, axis=0).repeat(self._step, axis=1)
        whole[: large.shape[0], : large.shape[1]] = large
        return whole

    def _searched(self, keyframe: int) -> Image | None:
        """The same of the small images [h, w]."""
        from scipy.ndimage import distance_transform_edt

        others, missing = self._others(keyframe), self._beyond(keyframe)
        if len(others) < 2 or np.mean(missing) < self._config.least_missing:
            return None
        part = _around(missing)
        gray, rays = self._small[keyframe][0][part], self._camera.rays()[part]
        moved = [(k, se3.inverse(self._poses[k]) @ self._poses[keyframe]) for k in others]
        inverse = self._planes(keyframe, others)
        plane, sure = self._best_planes(self._correlations(gray, rays, moved, inverse))
        z = 1 / np.maximum(inverse, 0.25 * inverse[1])[plane]  # the farthest plane has no depth
        sure &= missing[part] & (z > NEAREST_FOUND * self._range_m())
        sure &= self._seen(rays * z[..., None], moved)
        if not sure.any():
            return None
        apart_px, (row, column) = distance_transform_edt(~sure, return_indices=True)
        found = np.zeros(missing.shape, np.float32)
        found[part] = np.where(missing[part] & (apart_px <= self._config.filled_px), z[row, column], 0.0)
        return found

    def _beyond(self, keyframe: int) -> NDArray[np.bool_]:
        """Pixels [h, w] without depth, where the nearest that has some is near the end of the range.

        Other holes are edges and what shines or is black, at any distance.
        """
        from scipy.ndimage import distance_transform_edt

        _, depth_m = self._small[keyframe]
        missing = depth_m == 0
        if missing.all() or not missing.any():
            return np.zeros_like(missing)
        row, column = distance_transform_edt(missing, return_distances=False, return_indices=True)
        return np.asarray(missing & (depth_m[row, column] > BORDER * self._range_m()))

    def _range_m(self) -> float:
        """How far the depth camera measures what the keyframes show."""
        return max(self._ranges_m, default=0.0)

    def _others(self, keyframe: int) -> list[int]:
        """Keyframes that look the same way from farthest apart."""
        own, most_m = self._poses[keyframe], FARTHEST_APART * self._range_m()
        poses = np.array(self._poses)
        apart_m = np.linalg.norm(poses[:, :3, 3] - own[:3, 3], axis=1)
        fits = (apart_m > 0) & (apart_m < most_m)
        fits &= np.clip(poses[:, :3, 2] @ own[:3, 2], -1, 1) > math.cos(MOST_TURNED_RAD)
        order = np.argsort(-apart_m, kind="stable")
        return [int(k) for k in order[fits[order]][: self._config.keyframes]]

    def _seen(self, points: Array, moved: Sequence[tuple[int, Array]]) -> NDArray[np.bool_]:
        """Whether nothing measured hides points [h, w, 3] from most of the others that look there."""
        seen, looked = np.zeros((2, points[..., 2].size), np.int64)
        for k, T_other_own in moved:
            at = se3.transform(T_other_own, points.reshape(-1, 3))
            index, column, row = visible(self._camera, at)
            measured_m = self._small[k][1][row, column]
            looked[index] += 1
            seen[index] += (measured_m == 0) | (measured_m > HIDDEN * at[index, 2])
        return (2 * seen > looked).reshape(points.shape[:-1])

    def _planes(self, keyframe: int, others: list[int]) -> Array:
        """Inverse depths [p], 1/m, from infinity to well within the range.

        A pixel of parallax apart, and where something was measured as a rule, some pixels.
        """
        apart_m = max(
            float(np.linalg.norm(self._poses[k][:3, 3] - self._poses[keyframe][:3, 3])) for k in others
        )
        step = 1 / (self._camera.fx * apart_m)
        far = 1 / (NEAREST_FOUND * self._range_m() * step)
        near = far * NEAREST_FOUND / NEAREST_PLANE
        steps = [*np.arange(math.ceil(far) + 1), *np.arange(math.ceil(far) + NEAR_STEPS, near, NEAR_STEPS)]
        return np.asarray(step * np.array(steps[: self._config.planes], dtype=np.float64))

    def _correlations(
        self,
        gray: NDArray[np.uint8],
        rays: Array,
        moved: Sequence[tuple[int, Array]],
        inverse: Array,
    ) -> Image:
        """Normalized correlation [p, h, w] of windows of an image with those of others, by plane.

        The mean of the better half of them: a surface may be hidden from the others.
        """
        own, camera, (x0, y0, _) = _Windows(gray), self._camera, np.moveaxis(rays, -1, 0)
        between_px = camera.height - 1, camera.width - 1  # of the centers of the outermost pixels
        turned = [np.stack([a * x0 + (b * y0 + c) for a, b, c in T[:3, :3]]) for _, T in moved]
        out, half = np.empty((len(inverse), *gray.shape), np.float32), max(2, (len(moved) + 1) // 2)
        for p, near in enumerate(inverse):
            found = np.full((len(moved), *gray.shape), -1.0, np.float32)
            for n, (k, T_other_own) in enumerate(moved):
                x, y, z = turned[n] + (near * T_other_own[:3, 3])[:, None, None]
                ahead = z > NEAR_M
                z = np.where(ahead, z, 1.0)
                u, v = camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy
                shown = ahead & inside(u, v, between_px)
                if shown.any():
                    np.copyto(found[n], own.correlation(sampled(self._small[k][0], u, v)), where=shown)
            found.sort(axis=0)
            out[p] = found[-half:].mean(axis=0)
        return out

    def _best_planes(self, correlation: Image) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The plane [h, w] on which images are most alike, and whether that is sure."""
        best = correlation.argmax(axis=0)
        value = correlation.max(axis=0)
        elsewhere = np.abs(np.arange(len(correlation))[:, None, None] - best) > 2
        second = np.where(elsewhere, correlation, np.float32(-1)).max(axis=0)
        sure = (value > self._config.alike) & (value - second > self._config.clearer)
        sure &= best < len(correlation) - 1  # the surface may be nearer
        planes, known = np.pad(best, 1, mode="edge"), np.pad(sure, 1)
        h, w = best.shape
        around = np.zeros(best.shape, np.int64)
        for row in range(3):
            for column in range(3):
                part = slice(row, row + h), slice(column, column + w)
                around += known[part] & (np.abs(planes[part] - best) <= 1)
        return best, sure & (around >= ALIKE_AROUND)


def _around(pixels: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns around some pixels, with room for a window."""
    rows, columns = (np.flatnonzero(pixels.any(axis=axis)) for axis in (1, 0))
    high, wide = (slice(max(0, at[0] - WINDOW_PX), at[-1] + WINDOW_PX + 1) for at in (rows, columns))
    return high, wide


class _Windows:
    """An image by its windows. Their sums are whole numbers below 2^24: exact in float32, in whatever order."""

    def __init__(self, gray: NDArray[np.uint8]) -> None:
        self._gray = gray.astype(np.float32)
        self._sum, self._spread = self._sums(self._gray)

    def correlation(self, other: NDArray[np.uint8]) -> Image:
        """Normalized correlation [h, w] with the windows of another image, -1 to 1."""
        image = other.astype(np.float32)
        total, spread = self._sums(image)
        common = np.float32(WINDOW_PX**2) * _box(self._gray * image) - self._sum * total
        return np.asarray(common / (self._spread * spread))

    @staticmethod
    def _sums(image: Image) -> tuple[Image, Image]:
        """Sums of windows, and their standard deviations times the number of pixels."""
        total, n = _box(image), np.float32(WINDOW_PX**2)
        variance = n * _box(image * image) - total * total
        return total, np.sqrt(np.maximum(variance, np.float32((LEAST_SIGMA * WINDOW_PX**2) ** 2)))


def _box(image: Image) -> Image:
    import cv2

    window = (WINDOW_PX, WINDOW_PX)
    return np.asarray(
        cv2.boxFilter(image, cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_REFLECT)
    )
