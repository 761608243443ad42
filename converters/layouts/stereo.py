"""Depth of a stereo pair, with the standard deviation of every pixel.

Bouguet's rectification turns both cameras until corresponding points lie in one row; semi-global matching
(Hirschmueller 2008) finds the disparity d to a part of a pixel; then z = f b / d and, to first order,
sigma_z = z^2 sigma_d / (f b). Everything here is OpenCV, arrays in and arrays out, for any converter:

    rig = StereoRig.of(left, right, T_right_left)
    row_check.RowCheck().add(*pair) ... .result(where)  # refuses a calibration that is not that of the images
    color, depth_m, sigma_m = rig.rectify_left(image), *rig.depth(gray_left, gray_right)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from duagc.converters.layouts.validity import shrunk
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.base import Config
from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, Maps, seen_by_source
from duagc.pipeline.geometry.masks import Mask

Image = NDArray[np.uint8]
Depth = NDArray[np.float32]
BLOCK_PX = 5
SUBPIXELS = 16  # SGBM gives disparities in sixteenths
SIGMA_OF_NOISE = 0.13  # disparity error x gradient / gray noise; of 5x5 blocks and their paths, measured
LEAST_GRADIENT = 0.3  # gray values per px: below it is noise


class StereoOptions(Config):
    """Matching of a stereo pair."""

    min_depth_m: float = Field(default=0.8, gt=0)
    """Nearest depth that is looked for: the largest disparity is f b / min_depth_m, and costs time."""
    max_relative_sigma: float = Field(default=0.05, gt=0)
    """Depth with a larger standard deviation, as a share of itself, is left out."""
    disparity_sigma_px: float = Field(default=0.2, gt=0)
    """Standard deviation of a disparity where the texture is strong: what block matching does at its best."""
    gray_sigma: float = Field(default=2.0, gt=0)
    """Noise of the gray values (of 255): where the texture is weak it decides."""
    shrink: int = Field(default=1, ge=1, le=8)
    """Side of the blocks of rectified pixels that become one."""


@dataclass(frozen=True)
class RawCamera:
    """One camera of the pair as calibrated: K [3, 3], distortion as OpenCV has it, size in pixels."""

    K: Array
    distortion: tuple[float, ...]
    width: int
    height: int
    fisheye: bool = False

    def maps(self, R_rectified_camera: Array, rectified: PinholeCamera) -> Maps:
        """Where in its images the pixels of the rectified camera lie.

        Args:
            R_rectified_camera: [3, 3], takes its coordinates to those of the rectified camera.
            rectified: the pinhole camera at the same place.
        """
        focal_center = (float(self.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        source = PinholeCamera(self.width, self.height, *focal_center)
        x, y, z = (float(part) for part in so3.log(R_rectified_camera.T))
        return Lens(source, self.distortion or (0.0,) * 4, self.fisheye, (x, y, z)).maps(rectified)


def _of_projection(P: Array, size: tuple[int, int]) -> PinholeCamera:
    """The rectified camera of a projection [3, 4], images of width and height `size`."""
    return PinholeCamera(*size, *(float(P[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))))


class StereoRig:
    """A calibrated pair. camera: of the rectified left images, to which the depth belongs. baseline_m.

    R_rectified_left [3, 3]: takes coordinates in the left camera to the rectified one (the center is the same).
    """

    def __init__(
        self,
        camera: PinholeCamera,
        baseline_m: float,
        options: StereoOptions | None = None,
        maps: tuple[Maps, Maps] | None = None,
        *,
        R_rectified_left: Array | None = None,
    ) -> None:
        """Of images that are rectified already, unless `maps` rectify the left and the right ones.

        Args:
            camera: of the rectified left images, before they are shrunk.
            baseline_m: distance of the two cameras.
            options: of matching and shrinking; None: the defaults.
            maps: of `cv2.remap`, of the left and the right images; None: these are rectified.
            R_rectified_left: [3, 3]; None: identity.
        """
        self.options = options or StereoOptions()
        self.baseline_m, self._maps = float(baseline_m), maps
        k = self.options.shrink
        self._whole = PinholeCamera(
            camera.width // k * k, camera.height // k * k, camera.fx, camera.fy, camera.cx, camera.cy
        )
        self.camera = self._whole.scaled(camera.width // k, camera.height // k)
        self.R_rectified_left = np.eye(3) if R_rectified_left is None else R_rectified_left

    @staticmethod
    def of(
        left: RawCamera,
        right: RawCamera,
        T_right_left: Array,
        where: str,
        *,
        options: StereoOptions | None = None,
    ) -> StereoRig:
        """Rectify a pair by its calibration.

        Args:
            left: the left camera.
            right: the right camera.
            T_right_left: [4, 4], takes coordinates in the left camera to the right one; its x is negative.
            where: begins the line of an error.
            options: of the matching; by default those of `StereoOptions`.
        Raises:
            DuagError: the cameras are not side by side, left to the left, one alone is a fisheye, or no part of the
                images is rectified.
        """
        import cv2

        size = (left.width, left.height)
        if size != (right.width, right.height):
            raise DuagError(
                f"{where}: right images are {right.width}x{right.height}, expected {size[0]}x{size[1]}"
            )
        if left.fisheye != right.fisheye:
            raise DuagError(f"{where}: one camera of the pair is a fisheye, expected both or none")
        # OpenCV's fisheye functions take whole arrays alone, no parts of others
        R, t = T_right_left[:3, :3].copy(), T_right_left[:3, 3].copy()
        if -t[0] <= abs(t[1]) + abs(t[2]):
            raise DuagError(
                f"{where}: the right camera sees the left one at {np.round(t, 3).tolist()} m, expected it to the left "
                "(cameras side by side, not swapped, translation in meters)"
            )
        D = [np.array(c.distortion or (0.0,) * 4) for c in (left, right)]
        model: Any = cv2.fisheye if left.fisheye else cv2
        more = {"balance": 0.0, "tvec": t[:, None]} if left.fisheye else {"alpha": 0, "T": t[:, None]}
        found = model.stereoRectify(
            left.K, D[0], right.K, D[1], size, R, flags=cv2.CALIB_ZERO_DISPARITY, **more
        )
        R_left, R_right, P_left, P_right = (np.asarray(a, dtype=np.float64) for a in found[:4])
        if not (np.isfinite(P_left).all() and 0.2 < P_left[0, 0] / left.K[0, 0] < 5):
            raise DuagError(
                f"{where}: rectified focal length is {P_left[0, 0]:g} px, expected about {left.K[0, 0]:g}"
            )
        focal, u0, v0 = float(P_left[0, 0]), float(P_left[0, 2]), float(P_left[1, 2])
        camera = PinholeCamera(*size, focal, focal, u0, v0)
        maps = left.maps(R_left, camera), right.maps(R_right, camera)
        return StereoRig(camera, -P_right[0, 3] / P_right[0, 0], options, maps, R_rectified_left=R_left)

    @staticmethod
    def rectified(
        left: PinholeCamera,
        right: PinholeCamera,
        baseline_m: float,
        where: str,
        *,
        options: StereoOptions | None = None,
    ) -> StereoRig:
        """A pair whose images are rectified already.

        Args:
            left: camera of the left images.
            right: camera of the right images.
            baseline_m: distance of the two cameras.
            where: begins the line of an error.
            options: of matching and shrinking; None: the defaults.

        Raises:
            DuagError: the cameras differ, or the right one is not to the right.
        """
        pairs = {name: (value, getattr(right, name)) for name, value in vars(left).items()}
        unequal = [f"{name} {a:.10g} and {b:.10g}" for name, (a, b) in pairs.items() if a != b]
        if unequal:
            raise DuagError(
                f"{where}: left and right rectified camera have {', '.join(unequal)}, expected the same"
            )
        if not baseline_m > 0:
            raise DuagError(
                f"{where}: base line is {baseline_m:g} m, expected more than 0; P[3] of the right CameraInfo must "
                "be -f b, or left and right are swapped"
            )
        return StereoRig(left, baseline_m, options)

    @staticmethod
    def projected(
        left: RawCamera,
        right: RawCamera,
        R: Sequence[Array],
        P: Sequence[Array],
        *,
        where: str,
        options: StereoOptions | None = None,
    ) -> StereoRig:
        """A pair with the rectification of a CameraInfo.

        Args:
            left: camera of the left images, with distortion.
            right: camera of the right images.
            R: rotations to the rectified cameras, [3, 3], of left and right.
            P: projections of the rectified cameras, [3, 4], of left and right.
            where: begins the line of an error.
            options: of matching and shrinking; None: the defaults.

        Raises:
            DuagError: as `rectified`.
        """
        a, b = (_of_projection(p, (left.width, left.height)) for p in P)
        rig = StereoRig.rectified(a, b, -float(P[1][0, 3]) / float(P[1][0, 0]), where, options=options)
        turns = [np.asarray(r, dtype=np.float64).reshape(3, 3) for r in R]
        maps = left.maps(turns[0], a), right.maps(turns[1], b)
        return StereoRig(a, rig.baseline_m, options, maps, R_rectified_left=turns[0])

    @cached_property
    def valid(self) -> Mask | None:
        """Pixels [h, w] of the rectified left images that are made of pixels of the camera's; None: all."""
        if self._maps is None:
            return None
        height, width = self._maps[0][0].shape  # of the source too
        mask = seen_by_source(self._maps[0], width, height)[: self._whole.height, : self._whole.width]
        return shrunk(mask, self.options.shrink)

    def rectify_left(self, image: Image) -> Image:
        """A left image as the rectified camera sees it.

        Args:
            image: [h, w] or [h, w, 3].
        """
        return self._rectify(image, 0)

    def rectify_right(self, image: Image) -> Image:
        """A right image likewise.

        Args:
            image: [h, w] or [h, w, 3].
        """
        return self._rectify(image, 1)

    def _rectify(self, image: Image, side: int) -> Image:
        import cv2

        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps[side], cv2.INTER_LINEAR), dtype=np.uint8)
        image = image[: self._whole.height, : self._whole.width]
        if self.options.shrink == 1:
            return np.ascontiguousarray(image)
        size = self.camera.width, self.camera.height
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    @property
    def disparities(self) -> int:
        """How many disparities are tried, a multiple of 16; none is larger than the images are wide."""
        largest = min(self.camera.fx * self.baseline_m / self.options.min_depth_m, self.camera.width)
        return max(SUBPIXELS, math.ceil(largest / SUBPIXELS) * SUBPIXELS)

    @cached_property
    def _matcher(self) -> Any:
        import cv2

        return cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self.disparities,
            blockSize=BLOCK_PX,
            P1=8 * BLOCK_PX**2,
            P2=32 * BLOCK_PX**2,
            disp12MaxDiff=1,  # left-right check: what the right camera does not see is left out
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=1,
            mode=cv2.StereoSGBM_MODE_SGBM,
        )

    def disparity(self, left: Image, right: Image) -> Depth:
        """Disparity [h, w], px, of rectified gray images; 0 where no match is certain.

        Args:
            left: gray, [h, w].
            right: gray, [h, w].
        """
        import cv2

        # the matcher leaves out as many columns as it tries disparities: give it those, and use no match in them
        n = self.disparities
        wide = [cv2.copyMakeBorder(side, 0, 0, n, 0, cv2.BORDER_REPLICATE) for side in (left, right)]
        found = self._matcher.compute(*wide)[:, n:].astype(np.float32) / np.float32(SUBPIXELS)
        column = np.arange(found.shape[1], dtype=np.float32)
        return np.where((found > 0) & (found <= column), found, np.float32(0))

    def depth(self, left: Image, right: Image) -> tuple[Depth, Depth]:
        """Depth and its standard deviation, meters [h, w], of rectified images; both 0 where not known.

        Args:
            left: gray, [h, w].
            right: gray, [h, w].
        """
        disparity = self.disparity(left, right)
        known = disparity > 0
        depth_m = np.where(known, self.camera.fx * self.baseline_m / np.where(known, disparity, 1), 0)
        sigma_m = disparity_sigma_m(depth_m, self.disparity_sigma_px(left), self.camera.fx * self.baseline_m)
        kept = known & (sigma_m <= self.options.max_relative_sigma * depth_m)
        return (
            np.where(kept, depth_m, 0).astype(np.float32),
            np.where(kept, sigma_m, 0).astype(np.float32),
        )

    def disparity_sigma_px(self, left: Image) -> Depth:
        """Standard deviation [h, w] of the disparities of a rectified gray left image.

        The best that matching does, and the noise of the gray values over their gradient along the row (root mean
        square over a block). On the simulated room, three sizes and noises, errors over this have a spread (by their
        median) of 0.93 to 1.23; 2 to 6 % are beyond 3, mostly at edges.

        Args:
            left: [h, w].
        """
        import cv2

        smooth = cv2.GaussianBlur(left.astype(np.float32), (0, 0), 1.0)
        slope = np.zeros_like(smooth)
        slope[:, 1:-1] = 0.5 * (smooth[:, 2:] - smooth[:, :-2])
        mean_square = cv2.boxFilter(slope * slope, -1, (BLOCK_PX, BLOCK_PX))
        gradient = np.maximum(np.sqrt(np.maximum(mean_square, 0)), LEAST_GRADIENT)
        by_noise = SIGMA_OF_NOISE * self.options.gray_sigma / gradient
        return np.hypot(np.float32(self.options.disparity_sigma_px), by_noise).astype(np.float32)


def disparity_sigma_m(
    depth_m: NDArray[np.floating], sigma_px: NDArray[np.floating] | float, focal_baseline: float
) -> Array:
    """Standard deviation of a depth by that of its disparity: sigma_z = z^2 sigma_d / (f b), meters.

    Args:
        depth_m: meters.
        sigma_px: of the disparity, pixels.
        focal_baseline: f b, px m.
    """
    return np.square(np.asarray(depth_m, dtype=np.float64)) * sigma_px / focal_baseline
