"""Parts of a path that the judgment of the poses rejected: each becomes a submap of its own if it is large enough.

Nothing contradicts such a part in itself. Only where it lies to the rest of the path is not known, as of a submap that
did not join. So it is a component of its own from then on, which the exchange may join to others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import SubmapConfig
from duagc.pipeline.frontend.components import Component, whole
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.submaps import TrackedLog, TrackedSubmap, lost
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.posegraph.relative_poses import RelativePose


@dataclass(frozen=True)
class RejectedPart:
    """Keyframes that other keyframes of their path contradict, but not each other.

    Attributes:
        keyframes: their numbers in the path, ascending.
        T_map_keyframe: [n, 4, 4], where the optimization had them.
        pairs: registrations between them, by their numbers in the path.
        following: those from which something that moves was followed to the next one: other frames are lost.
    """

    keyframes: Sequence[int]
    T_map_keyframe: Array
    pairs: Sequence[RelativePose]
    following: frozenset[int] = frozenset()

    @property
    def index_of(self) -> dict[int, int]:
        """Its own numbers of its keyframes, by those in the path."""
        return {before: k for k, before in enumerate(self.keyframes)}

    def submap(self, number: int, keyframes: Sequence[TrackedKeyframe]) -> TrackedSubmap:
        """The part as a submap.

        Args:
            number: of the submap.
            keyframes: of the path.
        """
        new = self.index_of
        own = [
            replace(
                keyframes[before],
                keyframe_index=k,
                previous_index=new.get(keyframes[before].previous_index, k - 1),
                T_map_keyframe=T,
            )
            for (before, k), T in zip(new.items(), self.T_map_keyframe, strict=True)
        ]
        return TrackedSubmap(number, own, [replace(p, i=new[p.i], j=new[p.j]) for p in self.pairs])


@dataclass(frozen=True)
class Separated:
    """A component, and what was rejected of it as components of their own.

    Attributes:
        log: as it was tracked, with the parts as submaps.
        own: the component without them.
        others: of one part each.
    """

    log: TrackedLog
    own: Component
    others: list[Component]

    def frames(self, frames: Sequence[TrackedFrame]) -> list[TrackedFrame]:
        """Frames of the component's path; those that are lost here, but have a pose in a part, say so.

        Args:
            frames: every frame, as the path was optimized.
        """
        numbers = {number for component in self.others for number in component.numbers}
        return [
            replace(frame, reason=Reason.OTHER_COMPONENT)
            if number in numbers and frame.status is Status.LOST and tracked.status is not Status.LOST
            else frame
            for frame, tracked, number in zip(frames, self.log.frames, self.log.submap_of, strict=True)
        ]


def separated(
    log: TrackedLog, component: Component, parts: Sequence[RejectedPart], config: SubmapConfig
) -> Separated:
    """Make components of the rejected parts that have as many frames and keyframes as a submap must have.

    Args:
        log: as it was tracked.
        component: from whose path the parts were rejected.
        parts: of its keyframes.
        config: what a submap must have.
    """
    frames, submap_of, submaps = list(log.frames), list(log.submap_of), list(log.submaps)
    index_of, others = dict(component.index_of), []
    for part in parts if config.enabled else ():
        new = part.index_of
        anchored = {
            at: new[index_of[anchor]]
            for at, frame in enumerate(frames)
            if (anchor := (submap_of[at], frame.keyframe_index)) in index_of and index_of[anchor] in new
        }
        unsure = {component.keyframes[k].frame_index: new[k] for k in part.following}
        own_frames = {
            at: lost(frames[at], Reason.SOMETHING_MOVED)
            if keyframe in unsure.values() and frames[at].frame_index not in unsure
            else frames[at]
            for at, keyframe in anchored.items()
        }
        posed = sum(frame.status is not Status.LOST for frame in own_frames.values())
        if posed < config.min_frames or len(new) < config.min_keyframes:
            continue
        submap = part.submap(max(s.number for s in submaps) + 1, component.keyframes)
        for at, keyframe in anchored.items():
            frames[at] = replace(own_frames[at], keyframe_index=keyframe)
            submap_of[at] = submap.number
        submaps.append(submap)
        others.append(whole(submap))
        index_of = {key: index for key, index in index_of.items() if index not in new}
    if not others:
        return Separated(log, component, [])
    left = tuple(sorted({number for number, _ in index_of}))
    own = replace(component, numbers=left, index_of=index_of)
    return Separated(TrackedLog(frames, submap_of, submaps), own, others)
