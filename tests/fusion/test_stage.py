"""The fusion stage on files: alone nothing changes, otherwise everything moves with its keyframe."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import ColorConfig, MapMatching
from duagc.pipeline.config.fusion import FinetuneConfig, FusionConfig, StatedScaleConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion import own_images
from duagc.pipeline.fusion.own_images import read_ahead
from duagc.pipeline.fusion.stage import run_fusion
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import read_tum
from duagc.pipeline.messages import (
    CorrectedKeyframes,
    GaussianInformation,
    GaussianMap,
    Keyframe,
    KeyframeFactor,
    Odometry,
    map_frame,
)
from duagc.pipeline.recording import LogWriter, read_log
from duagc.pipeline.runs.peer_colors import read_peer_colors
from duagc.pipeline.runs.robot_data import AgentInput
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.ply import write_ply
from duagc.schemas import topics

CAMERA = PinholeCamera(32, 24, 25.0, 25.0, 15.5, 11.5)
FRAMES, KEYFRAMES, N = 6, (0, 3), 12
SETTINGS: dict[str, Any] = {
    "config": FusionConfig(explained_opacity=0.0),
    "matching": MapMatching(),
    "moving": MovingConfig(),
}


@dataclass
class Result:
    """What the stage reads of a session."""

    robot: str
    component: tuple[str, ...]
    T_world_keyframe: np.ndarray
    own_evidence: Evidence
    evidence: dict[str, Evidence] = field(default_factory=dict)
    T_world_keyframe_of: dict[str, np.ndarray] = field(default_factory=dict)
    pairs: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)

    @property
    def depth_of(self) -> dict[str, str]:
        return dict.fromkeys(self.evidence, "blended")

    @property
    def camera_of(self) -> dict[str, PinholeCamera]:
        return dict.fromkeys(self.evidence, CAMERA)

    @property
    def arrived(self) -> dict[str, float]:
        return dict.fromkeys(self.evidence, 1.0)


@dataclass
class Robot:
    """Files of one robot and what is in them."""

    log: Path
    frontend: Path
    information: Path
    T_map_camera: np.ndarray
    gaussians: Gaussians
    sums: GaussianInformation

    @property
    def T_map_keyframe(self):  # noqa: N802
        return self.T_map_camera[list(KEYFRAMES)]

    def evidence(self):
        return Evidence.from_map("bravo", self.gaussians, self.sums, self.T_map_keyframe)

    def alone(self) -> Any:
        return result_of(self, self.T_map_keyframe)


def result_of(robot, T_world_keyframe, **others: Evidence) -> Any:
    """A session with others that stand at the origin."""
    poses = {"bravo": T_world_keyframe, **{name: np.eye(4)[None] for name in others}}
    return Result("bravo", tuple(sorted(poses)), T_world_keyframe, robot.evidence(), others, poses)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """Six frames of a wall 2 m away, two keyframes, a map in front of it."""
    folder = tmp_path_factory.mktemp("robot")
    rng = np.random.default_rng(0)
    T_map_camera = se3.exp(np.concatenate([np.zeros((1, 6)), 0.05 * rng.normal(size=(FRAMES - 1, 6))]))
    _, png = cv2.imencode(".png", np.full((24, 32, 3), 90, np.uint8))
    with (
        RecordingWriter(folder / "recording", "wall", {"made": "by the tests"}, "tests") as recording,
        recording.robot("bravo", CAMERA, 0.001, {"depth_noise": "none"}) as log,
    ):
        for k in range(FRAMES):
            log.add_frame(k * 10**8, png.tobytes(), "png", np.full((24, 32), 2000, np.uint16))
    gaussians = Gaussians(
        np.arange(N),
        np.arange(N) % 2,
        np.add(rng.normal(size=(N, 3)), [0, 0, 2]),
        rng.normal(size=(N, 4)),
        rng.uniform(-5, -4, (N, 3)),
        rng.uniform(size=(N, 3)),
        rng.normal(size=N),
    )
    A = rng.normal(size=(N, 9, 9))
    geometry = (A @ A.swapaxes(-1, -2))[:, *np.triu_indices(9)].astype(np.float32)
    ones = np.ones((N, 3), np.float32)
    sums = GaussianInformation(
        5 * 10**8, "bravo", "gauss_newton", "all", gaussians.ids, geometry, ones, ones[:, 0],
        np.full(N, 7, np.uint32), 0.02, "0.001", np.full(N, 0.01, np.float32), 9.0, 25.0, 12.0,
    )  # fmt: skip
    with LogWriter(folder / "frontend.mcap", "bravo") as log:
        for k in range(FRAMES):
            at = max(i for i, frame in enumerate(KEYFRAMES) if frame <= k)
            T_keyframe_camera = se3.inverse(T_map_camera[KEYFRAMES[at]]) @ T_map_camera[k]
            frame = Odometry(
                k * 10**8, "bravo", k, k % 8 == 4, at, T_map_camera[k], T_keyframe_camera, np.eye(6),
                "ok", 1.0, 0.0, 0.0,
            )  # fmt: skip
            log.write(topics.ODOMETRY.of("bravo"), frame, k * 10**8)
            if k in KEYFRAMES:
                keyframe = Keyframe(
                    k * 10**8, "bravo", at, k, T_map_camera[k], at - 1, np.eye(4), np.zeros((6, 6)), (1.0, 0.0)
                )  # fmt: skip
                log.write(topics.KEYFRAME.of("bravo"), keyframe, k * 10**8)
                if at > 0:
                    tie = KeyframeFactor(k * 10**8, "bravo", at - 1, at, np.eye(4), np.eye(6), 1.0)
                    log.write(topics.KEYFRAME_FACTOR.of("bravo"), tie, k * 10**8)
        final = GaussianMap(5 * 10**8, "bravo", map_frame("bravo"), gaussians)
        log.write(topics.MAP.of("bravo"), final, 5 * 10**8)
    with LogWriter(folder / "information.mcap", "bravo") as log:
        log.write(topics.INFORMATION.of("bravo"), sums, 5 * 10**8)
    log_path = folder / "recording" / "bravo.mcap"
    return Robot(
        log_path, folder / "frontend.mcap", folder / "information.mcap", T_map_camera, gaussians, sums
    )


def fuse_files(robot, result, folder):
    source = AgentInput("bravo", robot.log, robot.frontend, robot.information, 1e-3)
    run_fusion(source, result, folder, **SETTINGS)
    fused = [topics.FUSED_MAP.of("bravo"), topics.CORRECTED_KEYFRAMES.of("bravo")]
    return {type(r.message()): r.message() for r in read_log(folder / "fused.mcap", topics=fused)}


def test_alone_everything_stays(robot, tmp_path):
    said = fuse_files(robot, robot.alone(), tmp_path)
    write_ply(tmp_path / "own.ply", robot.gaussians)
    assert (tmp_path / "fused.ply").read_bytes() == (tmp_path / "own.ply").read_bytes()
    for name in ("odometry.tum", "trajectory.tum"):  # messages hold unit quaternions: a turn of rounding
        np.testing.assert_allclose(read_tum(tmp_path / name).poses, robot.T_map_camera, atol=1e-14)
    expected_information = robot.evidence().in_world(robot.T_map_keyframe).information
    geometry = said[GaussianMap].information.geometry
    np.testing.assert_allclose(
        geometry[:, [0, 9, 17]], expected_information[:, [0, 3, 5]], rtol=1e-5
    )  # diagonals
    np.testing.assert_allclose(geometry[:, [24, 44]], expected_information[:, [6, 26]], rtol=1e-5)
    assert said[CorrectedKeyframes].component == ["bravo"]
    assert read_peer_colors(tmp_path / "fused.mcap", "bravo") == {}


def test_frames_and_gaussians_move_with_their_keyframes(robot, tmp_path):
    moves = se3.exp(np.array([[1.0, 0, 0, 0, 0, 0.3], [1.0, 0.1, 0, 0, 0, 0.3]]))
    T_world = moves @ robot.T_map_keyframe
    none_of_it = robot.evidence().select(slice(0, 0))
    other = Evidence("alpha", none_of_it.ids, none_of_it.anchors, none_of_it.theta, none_of_it.information)
    result = result_of(robot, T_world, alpha=other)
    said = fuse_files(robot, result, tmp_path)
    poses = read_tum(tmp_path / "trajectory.tum").poses
    expected = moves[[0, 0, 0, 1, 1, 1]] @ robot.T_map_camera
    np.testing.assert_allclose(poses, expected, atol=1e-12)
    np.testing.assert_array_equal(said[CorrectedKeyframes].T_world_keyframe, T_world)
    fused = said[GaussianMap]
    assert fused.frame_id == fused.information.frame_id == "world"
    np.testing.assert_array_equal(fused.gaussians.ids, robot.gaussians.ids)
    by_anchor = [
        se3.transform(moves[a], m[None])[0]
        for a, m in zip(robot.gaussians.anchors, robot.gaussians.means, strict=True)
    ]
    np.testing.assert_allclose(fused.gaussians.means, by_anchor, atol=1e-6)
    trace = [0, 9, 17]  # of the position block in the upper triangle of 9x9: what a turn leaves
    expected_information = np.trace(robot.evidence().position_information(), axis1=1, axis2=2)
    np.testing.assert_allclose(
        fused.information.geometry[:, trace].sum(axis=1), expected_information, rtol=1e-5
    )


def test_what_only_a_neighbor_saw_is_imported(robot, tmp_path):
    """A Gaussian of alpha behind bravo's cameras, and one on the wall that they measured."""
    theta = np.zeros((2, 13))
    theta[:, :3] = [[0, 0, -3.0], [0, 0, 2.0]]
    theta[:, 3:9] = -8 * np.array([1, 1, 1, 0, 0, 0])
    other = Evidence("alpha", np.array([40, 41]), np.zeros(2), theta, np.ones((2, 31)))
    result = result_of(robot, robot.T_map_keyframe, alpha=other)
    fused = fuse_files(robot, result, tmp_path)[GaussianMap]
    assert len(fused.gaussians) == len(fused.information.ids) == N + 1
    np.testing.assert_allclose(fused.gaussians.means[-1], [0, 0, -3.0])
    colors = read_peer_colors(tmp_path / "fused.mcap", "bravo")[
        "alpha"
    ]  # nothing matched: as if alike, and none_of_it knows
    assert colors.is_identity
    assert colors.matches == 0
    np.testing.assert_allclose(colors.sigma_gain, np.sqrt(2) * ColorConfig().prior_gain)


