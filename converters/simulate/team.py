"""Simulated recordings: a team of robots with cameras in a procedural scene or among textured meshes."""

import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from duagc.converters.simulate.frames import FrameImages, FrameJob, FrameSettings, RenderPool
from duagc.converters.simulate.movers import Mover, walk
from duagc.converters.simulate.preview import Preview
from duagc.converters.simulate.sensors import light, shutter
from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ, Degradations
from duagc.converters.simulate.sensors.lens import RadialLens
from duagc.converters.simulate.sensors.rig import RANGE_SIGMA_M, T_CAMERA_LIDAR, Rig
from duagc.converters.simulate.settings import SCENES, Cover, SimulationSettings, camera_of, scene_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes, SimulatedScene, set_up
from duagc.converters.simulate.trajectories import loops, paradigms
from duagc.converters.simulate.trajectories.moments import pose_at, twists_of
from duagc.converters.writer import RecordingWriter, robot_names
from duagc.pipeline.base import determinism
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.atomic_folder import check_apart, resolved
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.ply_points import write_points
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry.camera import PinholeCamera

START_NS = 1_000_000_000
OVERLAP_TOLERANCE = 0.05  # beyond it, the recording says so
SLOW_SHARE = 0.6  # of the scene's usual speed; likewise if no robot of a figure is as fast
MAX_WORKERS = 1024
METER_IMAGE = (40, 30)  # of the exposure meter


def simulate(
    out: str | Path,
    *,
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
    preview: str | Path | None = None,
    rig: Rig | None = None,
    movers: int = 0,
    masks: bool = True,
    covers: Sequence[Cover] = (),
    degradations: Degradations | None = None,
    triangles: bool = False,
    paths: Sequence[Array] | None = None,
) -> None:
    """Render a recording of a robot team, with exact depth, poses and geometry as ground truth.

    The bytes are the same for the same arguments, whatever the number of workers.

    Args:
        out: folder of the recording, made here.
        robots: how many; each follows a path of its own, 22 mm per frame in the room, 60 mm outdoors, else 28
            mm.
        frames: per robot, at 30 Hz.
        scene: one of `SCENES`, or else a folder of textured meshes.
        size: width and height of the images, pixels.
        noise: "none" or "kinect" (then the exact depth goes to the ground truth).
        seed: of scene, paths and noise.
        overlap: share of what a robot sees that the next one sees as well.
        workers: processes that render.
        force: replace a recording that is there.
        up: of meshes, the axis that is up in the files: "y", "z", or "auto", as is custom for their format.
        paradigm: the figure that the paths draw together, one of `PARADIGMS`; "wander" is none.
        preview: a PNG file to write, with what the robots saw and their paths from above.
        rig: the sensors, if other than an RGB-D camera that does not move during a frame.
        movers: figures that walk through the scene.
        masks: whether the log has masks that say where these are; else only the ground truth has.
        covers: when a lens is covered: the robot moves on and sees nothing.
        degradations: what makes the camera worse than an ideal one; None: nothing.
        triangles: make triangles of the room even if nothing needs them: its paths are then those of recordings
            that do.
        paths: T_world_camera [frames, 4, 4] of every robot, instead of those of the paradigm.
    Raises:
        DuagError: an argument is out of range, `out` exists, or a mesh cannot be used.
    """
    settings = SimulationSettings(
        robots=robots,
        frames=frames,
        scene=scene,
        size=size,
        noise=noise,
        seed=seed,
        overlap=overlap,
        up=up,
        paradigm=paradigm,
        rig=rig or Rig(),
        movers=movers,
        masks=masks,
        covers=tuple(covers),
        degradations=degradations or Degradations(),
        triangles=triangles,
    )
    settings.check()
    out, preview = Path(out), None if preview is None else Path(preview)
    if scene not in SCENES:
        check_apart(out, [Path(scene)])
    _check_output(out, workers, preview, force)
    _check_paths(settings, paths)
    determinism.configure_determinism()
    determinism.configure_opencv()
    source, parameters = scene_of(scene, up)
    with (
        RecordingWriter(
            out,
            source=source,
            converter="simulate",
            parameters=parameters | settings.parameters() | ({} if paths is None else {"paths": "given"}),
            force=force,
        ) as recording,
        tempfile.TemporaryDirectory(prefix="duagc-scene-") as cache,
        RenderPool(workers) as pool,
    ):
        simulated = set_up(
            scene, parameters.get("up", ""), seed, Path(cache), as_meshes=settings.needs_triangles
        )
        team = _Team(settings, simulated, camera_of(size), paths)
        figures = _movers(settings, simulated, team.trajectories, Path(cache))
        frame_settings = FrameSettings.of(settings, team.camera, figures, team.rig)
        jobs = team.jobs()
        images = pool.images(simulated, frame_settings, jobs)  # begun; what follows is done meanwhile
        shared = team.report_paths(recording)
        points = simulated.points()
        recording.add_geometry(lambda path: write_points(path, *points))
        title = f"{parameters['scene']}, {paradigm}, seed {seed}: neighbors share {shared:.2f} of the view"
        sheet = Preview(
            title,
            team.names,
            team.trajectories,
            [mover.poses for mover in figures],
            kept=team.kept_frames,
        )
        team.report_sensors(recording)
        team.write(recording, track(images, "simulate", len(jobs)), sheet)
        if preview is not None:
            sheet.write(preview, points[0], points[2])


