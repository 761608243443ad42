"""The simulator on textured meshes: a box room with a table, whose depth and colors are known by other formulas."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.simulate.render import meshes
from duagc.converters.simulate.render.raycast import Caster, MeshRenderer
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories import walks
from duagc.converters.simulate.trajectories.loops import look_at, shared_view
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording, open_rgbd
from tests.fixtures.mesh_scenes import (
    HOUSE,
    QUADS,
    ROOM,
    TABLE,
    WRITERS,
    folder_of,
    png,
    some_poses,
    write_glb,
    write_obj,
    write_ply,
)
from tests.fixtures.sampling import sampled


@pytest.fixture(scope="module", params=sorted(WRITERS))
def stage(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> SimulatedMeshes:
    where = tmp_path_factory.mktemp("scene")
    folder = folder_of(where / "room", request.param)
    files = meshes.mesh_files(folder)
    (where / "cache").mkdir()
    meshes.read(folder, meshes.up_axis(files, "auto"), where / "cache")
    return SimulatedMeshes(0, where / "cache")


def true_view(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, quad and color of rays [n, 3] through the room, in float64."""
    nearest, index = np.full(len(directions), np.inf), np.full(len(directions), -1)
    color = np.zeros((len(directions), 3))
    for k, quad in enumerate(QUADS):
        normal = np.cross(quad.axis_s, quad.axis_t)
        along = directions @ normal
        z = (quad.corner - origin) @ normal / np.where(along == 0, 1e-30, along)
        p = origin + z[:, None] * directions - quad.corner
        s, t = p @ quad.axis_s, p @ quad.axis_t
        hit = (z > 0) & (z < nearest) & (s >= 0) & (s <= quad.size[0]) & (t >= 0) & (t <= quad.size[1])
        nearest[hit], index[hit] = z[hit], k
        color[hit] = quad.color(s, t)[hit]
    return nearest, index, color


def test_depth_and_color_are_those_of_the_room(stage):
    camera = camera_of((240, 180))
    eye = MeshRenderer(stage.caster, camera)
    for T in some_poses():
        view = eye.render(T)
        depth, quad, color = true_view(T[:3, 3], camera.rays().reshape(-1, 3) @ T[:3, :3].T)
        depth, quad = depth.reshape(view.depth.shape), quad.reshape(view.depth.shape).astype(np.int16)
        window = np.ones((3, 3), dtype=np.uint8)
        inside = cv2.dilate(quad, window) == cv2.erode(quad, window)
        assert inside.mean() > 0.9
        assert np.abs(view.depth - depth)[inside].max() < 5e-6  # float32 rays over a few meters
        error = np.abs(view.color - color.reshape(view.color.shape))[inside]
        assert np.percentile(error, 99) < 6  # of 255; filtering dampens the shortest waves by some
        assert error.mean() < 2.0  # between vertices 25 mm apart the colors are straight lines


def test_color_is_the_mean_over_the_pixel(stage):
    """The same view at five times the size, averaged in blocks, is the view."""
    camera = camera_of((160, 120))
    T = some_poses()[1]
    view = MeshRenderer(stage.caster, camera).render(T)
    large = MeshRenderer(stage.caster, camera.scaled(800, 600)).render(T)
    blocks = large.color.reshape(120, 5, 160, 5, 3).mean(axis=(1, 3))
    difference = np.abs(view.color - blocks).mean(axis=2)
    assert np.median(difference) < 1.0
    assert np.percentile(difference, 98) < 12  # at borders, 4 samples against 100
    assert np.abs(large.depth[2::5, 2::5] - view.depth).max() < 5e-6


def test_points_lie_on_the_surfaces_and_have_their_colors(stage):
    points, normals, colors = stage.points()
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    assert stage.clearance(points).max() < 1e-5
    counted = np.zeros(len(QUADS))
    for k, quad in enumerate(QUADS[:6]):
        p = points - quad.corner
        on = np.abs(p @ np.cross(quad.axis_s, quad.axis_t)) < 1e-4
        counted[k] = on.sum() / (quad.size[0] * quad.size[1])
        error = np.abs(colors[on] - quad.color(p[on] @ quad.axis_s, p[on] @ quad.axis_t))
        assert np.median(error) < 1.0
    assert counted[:6] == pytest.approx(np.full(6, counted[:6].mean()), rel=0.05)  # the table adds little


@pytest.mark.parametrize("stage", ["obj"], indirect=True)
def test_walks_are_smooth_clear_and_overlap(stage):
    camera = camera_of((160, 120))
    ways = stage.wander(2, 40, 0.6, camera)
    for way in ways:
        step, turn = se3.distance(way[:-1], way[1:])
        assert step == pytest.approx(walks.STEP_M, rel=0.02)
        assert turn.max() < walks.MAX_TURN_RAD
        position = way[:, :3, 3]
        assert (position > walks.MIN_CLEARANCE_M - 0.06).all()
        assert (position < ROOM - walks.MIN_CLEARANCE_M + 0.06).all()
        aside = np.maximum(TABLE[0] - position, position - TABLE[1])[:, :2].max(axis=1)
        assert aside.min() > walks.MIN_CLEARANCE_M - 0.06  # the body does not stand in the table
        assert np.abs(way[:, 2, 0]).max() < 1e-9  # upright
    eye = MeshRenderer(stage.caster, camera.scaled(48, 36))
    assert abs(shared_view(eye, *ways) - 0.6) < 0.2
    (again,) = stage.wander(1, 40, 0.6, camera)  # of two, bytes are compared in test_simulate_workers.py
    assert np.array_equal(ways[0], again)


