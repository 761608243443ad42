"""Which views of a map are optimized at a keyframe: those that see most of what it sees, and random others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.frontend.mapping_views import View, view_overlap
from duagc.pipeline.geometry.camera import PinholeCamera


def optimization_window(
    views: Sequence[View],
    newest: View,
    config: MappingConfig,
    *,
    steps: int,
    camera: PinholeCamera,
    seed: int,
) -> list[View]:
    """The views of the steps at a keyframe: every second one the newest, the others in turn.

    Args:
        views: those that may be chosen, in the order in which they were added.
        newest: the last of them.
        config: numbers of views.
        steps: how many there are.
        camera: of all views.
        seed: of the run.
    """
    chosen = covisible(views, newest, config.window, candidates=config.candidates, camera=camera)[1:]
    taken = {view.index for view in chosen}
    rest = [view for view in views if view is not newest and view.index not in taken]
    draw = random_streams.generator(seed, "mapping.window", keyframe=newest.index)
    random = draw.permutation(len(rest))[: config.random_keyframes]
    others = [*chosen, *(rest[k] for k in random)]
    if not others:
        return [newest] * steps
    return [newest if k % 2 == 0 else others[(k // 2) % len(others)] for k in range(steps)]


def covisible(
    views: Sequence[View], newest: View, count: int, *, candidates: int, camera: PinholeCamera
) -> list[View]:
    """A view, the keyframe before it, and the older ones that see most of what it sees, best first; ties to the later.

    Args:
        views: those that may be chosen, in the order in which they were added.
        newest: the view.
        count: number of views returned at most, itself included.
        candidates: number of keyframes compared, those whose center of view is nearest.
        camera: of all views.
    """
    older = [view for view in views if view is not newest]
    if len(older) > candidates:
        centers = np.stack([view.center_map for view in older])
        distance = np.linalg.norm(centers - newest.center_map, axis=1)
        distance[-1] = 0.0
        nearest = np.sort(np.argsort(distance, kind="stable")[:candidates])
        older = [older[k] for k in nearest]
    overlaps = [view_overlap(newest, view, camera) for view in older]
    latest = len(older) - 1  # takes part whatever it sees: no other view saw what it added to the map
    ranked = sorted(range(len(older)), key=lambda k: (k != latest, -overlaps[k], -k))
    return [newest, *(older[k] for k in ranked[: count - 1])]
