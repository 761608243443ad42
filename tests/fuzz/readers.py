"""Everything that reads a file from outside: how a sound example of its input is made, and how it is read."""

from __future__ import annotations

import json
import os
import signal
import sys
import tomllib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from duagc.converters import registry
from duagc.converters.layouts import mesh_reader
from duagc.converters.logs import describe
from duagc.converters.simulate.render import mesh_process, meshes
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.open3d_import import import_open3d
from duagc.pipeline.checks import check
from duagc.pipeline.config.base import load_config
from duagc.pipeline.geometry.trajectory import read_tum
from duagc.pipeline.recording import Recording, format_info, info, open_rgbd, read_log, recovery
from duagc.pipeline.runs import digest
from tests.fixtures import image_folders
from tests.fuzz import seeds
from tests.fuzz.formats import Special, any_special


@dataclass(frozen=True)
class Reader:
    """make: writes sound input into a folder. read: reads it, may write below another folder."""

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path, Path], None]
    special: Special


# --- readers ----------------------------------------------------------------------------------------------------------


def read_back(recording: Path) -> None:
    """Whatever a converter has written must be sound."""
    try:
        opened = Recording(recording)
        for robot in opened.robots:
            with open_rgbd(opened.log(robot)) as log:
                for frame in log.frames():
                    assert np.isfinite(frame.depth).all()
            truth = opened.groundtruth(robot)
            for record in read_log(truth) if truth else ():
                record.message()
    except DuagError as error:
        raise AssertionError(f"written, and not readable: {error}") from error


def converter(
    name: str, make: Callable[[Path], Path], dataset: str, options: Callable[[], list[str]] = list
) -> Reader:
    """A converter by its fixture. make: writes below a folder and returns what to convert."""
    made: list[Path] = []

    def write(seed: Path) -> None:
        made[:] = [make(seed / "data").relative_to(seed)]

    def read(src: Path, out: Path) -> None:
        registry.convert(dataset, src / made[0], out / "rec", options=options())
        read_back(out / "rec")

    return Reader(name, write, read, any_special)


def read_recording(src: Path, out: Path) -> None:
    """Everything that opens a recording; each part must end well or with one line."""
    errors = []
    for step in (
        lambda: format_info(info(src / "rec")),
        lambda: check.check(src / "rec"),
        lambda: [
            list(open_rgbd(Recording(src / "rec").log(r)).frames()) for r in Recording(src / "rec").robots
        ],
        lambda: read_back_of(recovery.recover, src / "rec", out / "saved"),
        lambda: [digest.digest(path) for path in sorted((src / "rec").glob("*.mcap"))],
    ):
        try:
            step()
        except DuagError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def read_back_of(recover: Callable[[Path, Path], object], source: Path, out: Path) -> None:
    """What is recovered must open."""
    recover(source, out)
    saved = Recording(out)
    for robot in saved.robots:
        open_rgbd(saved.log(robot)).close()


class Forked:
    """The process that reads meshes, forked instead of started: Python and Open3D are loaded once for all cases. What
    `mesh_process` uses of `subprocess.Popen` is here."""

    def __init__(self, command: list[str], pass_fds: list[int], **others: object) -> None:
        assert command[-1] == "duagc.converters.layouts.mesh_reader"
        heard, said = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                os.dup2(heard, 0)
                for number in {heard, said, *_open_numbers()} - {0, 1, 2, *pass_fds}:
                    with suppress(OSError):
                        os.close(number)
                sys.stdin = open(0, closefd=False)  # noqa: SIM115
                mesh_reader.main()
                os._exit(0)
            finally:
                os._exit(1)
        os.close(heard)
        self.stdin = open(said, "wb", buffering=0)  # noqa: SIM115

    def wait(self) -> int:
        """The exit code, or a signal below 0; as often as one likes."""
        if self.pid:
            _, status = os.waitpid(self.pid, 0)
            self.pid, self._code = 0, os.waitstatus_to_exitcode(status)
        return self._code

    def kill(self) -> None:
        """As signal 9 does."""
        if self.pid:
            os.kill(self.pid, signal.SIGKILL)

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *error: object) -> None:
        self.stdin.close()
        self.wait()


def _open_numbers() -> list[int]:
    return [int(name) for name in os.listdir("/proc/self/fd")]


