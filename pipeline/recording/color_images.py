"""Color of a robot's log, as its pinhole camera would have taken it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens, rectified
from duagc.pipeline.recording.depth_sources import check_size
from duagc.pipeline.recording.read import Record


class ColorImages:
    """Decodes images; where the log states a lens, they are resampled to the pixels of a pinhole camera.

    A log keeps the bytes that the camera gave, which are fewer than those of resampled images, and no slower to read.
    """

    def __init__(self, camera: PinholeCamera, lens: Lens | None) -> None:
        """Compute where the pixels of the camera lie in images of the lens, if there is one.

        Args:
            camera: whose pixels the images get.
            lens: with which they were taken; None: by the camera.
        """
        self._camera = camera
        self._maps = None if lens is None else lens.maps(camera)

    def decode(self, record: Record) -> NDArray[np.uint8]:
        """RGB [H, W, 3] of a message with an encoded image.

        Args:
            record: the message.

        Raises:
            DuagError: no decoder reads it, or it has another size than the camera.
        """
        import cv2

        data = record.proto().data
        image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            where = f"{record.path}: {record.topic} at {record.publish_time_ns} ns"
            raise DuagError(f"{where} has {len(data)} bytes that no decoder reads, expected JPEG or PNG")
        check_size(record, image.shape[1], image.shape[0], self._camera)
        if self._maps is not None:
            image = rectified(image, self._maps)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
