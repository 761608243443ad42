"""The simulator: exact depth, colors that do not depend on the view, clear and overlapping paths, sensor noise."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from duagc.converters.simulate.render import bake
from duagc.converters.simulate.render.renderer import Renderer
from duagc.converters.simulate.scenes.catalog import build
from duagc.converters.simulate.scenes.scene import Scene
from duagc.converters.simulate.sensors import noise
from duagc.converters.simulate.settings import Cover, camera_of
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories import loops
from duagc.pipeline import messages
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.ply_points import write_points
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, content_digest, open_rgbd, read_log
from duagc.schemas import topics
from tests.fixtures.recordings import true_poses
from tests.fixtures.sampling import sampled

SIZE = (160, 120)


@pytest.fixture(scope="module")
def room() -> Scene:
    return build("room", 3)


@pytest.fixture(scope="module")
def atlas(room: Scene) -> bake.Atlas:
    return bake.bake(room, 0.006)


@pytest.fixture(scope="module")
def camera() -> PinholeCamera:
    return camera_of(SIZE)


@pytest.fixture(scope="module")
def ways(room: Scene, camera: PinholeCamera) -> list[np.ndarray]:
    return loops.plan(room, 3, 150, 0.6, camera=camera)


@pytest.fixture(scope="module")
def renderer(room: Scene, atlas: bake.Atlas, camera: PinholeCamera) -> Renderer:
    return Renderer(room, atlas, camera)


def some_poses(ways: list[np.ndarray]) -> Iterator[np.ndarray]:
    for way in ways:
        yield from way[[0, 60, 149]]


def test_depth_ends_on_a_surface_and_passes_through_none(room, renderer, ways):
    """Solids know their distance to a point by other formulas than those that cast rays."""
    rays = renderer.camera.rays()[::4, ::4]
    for T in some_poses(ways):
        depth, surface = renderer.depth(T)
        assert (depth > 0).all()
        assert (surface >= 0).all()
        sight = rays * depth[::4, ::4, None]
        assert np.abs(room.clearance(se3.transform(T, sight.reshape(-1, 3)))).max() < 1e-9  # float64, meters
        on_the_way = np.linspace(0.02, 0.995, 12)[:, None, None, None] * sight
        assert room.clearance(se3.transform(T, on_the_way.reshape(-1, 3))).min() > 0


@pytest.mark.parametrize(("i", "j"), [(0, 1), (0, 25), (70, 110)])
def test_views_agree_on_depth_and_color(room, atlas, ways, i, j):
    """A point seen in view i is, in view j, at the depth and of the color that view j has there."""
    camera, T_i, T_j = camera_of((480, 360)), ways[0][i], ways[0][j]
    renderer = Renderer(room, atlas, camera)
    one, other = renderer.render(T_i), renderer.render(T_j)
    points = se3.transform(se3.inverse(T_j) @ T_i, camera.back_project(one.depth).reshape(-1, 3))
    z = points[:, 2]
    u, v = camera.project(np.where(z[:, None] > 0.1, points, (0, 0, 1))).T
    inside = (z > 0.1) & (u > 1) & (v > 1) & (u < camera.width - 2) & (v < camera.height - 2)
    assert inside.mean() > 0.5
    # inverse depth is linear on planes: interpolating it is exact there
    inverse = map_coordinates(1 / other.depth, [v, u], order=1, mode="nearest")
    gap_m = np.abs(1 / inverse - z)
    same = inside & (gap_m < 1e-4)
    assert same.sum() > 0.8 * inside.sum()  # the rest is hidden, or interpolated across an edge
    assert np.median(gap_m[inside]) < 1e-9
    seen = np.stack(
        [map_coordinates(other.color[..., k].astype(float), [v, u], order=3) for k in range(3)], axis=1
    )
    difference = np.abs((seen - one.color.reshape(-1, 3)).mean(axis=1))[same]
    assert np.median(difference) < 1.0  # of 255


def test_color_is_the_mean_over_the_pixel(room, atlas, renderer, ways):
    """The same view at five times the size, averaged in blocks, is the view."""
    camera = renderer.camera.scaled(5 * SIZE[0], 5 * SIZE[1])
    for T in (ways[0][20], ways[1][90]):
        view = renderer.render(T)
        large = Renderer(room, atlas, camera).render(T)
        blocks = large.color.reshape(SIZE[1], 5, SIZE[0], 5, 3).mean(axis=(1, 3))
        difference = np.abs(view.color - blocks).mean(axis=2)
        assert np.median(difference) < 1.0
        assert (
            np.percentile(difference, 95) < 6.0
        )  # slanted surfaces are blurred a little more than necessary
        assert np.array_equal(view.depth, renderer.depth(T)[0])
        assert (
            np.abs(large.depth[2::5, 2::5] - view.depth).max() < 1e-9
        )  # the middle of the block is the pixel


@pytest.mark.parametrize("isa", ["auto", "portable"])
@pytest.mark.parametrize("shift_texels", [0.0, -70.3])  # shifted, some surfaces have no texels
def test_compiled_colors_are_those_of_numpy(room, atlas, ways, isa, shift_texels):
    along_a_wall = se3.from_rotation_translation(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.array([0.02, 0.4, 1.2])
    )
    colors = replace(atlas, origin=atlas.origin + shift_texels)
    for camera in (camera_of(SIZE), PinholeCamera(101, 67, 40.0, 40.0, 33.0, 31.0)):
        compiled, plain = (Renderer(room, colors, camera, isa=each) for each in (isa, "numpy"))
        for T in (*some_poses(ways), along_a_wall):
            one, other = compiled.render(T), plain.render(T)
            assert np.array_equal(one.color, other.color)
            assert np.array_equal(one.surface, other.surface)


def test_views_show_many_surfaces_and_many_features(renderer, ways):
    sift = cv2.SIFT_create()
    for T in some_poses(ways):
        view = renderer.render(T)
        counts = np.bincount(view.surface.ravel())
        assert (counts > 0.02 * view.surface.size).sum() >= 3
        assert len(sift.detect(cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY))) > 80


def test_paths_are_smooth_clear_and_long(room, ways):
    for way in ways:
        steps, turns = se3.distance(way[:-1], way[1:])
        assert steps.sum() > 3.0
        assert steps.min() > 0.020
        assert steps.max() < 0.025
        assert np.rad2deg(turns.max()) < 1.3
        positions = way[:, :3, 3]
        assert np.abs(np.diff(positions, n=2, axis=0)).max() < 1e-3  # meters per frame^2: no corners
        assert room.clearance(positions).min() > 0.5


@pytest.mark.parametrize("overlap", sampled([0.5, 0.7]))
def test_neighbors_share_as_much_of_the_view_as_asked(room, camera, overlap):
    small = Renderer(room, None, camera.scaled(*loops.OVERLAP_IMAGE))
    one, other = loops.plan(room, 2, 150, overlap, camera=camera)
    assert loops.shared_view(small, one, other) == pytest.approx(overlap, abs=0.04)
    apart, _ = se3.distance(one[:, None], other[None])
    assert apart.min(axis=0).max() > 0.2  # and not from the same places


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_robot_finds_a_way_in_every_room(seed):
    scene = build("room", seed)
    for robot in range(4):
        way = loops._loop(scene, robot).poses(160, 0.7)
        assert scene.clearance(way[:, :3, 3]).min() > 0.5


def test_kinect_noise_has_the_published_size(camera):
    """Nguyen et al. 2012, on walls seen straight on; and what is measured is a whole number of disparity steps."""
    for z in (0.8, 1.5, 3.0, 5.0):
        rng = random_streams.generator(0, "test", depth=str(z))
        exact = np.full((240, 320), z)
        measured = noise.kinect_depth(exact, camera.scaled(320, 240), rng)
        assert (measured > 0).mean() > 0.99
        error = (measured - exact)[measured > 0]
        assert np.std(error) == pytest.approx(noise.axial_sigma_m(np.array(z)), rel=0.12)
        assert abs(error.mean()) < 0.1 * np.std(error)
        steps = 8 * noise.SENSOR_FOCAL_PX * noise.BASELINE_M / measured[measured > 0]
        assert np.abs(steps - np.rint(steps)).max() < 1e-6
        field = np.where(measured > 0, measured - exact, 0)
        neighbors = np.mean(field[:, 1:] * field[:, :-1]) / np.mean(field**2)
        assert 0.3 < neighbors < 0.95


def test_kinect_noise_has_holes_where_the_sensor_is_blind(camera, renderer, ways):
    step = np.full((120, 160), 3.0)
    step[:, 60:100] = 1.0  # a board in front of a wall
    measured = noise.kinect_depth(step, camera, random_streams.generator(0, "test"))
    parallax = camera.fx * noise.BASELINE_M * (1 / 1.0 - 1 / 3.0)
    shadow = measured[:, 100 : 100 + int(parallax) - 1]
    assert (shadow == 0).all()
    assert (measured[:, 110:] > 0).all()
    assert (measured[:, :59] > 0).all()
    edge = measured[:, 59:61]
    assert ((edge > 1.2) & (edge < 2.7)).any()  # mixed pixels
    for T in some_poses(ways):
        depth, _ = renderer.depth(T)
        holes = (noise.kinect_depth(depth, camera, random_streams.generator(0, "test")) == 0).mean()
        assert 0.0 < holes < 0.15


def test_gray_noise_is_one_percent():
    gray = np.full((200, 200, 3), 128, dtype=np.uint8)
    noisy = noise.gray_noise(gray, random_streams.generator(0, "test")).astype(float) - 128
    assert np.std(noisy) == pytest.approx(2.55, rel=0.05)


def test_points_of_the_geometry_lie_on_surfaces(room, atlas, tmp_path):
    points, normals, colors = bake.surface_points(room, atlas, 5000)
    assert len(points) > 4000
    assert np.abs(room.clearance(points)).max() < 1e-6
    assert room.clearance(points + 0.002 * normals).min() > 0
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    assert colors.std() > 20
    write_points(tmp_path / "points.ply", points, normals, colors)
    header, _, body = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    assert f"element vertex {len(points)}\n".encode() in header
    assert len(body) == 27 * len(points)
    np.testing.assert_array_equal(np.frombuffer(body[:12], "<f4"), points[0].astype("<f4"))


NOISY = {"robots": 2, "frames": 5, "size": SIZE, "noise": "kinect", "seed": 1}


def test_a_noisy_recording_has_the_truth_apart(tmp_path):
    simulate(tmp_path / "rec", workers=1, **NOISY)
    check_noisy_recording(tmp_path / "rec")
    with pytest.raises(DuagError, match="exists"):
        simulate(tmp_path / "rec", workers=1, **NOISY)


def check_noisy_recording(folder: Path) -> None:
    """The log holds what was measured, the ground truth what was there."""
    recording = Recording(folder)
    assert recording.robots == ["alpha", "bravo"]
    scene, camera = build("room", 1), camera_of(SIZE)
    exact = Renderer(scene, None, camera)
    for robot in recording.robots:
        truth = recording.groundtruth(robot)
        assert truth is not None
        poses = [
            messages.unpack_pose_in_frame(r.proto())
            for r in read_log(truth, [topics.GROUNDTRUTH_POSE.of(robot)])
        ]
        depths = [r.proto() for r in read_log(truth, [topics.GROUNDTRUTH_DEPTH.of(robot)])]
        with open_rgbd(recording.log(robot)) as log:
            assert log.camera == camera
            assert len(log) == len(poses) == len(depths) == 5
            for frame, pose in zip(log.frames(), poses, strict=True):
                depth, _ = exact.depth(pose)
                valid = frame.depth > 0
                error = np.abs(frame.depth - depth)[valid] / noise.axial_sigma_m(depth[valid])
                assert 0.3 < np.median(error) < 1.1
    description = json.loads((folder / "recording.json").read_text())
    assert description["geometry"] == "groundtruth.ply"
    assert description["parameters"]["seed"] == 1
    assert content_digest(recording.log("alpha")) != content_digest(recording.log("bravo"))


@pytest.mark.parametrize(
    ("argument", "value"),
    [("robots", 0), ("frames", 1), ("noise", "rain"), ("scene", "moon"), ("size", (8, 8)), ("overlap", 1.5)],
)
def test_arguments_out_of_range_are_refused(tmp_path, argument, value):
    with pytest.raises(DuagError, match="expected"):
        simulate(tmp_path / "rec", **{argument: value})
    assert not (tmp_path / "rec").exists()


def test_a_covered_lens_is_black_while_the_robot_moves_on(tmp_path: Path) -> None:
    kind = {"robots": 1, "frames": 5, "size": (64, 48), "noise": "kinect", "workers": 1}
    simulate(tmp_path / "open", **kind)
    simulate(tmp_path / "covered", covers=[Cover.parse("alpha:1:3")], **kind)
    logs = [Recording(tmp_path / name).log("alpha") for name in ("open", "covered")]
    with open_rgbd(logs[0]) as seen, open_rgbd(logs[1]) as covered:
        for k in range(5):
            one, other = seen.frame(k), covered.frame(k)
            assert one.stamp_ns == other.stamp_ns
            hidden = 1 <= k < 4
            assert other.color.any() == (not hidden)
            assert other.depth.any() == (not hidden)
            assert hidden or (
                np.array_equal(one.color, other.color) and np.array_equal(one.depth, other.depth)
            )
    poses = [true_poses(Recording(tmp_path / name), "alpha") for name in ("open", "covered")]
    assert np.array_equal(*poses)


@pytest.mark.parametrize("text", ["alpha", "alpha:1", "alpha:1:x", "alpha:-1:2", "bravo:0:1", "alpha:3:3"])
def test_a_cover_that_cannot_be_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(DuagError, match="cover"):
        simulate(tmp_path / "out", robots=1, frames=5, covers=[Cover.parse(text)])
