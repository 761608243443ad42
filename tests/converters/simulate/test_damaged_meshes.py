"""Meshes and textures that are damaged or hostile: one line each, and no process is left."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters.simulate.render import meshes
from duagc.pipeline.base.errors import DuagError
from tests.fixtures.mesh_scenes import QUADS, folder_of, write_glb, write_ply
from tests.fuzz.images import png_bomb

ROOT = Path(__file__).parents[3]


def missing(folder: Path) -> None:
    folder_of(folder, "obj")
    (folder / "table1.png").unlink()


def torn(folder: Path) -> None:
    folder_of(folder, "obj")
    data = (folder / "table1.png").read_bytes()
    (folder / "table1.png").write_bytes(data[: len(data) // 2])


def bomb(folder: Path) -> None:
    folder_of(folder, "obj")
    (folder / "table1.png").write_bytes(png_bomb(20_000, 20_000, 8, 2))


def large(folder: Path) -> None:
    folder_of(folder, "obj")
    (folder / "table1.png").write_bytes(png_bomb(20_000, 4_000, 8, 2))


def wide(folder: Path) -> None:
    folder_of(folder, "obj")
    (folder / "table1.png").write_bytes(png_bomb(33_000, 8, 8, 2))


def pipe(folder: Path) -> None:
    folder_of(folder, "obj")
    (folder / "table1.png").unlink()
    os.mkfifo(folder / "table1.png")


def named_in_latin(folder: Path) -> None:
    folder_of(folder, "obj")
    for file in (folder / "table.mtl", folder / "table.obj"):
        file.write_bytes(file.read_bytes().replace(b"m1", b"\xb1"))


def mesh_pipe(folder: Path) -> None:
    folder.mkdir()
    os.mkfifo(folder / "room.ply")


def torn_inside(folder: Path) -> None:
    folder.mkdir()
    write_glb(folder / "room.glb", QUADS)
    data = (folder / "room.glb").read_bytes()
    at = data.rindex(b"IDAT")
    (folder / "room.glb").write_bytes(data[: at + 40] + bytes(40) + data[at + 80 :])


def triangle(x: str, corner: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        folder.mkdir()
        header = "ply\nformat ascii 1.0\nelement vertex 3\n"
        header += "".join(f"property float {axis}\n" for axis in "xyz")
        header += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
        header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        rows = f"0 0 0 9 9 9\n{x} 0 0 9 9 9\n0 1 0 9 9 9\n3 0 1 {corner}\n"
        (folder / "room.ply").write_text(header + rows)

    return make


def read(folder: Path, cache: Path) -> meshes.MeshScene:
    cache.mkdir()
    return meshes.read(folder, meshes.up_axis(meshes.mesh_files(folder), "auto"), cache)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (missing, "table.obj: its reader says .*table1.png"),
        (torn, "table.obj: its reader says 'Read Error'"),
        (bomb, "table.obj: takes more than .* MB of memory|table.obj: .*20000 x 20000 pixels"),
        (large, "table.obj: has a texture of 20000 x 4000 pixels, expected at most"),
        (wide, "table.obj: has a texture of 33000 x 8 pixels, expected sides of at most 32766"),
        (pipe, "table.obj: waits for something that does not come"),
        (named_in_latin, "table.obj: its reader finds a name that is no UTF-8"),
        (mesh_pipe, "room.ply: is no regular file"),
        (torn_inside, "room.glb: its reader says"),
        (triangle("1", "3"), "room.ply: the mesh has triangles of vertices 0 to 3, expected 0 to 2"),
        (triangle("1", "-7"), "room.ply: the mesh has triangles of vertices -7 to 1, expected 0 to 2"),
        (triangle("1e6", "2"), r"room.ply: the mesh is 1e\+06 x 1 x 0 m large, expected at most 400 m"),
    ],
)
def test_what_is_damaged_is_said_in_one_line(tmp_path, capfd, make: Callable[[Path], None], message: str):
    make(tmp_path / "scene")
    with pytest.raises(DuagError, match=message) as caught:
        read(tmp_path / "scene", tmp_path / "cache")
    assert "expected" in str(caught.value)
    assert str(caught.value).isprintable()
    assert capfd.readouterr() == ("", "")


def test_a_triangle_that_is_sound(tmp_path):
    triangle("1", "2")(tmp_path / "scene")
    scene = read(tmp_path / "scene", tmp_path / "cache")
    assert scene.areas() == pytest.approx(np.array([0.5]))


def test_several_files_in_the_order_of_their_names(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, quads in (("b", QUADS[:2]), ("a\nb", QUADS[2:3])):
        write_ply(folder / f"{name}.ply", quads)
        count = len(read(folder, tmp_path / f"cache {name[0]}").triangles)
    alone = tmp_path / "alone"
    alone.mkdir()
    (folder / "a\nb.ply").rename(alone / "a.ply")
    first = read(alone, tmp_path / "cache alone")
    whole = meshes.load(tmp_path / "cache a")
    assert len(whole.triangles) == count > len(first.triangles)
    assert np.array_equal(whole.vertices[: len(first.vertices)], first.vertices)


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_the_reader_ends_with_whoever_started_it(tmp_path, end: signal.Signals):
    pipe(tmp_path / "scene")
    (tmp_path / "cache").mkdir()
    code = "import sys; from pathlib import Path; from duagc.converters.simulate.render import meshes; "
    code += "meshes.read(Path(sys.argv[1]), 'y', Path(sys.argv[2]))"
    command = [sys.executable, "-c", code, str(tmp_path / "scene"), str(tmp_path / "cache")]
    caller = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE)
    children = Path(f"/proc/{caller.pid}/task/{caller.pid}/children")
    reader = wait_for(
        lambda: [pid for pid in children.read_text().split() if b"mesh_reader" in command_of(pid)]
    )
    wait_for(lambda: b"open3d" in Path(f"/proc/{reader[0]}/maps").read_bytes())
    caller.send_signal(end)
    caller.communicate(timeout=60)
    assert caller.returncode != 0
    wait_for(lambda: not command_of(reader[0]))


def command_of(pid: str) -> bytes:
    """Empty once it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def wait_for(condition: Callable[[], Any]) -> Any:
    until = time.monotonic() + 60
    while not (value := condition()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return value
