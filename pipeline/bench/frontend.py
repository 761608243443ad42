"""Time, memory and accuracy of the front end on a recording, its ablation, and Open3D's odometry in the same run.

Every run of the front end has a process of its own, so that its peak memory is its own, and runs the stage that
`duagc run` runs; calls of named functions are timed on the way, nothing is taken apart. Ground truth is opened here,
after the stage has written its log. Runs come one after the other. Processor time is that of the process, all its
threads together; it suffers less from other load on the machine than wall time does, but also shows it.
"""

from __future__ import annotations

import functools
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.open3d_import import import_open3d
from duagc.pipeline.base.progress import track
from duagc.pipeline.base.workers import peak_memory_bytes, worker_pool
from duagc.pipeline.bench.frontend_errors import agreement_of, map_errors_of, trajectory_errors_of
from duagc.pipeline.bench.stopwatch import Calls, Stopwatch, counted, replaced, shares, summary
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.evaluation.results import split_reasons
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RobotRun

SCHEMA = 1
OPEN3D = {"Open3D, hybrid": "Hybrid", "Open3D, point-to-plane": "PointToPlane"}
DEPTH_MAX_M = 10.0

WITHOUT_MAP = "all"
# What changes against the configuration given, all without a map. The order is that of the table.
ABLATION: dict[str, dict[str, Any]] = {
    WITHOUT_MAP: {},
    "point-to-plane only": {
        "tracking.registration.residuals": "depth",
        "tracking.recovery.residuals": "depth",
    },
    "photometric only": {
        "tracking.registration.residuals": "gray",
        "tracking.recovery.residuals": "gray",
    },
    "no local optimization": {"keyframes.local_optimization": False},
    "no loops": {"keyframes.loops.enabled": False},
    "neither": {"keyframes.local_optimization": False, "keyframes.loops.enabled": False},
}
FRAME_PARTS = {
    "pyramid": ("tracking.RgbdPyramid", "build"),
    "registration": ("nearby", "register"),
}
KEYFRAME_PARTS = {"seeding": ("mapping.Mapper", "_seed"), "optimization": ("mapping.Mapper", "_optimize")}
COUNTED = {
    "frame": ("submaps.SubmapTracker", "track"),
    "step": ("alignment", "align"),
    "keyframe": ("mapping.Mapper", "add_keyframe"),
    "draw": ("mapping.Mapper", "_optimize"),
}


@dataclass(frozen=True)
class Plan:
    """What to measure.

    Attributes:
        config: of the front end; the ablation and the caps change it.
        caps: numbers of Gaussians, the first is that of the table of times; empty = no mapping.
        ablation: whether to run them.
        open3d: whether to run them.
        threads: of the kernels.
        robots: names; empty = all of the recording.
    """

    recording: Path
    config: FrontendConfig
    caps: tuple[int, ...] = ()
    ablation: bool = True
    open3d: bool = True
    threads: int = 1
    seed: int = 0
    robots: tuple[str, ...] = ()


def run(plan: Plan) -> dict[str, Any]:
    """Measure; the result as {"machine", "recording", "rows", "reasons"}, ready for JSON.

    Args:
        plan: what to measure.

    Raises:
        DuagError: the recording is broken, or has no such robot; Open3D cannot be imported.
    """
    from duagc.pipeline.bench.peaks import cpu_name

    if plan.open3d:
        with worker_pool(1) as pool:  # not in this process, whose memory would grow
            pool.submit(_check_open3d).result()

    source = Recording(plan.recording)
    robots = list(plan.robots) or source.robots
    for robot in robots:
        if robot not in source.robots:
            raise DuagError(
                f"{plan.recording}: has no robot {robot}, expected one of {', '.join(source.robots)}"
            )
    jobs = [job for robot in robots for job in _jobs(plan, robot)]
    rows = [_row(plan, source, job) for job in track(jobs, "bench frontend", len(jobs))]
    tree = {
        "schema": SCHEMA,
        "machine": {
            "cpu": cpu_name(),
            "cores": processors(),
            "threads": plan.threads,
            "load_average": os.getloadavg()[0],
        },
        "recording": source.description["name"],
        "digests": {robot: source.digest(source.log(robot).name) for robot in robots},
        "rows": {str(k): row for k, row in enumerate(rows)},
    }
    content, reasons = split_reasons(tree)
    return content | {"rows": list(content["rows"].values()), "reasons": reasons}


@dataclass(frozen=True)
class _Job:
    """One run: of the front end with a configuration, or of the named odometry of Open3D (config None)."""

    robot: str
    name: str
    config: FrontendConfig | None


def _jobs(plan: Plan, robot: str) -> Iterator[_Job]:
    tracking_only = plan.config.model_copy(update={"mapping_enabled": False})
    for cap in plan.caps:
        yield _Job(
            robot, "map", changed(plan.config, {"mapping_enabled": True, "mapping.max_gaussians": cap})
        )
    names = list(ABLATION) if plan.ablation else [WITHOUT_MAP]
    for name in names:
        yield _Job(robot, name, changed(tracking_only, ABLATION[name]))
    if plan.open3d:
        for name in OPEN3D:
            yield _Job(robot, name, None)


