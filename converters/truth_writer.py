"""Writes the ground truth of one robot into a log of its own, which no stage but the evaluation opens."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline import messages
from duagc.pipeline.recording import DEPTH_SCALE_KEY, LogWriter
from duagc.schemas import topics


class TruthWriter:
    """Writes what is known of the truth at frames; there is a log only if something is known."""

    def __init__(self, folder: Path, robot: str, depth_scale: float, files: ExitStack) -> None:
        """Open nothing yet.

        Args:
            folder: of the recording.
            robot: its name.
            depth_scale: meters per unit of exact depth.
            files: closes the log.
        """
        self._folder, self._robot, self._depth_scale, self._files = folder, robot, depth_scale, files
        self._open: LogWriter | None = None
        self._has_depth = False
        self._positions: list[NDArray[np.float64]] = []

    def add(
        self,
        stamp_ns: int,
        T_world_camera: NDArray[np.float64] | None,
        exact_depth: NDArray[np.uint16] | None,
        mask: NDArray[np.bool_] | None,
    ) -> None:
        """Append what is known at a frame.

        Args:
            stamp_ns: time of the frame.
            T_world_camera: pose [4, 4] of the color camera in the world that all robots share; None: not known.
            exact_depth: uint16 [H, W] in units of `depth_scale`, 0 = none; None: not known.
            mask: bool [H, W], False where something moves; None: not known.
        """
        if mask is not None:
            message = messages.pack_mask(stamp_ns, self._robot, mask)
            self._log.write(topics.GROUNDTRUTH_MASK.of(self._robot), message, stamp_ns)
        if T_world_camera is not None:
            pose = messages.pack_pose_in_frame(stamp_ns, messages.WORLD_FRAME, T_world_camera)
            self._log.write(topics.GROUNDTRUTH_POSE.of(self._robot), pose, stamp_ns)
            self._positions.append(T_world_camera.astype(np.float64)[:3, 3].copy())
        if exact_depth is not None:
            topic = topics.GROUNDTRUTH_DEPTH.of(self._robot)
            if not self._has_depth:
                unit = {DEPTH_SCALE_KEY: repr(self._depth_scale)}
                self._log.channel(topic, topics.GROUNDTRUTH_DEPTH.schema, unit)
                self._has_depth = True
            self._log.write(topic, messages.pack_depth(stamp_ns, self._robot, exact_depth), stamp_ns)

    @property
    def digests(self) -> dict[str, str]:
        """Digest of the closed log by its name; empty if there is none."""
        return {} if self._open is None else {self._open.path.name: self._open.digest}

    @property
    def path(self) -> dict[str, float | list[float]] | None:
        """How long the true path is, and the corners of the box around it, meters; None: no pose is known."""
        if not self._positions:
            return None
        positions = np.array(self._positions)
        length = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
        low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
        return {"length_m": length, "low_m": low, "high_m": high}

    @property
    def _log(self) -> LogWriter:
        """The log, opened when there is something to say."""
        if self._open is None:
            log = LogWriter(self._folder / f"{self._robot}.groundtruth.mcap", self._robot)
            self._open = self._files.enter_context(log)
        return self._open