def test_a_neighbor_far_from_own_images_raises_what_is_stated_of_positions(robot, tmp_path):
    """Alpha's Gaussians lie 40 mm behind the wall and state 10 mm."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 12), np.linspace(-0.4, 0.4, 10))
    theta = np.zeros((x.size, 13))
    theta[:, :3] = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.04)])
    theta[:, 3:9] = [-7.0, -7.0, -12.0, 0, 0, 0]
    theta[:, 9:12] = 90 / 255
    information = np.ones((x.size, 31))
    information[:, :6] = [1e4, 0, 0, 1e4, 0, 1e4]
    other = Evidence("alpha", np.arange(x.size), np.zeros(x.size), theta, information)
    still = replace(robot, T_map_camera=np.tile(np.eye(4), (FRAMES, 1, 1)))
    source = AgentInput("bravo", robot.log, robot.frontend, robot.information, 1e-3)
    training = FinetuneConfig(steps_per_view=0)
    maps = []
    cases = ((False, 128, "block"), (True, 128, "block"), (True, 128, "uniform"), (True, 1, "block"))
    for enabled, most_views, weights in cases:
        stated = StatedScaleConfig(enabled=enabled, min_views=2, views=most_views)
        config = FusionConfig(explained_opacity=0.0, finetune=training, stated_scale=stated)
        result = result_of(robot, still.T_map_keyframe, alpha=other)
        run_fusion(source, result, tmp_path, **SETTINGS | {"config": config, "weights": weights})
        (record,) = read_log(tmp_path / "fused.mcap", topics=[topics.FUSED_MAP.of("bravo")])
        maps.append(record.message())
    before, after, uniform, of_one_view = (m.information for m in maps)
    assert before.stated_scale == uniform.stated_scale == 1.0  # weights that are uniform state nothing
    assert of_one_view.stated_scale == 1.0  # two views must have measured a surface
    assert 1.5 < after.stated_scale < 4.0  # 4 standard deviations; some of the errors are those of the poses
    positions = [0, 1, 2, 9, 10, 17]  # in the upper triangle of 9x9
    np.testing.assert_allclose(
        after.stated_scale**2 * after.geometry[:, positions], before.geometry[:, positions], rtol=1e-5
    )
    others = np.setdiff1d(np.arange(45), positions)
    np.testing.assert_array_equal(after.geometry[:, others], before.geometry[:, others])
    for name in ("color", "opacity", "ids"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_array_equal(maps[1].gaussians.means, maps[0].gaussians.means)


def test_what_was_read_ahead_is_read_once_and_gives_the_same_bytes(robot, tmp_path, monkeypatch):
    source = AgentInput("bravo", robot.log, robot.frontend, robot.information, 1e-3)
    moved = np.array([se3.exp(np.array([1.0, 0, 0, 0, 0, 0.3]))]) @ robot.T_map_keyframe
    other = Evidence("alpha", np.array([40]), np.zeros(1), np.zeros((1, 13)), np.ones((1, 31)))
    loads: list[AgentInput] = []
    load = own_images.load
    monkeypatch.setattr(own_images, "load", lambda files: loads.append(files) or load(files))
    files = []
    for ahead in (False, True, False):
        folder = tmp_path / str(len(files))
        folder.mkdir()
        if ahead:
            read_ahead(source, FinetuneConfig())
        run_fusion(source, result_of(robot, moved, alpha=other), folder, **SETTINGS)
        files.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert len(loads) == 3
    assert "trajectory.tum" in files[0]
    assert files[0] == files[1] == files[2]


def test_a_merge_has_no_more_gaussians_than_it_may(robot, tmp_path):
    """A Gaussian of alpha that bravo did not see comes in, and as many of bravo's go as must."""
    theta = np.zeros((1, 13))
    theta[:, 3:9], theta[:, 12] = -8 * np.array([1, 1, 1, 0, 0, 0]), 4.0
    theta[:, 2] = -3.0
    other = Evidence("alpha", np.array([40]), np.zeros(1), theta, np.ones((1, 31)))
    result = result_of(robot, robot.T_map_keyframe, alpha=other)
    source = AgentInput("bravo", robot.log, robot.frontend, robot.information, 1e-3)
    training = FinetuneConfig(steps_per_view=1, peer_views=2)
    config = FusionConfig(final_start="drawn", most_final=5, explained_opacity=0.0, finetune=training)
    run_fusion(source, result, tmp_path, **SETTINGS | {"config": config})
    (record,) = read_log(tmp_path / "fused.mcap", topics=[topics.REFINED_MAP.of("bravo")])
    refined = record.message().gaussians
    assert len(refined) == 5
    assert len(np.unique(refined.ids)) == 5


