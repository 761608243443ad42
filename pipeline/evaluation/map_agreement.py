"""Agreement of held-out views under several trajectories, of their depth and of their features."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.evaluation.depth_agreement import depth_agreement
from duagc.pipeline.evaluation.feature_agreement import MatchedPair, feature_agreement, matched_pairs
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import NO_ROTATIONS, Paired
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.recording import RgbdLog, open_rgbd

Path3D = Mapping[int, NDArray[np.float64]]
"""T_frame_camera [4, 4] by time stamp."""

VIEWS = 40
"""Held-out views, evenly spread, that are compared in pairs."""
OF_TRUTH = "_of_truth"


@dataclass(frozen=True)
class MatchedViews:
    """Views of a robot and the features that they share.

    Attributes:
        frames: indices of the views.
        pairs: of views, by their places in `frames`.
    """

    frames: tuple[int, ...]
    pairs: list[MatchedPair]


def matched_views(log_path: Path, known: Sequence[int], *, frontend: Path) -> MatchedViews:
    """What `section` matches, as long as every frame has a pose in all paths: it needs none of them.

    Args:
        log_path: sensor log of the robot.
        known: held-out frames that were tracked, in order.
        frontend: as of `section`.
    """
    chosen = _chosen(known)
    with _opened(log_path, frontend) as log:
        return _matched(log, chosen)


def section(
    log_path: Path,
    held_out: Mapping[int, int],
    paths: Mapping[str, Path3D],
    true: Paired | Absent,
    *,
    frontend: Path,
    matched: MatchedViews | None = None,
) -> dict[str, Any]:
    """How well held-out views agree under trajectories, and under the ground truth where there is one.

    Ground truth of a part of the views takes no view from the trajectories, which need none.

    Args:
        log_path: sensor log of the robot.
        held_out: stamp of every held-out frame that was tracked, by its index.
        paths: by the ending of their names in the result.
        true: estimate and ground truth, paired.
        frontend: frontend.mcap of the robot, by which depth of another time is moved into that of its image.
        matched: `matched_views` of the frames, if it is known already.
    Returns:
        `depth_agreement_m` and `feature_agreement_px` of every path, and of how many pairs of views.
    """
    found: dict[str, Any] = {}
    own = [i for i, stamp in held_out.items() if all(stamp in path for path in paths.values())]
    with_truth, judged = own, dict(paths)
    if isinstance(true, Absent) or true.positions_only:
        absent = true if isinstance(true, Absent) else NO_ROTATIONS
        found = {f"depth_agreement_m{OF_TRUTH}": absent, f"feature_agreement_px{OF_TRUTH}": absent}
    else:
        of_truth = dict(zip(true.stamps_ns.tolist(), true.true, strict=True))
        with_truth, judged = [i for i in own if held_out[i] in of_truth], {**paths, OF_TRUTH: of_truth}
    views = partial(_views, log_path, held_out, frontend=frontend, matched=matched)
    if with_truth == own:
        return found | views(own, judged)
    truth_only = views(with_truth, judged)  # on the views that have some; it takes none from the others
    return views(own, paths) | {name: value for name, value in truth_only.items() if name.endswith(OF_TRUTH)}


def _views(
    log_path: Path,
    held_out: Mapping[int, int],
    known: Sequence[int],
    paths: Mapping[str, Path3D],
    *,
    frontend: Path,
    matched: MatchedViews | None,
) -> dict[str, Any]:
    """Agreement under every path of some of the held-out frames `known`, and of how many pairs."""
    chosen = _chosen(known)
    poses = {
        name: np.array([path[held_out[index]] for index in chosen]).reshape(-1, 4, 4)
        for name, path in paths.items()
    }
    with _opened(log_path, frontend) as log:
        pairs, by_depth = depth_agreement([log.usable_depth(index) for index in chosen], log.camera, poses)
        if matched is None or matched.frames != tuple(chosen):
            matched = _matched(log, chosen)
        by_features = feature_agreement(matched.pairs, log.camera, poses)
    found: dict[str, Any] = {"depth_agreement_pairs": pairs, "feature_agreement_pairs": len(matched.pairs)}
    for name in paths:
        found[f"depth_agreement_m{name}"] = by_depth[name]
        found[f"feature_agreement_px{name}"] = by_features[name]
    return found


def _chosen(known: Sequence[int]) -> list[int]:
    return [known[k] for k in evenly_spaced(len(known), min(VIEWS, len(known)))]


@contextmanager
def _opened(log_path: Path, frontend: Path) -> Iterator[RgbdLog]:
    with open_rgbd(log_path) as log:
        log.move_depth_by(frontend)
        yield log


def _matched(log: RgbdLog, chosen: Sequence[int]) -> MatchedViews:
    frames = [log.frame(index) for index in chosen]
    depths, usable = [f.usable_depth for f in frames], [f.mask for f in frames]
    pairs = matched_pairs([f.color for f in frames], depths, log.camera, usable)
    return MatchedViews(tuple(chosen), pairs)
