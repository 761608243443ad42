"""All frames of a log tracked in order; again where that shows that depth or rows are of other times than color."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import SupportsIndex

from duagc.pipeline.base import progress as progress_bar
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.color_blocks import BlocksOfLog
from duagc.pipeline.frontend.component_paths import trajectories_of
from duagc.pipeline.frontend.depth_delay import certain_delay_ns
from duagc.pipeline.frontend.depth_quality import largest_depth_offset_s
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.frame_pairs import FramePairs
from duagc.pipeline.frontend.leading_frames import track_leading_frames
from duagc.pipeline.frontend.other_tracker import OtherTracker
from duagc.pipeline.frontend.readout_time import certain_readout, moves_rows_far
from duagc.pipeline.frontend.submaps import SubmapTracker, TrackedLog
from duagc.pipeline.recording import MotionPrior, RgbdFrame, RgbdLog


@dataclass(frozen=True)
class LogTracking:
    """Tracks all frames of a log in order.

    Attributes:
        log: of the robot; it reads depth and rows as they are found to be taken.
        config: of the front end.
        motion: how the camera moved by other sensors; None: there are none.
        checkpoints: of the stage.
        blocks: of the frames that are read.
        seed: of the run.
        threads: of the rasterizer.
        progress: whether it is shown.
    """

    log: RgbdLog
    config: FrontendConfig
    motion: MotionPrior | None
    checkpoints: Checkpoints
    blocks: BlocksOfLog
    seed: int
    threads: SupportsIndex
    progress: bool

    def run(self) -> TrackedLog:
        """Track; where depth is of other times, or rows move far, again with them moved by the first result."""
        log, save = self.log, self.checkpoints
        keep = self.blocks.keep if self.config.exposure.mode != "off" else None
        first = save.done("tracked first", lambda: self._frames("tracking", keep))
        self._correct_times(first)
        tracked = save.done("tracked", lambda: self._leading(self._again(first)))
        if tracked.submaps[0].keyframes:
            log.move_depth(*trajectories_of(tracked))
        return tracked

    def _correct_times(self, first: TrackedLog) -> None:
        """Let the log read depth and rows at the times that the first pass finds."""
        log, save = self.log, self.checkpoints
        if not first.submaps[0].keyframes:
            return
        pairs = FramePairs(log, trajectories_of(first))
        if delay_ns := save.done("delay", lambda: certain_delay_ns(pairs, self.config.delay)):
            save.say(
                f"depth of {log.robot} was taken {1e-6 * delay_ns:.1f} ms before its stamps, and is moved"
            )
            log.delay_depth(delay_ns)
        if (readout := save.done("readout", lambda: certain_readout(pairs, self.config.readout))).rolls:
            times = f"{1e3 * readout.color_s:.1f} and {1e3 * readout.depth_s:.1f} ms"
            save.say(f"rows of {log.robot} were read for {times} (color, depth), and are moved")
            log.readout = readout

    def _again(self, tracked: TrackedLog) -> TrackedLog:
        log = self.log
        if not (log.needs_motion and tracked.submaps[0].keyframes):
            return tracked
        log.move_depth(*trajectories_of(tracked))
        late = bool(log.pairing.largest_offset_ns)
        return self._frames("tracking again") if late or moves_rows_far(log, self.config.readout) else tracked

    def _leading(self, tracked: TrackedLog) -> TrackedLog:
        if not tracked.submaps[0].keyframes or self.config.tracking.method != "registration":
            return tracked
        return track_leading_frames(self.log, tracked, self.config)

    def _frames(self, part: str, keep: Callable[[RgbdFrame], None] | None = None) -> TrackedLog:
        log, save = self.log, self.checkpoints
        tracker = self._tracker()
        begin = 0
        if (saved := save.resume(part)) is not None:
            begin, state = saved
            tracker.go_on(state)
        left: Iterable[int] = range(begin, len(log))
        if self.progress:
            left = progress_bar.track(left, f"{part} {log.robot}", len(log) - begin)
        for index in left:
            frame = log.frame(index)
            if keep is not None:
                keep(frame)
            tracker.track(RgbdImages.of(frame))
            save.at(part, index + 1, len(log), tracker.state, shown=tracker.path)
        return tracker.finish()

    def _tracker(self) -> SubmapTracker | OtherTracker:
        """As the configuration asks for; others than the usual one are imported by need."""
        camera, config = self.log.camera, self.config
        limit_s = largest_depth_offset_s(self.log.pairing.pairs, config.keyframes.max_depth_offset_s)
        if config.tracking.method == "registration":
            return SubmapTracker(camera, config, self.motion, max_depth_offset_s=limit_s)
        keyframes = config.keyframes.model_copy(update={"max_depth_offset_s": limit_s})
        config = config.model_copy(update={"keyframes": keyframes})
        if config.tracking.method == "rendering":
            from duagc.pipeline.frontend.rendering_tracker import RenderingTracker

            return RenderingTracker(camera, config, self.log.frame, seed=self.seed, threads=self.threads)
        from duagc.pipeline.frontend.open3d_tracker import Open3dTracker

        return Open3dTracker(camera, config, self.log.frame)
