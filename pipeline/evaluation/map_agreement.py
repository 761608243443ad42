"""Agreement of held-out views under several trajectories, of their depth and of their features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.evaluation.depth_agreement import depth_agreement
from duagc.pipeline.evaluation.feature_agreement import feature_agreement
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import NO_ROTATIONS, Paired
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.recording import open_rgbd

Path3D = Mapping[int, NDArray[np.float64]]
"""T_frame_camera [4, 4] by time stamp."""

VIEWS = 40
"""Held-out views, evenly spread, that are compared in pairs."""
OF_TRUTH = "_of_truth"


def section(
    log_path: Path,
    held_out: Mapping[int, int],
    paths: Mapping[str, Path3D],
    true: Paired | Absent,
    *,
    frontend: Path,
) -> dict[str, Any]:
    """How well held-out views agree under trajectories, and under the ground truth where there is one.

    Ground truth of a part of the views takes no view from the trajectories, which need none.

    Args:
        log_path: sensor log of the robot.
        held_out: stamp of every held-out frame that was tracked, by its index.
        paths: by the ending of their names in the result.
        true: estimate and ground truth, paired.
        frontend: frontend.mcap of the robot, by which depth of another time is moved into that of its image.
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
    views = partial(_views, log_path, held_out, frontend=frontend)
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
) -> dict[str, Any]:
    """Agreement under every path of some of the held-out frames `known`, and of how many pairs."""
    most = min(VIEWS, len(known))
    chosen = [known[k] for k in evenly_spaced(len(known), most)]
    with open_rgbd(log_path) as log:
        log.move_depth_by(frontend)
        camera, frames = log.camera, [log.frame(index) for index in chosen]
    depths = [f.usable_depth for f in frames]
    poses = {
        name: np.array([path[held_out[index]] for index in chosen]).reshape(-1, 4, 4)
        for name, path in paths.items()
    }
    pairs, by_depth = depth_agreement(depths, camera, poses)
    colors, usable = [f.color for f in frames], [f.mask for f in frames]
    matched, by_features = feature_agreement(colors, depths, camera, poses, masks=usable)
    found: dict[str, Any] = {"depth_agreement_pairs": pairs, "feature_agreement_pairs": matched}
    for name in paths:
        found[f"depth_agreement_m{name}"] = by_depth[name]
        found[f"feature_agreement_px{name}"] = by_features[name]
    return found