def white_wall():
    """Evidence of alpha: a white wall where bravo saw a dark one, and one more Gaussian where bravo never looked."""
    x, y = np.meshgrid(np.arange(-1.4, 1.4, 0.05), np.arange(-1.1, 1.1, 0.05))
    theta = np.zeros((x.size + 1, 13))
    theta[:-1, :3] = np.stack([x, y, np.full_like(x, 2.0)], axis=-1).reshape(-1, 3)
    theta[-1, :3] = [0, 0, -3.0]
    theta[:, 3:6], theta[:, 9:12], theta[:, 12] = 2 * np.log(0.03), 1.0, 4.0
    ids = np.arange(len(theta))
    return Evidence("alpha", ids, np.zeros(len(ids)), theta, np.ones((len(ids), 31)))


def test_the_training_begins_with_the_own_map_if_no_neighbor_is_used(robot, tmp_path):
    result = result_of(robot, robot.T_map_keyframe, alpha=white_wall())
    source = AgentInput("bravo", robot.log, robot.frontend, robot.information, 1e-3)
    training = FinetuneConfig(steps_per_view=1, peer_views=2)
    config = FusionConfig(final_start="drawn", most_final=5, explained_opacity=0.0, finetune=training)
    run_fusion(source, result, tmp_path, **SETTINGS | {"config": config})
    (record,) = read_log(tmp_path / "fused.mcap", topics=[topics.REFINED_MAP.of("bravo")])
    np.testing.assert_array_equal(record.message().gaussians.ids, robot.gaussians.ids)


def test_a_neighbor_that_contradicts_own_images_is_left_out(robot, tmp_path):
    other = white_wall()
    ids = other.ids
    fused = fuse_files(robot, result_of(robot, robot.T_map_keyframe, alpha=other), tmp_path)[GaussianMap]
    assert len(fused.gaussians) == N
    (record,) = read_log(tmp_path / "fused.mcap", topics=[topics.PEER_MAP_REPORT.of("bravo")])
    said = record.message()
    assert (said.peer, said.gaussians, said.used) == ("alpha", len(ids), False)
    assert "contradicts own images" in said.reason


def test_information_of_another_map_is_refused(robot, tmp_path):
    other = robot.sums.ids + 1
    with LogWriter(tmp_path / "information.mcap", "bravo") as log:
        log.write(topics.INFORMATION.of("bravo"), replace(robot.sums, ids=other), 5 * 10**8)
    source = AgentInput("bravo", robot.log, robot.frontend, tmp_path / "information.mcap", 1e-3)
    with pytest.raises(DuagError, match="other Gaussians"):
        run_fusion(
            source,
            robot.alone(),
            tmp_path,
            **SETTINGS,
        )
    assert [p.name for p in tmp_path.iterdir()] == ["information.mcap"]