def changed(config: FrontendConfig, values: Mapping[str, Any]) -> FrontendConfig:
    """A configuration with other values, by dotted names.

    Args:
        config: left as it is.
        values: by dotted names below "frontend".

    Raises:
        DuagError: there is no such setting.
    """
    content = config.model_dump()
    for name, value in values.items():
        *sections, last = name.split(".")
        section = content
        for key in sections:
            section = section.get(key, {})
        if last not in section:
            raise DuagError(f"frontend.{name}: no such setting, expected one of {', '.join(section)}")
        section[last] = value
    return FrontendConfig.model_validate(content)


def _functions(parts: Mapping[str, tuple[str, str]]) -> dict[str, tuple[Any, str]]:
    from duagc.pipeline.frontend import (
        mapping,
        model_registration,
        nearby_registration,
        pose_optimization,
        submaps,
        tracking,
    )
    from duagc.pipeline.kernels import alignment

    modules: dict[str, ModuleType] = {
        "mapping": mapping,
        "poses": pose_optimization,
        "submaps": submaps,
        "tracking": tracking,
        "nearby": nearby_registration,
        "model": model_registration,
        "alignment": alignment,
    }
    found = {}
    for label, (path, name) in parts.items():
        module, _, owner = path.partition(".")
        found[label] = (getattr(modules[module], owner) if owner else modules[module], name)
    return found


# --- one run -----------------------------------------------------------------------------------------------------


def measure(log: Path, folder: Path, config: FrontendConfig, *, seed: int, threads: int) -> dict[str, Any]:
    """Run the front end on a log into folder/frontend.mcap, in a fresh process; times and peak memory.

    Args:
        log: of the robot.
        folder: gets frontend.mcap.
        config: of the front end.
        seed: of its random streams.
        threads: of the kernels.
    """
    from duagc.pipeline.frontend.stage import run_frontend

    whole = {"frame": ("submaps.SubmapTracker", "track"), "poses": ("poses.PathOptimization", "run")}
    if config.mapping_enabled:
        whole |= {"keyframe": ("mapping.Mapper", "add_keyframe"), "final": ("mapping.Mapper", "finalize")}
        whole |= {"model": ("model.ModelTracker", "register")}
    counts = _functions(COUNTED)
    with ExitStack() as stack:
        steps = stack.enter_context(counted(counts["frame"], counts["step"], lambda found, *_: found[3]))
        drawn = stack.enter_context(
            counted(counts["keyframe"], counts["draw"], lambda _, mapper, *__: mapper.rasterizer.visible)
        )
        outer = stack.enter_context(Stopwatch(_functions(whole)))
        inner = stack.enter_context(_in_turn(config))
        start = time.process_time()
        laps = run_frontend(log, folder / "frontend.mcap", config, seed=seed, threads=threads)
        cpu_s = time.process_time() - start
    frame = outer.calls["frame"]
    times: dict[str, Any] = {"frame": summary(frame) | {"parts_cpu_ms": shares(frame, inner.of("frame"))}}
    times["frame"] |= steps.summary("steps")
    times["pose_optimization_cpu_s"] = sum(outer.calls["poses"].cpu_s)
    if config.mapping_enabled:
        keyframe = outer.calls["keyframe"]
        times["keyframe"] = summary(keyframe) | {"parts_cpu_ms": shares(keyframe, inner.of("keyframe"))}
        times["keyframe"] |= drawn.summary("gaussians_drawn")
        if outer.calls["model"].cpu_s:
            times["model"] = summary(outer.calls["model"])
        times["final_refinement_cpu_s"] = sum(outer.calls["final"].cpu_s)
    return {
        "times": times,
        "laps_wall_s": laps,
        "cpu_s": cpu_s,
        "peak_memory_mb": peak_memory_bytes() / 1e6,
    }


class _Inner:
    """Times of the parts of a frame and of a keyframe; calls outside of the whole, as in `finish`, do not count."""

    def __init__(self, whole: Mapping[str, Stopwatch]) -> None:
        self._of = whole

    def of(self, whole: str) -> dict[str, Calls]:
        return self._of[whole].calls


@contextmanager
def _in_turn(config: FrontendConfig) -> Iterator[_Inner]:
    """Stopwatches of parts, which run only while the whole that they belong to does."""
    watches = {"frame": Stopwatch(_functions(FRAME_PARTS))}
    wholes = {"frame": ("submaps.SubmapTracker", "track")}
    if config.mapping_enabled:
        watches["keyframe"] = Stopwatch(_functions(KEYFRAME_PARTS))
        wholes["keyframe"] = ("mapping.Mapper", "add_keyframe")
    with ExitStack() as stack:
        for label, (owner, name) in _functions(wholes).items():
            stack.enter_context(replaced(owner, name, functools.partial(_within, watches[label])))
        yield _Inner(watches)


