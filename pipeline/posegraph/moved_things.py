"""Loop closures that follow something that moved between two recordings, and not the place.

Where a chair was moved, two views of it agree on two motions: of the room, and of the chair. What moves is smaller than
the place, so that of two motions that one pair of views shows, the one whose features spread wider is that of the place
(`GeometricVerification.of_place`). Other pairs see the chair alone. They are known as well, for they agree with the
motions that such pairs ascribe to something that moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import Group, KeyframePoses, consistent
from duagc.pipeline.posegraph.relative_poses import LoopClosure


@dataclass(frozen=True)
class TwoMotions:
    """What one pair of views shows.

    Attributes:
        place: the motion of the place, as features have it: where what moved fills most of a view, dense registration
            may not confirm it.
        moved: the motion of something that moved, which registration confirms.
    """

    place: LoopClosure
    moved: LoopClosure


def following_moved_things(
    closures: Sequence[LoopClosure],
    tentative: Sequence[LoopClosure],
    shown: Sequence[TwoMotions],
    *,
    own: KeyframePoses,
    peer: KeyframePoses,
    config: LoopClosureConfig,
) -> dict[int, float]:
    """Loop closures that follow something that moved.

    Args:
        closures: all that are verified between two robots or two submaps.
        tentative: what features of other pairs agree on, and registration does not confirm.
        shown: what pairs of views show that two motions were found of.
        own: own keyframes.
        peer: the others' keyframes.
        config: which loop closures agree.

    Returns:
        Indices of such loop closures, and how far off they have the others' frame, meters.
    """
    if not shown:
        return {}
    count, first = len(closures), len(closures) + len(tentative)
    motions = [*closures, *tentative, *(two.place for two in shown), *(two.moved for two in shown)]
    moved = first + len(shown)
    found = consistent(motions, own, peer, config)
    if found.T_ownmap_peermap is None:
        return {}
    groups = [Group(found.keep, found.T_ownmap_peermap), *found.others]
    votes = [int(g.keep[first:moved].sum()) - int(g.keep[moved:].sum()) for g in groups]
    place = int(np.argmax(votes))
    if votes[place] <= 0:
        return {}
    out: dict[int, float] = {}
    for group, vote in zip(groups, votes, strict=True):
        if vote < 0:
            apart_m, _ = se3.distance(groups[place].T_ownmap_peermap, group.T_ownmap_peermap)
            out |= dict.fromkeys(np.flatnonzero(group.keep[:count]).tolist(), float(apart_m))
    return out