def read_scene(src: Path, out: Path) -> None:
    """A folder of meshes."""
    import_open3d()  # in this process: the one that reads is a copy of it
    mesh_process.subprocess.Popen, mesh_process.IDLE_S = Forked, 1
    files = meshes.mesh_files(src / "scene")
    (out / "cache").mkdir()
    meshes.read(src / "scene", meshes.up_axis(files, "auto"), out / "cache")
    scene = meshes.load(out / "cache")
    areas = scene.areas()
    assert np.isfinite(areas).all()
    if areas.sum() > 0:
        meshes.surface_points(scene, areas, 1000, np.random.default_rng(0))


def graph_reader(name: str, make: Callable[[Path], None], file: str, robots: int | None) -> Reader:
    def read(src: Path, out: Path) -> None:
        from duagc.pipeline.posegraph.files import read_team_graph

        read_team_graph(src / file, robots)

    return Reader(name, make, read, any_special)


def read_logs(src: Path, out: Path) -> None:
    """What `duagc info` says of logs of other programs."""
    assert describe.is_foreign(src / "logs") or not any((src / "logs").glob("*/*"))
    described = describe.describe(src / "logs")
    json.dumps(described, allow_nan=False)
    describe.format_description(described)
    tomllib.loads(describe.toml_text(described))


def _read(result: object) -> None:
    """Is enough; whatever was read is thrown away."""


def read_config(src: Path, out: Path) -> None:
    from duagc.pipeline.config.run import RunConfig

    load_config(RunConfig, src / "config.toml")


def read_gaussians(src: Path, out: Path) -> None:
    from duagc.pipeline.splat.ply import read_ply

    read_ply(src / "map.ply")


def read_run(src: Path, out: Path) -> None:
    """Everything that opens a run but the evaluation, which takes long."""
    from duagc.pipeline.runs.folder import RunFolder
    from duagc.pipeline.viewing.inspection import Inspector

    errors = []
    for step in (
        lambda: info(src / "run"),
        lambda: digest.digest(src / "run"),
        lambda: Inspector(RunFolder(src / "run")).round(1),
        lambda: Inspector(RunFolder(src / "run")).packet(2),
        lambda: Inspector(RunFolder(src / "run")).gaussian("alpha", 5),
    ):
        try:
            step()
        except DuagError as error:
            errors.append(error)
    if len(errors) == 5:
        raise errors[0]


def _truth() -> list[str]:
    return ["truth=/odom"]


CONVERTERS = (
    *(
        converter(name, make, name, partial(seeds.image_options, name))
        for name, (make, *_) in image_folders.CASES.items()
    ),
    converter("7scenes", seeds.seven, "7scenes", seeds.seven_options),
    converter("ros1", seeds.ros_bag(1, "plain"), "ros", _truth),
    converter("ros1-bz2", seeds.ros_bag(1, "bz2"), "ros", _truth),
    converter("ros1-lz4", seeds.ros_bag(1, "lz4"), "ros", _truth),
    converter("ros2-db3", seeds.ros_bag(2, "sqlite3"), "ros", _truth),
    converter("ros2-mcap", seeds.ros_bag(2, "mcap"), "ros", _truth),
    converter("ros2-compressed", seeds.compressed_bag, "ros", _truth),
    converter("ros2-lidar", seeds.lidar_bag, "ros", lambda: list(seeds.LIDAR_OPTIONS)),
    converter("ros-toml", seeds.team_file, "ros"),
    converter("mcap-json", seeds.foreign("json"), "ros"),
    converter("mcap-rosbridge", seeds.foreign("rosbridge"), "ros"),
    converter("mcap-protobuf", seeds.foreign("protobuf"), "ros"),
    converter("kimera-multi", seeds.kimera, "kimera-multi"),
    converter("s3e", seeds.s3e, "s3e"),
)
OTHERS = (
    Reader("recording", seeds.make_recording, read_recording, any_special),
    Reader("run", seeds.make_run, read_run, any_special),
    Reader(
        "trajectory", seeds.make_trajectory, lambda src, out: _read(read_tum(src / "poses.tum")), any_special
    ),
    Reader("logs", seeds.make_logs, read_logs, any_special),
    Reader("config", seeds.make_config, read_config, any_special),
    graph_reader("g2o", seeds.make_g2o, "graph.g2o", 3),
    graph_reader("csv", seeds.make_csv, ".", None),
    Reader("map-ply", seeds.make_gaussians, read_gaussians, any_special),
    *(
        Reader(f"scene-{kind}", seeds.make_scene(kind), read_scene, any_special)
        for kind in ("glb", "obj", "ply")
    ),
    Reader("scene-gltf", seeds.make_gltf, read_scene, any_special),
)
READERS = {reader.name: reader for reader in (*CONVERTERS, *OTHERS)}
