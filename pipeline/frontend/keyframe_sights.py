"""What the keyframes of a component saw, without their images: how far, what is free, what is too far to measure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.far_depth import FarDepth, Image
from duagc.pipeline.frontend.tiles import border_keyframes, make_tiles
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.view_extent import ViewExtent
from duagc.pipeline.messages import Keyframe
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.registration.moving import FreeSpace


class KeyframeSights:
    """Looks at every keyframe once, before a map is built.

    Attributes:
        free: what all of them saw through.
        extents: how far each sees.
    """

    def __init__(self, log: RgbdLog, config: FrontendConfig) -> None:
        """Begin without a keyframe.

        Args:
            log: of the robot.
            config: of the front end.
        """
        self._log, self._config = log, config.mapping
        self.free = FreeSpace(log.camera, config.moving)
        self.extents: list[ViewExtent] = []
        self._far = FarDepth(log.camera, config.mapping.far)
        self._poses: list[Array] = []

    def look(self, keyframes: Sequence[Keyframe]) -> None:
        """Look at all keyframes.

        Args:
            keyframes: with their optimized poses, in order of their index.
        """
        for keyframe in keyframes:
            frame = self._log.frame(keyframe.frame_index)
            depth_m = frame.usable_depth
            self.free.add(depth_m, keyframe.T_map_camera)
            self.extents.append(ViewExtent.of(depth_m, self._log.camera))
            self._far.add(frame.color, depth_m, keyframe.T_map_camera)
            self._poses.append(keyframe.T_map_camera)

    def far_m(self, keyframe: int) -> Image | None:
        """Depth of what a keyframe saw too far away to be measured (`FarDepth.of`).

        Args:
            keyframe: number in order of arrival.
        """
        return self._far.of(keyframe)

    def tiles(self) -> list[list[int]]:
        """Keyframes of every tile of the map, cut where they look."""
        count = len(self.extents)
        if count <= self._config.whole_keyframes:
            return [list(range(count))]
        centers = [
            se3.transform(T, extent.center_camera[None])[0]
            for T, extent in zip(self._poses, self.extents, strict=True)
        ]
        return make_tiles(np.array(centers), self._config.tile_keyframes)

    def border(self, tile: Sequence[int], others: Sequence[int]) -> list[int]:
        """Keyframes of other tiles, out of some, that look into a tile.

        Args:
            tile: its keyframes.
            others: keyframes that may.
        """
        views = list(zip(self.extents, self._poses, strict=True))
        return border_keyframes(tile, others, views, self._config.border_keyframes)