class _Team:
    """The robots of a simulation: their names and trajectories, and what a recording says about them."""

    def __init__(
        self,
        settings: SimulationSettings,
        scene: SimulatedScene,
        camera: PinholeCamera,
        paths: Sequence[Array] | None,
    ) -> None:
        self.settings, self.scene, self.camera = settings, scene, camera
        self.names = robot_names(settings.robots)
        self.trajectories = self._plan() if paths is None else list(paths)
        """T_world_camera [frames, 4, 4] of every robot."""
        self._clocks_ns = {name: settings.rig.clock_offset_ns(settings.seed, name) for name in self.names}
        self._twists = [twists_of(path) for path in self.trajectories]
        self.rig = self._rig()
        """The sensors, with the exposure that the motion blur takes."""
        d, seed = settings.degradations, settings.seed
        self._kept = {name: d.kept_frames(settings.frames, seed, name).tolist() for name in self.names}
        self._exposures = self._exposure_gains()
        self._balances = [light.white_balance_gains(settings.frames, d, seed, name) for name in self.names]

    def _plan(self) -> list[Array]:
        s = self.settings
        if s.paradigm == "wander":
            return self.scene.wander(s.robots, s.frames, s.overlap, self.camera)
        return paradigms.plan(
            self.scene,
            s.paradigm,
            robots=s.robots,
            frames=s.frames,
            overlap=s.overlap,
            camera=self.camera,
            seed=s.seed,
        )

    def _rig(self) -> Rig:
        rig, blur_px = self.settings.rig, self.settings.degradations.blur_px
        if blur_px == 0:
            return rig
        small = self.scene.renderer(self.camera.scaled(*loops.OVERLAP_IMAGE))
        exposure_s = shutter.exposure_for(blur_px, small, self.trajectories, self._twists, camera=self.camera)
        return dataclasses.replace(rig, exposure_s=exposure_s)

    def _exposure_gains(self) -> list[Array]:
        """Gains [frames] of every robot's automatic exposure."""
        d = self.settings.degradations
        if d.auto_exposure == 0:
            return [np.ones(self.settings.frames) for _ in self.names]
        small = self.scene.renderer(self.camera.scaled(*METER_IMAGE))
        return [
            light.exposure_gains(np.array([light.metered(small.render(T).color) for T in path]), d)
            for path in self.trajectories
        ]

    @property
    def kept_frames(self) -> list[list[int]]:
        """Indices on its path of the recorded frames of every robot."""
        return [self._kept[name] for name in self.names]

    def report_paths(self, recording: RecordingWriter) -> float:
        """Write clearance, shared views and distances to the checks, and warn where settings were not met.

        Args:
            recording: gets the checks and warnings.
        Returns:
            Share of the view that neighbors have in common, on average.
        """
        s, names, paths = self.settings, self.names, self.trajectories
        small = self.scene.renderer(self.camera.scaled(*loops.OVERLAP_IMAGE))
        recording.checks["clearance_m"] = {
            name: float(self.scene.clearance(path[:, :3, 3]).min())
            for name, path in zip(names, paths, strict=True)
        }
        recording.checks["shared_view"] = {
            f"{names[i]}-{names[i + 1]}": loops.shared_view(small, paths[i], paths[i + 1])
            for i in range(s.robots - 1)
        }
        shares = list(recording.checks["shared_view"].values()) or [s.overlap]
        shared = float(np.mean(shares))
        if abs(shared - s.overlap) > OVERLAP_TOLERANCE:
            recording.warnings.append(
                f"neighbors share {shared:.2f} of the view ({min(shares):.2f} to {max(shares):.2f}), "
                f"expected {s.overlap:.2f}"
            )
        if s.paradigm != "wander":
            self._report_figure(recording)
        return shared

    def _report_figure(self, recording: RecordingWriter) -> None:
        """How far apart robots stay whose paths draw a figure, and whether they are as fast as usual."""
        s, paths = self.settings, self.trajectories
        if s.robots > 1:
            recording.checks["robots_apart_m"] = paradigms.least_apart(paths)
        step_m = max(float(np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).mean()) for path in paths)
        if step_m < SLOW_SHARE * self.scene.step_m:
            recording.warnings.append(
                f"there was room for {s.paradigm} paths of {step_m * (s.frames - 1):.1f} m, so robots move "
                f"{1000 * step_m:.1f} mm per frame, expected {1000 * self.scene.step_m:.0f} mm"
            )

    def report_sensors(self, recording: RecordingWriter) -> None:
        """Write clock offsets, exposures, color responses and missing frames to the checks.

        Args:
            recording: gets the checks.
        """
        rig, seed = self.settings.rig, self.settings.seed
        if rig.clock_s > 0:
            recording.checks["clock_offset_ns"] = self._clocks_ns
        if rig.gain_stops > 0:
            recording.checks["exposure_gain"] = {
                name: [rig.gain(seed, name, i / FRAME_RATE_HZ) for i in self._kept[name]]
                for name in self.names
            }
        if rig.camera_stops > 0:
            tints = {name: rig.tint(seed, name) for name in self.names}
            recording.checks["camera_gain"] = {name: gain.tolist() for name, (gain, _) in tints.items()}
            recording.checks["camera_black"] = {name: black.tolist() for name, (_, black) in tints.items()}
        d = self.settings.degradations
        if d.auto_exposure > 0:
            recording.checks["auto_exposure_gain"] = {
                name: gains[self._kept[name]].tolist()
                for name, gains in zip(self.names, self._exposures, strict=True)
            }
        if d.white_balance > 0:
            recording.checks["white_balance_gain"] = {
                name: gains[self._kept[name]].tolist()
                for name, gains in zip(self.names, self._balances, strict=True)
            }
        if d.missing > 0 or d.rate_hz < FRAME_RATE_HZ:
            recording.checks["frames_of_path"] = self._kept

    def jobs(self) -> list[FrameJob]:
        """All frames to render, robot after robot."""
        robots = zip(
            self.names, self.trajectories, self._twists, self._exposures, self._balances, strict=True
        )
        delay = self.settings.degradations.depth_delay_s * FRAME_RATE_HZ
        return [
            FrameJob(
                name,
                i,
                path[i],
                twists[i],
                tuple((exposures[i] * balances[i]).tolist()),
                T_world_depth=pose_at(path, i - delay) if delay > 0 else None,
            )
            for name, path, twists, exposures, balances in robots
            for i in self._kept[name]
        ]

    def write(self, recording: RecordingWriter, images: Iterator[FrameImages], sheet: Preview) -> None:
        """Write the logs of all robots.

        Args:
            recording: gets the logs.
            images: of all frames, in the order of `jobs`.
            sheet: gets the frames that it shows.
        """
        rig = self.rig
        k1 = self.settings.degradations.lens_k1
        lens = RadialLens(self.camera, k1) if k1 != 0 else None
        sensors = _log_metadata(rig, self.settings, lens)
        camera = self.camera if lens is None else lens.pinhole
        for name, path in zip(self.names, self.trajectories, strict=True):
            scale_m = self.scene.depth_scale_m
            # black that was rendered is part of the scene
            with recording.robot(name, camera, scale_m, sensors, find_regions=False) as robot:
                if rig.sensor == "lidar":
                    robot.set_lidar(T_CAMERA_LIDAR, RANGE_SIGMA_M)
                for i in self._kept[name]:
                    image = next(images)
                    sheet.add(name, i, image.png)
                    stamp_ns = START_NS + self._clocks_ns[name] + round(i * 1e9 / FRAME_RATE_HZ)
                    robot.add_frame(
                        stamp_ns,
                        image.png,
                        "png",
                        image.depth,
                        T_world_camera=path[i],
                        exact_depth=image.exact_depth,
                        mask=image.mask if self.settings.masks else None,
                        true_mask=None if self.settings.masks else image.mask,
                        depth_sigma_m=image.sigma_m,
                    )
                    if image.points is not None:
                        robot.add_points(stamp_ns, image.points)


