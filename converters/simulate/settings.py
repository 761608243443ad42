"""What to simulate, checked before anything is computed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from duagc.converters.simulate.scenes.catalog import SCENES
from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ, Degradations
from duagc.converters.simulate.sensors.rig import SENSORS, Rig
from duagc.converters.simulate.trajectories.paradigms import PARADIGMS
from duagc.converters.writer import robot_names
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera

FOCAL_OF_WIDTH = 0.82  # focal length as a share of the image width: 63 degrees across
NOISES = ("none", "kinect")
MAX_ROBOTS = 8


@dataclass(frozen=True)
class Cover:
    """The lens of one robot is covered for a while: its images are black, without depth; it moves on.

    Attributes:
        robot: its name.
        first: the first frame.
        frames: how many.
    """

    robot: str
    first: int
    frames: int

    @staticmethod
    def parse(text: str) -> Cover:
        """From "alpha:80:90".

        Args:
            text: name, first frame and number of frames.
        Raises:
            DuagError: it is not that.
        """
        robot, *numbers = text.split(":")
        if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
            raise DuagError(f"simulate: cover is {text!r}, expected ROBOT:FIRST:FRAMES, such as alpha:80:90")
        return Cover(robot, int(numbers[0]), int(numbers[1]))

    def hides(self, robot: str, frame: int) -> bool:
        """Whether a frame shows nothing.

        Args:
            robot: whose frame.
            frame: its index.
        """
        return robot == self.robot and 0 <= frame - self.first < self.frames


@dataclass(frozen=True)
class SimulationSettings:
    """What is simulated.

    Attributes:
        robots: how many; each follows a path of its own, 22 mm per frame in the room, 60 mm outdoors, else 28 mm.
        frames: per robot, at 30 Hz.
        scene: one of `SCENES`, or else a folder of textured meshes.
        size: width and height of the images, pixels.
        noise: "none" or "kinect" (then the exact depth goes to the ground truth).
        seed: of scene, paths and noise.
        overlap: share of what a robot sees that the next one sees as well.
        up: of meshes, the axis that is up in the files: "y", "z", or "auto", as is custom for their format.
        paradigm: the figure that the paths draw together, one of `PARADIGMS`; "wander" is none.
        rig: the sensors.
        movers: figures that walk through the scene.
        masks: whether the log has masks that say where these are; else only the ground truth has.
        covers: when a lens is covered.
        degradations: what makes the camera worse than an ideal one.
        triangles: make triangles of the room even if nothing needs them.
    """

    robots: int = 2
    frames: int = 160
    scene: str = "room"
    size: tuple[int, int] = (480, 360)
    noise: str = "none"
    seed: int = 0
    overlap: float = 0.6
    up: str = "auto"
    paradigm: str = "wander"
    rig: Rig = field(default_factory=Rig)
    movers: int = 0
    masks: bool = True
    covers: tuple[Cover, ...] = ()
    degradations: Degradations = field(default_factory=Degradations)
    triangles: bool = False

    @property
    def needs_triangles(self) -> bool:
        """Whether the room's own renderer, which knows rays from one point only, does not do."""
        d = self.degradations
        return self.triangles or not self.rig.plain or self.movers > 0 or d.needs_triangles

    def check(self) -> None:
        """Refuse settings out of range.

        Raises:
            DuagError: names the setting, its value and what was expected.
        """
        self._check_team()
        self._check_sensors()
        names = robot_names(self.robots)
        for cover in self.covers:
            if cover.robot not in names or cover.first + cover.frames > self.frames:
                raise DuagError(
                    f"simulate: cover names {cover.robot}, frames {cover.first} to {cover.first + cover.frames - 1}, "
                    f"expected one of {', '.join(names)}, frames 0 to {self.frames - 1}"
                )
        self._check_degradations()

    def _check_team(self) -> None:
        for name, value, low, high in (
            ("robots", self.robots, 1, MAX_ROBOTS),
            ("frames", self.frames, 2, 100_000),
            ("width", self.size[0], 32, 4096),
            ("height", self.size[1], 32, 4096),
            ("overlap", self.overlap, 0.0, 1.0),
        ):
            if not low <= value <= high:
                raise DuagError(f"simulate: {name} is {value}, expected {low} to {high}")
        if self.noise not in NOISES:
            raise DuagError(f"simulate: noise is {self.noise!r}, expected one of {', '.join(NOISES)}")
        if self.paradigm not in PARADIGMS:
            raise DuagError(
                f"simulate: paradigm is {self.paradigm!r}, expected one of {', '.join(PARADIGMS)}"
            )
        if self.scene not in SCENES and not Path(self.scene).is_dir():
            raise DuagError(
                f"simulate: scene is {self.scene!r}, expected {', '.join(SCENES)} or a folder of textured meshes"
            )

    def _check_sensors(self) -> None:
        rig = self.rig
        if rig.sensor not in SENSORS:
            raise DuagError(f"simulate: sensor is {rig.sensor!r}, expected one of {', '.join(SENSORS)}")
        if rig.sensor != "rgbd" and self.noise != "none":
            raise DuagError(f"simulate: noise is {self.noise!r} with {rig.sensor}, expected it with rgbd")
        for name, value, high in (
            ("readout", rig.readout_s, 1 / FRAME_RATE_HZ),
            ("exposure", rig.exposure_s, 1 / FRAME_RATE_HZ),
            ("gain", rig.gain_stops, 3.0),
            ("difference of cameras", rig.camera_stops, 2.0),
            ("clock offset", rig.clock_s, 0.9),  # logs begin at 1 s, and no time is negative
            ("movers", self.movers, 8),
        ):
            if not 0 <= value <= high:
                raise DuagError(f"simulate: {name} is {value:g}, expected 0 to {high:g}")

    def _check_degradations(self) -> None:
        d = self.degradations
        d.check()
        if self.rig.sensor != "rgbd" and d.of_depth_or_lens:
            raise DuagError(
                f"simulate: a lens, a depth step or a depth delay with {self.rig.sensor}, expected it with rgbd"
            )
        if d.blur_px > 0 and self.rig.exposure_s > 0:
            raise DuagError(
                f"simulate: motion blur is given as {d.blur_px:g} px and as {self.rig.exposure_s:g} s of exposure, "
                "expected one of them"
            )
        if not self.masks and not self.movers:
            raise DuagError("simulate: masks are withheld without movers, expected movers")
        if d.lens_k1 != 0 and self.movers:
            raise DuagError("simulate: movers are seen through a lens, expected a camera without one")

    def parameters(self) -> dict[str, Any]:
        """What `recording.json` keeps of them, besides the scene; defaults of sensors and paths are left out."""
        kept = {"robots": self.robots, "frames": self.frames, "size": list(self.size)}
        kept |= {"noise": self.noise, "seed": self.seed, "overlap": self.overlap}
        if self.paradigm != "wander":
            kept["paradigm"] = self.paradigm
        if self.rig != Rig() or self.movers:
            kept |= asdict(self.rig) | {"movers": self.movers}
        if not self.masks:
            kept["masks"] = False
        if self.covers:
            kept["covers"] = [asdict(cover) for cover in self.covers]
        if self.degradations != Degradations():
            kept["degradations"] = asdict(self.degradations)
        if self.triangles:
            kept["triangles"] = True
        return kept


def camera_of(size: tuple[int, int]) -> PinholeCamera:
    """The camera of all robots.

    Args:
        size: width and height of its images, pixels.
    """
    width, height = size
    focal = FOCAL_OF_WIDTH * width
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def scene_of(scene: str, up: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `recording.json` says about a scene: source and parameters, no path of this machine.

    Args:
        scene: one of `SCENES`, or a folder of textured meshes.
        up: as in `SimulationSettings`.
    """
    from duagc.converters.simulate.render import meshes

    meshes.check_up(up)
    if scene in SCENES:
        return {"kind": "simulation"}, {"scene": scene}
    folder = Path(scene).resolve()
    files = meshes.mesh_files(folder)
    source = {"kind": "simulation", "scene": folder.name, "files_sha256": meshes.digests(files)}
    return source, {"scene": folder.name, "up": meshes.up_axis(files, up)}
