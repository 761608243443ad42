"""Both cameras of an RGB-D recording, calibrated from its own images; no target, no ground truth.

The front end tracks the recording; then poses, landmarks and cameras are adjusted together, once to all views and once
to each half. The calibration by one half is tested on the other: it is reported only if it holds there. Frames that are
held out for the evaluation of maps take no part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.camera_calibration.adjustment import PRIOR, Adjusted, Quality, adjust
from duagc.pipeline.camera_calibration.rig import NAMES, CameraRig
from duagc.pipeline.camera_calibration.views import Views, load_views, track_log
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.recording import Recording

MIN_LANDMARKS = 200  # of a half
UNKNOWN = 0.7  # share of its prior standard deviation from which a number counts as undetermined


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Attributes:
        rig: the cameras, from all views.
        sigma: standard deviation of every number of `NAMES`.
        halves: the cameras from each half alone.
        before: agreement of each half as recorded.
        after: agreement of each half calibrated by the *other* half.
        names: of the halves.
        views: number of views.
        landmarks: number of landmarks.
        recording: description of the recording.
    """

    rig: CameraRig
    sigma: dict[str, float]
    halves: list[CameraRig]
    before: list[Quality]
    after: list[Quality]
    names: list[str]
    views: int
    landmarks: int
    recording: dict[str, Any]


def calibrate(folder: Path, config: FrontendConfig, robots: Sequence[str], views: int = 56) -> Calibration:
    """Calibrate the cameras of a recording; all chosen robots have the same.

    Args:
        folder: of the recording.
        config: of the front end that tracks it.
        robots: names; empty = all.
        views: largest number of each half.

    Raises:
        DuagError: the recording is broken, or its images do not determine the cameras, or a half contradicts the other.
    """
    source = Recording(folder)
    for robot in robots:
        if robot not in source.robots:
            raise DuagError(f"{folder}: has no robot {robot}, expected one of {', '.join(source.robots)}")
    tracked = [track_log(source.log(robot), robot, config) for robot in robots or source.robots]
    if len(tracked) == 1:
        n = len(tracked[0].ok)
        halves = [[load_views(tracked[0], a, b, views)] for a, b in ((0, n // 2), (n // 2, n))]
    else:
        most = max(12, 2 * views // len(tracked))
        halves = [[load_views(t, 0, len(t.ok), most) for t in tracked[k::2]] for k in (0, 1)]
    cameras = {part.camera for half in halves for part in half}
    if len(cameras) > 1:
        raise DuagError(f"{folder}: its robots have {len(cameras)} different cameras, expected --robot NAME")
    for half in halves:
        found = sum(len(part.points_map) for part in half)
        if found < MIN_LANDMARKS:
            names = " and ".join(part.name for part in half)
            raise DuagError(f"{folder}: {found} features were followed in {names}, expected {MIN_LANDMARKS}")
    return _calibrate(folder, halves, CameraRig.of(cameras.pop()), source.description)


def _calibrate(
    folder: Path, halves: list[list[Views]], start: CameraRig, description: dict[str, Any]
) -> Calibration:
    done = list(track(_adjustments(halves, start), "adjust", total=7))
    recorded, alone, by_other, both = done[:2], done[2:4], done[4:6], done[6]
    assert both.covariance is not None
    sigma = dict(zip(NAMES, np.sqrt(np.diag(both.covariance)).tolist(), strict=True))
    scale = start.camera.width / 640
    unknown = [
        n for n in NAMES if sigma[n] > UNKNOWN * PRIOR[n] * (scale if n in ("fx", "fy", "cx", "cy") else 1)
    ]
    if unknown:
        raise DuagError(
            f"{folder}: its images do not determine {', '.join(unknown)}, expected more motion (turns about all axes, "
            "near and far) and texture up to the corners"
        )
    found = Calibration(
        rig=both.rig,
        sigma=sigma,
        halves=[half.rig for half in alone],
        before=[_mean(half.quality) for half in recorded],
        after=[_mean(half.quality) for half in by_other],
        names=[" and ".join(part.name for part in half) for half in halves],
        views=sum(len(part.T_map_camera) for half in halves for part in half),
        landmarks=sum(len(part.points_map) for half in halves for part in half),
        recording=description,
    )
    for name, before, after in zip(found.names, found.before, found.after, strict=True):
        if after.features_px > before.features_px:
            raise DuagError(
                f"{folder}: found no better calibration than its own: by that of the other half, features of {name} "
                f"meet within {after.features_px:.3f} px, expected less than {before.features_px:.3f} px as recorded"
            )
    return found


def _adjustments(halves: list[list[Views]], start: CameraRig) -> Iterator[Adjusted]:
    """Each half as recorded, each calibrated by itself, each as the other calibrates it, and all of it calibrated."""

    def adjusted(parts: Sequence[Views], rig: CameraRig, calibrate: bool) -> Adjusted:
        return adjust([copy(part) for part in parts], rig, calibrate)

    for half in halves:
        yield adjusted(half, start, False)
    alone = []
    for half in halves:
        alone.append(adjusted(half, start, True))
        yield alone[-1]
    for half, other in zip(halves, reversed(alone), strict=True):
        yield adjusted(half, other.rig, False)
    yield adjusted([part for half in halves for part in half], start, True)


def _mean(quality: Sequence[Quality]) -> Quality:
    return Quality(
        *(
            float(np.mean([getattr(q, name) for q in quality]))
            for name in ("features_px", "depth_of_features", "depth")
        )
    )