def _movers(
    settings: SimulationSettings, scene: SimulatedScene, trajectories: list[Array], cache: Path
) -> list[Mover]:
    """The figures that walk through the scene."""
    if not settings.movers:
        return []
    assert isinstance(scene, SimulatedMeshes)
    return walk(
        settings.movers, scene.free_space(), scene.caster, trajectories, seed=settings.seed, cache=cache
    )


def _check_paths(settings: SimulationSettings, paths: Sequence[Array] | None) -> None:
    """Refuse paths that are not one pose a frame of every robot."""
    expected = [(settings.frames, 4, 4)] * settings.robots
    if paths is not None and (found := [path.shape for path in paths]) != expected:
        raise DuagError(f"simulate: paths are of shapes {found}, expected {expected}")


def _check_output(out: Path, workers: int, preview: Path | None, force: bool) -> None:
    """Refuse a number of workers or a picture that cannot be."""
    if not 1 <= workers <= MAX_WORKERS:
        raise DuagError(f"simulate: workers is {workers}, expected 1 to {MAX_WORKERS}")
    if preview is not None and resolved(out) in resolved(preview).parents:
        raise DuagError(f"{preview}: is inside the recording that is replaced, expected a picture elsewhere")
    if preview is not None and preview.exists() and not (force and preview.is_file()):
        raise DuagError(f"{preview}: exists already, expected the name of a new picture, or --force")
    if preview is not None and (preview.suffix != ".png" or not preview.absolute().parent.is_dir()):
        raise DuagError(
            f"{preview}: found no such place for a picture, expected NAME.png in a folder that exists"
        )


def _log_metadata(rig: Rig, settings: SimulationSettings, lens: RadialLens | None) -> dict[str, str]:
    """What a log says about its sensors, as far as a camera's maker states it; the readout is of undistorted images."""
    metadata = {"depth_noise": settings.noise} if rig.sensor == "rgbd" else {"depth": rig.sensor}
    if rig.readout_s > 0:
        metadata["rolling_shutter_s"] = repr(rig.readout_s * (1.0 if lens is None else lens.rows_per_row))
    if rig.exposure_s > 0:
        metadata["exposure_s"] = repr(rig.exposure_s)
    if lens is not None:
        metadata["lens_k1"] = repr(lens.k1)
    return metadata
