"""Both cameras of an RGB-D recording, calibrated from its own images; no target, no ground truth.

The front end tracks the recording; then poses, landmarks and cameras are adjusted together, once to all views and once
to each half. Views that a calibration did not use judge it: each half the calibration of the other, and frames between
the views that of both. Frames that are held out for the evaluation of maps take no part at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import determinism
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.camera_calibration.adjustment import PRIOR, Adjusted, Quality, adjust
from duagc.pipeline.camera_calibration.rig import NAMES, CameraRig
from duagc.pipeline.camera_calibration.tracked import Tracked, track_log
from duagc.pipeline.camera_calibration.undetermined import UndeterminedError
from duagc.pipeline.camera_calibration.views import MIN_VIEWS, Views, load_views
from duagc.pipeline.config.calibration import CalibrationConfig
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.recording import Recording

Found = TypeVar("Found")
Pool = ProcessPoolExecutor | None
"""Where tasks are done; None: in this process."""
Part = tuple[Tracked, int, int]
"""A log, and its frames from one to before another."""
MIN_LANDMARKS = 200  # of a half
UNKNOWN = 0.7  # share of its prior standard deviation from which a number counts as undetermined
QUALITIES = ("features_px", "depth_of_features", "depth")
TOO_SMALL = 0.1  # px, or standard deviations of depth: views that agree this well have exact cameras
BY_OTHER, BY_BOTH = "the other half", "both halves"


@dataclass(frozen=True)
class Judged:
    """How well views agree under a calibration that did not use them.

    Attributes:
        views: what they are.
        calibrated_by: which views the calibration is from.
        before: agreement as recorded.
        after: agreement as calibrated.
    """

    views: str
    calibrated_by: str
    before: Quality
    after: Quality

    def ratios(self) -> list[float]:
        """After over before, of each of `QUALITIES`, as far as they are not too small to tell."""
        return [
            max(getattr(self.after, name), TOO_SMALL) / max(getattr(self.before, name), TOO_SMALL)
            for name in QUALITIES
        ]


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Attributes:
        rig: the cameras, from all views.
        sigma: standard deviation of every number of `NAMES`.
        halves: the cameras from each half alone.
        judged: agreement of views that the calibration did not use.
        names: of the halves.
        views: number of views.
        landmarks: number of landmarks.
        recording: description of the recording.
    """

    rig: CameraRig
    sigma: dict[str, float]
    halves: list[CameraRig]
    judged: list[Judged]
    names: list[str]
    views: int
    landmarks: int
    recording: dict[str, Any]

    def refusal(self, config: CalibrationConfig) -> str:
        """Why the recording is no better with this calibration, by views that it did not use; "" if it is.

        Args:
            config: how much better it must be.
        """
        for judged in self.judged:
            ratios = judged.ratios()
            gain, loss = 1 - float(np.exp(np.mean(np.log(ratios)))), max(ratios) - 1
            if not (gain >= config.min_gain and loss <= config.max_loss):  # nor one that is not a number
                return (
                    f"{judged.views}, calibrated by {judged.calibrated_by}: {100 * abs(gain):.1f} % "
                    f"{'better' if gain >= 0 else 'worse'} in the mean, "
                    f"up to {100 * max(loss, 0):.1f} % worse, expected at least {100 * config.min_gain:g} % and "
                    f"at most {100 * config.max_loss:g} %"
                )
        return ""

    def delay_ns(self, config: CalibrationConfig) -> int:
        """How much later color was taken than its stamps say, where that is certain enough; else 0.

        A delay that differs from half to half is less certain than its standard deviation says: stamps wander.

        Args:
            config: what is certain enough.
        """
        first, second = (half.delay_s for half in self.halves)
        uncertain_s = max(self.sigma["delay_s"], abs(first - second) / 2)
        certain = abs(self.rig.delay_s) > config.delay_sigmas * uncertain_s
        return round(1e9 * self.rig.delay_s) if certain else 0


def calibrate(
    folder: Path,
    config: FrontendConfig,
    robots: Sequence[str],
    views: int = CalibrationConfig().views,
    *,
    workers: int = 1,
) -> Calibration:
    """Calibrate the cameras of a recording; all chosen robots have the same.

    Args:
        folder: of the recording.
        config: of the front end that tracks it.
        robots: names; empty = all.
        views: largest number of each half.
        workers: tasks that are done at the same time; changes no bit of the result.

    Raises:
        UndeterminedError: its images do not determine the cameras.
        DuagError: the recording is broken, or the robots have different cameras.
    """
    with _pool(workers) as pool:
        return _calibration(folder, config, robots, views, pool=pool)


@contextmanager
def _pool(workers: int) -> Iterator[Pool]:
    if workers < 2:
        yield None
    else:
        with worker_pool(workers, determinism.configure_opencv) as pool:
            yield pool


def _later(pool: Pool, task: Callable[..., Found], *arguments: Any) -> Callable[[], Found]:
    """What a task finds, when it is asked for: the pool begins it now, this process when it is asked for first."""
    if pool is None:
        return cache(partial(task, *arguments))
    return pool.submit(task, *arguments).result


