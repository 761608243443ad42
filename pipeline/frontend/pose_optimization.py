"""Keyframe poses of a path: joint optimization with loop closures, then the judgment by features and depth.

Where features contradict the poses of two keyframes, the motion that they agree on takes the place of what tracking
found, and all is optimized again. What is contradicted even then is rejected: the frames that are anchored to it are
lost here, and what is contradicted as a whole may go on by itself (`rejected_parts`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend import bundle, loops
from duagc.pipeline.frontend.bundle import Images
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.followed_things import Witnesses
from duagc.pipeline.frontend.judgment import Judgment, judge
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes, solve_pose_graph
from duagc.pipeline.frontend.loop_outliers import consistent_loops
from duagc.pipeline.frontend.lost_frames import found_afterwards, without_jumps
from duagc.pipeline.frontend.rejected_parts import RejectedPart
from duagc.pipeline.frontend.repeated_frames import without_stuck
from duagc.pipeline.frontend.submaps import lost
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import RgbdPyramid


@dataclass(frozen=True)
class OptimizedPath:
    """A path whose poses nothing contradicts.

    Attributes:
        keyframes: those that are not rejected, numbered from 0.
        frames: every frame; lost if its keyframe was rejected.
        solution: poses of the keyframes.
        factors: of their pose graph.
        rejected: parts of the path before, the first one first.
    """

    keyframes: list[TrackedKeyframe]
    frames: list[TrackedFrame]
    solution: OptimizedKeyframes
    factors: Sequence[RelativePose]
    rejected: Sequence[RejectedPart] = ()


@dataclass(frozen=True)
class PathOptimization:
    """Settings of the optimization of one path, and what it reads.

    Attributes:
        images: reads the images of a frame of the log, by its index.
        config: of the front end.
        seed: of the random streams.
        robot: of the random streams.
        checkpoints: of the stage.
        part: its name there.
    """

    images: Images
    config: FrontendConfig
    seed: int
    robot: str
    checkpoints: Checkpoints = NO_CHECKPOINTS
    part: str = "poses"

    def run(
        self,
        keyframes: Sequence[TrackedKeyframe],
        frames: Sequence[TrackedFrame],
        pairs: Sequence[RelativePose],
    ) -> OptimizedPath:
        """Optimize the poses of all keyframes, judge them, and look again for lost frames.

        Args:
            keyframes: as tracked.
            frames: every frame, anchored to keyframes.
            pairs: registrations that connect the keyframes.
        """
        path = self._consistent_path(keyframes, frames, pairs)
        T_map_keyframes = path.solution.T_map_keyframe
        found = found_afterwards(
            without_jumps(path.frames, path.keyframes, T_map_keyframes, self.config),
            path.keyframes,
            T_map_keyframes,
            self.images,
            config=self.config,
            checkpoints=self.checkpoints,
            part=f"{self.part}.lost",
        )
        return replace(path, frames=without_stuck(found, T_map_keyframes))

    def _consistent_path(
        self,
        keyframes: Sequence[TrackedKeyframe],
        frames: Sequence[TrackedFrame],
        pairs: Sequence[RelativePose],
    ) -> OptimizedPath:
        """Optimized poses that nothing contradicts."""
        solution, factors = self._optimized(keyframes, pairs, 1)
        path = OptimizedPath(list(keyframes), list(frames), solution, factors)
        if not self.config.keyframes.judgment.enabled or not keyframes:
            return path
        judgment = self._judged(path, 1)
        if judgment.believes_all:
            return path
        if judgment.may_be_corrected:
            pairs = judgment.corrected(pairs)
            solution, factors = self._optimized(keyframes, pairs, 2)
            path = replace(path, solution=solution, factors=factors)
            judgment = self._judged(path, 2)
            if judgment.believes_all:
                return path
        pairs = judgment.corrected(pairs)
        rejected = _rejected(path, pairs, judgment)
        path, pairs = _without_rejected(path, pairs, judgment)
        solution, factors = self._optimized(path.keyframes, pairs, 3)
        return replace(path, solution=solution, factors=factors, rejected=rejected)

    def _judged(self, path: OptimizedPath, attempt: int) -> Judgment:
        part = f"{self.part}.judgment{attempt}"

        def judged() -> Judgment:
            return judge(
                path.solution.T_map_keyframe,
                path.keyframes,
                path.factors,
                self.config,
                images=lambda index, levels: self.images(path.keyframes[index].frame_index, levels),
                seed=self.seed,
                robot=self.robot,
                witnesses=Witnesses(path.frames, self.images),
                checkpoints=self.checkpoints,
                part=part,
            )

        return self.checkpoints.done(part, judged)

    def _optimized(
        self, keyframes: Sequence[TrackedKeyframe], pairs: Sequence[RelativePose], attempt: int
    ) -> tuple[OptimizedKeyframes, Sequence[RelativePose]]:
        """Keyframe poses by all their images together, and the factors of the pose graph."""
        part = f"{self.part}.optimized{attempt}"
        return self.checkpoints.done(part, lambda: self._solved(keyframes, pairs, part))

    def _solved(
        self, keyframes: Sequence[TrackedKeyframe], pairs: Sequence[RelativePose], part: str
    ) -> tuple[OptimizedKeyframes, Sequence[RelativePose]]:
        settings, registration = self.config.keyframes, self.config.tracking.registration
        start = np.array([keyframe.T_map_keyframe for keyframe in keyframes])
        if len(keyframes) < 2 or not (settings.local_optimization or settings.loops.enabled):
            return solve_pose_graph(start, pairs, settings.huber_sigmas), pairs

        def images(index: int, levels: int) -> RgbdPyramid:
            return self.images(keyframes[index].frame_index, levels)

        closures: Sequence[RelativePose] = ()
        if settings.loops.enabled:
            tracked = solve_pose_graph(start, pairs, settings.huber_sigmas).T_map_keyframe
            found = self.checkpoints.done(
                f"{part}.loops",
                lambda: loops.find_loops(
                    tracked,
                    keyframes,
                    images,
                    config=settings.loops,
                    registration=registration,
                    seed=self.seed,
                    robot=self.robot,
                    checkpoints=self.checkpoints,
                    part=f"{part}.loops",
                ),
            )
            closures = consistent_loops(tracked, pairs, found, settings.loops)
        if not settings.local_optimization:
            known = [*pairs, *closures]
            return solve_pose_graph(start, known, settings.huber_sigmas), known
        return bundle.optimize(
            start,
            keyframes,
            images,
            pairs,
            closures=closures,
            config=settings,
            registration=registration,
            checkpoints=self.checkpoints,
            part=f"{part}.bundle",
        )


def _rejected(path: OptimizedPath, pairs: Sequence[RelativePose], judgment: Judgment) -> list[RejectedPart]:
    """The parts of a path that were contradicted, each with the pairs that may be true within it."""
    members: dict[int, list[int]] = {}
    for keyframe in judgment.contradicted:
        members.setdefault(judgment.parts[keyframe], []).append(keyframe)
    return [
        RejectedPart(
            sorted(part),
            path.solution.T_map_keyframe[sorted(part)],
            [pair for pair in pairs if pair.i in part and pair.j in part],
            judgment.following.intersection(part),
        )
        for _, part in sorted(members.items())
    ]


def _without_rejected(
    path: OptimizedPath, pairs: Sequence[RelativePose], judgment: Judgment
) -> tuple[OptimizedPath, list[RelativePose]]:
    """The path and its pairs without some keyframes; it starts from where it was optimized."""
    contradicted = judgment.contradicted
    left = [k for k in range(len(path.keyframes)) if k not in contradicted]
    new = {before: k for k, before in enumerate(left)}
    keyframes = []
    for before, index in new.items():
        previous = max((k for k in new if k <= path.keyframes[before].previous_index), default=-1)
        keyframes.append(
            replace(
                path.keyframes[before],
                keyframe_index=index,
                previous_index=new.get(previous, index - 1),
                T_map_keyframe=path.solution.T_map_keyframe[before],
            )
        )
    kept = [replace(p, i=new[p.i], j=new[p.j]) for p in pairs if p.i in new and p.j in new]
    frames: list[TrackedFrame] = []
    anchor, T_anchor_camera = 0, np.eye(4)
    for frame in path.frames:
        if judgment.follows(frame, path.keyframes[frame.keyframe_index]):
            frame = lost(frame, Reason.SOMETHING_MOVED)
        if frame.keyframe_index in new:
            anchor, T_anchor_camera = new[frame.keyframe_index], frame.T_keyframe_camera
        elif frame.status is not Status.LOST:
            frame = lost(frame, contradicted[frame.keyframe_index])
        frames.append(replace(frame, keyframe_index=anchor, T_keyframe_camera=T_anchor_camera))
    return OptimizedPath(keyframes, frames, path.solution, path.factors), kept
