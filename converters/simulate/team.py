"""Simulated recordings: a team of robots with cameras in a procedural scene or among textured meshes."""

import tempfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.simulate.movers import Mover, walk
from duagc.converters.simulate.scenes.catalog import SCENES
from duagc.converters.simulate.sensors.rig import (
    BASELINE_M,
    RANGE_SIGMA_M,
    SENSORS,
    T_CAMERA_LIDAR,
    Rig,
    with_gain,
)
from duagc.converters.simulate.trajectories.paradigms import PARADIGMS
from duagc.converters.writer import RecordingWriter, robot_names
from duagc.pipeline.base import determinism, random_streams
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.geometry.camera import PinholeCamera

FRAME_RATE_HZ = 30
START_NS = 1_000_000_000
FOCAL_OF_WIDTH = 0.82  # focal length as a share of the image width: 63 degrees across
NOISES = ("none", "kinect")
PNG_LEVEL = 1
MAX_ROBOTS = 8
OVERLAP_TOLERANCE = 0.05  # beyond it, the recording says so
SLOW_SHARE = 0.6  # of the scene's usual speed; likewise if no robot of a figure is as fast


def simulate(
    out: Path,
    robots: int = 2,
    frames: int = 160,
    scene: str = "room",
    size: tuple[int, int] = (480, 360),
    noise: str = "none",
    seed: int = 0,
    overlap: float = 0.6,
    workers: int = 2,
    force: bool = False,
    up: str = "auto",
    paradigm: str = "wander",
    preview: Path | None = None,
    rig: Rig | None = None,
    movers: int = 0,
) -> None:
    """Render a recording of a robot team, with exact depth, poses and geometry as ground truth.

    Args:
        out: folder of the recording, made here.
        robots: how many; each follows a path of its own, 22 mm per frame in the room, 60 mm outdoors, else 28 mm.
        frames: per robot, at 30 Hz.
        scene: one of `SCENES`, or else a folder of textured meshes.
        size: width and height of the images, pixels.
        noise: "none" or "kinect" (then the exact depth goes to the ground truth).
        seed: of scene, paths and noise; the same bytes for the same arguments, whatever the workers.
        overlap: share of what a robot sees that the next one sees as well.
        workers: processes that render.
        force: replace a recording that is there.
        up: of meshes, the axis that is up in the files: "y", "z", or "auto", as is custom for their format.
        paradigm: the figure that the paths draw together, one of `PARADIGMS`; "wander" is none.
        preview: a PNG file to write, with what the robots saw and their paths from above.
        rig: the sensors, if other than an RGB-D camera that stands still while it looks.
        movers: figures that walk through the scene; a mask says where they are.
    Raises:
        DuagError: an argument is out of range, `out` exists, or a mesh cannot be used.
    """
    rig = rig or Rig()
    _check(robots, frames, scene, size, noise, overlap, workers, paradigm, preview)
    _check_rig(rig, movers, noise)
    determinism.configure_determinism()
    determinism.configure_opencv()
    from duagc.converters.simulate.preview import Preview
    from duagc.converters.simulate.stages import MeshStage, set_up
    from duagc.converters.simulate.trajectories import loops, paradigms

    camera = camera_of(size)
    names = robot_names(robots)
    source, parameters = scene_of(scene, up)
    scene_name = parameters["scene"]
    parameters |= {"robots": robots, "frames": frames, "size": list(size)}
    parameters |= {"noise": noise, "seed": seed, "overlap": overlap}
    if paradigm != "wander":
        parameters["paradigm"] = paradigm
    if rig != Rig() or movers:
        parameters |= asdict(rig) | {"movers": movers}
    with (
        RecordingWriter(out, "", source, "simulate", parameters, force) as recording,
        tempfile.TemporaryDirectory(prefix="duagc-scene-") as cache,
    ):
        stage = set_up(
            scene, parameters.get("up", ""), seed, Path(cache), as_meshes=not rig.plain or movers > 0
        )
        if paradigm == "wander":
            ways = stage.wander(robots, frames, overlap, camera)
        else:
            ways = paradigms.plan(stage, paradigm, robots, frames, overlap, camera, seed)
        small = stage.eye(camera.scaled(*loops.OVERLAP_IMAGE))
        recording.checks["clearance_m"] = {
            name: float(stage.clearance(way[:, :3, 3]).min()) for name, way in zip(names, ways, strict=True)
        }
        recording.checks["shared_view"] = {
            f"{names[i]}-{names[i + 1]}": loops.shared_view(small, ways[i], ways[i + 1])
            for i in range(robots - 1)
        }
        shares = list(recording.checks["shared_view"].values()) or [overlap]
        shared = np.mean(shares)
        if abs(shared - overlap) > OVERLAP_TOLERANCE:
            recording.warnings.append(
                f"neighbors share {shared:.2f} of the view ({min(shares):.2f} to {max(shares):.2f}), "
                f"expected {overlap:.2f}"
            )
        if paradigm != "wander":
            if robots > 1:
                recording.checks["robots_apart_m"] = paradigms.least_apart(ways)
            step_m = max(float(np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1).mean()) for way in ways)
            if step_m < SLOW_SHARE * stage.step_m:
                recording.warnings.append(
                    f"there was room for {paradigm} ways of {step_m * (frames - 1):.1f} m, so robots move "
                    f"{1000 * step_m:.1f} mm per frame, expected {1000 * stage.step_m:.0f} mm"
                )
        points = stage.points()
        recording.add_geometry(lambda path: write_points(path, *points))
        walkers: list[Mover] = []
        if movers:
            assert isinstance(stage, MeshStage)
            walkers = walk(movers, stage.free_space(), stage.caster, ways, seed, Path(cache))
        title = f"{scene_name}, {paradigm}, seed {seed}: neighbors share {shared:.2f} of the view"
        sheet = Preview(title, names, ways, [mover.poses for mover in walkers])
        twists = [_twists(way) for way in ways]
        jobs = [_Job(names[k], i, ways[k][i], twists[k][i]) for k in range(robots) for i in range(frames)]
        clocks = {name: rig.clock_offset_ns(seed, name) for name in names}
        if rig.clock_s > 0:
            recording.checks["clock_offset_ns"] = clocks
        if rig.gain_stops > 0:
            recording.checks["exposure_gain"] = {
                name: [rig.gain(seed, name, i / FRAME_RATE_HZ) for i in range(frames)] for name in names
            }
        if rig.camera_stops > 0:
            tints = {name: rig.tint(seed, name) for name in names}
            recording.checks["camera_gain"] = {name: gain.tolist() for name, (gain, _) in tints.items()}
            recording.checks["camera_black"] = {name: black.tolist() for name, (_, black) in tints.items()}
        sensors = _told(rig, noise)
        with _Studio(stage, camera, noise, seed, workers, rig, walkers) as studio:
            images = track(studio.images(jobs), "simulate", len(jobs))
            for name, way in zip(names, ways, strict=True):
                with recording.robot(name, camera, stage.depth_scale_m, sensors) as robot:
                    if rig.sensor == "lidar":
                        robot.set_lidar(T_CAMERA_LIDAR, RANGE_SIGMA_M)
                    for i in range(frames):
                        image = next(images)
                        sheet.add(name, i, image.png)
                        stamp_ns = START_NS + clocks[name] + round(i * 1e9 / FRAME_RATE_HZ)
                        robot.add_frame(
                            stamp_ns,
                            image.png,
                            "png",
                            image.depth,
                            way[i],
                            image.exact_depth,
                            image.mask,
                            image.sigma_m,
                        )
                        if image.points is not None:
                            robot.add_points(stamp_ns, image.points)
        if preview is not None:
            sheet.write(preview, points[0], points[2])


