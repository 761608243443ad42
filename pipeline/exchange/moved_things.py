"""Candidates of two robots that show something that moved between their recordings (`posegraph.moved_things`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.exchange.loop_closing import Tried
from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.posegraph.loop_closures import KeyframePoses
from duagc.pipeline.posegraph.moved_things import following_moved_things


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
    held = [(k, c) for k, t in enumerate(tried) if (c := t.result.closure) is not None]
    following = following_moved_things(
        [closure for _, closure in held],
        [t.result.tentative for t in tried if t.result.tentative is not None and t.result.shown is None],
        [shown for t in tried if (shown := t.result.shown) is not None],
        own=own,
        peer=peer,
        config=config,
    )
    out = list(tried)
    for at, apart_m in following.items():
        k = held[at][0]
        detail = f"places the map {apart_m:.2f} m from where the surroundings do"
        result = replace(tried[k].result, verdict=Verdict.SOMETHING_MOVED, detail=detail, closure=None)
        out[k] = replace(tried[k], result=result)
    return out