def _within(watch: Stopwatch, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with watch:
            return function(*args, **kwargs)

    return call


def _check_open3d() -> None:
    """Raise what keeps Open3D from running, before minutes are spent."""
    import_open3d()


def measure_open3d(log: Path, method: str) -> dict[str, Any]:
    """Open3D's RGB-D odometry (tensors, CPU, its defaults) from each frame to the next, in a fresh process.

    It starts from the motion before, as the tracker does: from rest it is worse.

    Args:
        log: of one robot.
        method: "Hybrid" or "PointToPlane".

    Returns:
        Times, peak memory, stamps_ns and poses T_first_camera [n, 4, 4]; `failed` frames keep the pose before.
    """
    o3d = import_open3d()
    odometry = o3d.t.pipelines.odometry
    how, tensor = getattr(odometry.Method, method), o3d.core.Tensor.from_numpy
    calls = Calls()
    T, motion = np.eye(4), np.eye(4)
    poses, stamps, failed, before = [], [], 0, None
    with open_rgbd(log) as source:
        intrinsics = tensor(source.camera.matrix())
        for frame in source.frames():
            wall, cpu = time.perf_counter(), time.process_time()
            color, depth = (
                np.ascontiguousarray(frame.color),
                np.ascontiguousarray(frame.usable_depth[..., None]),
            )
            image = o3d.t.geometry.RGBDImage(
                o3d.t.geometry.Image(tensor(color)), o3d.t.geometry.Image(tensor(depth))
            )
            if before is not None:
                try:
                    found = odometry.rgbd_odometry_multi_scale(
                        image, before, intrinsics, tensor(motion), 1.0, DEPTH_MAX_M, method=how
                    )
                    motion = found.transformation.numpy()
                except RuntimeError:  # a singular system
                    failed, motion = failed + 1, np.eye(4)
            T, before = T @ motion, image
            calls.cpu_s.append(time.process_time() - cpu)
            calls.wall_s.append(time.perf_counter() - wall)
            poses.append(T)
            stamps.append(frame.stamp_ns)
    return {
        "times": {"frame": summary(calls)},
        "peak_memory_mb": peak_memory_bytes() / 1e6,
        "stamps_ns": np.array(stamps, dtype=np.int64),
        "poses": np.array(poses),
        "failed": failed,
    }


def _row(plan: Plan, source: Recording, job: _Job) -> dict[str, Any]:
    """One run in a process of its own, and its accuracy."""
    log = source.log(job.robot)
    row: dict[str, Any] = {"robot": job.robot, "name": job.name}
    with tempfile.TemporaryDirectory(prefix="duagc-bench-") as name, worker_pool(1) as pool:
        folder = Path(name)
        if job.config is None:
            measured = pool.submit(measure_open3d, log, OPEN3D[job.name]).result()
            estimated = Trajectory(measured.pop("stamps_ns"), measured.pop("poses"))
            return (
                row
                | measured
                | {"frames": len(estimated)}
                | trajectory_errors_of(source, job.robot, estimated, estimated.stamps_ns)
            )
        measured = pool.submit(
            measure, log, folder, job.config, seed=plan.seed, threads=plan.threads
        ).result()
        robot = RobotRun(job.robot, folder)
        stamps_ns = np.array([f.stamp_ns for f in robot.frames], dtype=np.int64)
        placed = [f for f in robot.frames if f.status != "lost"]
        estimated = Trajectory(
            np.array([f.stamp_ns for f in placed], dtype=np.int64), np.array([f.T_map_camera for f in placed])
        )
        row |= measured | {
            "frames": len(robot.frames),
            "lost": len(robot.frames) - len(placed),
            "keyframes": len(robot.keyframes),
        }
        row |= trajectory_errors_of(source, job.robot, estimated, stamps_ns)
        row |= agreement_of(source, robot, estimated)
        if job.config.mapping_enabled:
            row |= {"max_gaussians": job.config.mapping.max_gaussians}
            row |= map_errors_of(source, robot, estimated, plan.threads)
    return row


def by_cap(result: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """What `report.figures.map_sizes` draws: the runs with a map, robot by robot, smallest cap first.

    Args:
        result: of `run`.
    """
    robots: dict[str, list[dict[str, Any]]] = {}
    for row in sorted(result["rows"], key=lambda row: row.get("max_gaussians", 0)):
        if row["name"] == "map":
            times, scores = row["times"], row["refined"]
            robots.setdefault(row["robot"], []).append(
                {"cap": row["max_gaussians"], "peak_memory_mb": row["peak_memory_mb"]}
                | {name: scores[name] for name in ("psnr_db", "depth_l1_m", "depth_l1_layer_m")}
                | {
                    "keyframe_s": times["keyframe"]["cpu_ms"] / 1e3,
                    "refinement_s": times["final_refinement_cpu_s"],
                }
            )
    return robots