@pytest.mark.parametrize("stage", ["obj"], indirect=True)
def test_free_space_is_the_floor_without_the_table(stage):
    space = walks.free_space(stage.caster)
    assert space.floor_m == pytest.approx(0.0, abs=0.01)
    kept = walks.MIN_CLEARANCE_M
    low, high = space.cells.min(axis=0), space.cells.max(axis=0)
    assert np.abs(low - kept).max() < 0.1 + 1e-6
    assert np.abs(high - (ROOM[:2] - kept)).max() < 0.1 + 1e-6
    aside = np.maximum(TABLE[0, :2] - space.cells, space.cells - TABLE[1, :2]).max(axis=1)
    assert aside.min() > 0.2


@pytest.mark.slow  # of OBJ files in `make test`: test_simulate_sensors.py
@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_a_recording_says_what_it_was_made_of(tmp_path, kind):
    folder = folder_of(tmp_path / "flat", kind)
    settings = {"scene": str(folder), "frames": 3, "size": (64, 48), "noise": "kinect", "seed": 2}
    simulate(tmp_path / "one" / "rec", workers=1, **settings)
    text = (tmp_path / "one" / "rec" / "recording.json").read_text()
    description = json.loads(text)
    assert str(tmp_path) not in text
    assert description["parameters"]["scene"] == description["source"]["scene"] == "flat"
    assert description["parameters"]["up"] == {"glb": "y", "ply": "z"}[kind]
    assert sorted(description["source"]["files_sha256"]) == [f"table.{kind}", f"walls.{kind}"]
    recording = Recording(tmp_path / "one" / "rec")
    assert recording.geometry() is not None
    with open_rgbd(recording.log("bravo")) as log:
        assert len(log) == 3


def test_a_hole_has_no_depth_and_is_black(tmp_path):
    (tmp_path / "cache").mkdir()
    write_glb(tmp_path / "floor.glb", QUADS[4:5])
    scene = meshes.read(tmp_path, "y", tmp_path / "cache")
    T = look_at(np.array([[2.5, 1.0, 1.0]]), np.array([[2.5, 3.0, 1.0]]))[0]
    view = MeshRenderer(Caster(scene), camera_of((64, 48))).render(T)
    up = slice(0, 20)  # above the horizon there is nothing
    assert (view.depth[up] == 0).all()
    assert (view.surface[up] == -1).all()
    assert (view.color[up] == 0).all()
    assert (view.depth[40:] > 0).any()


def test_a_texture_goes_on_beyond_its_border(tmp_path):
    scene = one_quad(tmp_path, np.zeros((8, 8, 3), np.uint8) + np.arange(8, dtype=np.uint8)[:, None] * 20)
    inside = scene.sample(np.array([0]), np.array([[0.3, 0.3]], np.float32), np.zeros(1, np.float32))
    moved = meshes.MeshScene(
        scene.vertices, scene.triangles, scene.texels + 8, scene.texture_of, scene.colors, scene.textures
    )
    beyond = moved.sample(np.array([0]), np.array([[0.3, 0.3]], np.float32), np.zeros(1, np.float32))
    assert np.array_equal(inside, beyond)


def one_quad(folder: Path, image: np.ndarray) -> meshes.MeshScene:
    (folder / "cache").mkdir()
    write_obj(folder / "quad.obj", QUADS[:1])
    (folder / "quad0.png").write_bytes(png(image))
    return meshes.read(folder, "y", folder / "cache")


def test_a_far_texture_is_blurred_to_its_mean(tmp_path):
    """A checkerboard of single texels, seen from where a pixel holds many of them, is even gray."""
    board = ((np.indices((512, 512)).sum(axis=0) % 2) * 200).astype(np.uint8)
    scene = one_quad(tmp_path, np.repeat(board[..., None], 3, axis=2))
    T = look_at(np.array([[3.0, 2.0, 1.3]]), np.array([[0.0, 2.0, 1.3]]))[0]
    color = MeshRenderer(Caster(scene), camera_of((48, 36))).render(T).color
    assert np.abs(color[16:20, 22:26].astype(int) - 100).max() <= 2


