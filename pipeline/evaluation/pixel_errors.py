"""How far the depth that maps render at held-out views is from the true one, and how far it was predicted to be."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import local
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation import uncertainty_calibration
from duagc.pipeline.evaluation.pixel_deviation import (
    RenderedDepth,
    StatedMap,
    own_in_world,
    rendered_depth,
    stated_in_world,
    stated_own,
)
from duagc.pipeline.evaluation.rendering import (
    NONE_MET,
    REASONS,
    held_out_of,
    mates,
    poses_by_stamp,
    scored_frames,
    spread,
)
from duagc.pipeline.evaluation.results import Absent, mean
from duagc.pipeline.evaluation.views import ScoredFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.geometry.masks import masked_depth
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RobotRun, RunFolder

MAPS = ("own", "refined")
SETS = ("held_out", "peers")
MOST_VIEWS = 6
"""Of a set: enough for numbers good to a hundredth, in a few percent of the time that scoring renders takes."""
EVERY_PX = 8
"""One pixel of every second block of 4 x 4 in both directions: such blocks are what the rasterizer can leave out."""
MIN_PIXELS = 100
NAMES = (
    "pixels", "pixels_without_sigma", "median_error_m", "median_sigma_m", "spearman", "ece_rank",
    "ece_rank_if_right", "ece_rank_shuffled", "coverage_95", "nll", "sigma_scale", "coverage_95_scaled", "nll_scaled",
)  # fmt: skip
Scores = dict[str, dict[str, dict[str, Any]]]
"""Numbers by map and set of views."""


@dataclass(frozen=True)
class PixelErrors:
    """Pixels of a view.

    Attributes:
        error_m: difference of rendered and true depth [n], absolute.
        sigma_m: predicted standard deviation of that difference [n].
        without_sigma: pixels left out, because too little is stated of what they blend.
    """

    error_m: Array
    sigma_m: Array
    without_sigma: int


def scores_of_robot(run: RunFolder, source: Recording, name: str, *, threads: int) -> Scores:
    """The calibration of the depth that a robot's maps render, in the names of metrics.json.

    Args:
        run: the run.
        source: its recording.
        name: of the robot.
        threads: views rendered at the same time; changes no bit of the result.
    """
    robot, settings = run.robots[name], run.config.information
    noise, stated = DepthNoise.stated(settings), {"own": stated_own(robot)}
    if robot.refined_map is not None:
        stated["refined"] = stated_in_world(robot, robot.refined_map)
    found: dict[tuple[str, str], list[PixelErrors]] = {(kind, s): [] for kind in stated for s in SETS}

    def add(view_set: str, views: _Views) -> None:
        for kind, errors in views.errors(source, threads):
            found[kind, view_set].append(errors)

    paths = {"own": robot.odometry, "refined": robot.trajectory}
    add("held_out", _Views({k: (m, paths[k]) for k, m in stated.items()}, robot, MOST_VIEWS, noise))
    in_world, peers = stated | {"own": own_in_world(robot, stated["own"])}, mates(run, robot)
    for peer in peers:
        maps = {kind: (m, peer.trajectory) for kind, m in in_world.items()}
        add("peers", _Views(maps, peer, -(-MOST_VIEWS // len(peers)), noise))
    return {
        kind: {
            s: _scores(found[kind, s], f"{name} {kind} {s}", REASONS[s])
            if kind in stated
            else dict.fromkeys(NAMES, Absent(NONE_MET))
            for s in SETS
        }
        for kind in MAPS
    }


@dataclass(frozen=True)
class _Views:
    """Maps where one robot's camera stood at held-out frames.

    Attributes:
        maps: by kind, with the T_frame_camera of the views in its frame.
        camera_robot: whose views they are.
        most: views, evenly spread.
        noise: of a sensor that states none.
    """

    maps: Mapping[str, tuple[StatedMap, Trajectory]]
    camera_robot: RobotRun
    most: int
    noise: DepthNoise

    def errors(self, source: Recording, threads: int) -> Iterator[tuple[str, PixelErrors]]:
        """Kinds of maps and their errors, view by view."""
        from duagc.pipeline.kernels import Rasterizer

        robot, own = self.camera_robot, local()
        maps = {kind: (stated, poses_by_stamp(path)) for kind, (stated, path) in self.maps.items()}
        with open_rgbd(source.log(robot.robot)) as log:
            log.move_depth_by(robot.folder / "frontend.mcap")
            camera = log.camera
            sample = np.ix_(_every(camera.height), _every(camera.width))
            mask = np.zeros((camera.height, camera.width), bool)
            mask[sample] = True

            def of_view(view: ScoredFrame) -> list[tuple[str, PixelErrors]]:
                if not hasattr(own, "rasterizer"):
                    own.rasterizer = Rasterizer(threads=1)
                found = []
                for kind, (stated, poses) in maps.items():
                    T = poses.get(view.frame.stamp_ns)
                    if T is not None:
                        rendered = rendered_depth(own.rasterizer, stated, camera, se3.inverse(T), mask=mask)
                        found.append((kind, self._of(rendered, view, sample)))
                return found

            chosen = spread(held_out_of(robot), self.most)
            for found in in_order(of_view, scored_frames(log, chosen, source, robot), threads):
                yield from found

    def _of(self, rendered: RenderedDepth, view: ScoredFrame, sample: Any) -> PixelErrors:
        """The errors of a view at the sampled pixels, against exact depth where there is some, else recorded depth."""
        true_m, sensor_m = true_depth(view, self.noise)
        true, z, sigma_m = true_m[sample], rendered.depth_m[sample], rendered.sigma_m[sample]
        compared = (true > 0) & (z > 0)
        both = compared & (sigma_m > 0)
        error_m = np.abs(z[both].astype(np.float64) - true[both])
        predicted_m = np.hypot(sigma_m[both].astype(np.float64), sensor_m[sample][both])
        return PixelErrors(error_m, predicted_m, int(np.count_nonzero(compared & ~both)))


def true_depth(view: ScoredFrame, noise: DepthNoise) -> tuple[NDArray[np.float32], Array]:
    """What a rendered depth is compared with, and the standard deviation of that itself: images [h, w], meters.

    Exact depth has none. Recorded depth has what the log states, else what the model says.

    Args:
        view: a frame.
        noise: model of the sensor.
    """
    frame, exact_m = view.frame, view.exact_depth_m
    if not isinstance(exact_m, Absent):
        exact_m = masked_depth(exact_m, frame.mask)
        return exact_m, np.zeros(exact_m.shape)
    if frame.depth_sigma is not None:
        return frame.usable_depth, frame.depth_sigma.astype(np.float64)
    return frame.usable_depth, noise.sigma_m(frame.depth.astype(np.float64))


def _scores(errors: Sequence[PixelErrors], name: str, reason_if_none: str) -> dict[str, Any]:
    """All numbers of a map; the factor is fitted on every second view, judged on the others; `name` is of streams."""
    if not errors:
        return dict.fromkeys(NAMES, Absent(reason_if_none))
    sigma, error = np.concatenate([e.sigma_m for e in errors]), np.concatenate([e.error_m for e in errors])
    fitting = np.concatenate([np.full(len(e.error_m), k % 2 == 0) for k, e in enumerate(errors)])
    counts = {"pixels": len(error), "pixels_without_sigma": sum(e.without_sigma for e in errors)}
    if len(error) < MIN_PIXELS or fitting.all() or not fitting.any():
        absent = Absent(
            f"fewer than {MIN_PIXELS} pixels, or of one view alone, have a rendered and a true depth"
        )
        return dict.fromkeys(NAMES, absent) | counts
    scale = uncertainty_calibration.fitted_scale(sigma[fitting], error[fitting])
    judged = scale * sigma[~fitting], error[~fitting]
    if_right = uncertainty_calibration.if_right(sigma, name)
    shuffled = uncertainty_calibration.shuffled(sigma, name)
    return {
        **counts,
        "median_error_m": float(np.median(error)),
        "median_sigma_m": float(np.median(sigma)),
        "spearman": uncertainty_calibration.spearman(sigma, error),
        "ece_rank": uncertainty_calibration.ece_rank(sigma, error),
        "ece_rank_if_right": uncertainty_calibration.ece_rank(sigma, if_right),
        "ece_rank_shuffled": uncertainty_calibration.ece_rank(shuffled, error),
        "coverage_95": uncertainty_calibration.coverage_95(sigma, error),
        "nll": uncertainty_calibration.nll(sigma, error),
        "sigma_scale": scale,
        "coverage_95_scaled": uncertainty_calibration.coverage_95(*judged),
        "nll_scaled": uncertainty_calibration.nll(*judged),
    }


def team_scores(robots: Collection[Scores]) -> Scores:
    """Means over the robots; counts add up.

    Args:
        robots: scores of every robot, one at least.
    """
    return {
        kind: {s: {key: _together(key, [r[kind][s][key] for r in robots]) for key in NAMES} for s in SETS}
        for kind in MAPS
    }


def _together(key: str, values: list[float | Absent]) -> float | Absent:
    if not key.startswith("pixels"):
        return mean(values)
    counts = [v for v in values if not isinstance(v, Absent)]
    return int(sum(counts)) if counts else values[0]


def _every(side_px: int) -> NDArray[np.int64]:
    """Pixels along a side of the image that are sampled, in the middle of their blocks."""
    return np.arange(EVERY_PX // 2, side_px, EVERY_PX)