def scene_of(scene: str, up: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `recording.json` says about a scene: source and parameters, no path of this machine."""
    if scene in SCENES:
        return {"kind": "simulation"}, {"scene": scene}
    from duagc.converters.simulate.render import meshes

    folder = Path(scene).resolve()
    files = meshes.mesh_files(folder)
    source = {"kind": "simulation", "scene": folder.name, "files_sha256": meshes.digests(files)}
    return source, {"scene": folder.name, "up": meshes.up_axis(files, up)}


def _check(
    robots: int,
    frames: int,
    scene: str,
    size: tuple[int, int],
    noise: str,
    overlap: float,
    workers: int,
    paradigm: str,
    preview: Path | None,
) -> None:
    """Refuse arguments out of range."""
    for name, value, low, high in (
        ("robots", robots, 1, MAX_ROBOTS),
        ("frames", frames, 2, 100_000),
        ("width", size[0], 32, 4096),
        ("height", size[1], 32, 4096),
        ("overlap", overlap, 0.0, 1.0),
        ("workers", workers, 1, 1024),
    ):
        if not low <= value <= high:
            raise DuagError(f"simulate: {name} is {value}, expected {low} to {high}")
    if noise not in NOISES:
        raise DuagError(f"simulate: noise is {noise!r}, expected one of {', '.join(NOISES)}")
    if paradigm not in PARADIGMS:
        raise DuagError(f"simulate: paradigm is {paradigm!r}, expected one of {', '.join(PARADIGMS)}")
    if preview is not None and (preview.suffix != ".png" or not preview.absolute().parent.is_dir()):
        raise DuagError(
            f"{preview}: found no such place for a picture, expected NAME.png in a folder that exists"
        )
    if scene not in SCENES and not Path(scene).is_dir():
        raise DuagError(
            f"simulate: scene is {scene!r}, expected {', '.join(SCENES)} or a folder of textured meshes"
        )


def camera_of(size: tuple[int, int]) -> PinholeCamera:
    """The camera of all robots."""
    width, height = size
    focal = FOCAL_OF_WIDTH * width
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


@dataclass(frozen=True)
class _Job:
    """One frame to render: robot, index, T_world_camera [4, 4], its motion per second (right tangent [6])."""

    robot: str
    index: int
    pose: NDArray[np.float64]
    twist: NDArray[np.float64]


@dataclass(frozen=True)
class _Images:
    """One frame as it goes into the logs; depths uint16 in units of the stage, 0 = none."""

    png: bytes
    depth: NDArray[np.uint16] | None
    exact_depth: NDArray[np.uint16] | None
    mask: NDArray[np.bool_] | None = None
    sigma_m: NDArray[np.float32] | None = None
    points: NDArray[np.float64] | None = None


class _Artist:
    """Renders, disturbs and encodes frames; what it makes of a job depends on nothing but the job."""

    def __init__(
        self, stage: Any, camera: PinholeCamera, noise: str, seed: int, rig: Rig, movers: list[Mover]
    ) -> None:
        from duagc.converters.layouts.stereo import StereoRig
        from duagc.converters.simulate.sensors.rig import MovingCamera

        self.eye, self.camera, self.noise, self.seed = stage.eye(camera), camera, noise, seed
        self.depth_scale_m, self.rig, self.has_movers = stage.depth_scale_m, rig, bool(movers)
        self.moving = None if rig.plain and not movers else MovingCamera(self.eye, rig, movers)
        self.stereo = StereoRig.rectified(camera, camera, BASELINE_M, "simulate")

    def draw(self, job: _Job) -> _Images:
        """The images of one frame."""
        from duagc.converters.simulate.sensors import noise

        view, mask = self._view(job, job.pose)
        color, exact = view.color, _units(view.depth, self.depth_scale_m)
        depth: NDArray[np.uint16] | None = exact
        sigma_m, points = None, None
        if self.noise == "kinect":
            rng = random_streams.generator(self.seed, "simulate.noise", robot=job.robot, frame=job.index)
            depth = _units(noise.kinect_depth(view.depth, self.camera, rng), self.depth_scale_m)
            color = noise.gray_noise(color, rng)
        elif self.rig.sensor == "stereo":
            depth, sigma_m = self._by_stereo(job, color)
        elif self.rig.sensor == "lidar":
            assert self.moving is not None
            rng = random_streams.generator(self.seed, "simulate.lidar", robot=job.robot, frame=job.index)
            depth, points = None, self.moving.sweep(job.pose, job.index, rng)
        if self.rig.gain_stops > 0 or self.rig.camera_stops > 0:
            gain = self.rig.gain(self.seed, job.robot, job.index / FRAME_RATE_HZ)
            color = with_gain(color, gain, self.rig.tint(self.seed, job.robot))
        return _Images(
            _png(color),
            depth,
            None if depth is exact else exact,
            mask if self.has_movers else None,
            sigma_m,
            points,
        )

    def _view(self, job: _Job, pose: NDArray[np.float64]) -> tuple[Any, NDArray[np.bool_] | None]:
        if self.moving is None:
            return self.eye.render(pose), None
        return self.moving.render(pose, job.twist, job.index)

    def _by_stereo(
        self, job: _Job, left: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
        """Depth and its standard deviation (m) by matching with a second camera to the right."""
        import cv2

        right_pose = job.pose.copy()
        right_pose[:3, 3] += BASELINE_M * job.pose[:3, 0]
        right, _ = self._view(job, right_pose)
        gray = [np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8) for each in (left, right.color)]
        depth_m, sigma_m = self.stereo.depth(gray[0], gray[1])
        return _units(depth_m.astype(np.float64), self.depth_scale_m), sigma_m


def _png(color: NDArray[np.uint8]) -> bytes:
    import cv2

    settings = [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
    _, png = cv2.imencode(".png", np.ascontiguousarray(color[..., ::-1]), settings)
    return png.tobytes()


def _twists(way: NDArray[np.float64]) -> NDArray[np.float64]:
    """Motion per second, right tangents [frames, 6], of a path; the last frame moves on as the one before."""
    from duagc.pipeline.geometry import se3

    twist = FRAME_RATE_HZ * se3.log(se3.inverse(way[:-1]) @ way[1:])
    return np.concatenate([twist, twist[-1:]])


def _told(rig: Rig, noise: str) -> dict[str, str]:
    """What a log says about its sensors."""
    told = {"depth_noise": noise} if rig.sensor == "rgbd" else {"depth": rig.sensor}
    if rig.readout_s > 0:
        told["rolling_shutter_s"] = repr(rig.readout_s)
    if rig.exposure_s > 0:
        told["exposure_s"] = repr(rig.exposure_s)
    return told


def _check_rig(rig: Rig, movers: int, noise: str) -> None:
    """Refuse sensors that cannot be."""
    if rig.sensor not in SENSORS:
        raise DuagError(f"simulate: sensor is {rig.sensor!r}, expected one of {', '.join(SENSORS)}")
    if rig.sensor != "rgbd" and noise != "none":
        raise DuagError(f"simulate: noise is {noise!r} with {rig.sensor}, expected it with rgbd")
    for name, value, high in (
        ("readout", rig.readout_s, 1 / FRAME_RATE_HZ),
        ("exposure", rig.exposure_s, 1 / FRAME_RATE_HZ),
        ("gain", rig.gain_stops, 3.0),
        ("difference of cameras", rig.camera_stops, 2.0),
        ("clock offset", rig.clock_s, 0.9),  # logs begin at 1 s, and no time is negative
        ("movers", movers, 8),
    ):
        if not 0 <= value <= high:
            raise DuagError(f"simulate: {name} is {value:g}, expected 0 to {high:g}")


def _units(depth_m: NDArray[np.float64], scale_m: float) -> NDArray[np.uint16]:
    """Depth in units of scale_m; what does not fit is no measurement."""
    units = np.rint(depth_m / scale_m)
    return np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)


class _Studio:
    """Artists in as many processes as asked for, which share one scene on disk; one worker paints right here."""

    def __init__(
        self,
        stage: Any,
        camera: PinholeCamera,
        noise: str,
        seed: int,
        workers: int,
        rig: Rig,
        movers: list[Mover],
    ) -> None:
        self.stage, self.workers = stage, workers
        self._about = (camera, noise, seed, rig, movers)
        self._pool: ProcessPoolExecutor | None = None
        self._open = ExitStack()

    def __enter__(self) -> "_Studio":
        if self.workers > 1:
            folder = self._open.enter_context(tempfile.TemporaryDirectory(prefix="duagc-atlas-"))
            start = (self.stage.store(Path(folder)), *self._about)
            self._pool = self._open.enter_context(worker_pool(self.workers, _start_worker, start))
        return self

    def images(self, jobs: list[_Job]) -> Iterator[_Images]:
        """The images of all jobs, in their order; a few are in work ahead of the one that is asked for."""
        if self._pool is None:
            artist = _Artist(self.stage, *self._about)
            yield from map(artist.draw, jobs)
            return
        waiting: deque[Future[_Images]] = deque()
        for job in jobs:
            waiting.append(self._pool.submit(_draw, job))
            if len(waiting) > 4 * self.workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)


_artist: _Artist | None = None


def _start_worker(
    stored: Any, camera: PinholeCamera, noise: str, seed: int, rig: Rig, movers: list[Mover]
) -> None:
    """Set up the artist of a worker process."""
    global _artist
    determinism.configure_opencv()
    _artist = _Artist(stored.open(), camera, noise, seed, rig, movers)


def _draw(job: _Job) -> _Images:
    """One frame, in a worker process."""
    assert _artist is not None
    return _artist.draw(job)


def write_points(
    path: Path, points: NDArray[np.float64], normals: NDArray[np.float64], colors: NDArray[np.uint8]
) -> None:
    """Write a binary .ply of points (m, world), unit normals and colors, [n, 3] each."""
    row = np.dtype([("points", "<f4", 3), ("normals", "<f4", 3), ("colors", "u1", 3)])
    rows = np.zeros(len(points), dtype=row)
    rows["points"], rows["normals"], rows["colors"] = points, normals, colors
    properties = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *properties,
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


__all__ = ["NOISES", "PARADIGMS", "SCENES", "SENSORS", "Rig", "simulate", "write_points"]