def _calibration(
    folder: Path, config: FrontendConfig, robots: Sequence[str], views: int, *, pool: Pool
) -> Calibration:
    source = Recording(folder)
    for robot in robots:
        if robot not in source.robots:
            raise DuagError(f"{folder}: has no robot {robot}, expected one of {', '.join(source.robots)}")
    tracked = _track({robot: source.log(robot) for robot in robots or source.robots}, config, pool)
    if len(tracked) == 1:
        n = len(tracked[0].ok)
        ranges: list[list[Part]] = [[(tracked[0], a, b)] for a, b in pairwise((0, n // 2, n))]
        most = views
    else:
        ranges = [[(t, 0, len(t.ok)) for t in tracked[k::2]] for k in (0, 1)]
        most = max(12, 2 * views // len(tracked))
    loading = [[_later(pool, _loaded, part, most) for part in half] for half in ranges]
    loaded = [_determined(half) for half in loading]
    # a robot whose images show nothing to follow says nothing of the cameras
    kept = [[(part, seen) for part, seen in half if len(seen.points_map)] for half in loaded]
    halves = [[seen for _, seen in half] for half in kept]
    cameras = {seen.camera for half in loaded for _, seen in half}
    if len(cameras) > 1:
        raise DuagError(f"{folder}: its robots have {len(cameras)} different cameras, expected --robot NAME")
    for half, all_of_it in zip(halves, loaded, strict=True):
        found = sum(len(part.points_map) for part in half)
        if found < MIN_LANDMARKS:
            names = " and ".join(seen.name for _, seen in all_of_it)
            raise UndeterminedError(
                f"{folder}: {found} features were followed in {names}, expected {MIN_LANDMARKS}"
            )
    loading_between = [_later(pool, _between, of, part.frames, most) for half in kept for of, part in half]
    between = [found_between for load in loading_between if (found_between := load()) is not None]
    return _calibrate(folder, halves, between, source.description, pool=pool)


def _track(logs: dict[str, Path], config: FrontendConfig, pool: Pool) -> list[Tracked]:
    """The robots that have frames enough; all that were tracked, if none has."""
    found = _determined([_later(pool, track_log, log, robot, config) for robot, log in logs.items()])
    return [t for t in found if np.count_nonzero(t.ok & ~t.held_out) >= MIN_VIEWS] or found


def _loaded(part: Part, most: int) -> tuple[Part, Views]:
    return part, load_views(*part, most)


def _determined(tasks: Iterable[Callable[[], Found]]) -> list[Found]:
    """What tasks find but those whose robot says too little of its cameras.

    Raises:
        UndeterminedError: all do.
    """
    found, missing = list[Found](), list[UndeterminedError]()
    for task in tasks:
        try:
            found.append(task())
        except UndeterminedError as error:
            missing.append(error)
    if not found:
        raise missing[0]
    return found


def _between(of: Part, used: NDArray[np.int64], most: int) -> Views | None:
    """Views of frames of a part between those that are used; None if there are too few."""
    try:
        found = load_views(*of, most // 2, without=used.tolist())
    except UndeterminedError:
        return None
    return found if len(found.points_map) >= MIN_LANDMARKS // 2 else None


def _calibrate(
    folder: Path, halves: list[list[Views]], between: list[Views], description: dict[str, Any], *, pool: Pool
) -> Calibration:
    start = CameraRig.of(halves[0][0].camera)
    done = list(track(_adjustments(halves, between, start, pool), "adjust", total=9 if between else 7))
    alone, both, recorded, by_other = done[:2], done[2], done[3:5], done[5:7]
    assert both.covariance is not None
    sigma = dict(zip(NAMES, np.sqrt(np.diag(both.covariance)).tolist(), strict=True))
    scale = start.camera.width / 640
    unknown = [
        n
        for n in NAMES
        if not sigma[n] <= UNKNOWN * PRIOR[n] * (scale if n in ("fx", "fy", "cx", "cy") else 1)
    ]
    if unknown:
        raise UndeterminedError(
            f"{folder}: its images do not determine {', '.join(unknown)}, expected more motion (turns about all axes, "
            "near and far) and texture up to the corners"
        )
    names = [" and ".join(part.name for part in half) for half in halves]
    judged = [
        Judged(name, BY_OTHER, _mean(before.quality), _mean(after.quality))
        for name, before, after in zip(names, recorded, by_other, strict=True)
    ]
    if between:
        count = sum(len(part.frames) for part in between)
        judged.append(
            Judged(f"{count} frames between", BY_BOTH, *(_mean(adjusted.quality) for adjusted in done[7:]))
        )
    return Calibration(
        rig=both.rig,
        sigma=sigma,
        halves=[half.rig for half in alone],
        judged=judged,
        names=names,
        views=sum(len(part.T_map_camera) for half in halves for part in half),
        landmarks=sum(len(part.points_map) for half in halves for part in half),
        recording=description,
    )


def _adjustments(
    halves: list[list[Views]], between: list[Views], start: CameraRig, pool: Pool
) -> Iterator[Adjusted]:
    """Each half calibrated by itself, all of it calibrated, each half as recorded and as the other calibrates it.

    Then the views between, as recorded and as all of it is calibrated.
    """
    alone = [_later(pool, _adjusted, half, start, True) for half in halves]
    both = _later(pool, _adjusted, [part for half in halves for part in half], start, True)
    recorded = [_later(pool, _adjusted, half, start, False) for half in halves]
    for task in alone:
        yield task()
    by_other = [
        _later(pool, _adjusted, half, other().rig, False)
        for half, other in zip(halves, reversed(alone), strict=True)
    ]
    yield both()
    rigs = (start, both().rig) if between else ()
    of_between = [_later(pool, _adjusted, between, rig, False) for rig in rigs]
    for task in (*recorded, *by_other, *of_between):
        yield task()


def _adjusted(parts: Sequence[Views], rig: CameraRig, calibrate: bool) -> Adjusted:
    return adjust([copy(part) for part in parts], rig, calibrate)


def _mean(quality: Sequence[Quality]) -> Quality:
    return Quality(*(float(np.mean([getattr(q, name) for q in quality])) for name in QUALITIES))
