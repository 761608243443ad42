"""Files of S3E v1 next to its bags: calibrations of vehicles, and satellite positions; see `datasets.s3e`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from duagc.converters.layouts.image_files import check_near
from duagc.converters.layouts.stereo import RawCamera
from duagc.converters.layouts.tum_layout import nanoseconds
from duagc.converters.logs.gather import nearest
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.messages.parts import NANOSECONDS

FIX_NS = 55_000_000  # a fix is given to the image next to it, one of ten per second
FIX_GAP_NS = 1_500_000_000  # fixes farther apart are not interpolated
MOST_NUMBERS = 16  # in a matrix of the calibration
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class S3eCalibration:
    """The cameras of one vehicle, T_right_left, and where LiDAR and IMU are in the left camera, [4, 4] each."""

    left: RawCamera
    right: RawCamera
    T_right_left: Array
    T_left_lidar: Array
    T_left_imu: Array
    where: str

    @staticmethod
    def read(path: Path) -> S3eCalibration:
        """From the file of a vehicle, in the notation of OpenCV.

        Args:
            path: of the file.

        Raises:
            DuagError: a part is missing or no calibration, for example a translation that is not in millimeters.
        """
        import cv2

        text = read_text(path, "the calibration of a vehicle")
        try:
            store = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        except (cv2.error, SystemError) as error:
            raise DuagError(
                f"{path}: is no YAML of OpenCV, expected %YAML:1.0 with !!opencv-matrix"
            ) from error

        def numbers(name: str) -> Array | None:
            node = store.getNode(name)
            try:
                size = node.getNode("rows").real() * node.getNode("cols").real() if node.isMap() else 0
                return np.asarray(node.mat(), dtype=np.float64) if 0 < size <= MOST_NUMBERS else None
            except (cv2.error, SystemError, TypeError, ValueError) as error:
                raise DuagError(f"{path}: {name} is no !!opencv-matrix, expected one") from error

        def matrix(name: str, *shape: int) -> Array:
            found = numbers(name)
            if found is None or found.size != np.prod(shape) or not np.isfinite(found).all():
                size = "nothing" if found is None else f"{found.tolist()}"
                raise DuagError(f"{path}: {name} is {size}, expected a matrix of {shape}, all finite")
            return np.asarray(found, dtype=np.float64).reshape(shape)

        def camera(side: str) -> RawCamera:
            width, height = (int(store.getNode(f"{side}.{name}").real()) for name in ("width", "height"))
            distortion = numbers(f"{side}.D")
            if width <= 0 or height <= 0 or distortion is None or distortion.size not in (4, 5, 8):
                raise DuagError(f"{path}: {side}.width, height or D is missing, expected those of a camera")
            return RawCamera(matrix(f"{side}.K", 3, 3), tuple(distortion.ravel().tolist()), width, height)

        def motion(name: str) -> Array:
            T = matrix(name, 4, 4)
            return se3.from_rotation_translation(so3.project(T[:3, :3]), T[:3, 3])

        baseline_mm = matrix("RIGHT.P", 3, 4)[:, 3]
        if not 50 < np.linalg.norm(baseline_mm) < 5000:
            raise DuagError(
                f"{path}: last column of RIGHT.P is {baseline_mm.tolist()}, expected the translation to the right "
                "camera in millimeters"
            )
        T_right_left = se3.from_rotation_translation(so3.project(matrix("RIGHT.R", 3, 3)), baseline_mm / 1000)
        return S3eCalibration(
            camera("LEFT"),
            camera("RIGHT"),
            T_right_left,
            se3.inverse(motion("Tlc")),  # the files give p_lidar = Tlc p_left
            se3.inverse(motion("Tic")),
            str(path),
        )


@dataclass(frozen=True)
class Fixes:
    """Satellite positions: times, increasing, ns; positions [n, 3], m (UTM, altitude)."""

    stamps_ns: list[int]
    positions: Array

    def near(self, images_ns: list[int]) -> dict[int, Array]:
        """Position at the image next to each fix, moved along the path to the time of the image.

        Args:
            images_ns: times of the images, increasing.
        """
        found = {}
        stamps = np.array(self.stamps_ns)
        for image_ns in nearest(self.stamps_ns, images_ns, FIX_NS).values():
            k = int(np.searchsorted(stamps, image_ns))
            if stamps[min(k, len(stamps) - 1)] == image_ns:
                found[image_ns] = self.positions[k]
            elif 0 < k < len(stamps) and stamps[k] - stamps[k - 1] <= FIX_GAP_NS:
                share = (image_ns - stamps[k - 1]) / (stamps[k] - stamps[k - 1])
                found[image_ns] = (1 - share) * self.positions[k - 1] + share * self.positions[k]
        return found


def read_fixes(path: Path) -> Fixes | None:
    """Fixes of a `<robot>_gt.txt`; None if there is no such file, or only two indoor poses without times.

    Args:
        path: of the file.

    Raises:
        DuagError: a line is not `t x y z qx qy qz qw`; numbers may lack the blank before a minus sign.
    """
    if not path.is_file():
        return None
    rows: dict[int, list[float]] = {}
    for number, line in enumerate(read_text(path, "lines t x y z qx qy qz qw").splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = NUMBER.findall(line)
        if len(words) != 8 or NUMBER.sub("", line).strip():
            raise DuagError(
                f"{path}:{number}: {line.strip()[:60]!r}, expected eight numbers t x y z qx qy qz qw"
            )
        place = [float(word) for word in words[1:4]]
        if not np.isfinite(place).all():
            raise DuagError(f"{path}:{number}: {line.strip()[:60]!r}, expected meters")
        check_near(place, f"{path}:{number}")
        rows.setdefault(nanoseconds(words[0], f"{path}:{number}"), place)
    if len(rows) < 3 and all(stamp < 10 * NANOSECONDS for stamp in rows):
        return None
    stamps = sorted(rows)
    return Fixes(stamps, np.array([rows[stamp] for stamp in stamps]))