@pytest.mark.parametrize("kind", sampled(["obj", "glb", "ply"]))
def test_a_scene_may_be_turned(tmp_path, kind):
    """The other axis up: the room lies on its side, and x stays."""
    folder = folder_of(tmp_path / "room", kind)
    scenes = {}
    for up in ("y", "z"):
        (tmp_path / up).mkdir()
        scenes[up] = meshes.read(folder, up, tmp_path / up)
    p = scenes["z"].vertices
    assert scenes["y"].vertices == pytest.approx(np.stack([p[:, 0], -p[:, 2], p[:, 1]], axis=1))


def plain_glb(folder: Path) -> None:
    write_glb(folder / "plain.glb", QUADS, plain=True)


def plain_ply(folder: Path) -> None:
    write_ply(folder / "plain.ply", QUADS, colors=False)


def torn_ply(folder: Path) -> None:
    write_ply(folder / "torn.ply", QUADS)
    data = (folder / "torn.ply").read_bytes()
    (folder / "torn.ply").write_bytes(data[: len(data) // 3])


def torn_glb(folder: Path) -> None:
    write_glb(folder / "torn.glb", QUADS)
    data = (folder / "torn.glb").read_bytes()
    (folder / "torn.glb").write_bytes(data[: len(data) // 3])


def words(folder: Path) -> None:
    (folder / "words.obj").write_text("no mesh at all\n")


def mixed(folder: Path) -> None:
    write_ply(folder / "a.ply", QUADS)
    write_glb(folder / "b.glb", QUADS)


def nothing(folder: Path) -> None:
    (folder / "readme.txt").write_text("no mesh here")


def small(folder: Path) -> None:
    write_glb(folder / "small.glb", QUADS[6:])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (nothing, "found no mesh, expected files"),
        (plain_glb, "neither a texture nor colors"),
        (plain_ply, "neither a texture nor colors"),
        (torn_ply, "torn.ply: .*cannot be read"),
        (torn_glb, "torn.glb: .*cannot be read"),
        (words, "words.obj: .*cannot be read"),
        (mixed, "give --up y or --up z"),
        (small, "free floor"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_line(
    tmp_path, capfd, make: Callable[[Path], None], message: str
):
    folder = tmp_path / "scene"
    folder.mkdir()
    make(folder)
    with pytest.raises(DuagError, match=message) as caught:
        simulate(tmp_path / "rec", scene=str(folder), frames=2, size=(64, 48), workers=1)
    assert "\n" not in str(caught.value)
    assert "rror" not in capfd.readouterr().err  # libraries add nothing to it
    assert not (tmp_path / "rec").exists()


def test_a_scene_that_is_not_there(tmp_path):
    with pytest.raises(DuagError, match="expected room, office, corridor, outdoor or a folder"):
        simulate(tmp_path / "rec", scene=str(tmp_path / "nowhere"))
    with pytest.raises(DuagError, match="up is 'x'"):
        simulate(tmp_path / "rec", scene=str(folder_of(tmp_path / "room", "obj")), up="x")


def test_the_command_takes_a_folder_and_an_axis(tmp_path):
    folder = folder_of(tmp_path / "room", "obj")
    command = [
        sys.executable,
        "-c",
        "from duagc.pipeline.cli import main; main()",
        "simulate",
        "--out",
        "rec",
    ]
    command += ["--scene", str(folder), "--up", "x", "--workers", "1"]
    root = Path(__file__).parents[3]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root)
    assert done.returncode == 1
    assert done.stderr == "duagc: simulate: up is 'x', expected one of auto, y, z\n"
    assert not (root / "rec").exists()


@pytest.mark.skipif(not HOUSE.is_dir(), reason="the scanned house is not on this machine")
def test_a_chunk_of_a_real_scan(tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "scan").mkdir()
    shutil.copy(HOUSE / "room3_chunk3.glb", tmp_path / "scan")
    scene = meshes.read(tmp_path / "scan", "y", tmp_path / "cache")
    assert len(scene.triangles) == 28247
    assert [level.shape[0] for level in scene.textures[0]] == [4096, 2048, 1024, 512, 256, 128]
    caster = Caster(scene)
    assert walks.floor_height(caster) == pytest.approx(0.02, abs=0.05)
    T = look_at(np.array([[9.4, -7.0, 1.4]]), np.array([[10.6, -8.2, 0.9]]))[0]
    view = MeshRenderer(caster, camera_of((160, 120))).render(T)
    assert np.mean(view.depth > 0) > 0.95
    assert view.color[view.depth > 0].std() > 20


def test_a_scene_of_many_textures_has_the_colors_of_each() -> None:
    count = 5600
    textures = [[np.full((2, 2, 3), 1 + k % 250, np.uint8)] for k in range(count)]
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    each, three = np.arange(count, dtype=np.int32), np.arange(3, dtype=np.int32)
    texels, white = np.zeros((count, 3, 2), np.float32), np.zeros((3, 3), np.uint8)
    scene = meshes.MeshScene(corners, np.tile(three, (count, 1)), texels, each, white, textures)
    seen = scene.sample(each, np.full((count, 2), 0.3, np.float32), np.zeros(count, np.float32))
    assert np.array_equal(seen, np.repeat(1.0 + each[:, None] % 250, 3, axis=1))
