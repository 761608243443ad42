"""CameraInfo as ROS messages hold it: the pinhole, and the distortion of its images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import FISHEYE_NUMBERS, POLYNOMIAL_NUMBERS, Lens, Maps

MAX_ROTATION_DEFECT = 0.01  # largest entry of R R^T - 1
LONGEST_LENS = 200  # focal length over the longer side of the image, and the inverse
FISHEYE = (
    "equidistant",
    "fisheye",
    "kannala_brandt",
    "Kannala Brandt4",
)  # one model, by the names that ROS, RealSense, Foxglove give it
# with no name, as older drivers; RealSense names the model whose numbers are zero or those of plumb_bob, which its ROS
# driver calls plumb_bob and its rs2_project_point_to_pixel takes so, "inverse" (color of D455, D405) too
POLYNOMIAL = (
    "",
    "plumb_bob",
    "rational_polynomial",
    "radtan",
    "brown_conrady",
    "Brown Conrady",
    "Modified Brown Conrady",
    "Inverse Brown Conrady",
)


@dataclass(frozen=True)
class RosCamera:
    """A CameraInfo: the pinhole, and the distortion of its images.

    Attributes:
        fisheye: whether the distortion is that of the equidistant model.
        frame_id: without the slash that ROS 1 may put before it.
        is_straight: whether it says that there is no distortion, by numbers that are all zero.
        R: nine numbers, row by row, that take directions of the camera of `frame_id` to those of the rectified one, of
            P, as they are stated; empty: not stated.
        is_rectified: whether this is the rectified one.
    """

    camera: PinholeCamera
    distortion: tuple[float, ...]
    fisheye: bool
    frame_id: str
    is_straight: bool = False
    R: tuple[float, ...] = ()
    is_rectified: bool = False

    @staticmethod
    def of(message: Any, rectified: bool, where: str) -> RosCamera:
        """From a CameraInfo of ROS 1 or 2.

        Args:
            message: the CameraInfo.
            rectified: the images belong to P, without distortion.
            where: begins the line of an error.

        Raises:
            DuagError: it is not that of a camera.
        """
        K, D, R, P = (
            np.array(getattr(message, name if hasattr(message, name) else name.lower()), dtype=np.float64)
            for name in ("K", "D", "R", "P")
        )
        if K.size != 9 or P.size not in (0, 12):
            raise DuagError(f"{where}: K and P of {K.size} and {P.size} numbers, expected 9 and 12")
        model, frame = message.distortion_model, message.header.frame_id.removeprefix("/")
        rectified = rectified and bool(np.any(P))
        if rectified:
            fx, cx, fy, cy = P[0], P[2], P[5], P[6]
            D = np.zeros(0)
        else:
            fx, cx, fy, cy = K[0], K[2], K[4], K[5]
        side = max(message.width, message.height)
        if not (
            np.abs([cx, cy]).max() < LONGEST_LENS * side
            and all(side / LONGEST_LENS < f < LONGEST_LENS * side for f in (fx, fy))
        ):
            raise DuagError(
                f"{where}: focal length {fx:g}, {fy:g} px and center {cx:g}, {cy:g} px of {message.width}x"
                f"{message.height}, expected those of a camera"
            )
        binning = max(1, message.binning_x), max(1, message.binning_y)
        roi = message.roi
        width, height = (roi.width or message.width), (roi.height or message.height)
        camera = PinholeCamera(
            int(width) // binning[0],
            int(height) // binning[1],
            fx / binning[0],
            fy / binning[1],
            (cx - roi.x_offset + 0.5) / binning[0] - 0.5,
            (cy - roi.y_offset + 0.5) / binning[1] - 0.5,
        )
        fisheye = model in FISHEYE
        # by four zeros a fisheye is still one: the distance from the center is the angle
        if not np.any(D) and not (fisheye and len(D) >= min(FISHEYE_NUMBERS)):
            turn = tuple(R.tolist())
            return RosCamera(camera, (), False, frame, is_straight=len(D) > 0, R=turn, is_rectified=rectified)
        if fisheye:  # of four numbers, but drivers of RealSense send the five of their structure
            D = np.concatenate([D[:4], np.trim_zeros(D[4:], "b")])
        lengths = FISHEYE_NUMBERS if fisheye else POLYNOMIAL_NUMBERS
        if not fisheye and model not in POLYNOMIAL:
            known = ", ".join((*POLYNOMIAL[1:], *FISHEYE))
            raise DuagError(f"{where}: distortion model {model!r}, expected one of {known}")
        if len(D) not in lengths or not np.isfinite(D).all():
            raise DuagError(
                f"{where}: distortion {D.tolist()} of {model!r}, expected {' or '.join(map(str, lengths))} numbers"
            )
        return RosCamera(camera, tuple(D.tolist()), fisheye, frame, R=tuple(R.tolist()))

    @property
    def lens(self) -> Lens | None:
        """How its images are taken; None: as a pinhole camera does."""
        return self._lens if self.distortion else None

    @property
    def _lens(self) -> Lens:
        return Lens(self.camera, self.distortion[:4] if self.fisheye else self.distortion, self.fisheye)

    def lens_of_rectified(self, where: str) -> Lens:
        """How its images are taken, for the rectified camera, which R may turn.

        Args:
            where: begins the line of an error.
        """
        x, y, z = so3.log(self._rotation(where).T).tolist()
        return replace(self._lens, rotation_rad=(x, y, z))

    def T_images_frame(self, where: str) -> Array:  # noqa: N802 (a transform)
        """From the camera of `frame_id`, which transforms name, to that of the images: turned, if they are rectified.

        Args:
            where: begins the line of an error.
        """
        return se3.from_rotation_translation(
            self._rotation(where) if self.is_rectified else np.eye(3), np.zeros(3)
        )

    def _rotation(self, where: str) -> Array:
        """R [3, 3]."""
        if not any(self.R):  # nobody set it
            return np.eye(3)
        R = np.array(self.R)
        defect = np.abs(R.reshape(3, 3) @ R.reshape(3, 3).T - np.eye(3)).max() if R.size == 9 else np.inf
        if not (defect < MAX_ROTATION_DEFECT and np.linalg.det(R.reshape(3, 3)) > 0):
            raise DuagError(f"{where}: R is {R.tolist()}, expected a rotation")
        return so3.project(R.reshape(3, 3))

    def maps(self, onto: PinholeCamera | None = None) -> Maps | None:
        """Where in its images every pixel of a pinhole at the same place lies; None without distortion.

        Args:
            onto: the pinhole; None: its own.
        """
        lens = self.lens
        return None if lens is None else lens.maps(onto or self.camera)


def between_images(T_first_second: Array, first: RosCamera, second: RosCamera, where: str) -> Array:
    """A transform between the frames of two cameras as one between those of their images, which may be rectified.

    Args:
        T_first_second: [4, 4], between the frames.
        first: one camera.
        second: the other one.
        where: begins the line of an error.
    """
    a, b = (camera.T_images_frame(f"{where}: camera of {camera.frame_id!r}") for camera in (first, second))
    return a @ T_first_second @ se3.inverse(b)
