"""Components: the submaps of one robot that share a frame, as one sequence of keyframes with one pose graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.submaps import TrackedLog, TrackedSubmap, lost
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePose

Ends = tuple[int, int]
"""Of a pair of submaps, the earlier one first: places in a list of them."""


@dataclass(frozen=True)
class Component:
    """Submaps that share a frame: that of the first of them.

    Attributes:
        numbers: of these submaps, ascending.
        keyframes: in the order of time, numbered from 0.
        pairs: registrations and loop closures between them.
        closures: by number of a submap, how many loop closures tie it to others.
        index_of: place of a keyframe by (number of the submap, index there); none of one that was rejected and is in a
            component of its own.
    """

    numbers: tuple[int, ...]
    keyframes: list[TrackedKeyframe]
    pairs: list[RelativePose]
    closures: Mapping[int, int]
    index_of: dict[tuple[int, int], int]

    def frames(self, log: TrackedLog) -> list[TrackedFrame]:
        """Every frame of the log, anchored to the keyframes of this component; lost where it is in no submap of it.

        Args:
            log: as it was tracked.
        """
        frames, anchor, T_keyframe_camera = [], 0, np.eye(4)
        for frame, number in zip(log.frames, log.submap_of, strict=True):
            if (number, frame.keyframe_index) in self.index_of:
                anchor, T_keyframe_camera = (
                    self.index_of[number, frame.keyframe_index],
                    frame.T_keyframe_camera,
                )
            elif frame.status is not Status.LOST:
                frame = lost(frame, Reason.OTHER_COMPONENT)
            frames.append(replace(frame, keyframe_index=anchor, T_keyframe_camera=T_keyframe_camera))
        return frames


def whole(submap: TrackedSubmap) -> Component:
    """A submap by itself.

    Args:
        submap: whose keyframes stay as they are.
    """
    index_of = {(submap.number, k.keyframe_index): k.keyframe_index for k in submap.keyframes}
    return Component(
        (submap.number,), list(submap.keyframes), list(submap.pairs), {submap.number: 0}, index_of
    )


def assembled(
    submaps: Sequence[TrackedSubmap],
    T_world_map: Sequence[Array],
    closures: Mapping[Ends, Sequence[LoopClosure]],
) -> Component:
    """Submaps in one frame.

    Args:
        submaps: in the order in which they began.
        T_world_map: [4, 4], where each lies.
        closures: loop closures between two of them, which connect all.
    """
    if len(submaps) == 1:
        return whole(submaps[0])
    order = sorted((k.frame_index, s.number, k.keyframe_index) for s in submaps for k in s.keyframes)
    index_of = {(number, index): new for new, (_, number, index) in enumerate(order)}
    numbers = [submap.number for submap in submaps]
    joints = [
        _ordered(index_of[numbers[a], c.own_keyframe], index_of[numbers[b], c.peer_keyframe], c)
        for (a, b), found in sorted(closures.items())
        for c in found
    ]
    keyframes: dict[int, TrackedKeyframe] = {}
    pairs: list[RelativePose] = []
    for submap, T in zip(submaps, T_world_map, strict=True):
        new = [index_of[submap.number, k.keyframe_index] for k in submap.keyframes]
        pairs += [replace(pair, i=new[pair.i], j=new[pair.j]) for pair in submap.pairs]
        for keyframe, index in zip(submap.keyframes, new, strict=True):
            previous = keyframe.previous_index
            keyframes[index] = replace(
                keyframe,
                keyframe_index=index,
                previous_index=new[previous] if previous >= 0 else _previous(new, joints),
                T_map_keyframe=T @ keyframe.T_map_keyframe,
            )
    ordered = [keyframes[index] for index in range(len(order))]
    count = {
        number: sum(len(found) for ends, found in closures.items() if k in ends)
        for k, number in enumerate(numbers)
    }
    return Component(tuple(numbers), ordered, [*pairs, *joints], count, index_of)


def _ordered(i: int, j: int, closure: LoopClosure) -> RelativePose:
    """A loop closure from the earlier keyframe to the later one."""
    T, information = closure.T_own_peer, closure.information
    if i < j:
        return RelativePose(i, j, T, information)
    return RelativePose(j, i, se3.inverse(T), se3.inverse_information(T, information))


def _previous(own: Sequence[int], joints: Sequence[RelativePose]) -> int:
    """The keyframe before the first one of a submap: the other end of a loop closure nearest to it, if that is earlier.

    Args:
        own: keyframes of the submap, in the order of time.
        joints: loop closures of the component.
    """
    first, mine = own[0], set(own)
    if first == 0:
        return -1
    across = [(p.i, p.j) if p.j in mine else (p.j, p.i) for p in joints if (p.i in mine) != (p.j in mine)]
    earlier = sorted((inside, -other) for other, inside in across if other < first)
    return -earlier[0][1] if earlier else first - 1
