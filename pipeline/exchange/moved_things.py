"""Loop closures that show something that moved between two recordings, and not the place.

Where a chair was moved, two views of it agree on two motions: of the room, and of the chair. What moves is smaller than
the place, so that of two motions that one pair of views shows, the one whose features spread wider is that of the place
(`verification.verify`). Other pairs see the chair alone. They are known as well, for they agree with the motions that
such pairs ascribe to something that moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.exchange.loop_closing import Tried
from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import Group, KeyframePoses, consistent


def without_moved_things(
    tried: Sequence[Tried], own: KeyframePoses, peer: KeyframePoses, config: LoopClosureConfig
) -> list[Tried]:
    """Candidates, those that show something that moved without their loop closures.

    Args:
        tried: all candidates of a pair of robots.
        own: own keyframes as seen from the first.
        peer: the neighbor's keyframes, likewise.
        config: which loop closures agree.
    """
    held = [k for k, t in enumerate(tried) if t.result.closure is not None]
    moved = [t.result.moved for t in tried if t.result.moved is not None]
    out = list(tried)
    if not moved:
        return out
    closures = [c for k in held if (c := tried[k].result.closure) is not None]
    found = consistent([*closures, *moved], own, peer, config)
    if found.T_ownmap_peermap is None:
        return out
    groups = [Group(found.keep, found.T_ownmap_peermap), *found.others]
    # whether pairs of views that show two motions ascribe those of a group to the place
    of_place = np.array([t.result.moved is not None for t in tried])[held]
    votes = [int(of_place[g.keep[: len(held)]].sum()) - int(g.keep[len(held) :].sum()) for g in groups]
    place = int(np.argmax(votes))
    if votes[place] <= 0:
        return out
    for group, vote in zip(groups, votes, strict=True):
        if vote < 0:
            apart_m, _ = se3.distance(groups[place].T_ownmap_peermap, group.T_ownmap_peermap)
            _leave_out(out, np.array(held)[group.keep[: len(held)]], float(apart_m))
    return out


def _leave_out(tried: list[Tried], which: NDArray[np.int64], apart_m: float) -> None:
    """Take the loop closures of some candidates away."""
    for k in which.tolist():
        detail = f"places the map {apart_m:.2f} m from where the surroundings do"
        result = replace(tried[k].result, verdict=Verdict.SOMETHING_MOVED, detail=detail, closure=None)
        tried[k] = replace(tried[k], result=result)
