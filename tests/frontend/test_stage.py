"""The front-end stage on a small log: what it writes, and that it writes it again."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.frontend import FrontendConfig, KeyframeConfig, TrackingConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.frontend.depth_quality import depth_noise_m
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.keyframe_graph import solve_pose_graph
from duagc.pipeline.frontend.mapping_budget import MappingBudget
from duagc.pipeline.frontend.output import LATENCY_NS
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.frontend.supporting_frames import supporting_frames
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import ate_rmse_m
from duagc.pipeline.messages import Keyframe
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import content_digest, log_metadata, read_log
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.schemas import topics
from tests.fixtures.moving_ball import RADIUS_M, with_ball
from tests.fixtures.room import CAMERA, pose, render
from tests.fixtures.speckled_wall import wall

FRAMES = 13
FRAME_NS = 33_333_333
TRACKING = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)), mapping_enabled=False)


def walk(k: int) -> np.ndarray:
    return pose(x=-0.4 + 0.04 * k, y=0.01 * k * (k % 3), z=-0.9, yaw=0.5 - 0.03 * k)


@pytest.fixture(scope="module")
def sensor_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("stage") / "room"
    with RecordingWriter(out) as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(FRAMES):
            gray, depth = render(walk(k))
            image = np.repeat(np.rint(np.clip(gray, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=2)
            png = cv2.imencode(".png", image)[1].tobytes()
            robot.add_frame(k * FRAME_NS, png, "png", np.rint(depth / 0.0005).astype(np.uint16))
    return out / "alpha.mcap"


def messages(path: Path, topic: topics.Topic) -> list:
    return [record.message() for record in read_log(path, [topic.of("alpha")])]


@pytest.fixture(scope="module")
def frontend_log(sensor_log: Path) -> Path:
    out = sensor_log.with_name("frontend.mcap")
    run_frontend(sensor_log, out, TRACKING)
    return out


def test_every_frame_has_its_final_pose(frontend_log: Path) -> None:
    odometry = messages(frontend_log, topics.ODOMETRY)
    keyframes = messages(frontend_log, topics.KEYFRAME)
    assert [m.frame_index for m in odometry] == list(range(FRAMES))
    assert [m.status for m in odometry] == ["ok"] * FRAMES
    assert [m.frame_index for m in odometry if m.held_out] == [4, 12]
    for m in odometry:
        composed = keyframes[m.keyframe_index].T_map_camera @ m.T_keyframe_camera
        np.testing.assert_allclose(m.T_map_camera, composed, atol=1e-12)
    truth = np.array([walk(k)[:3, 3] for k in range(FRAMES)])
    assert ate_rmse_m(truth, np.array([m.T_map_camera[:3, 3] for m in odometry])) < 1.5e-3


def test_keyframes_chain_by_their_refined_motion(frontend_log: Path) -> None:
    keyframes = messages(frontend_log, topics.KEYFRAME)
    assert len(keyframes) >= 2
    assert [m.keyframe_index for m in keyframes] == list(range(len(keyframes)))
    assert keyframes[0].previous_index == -1
    np.testing.assert_array_equal(keyframes[0].T_map_camera, np.eye(4))
    np.testing.assert_array_equal(keyframes[0].information, 0)
    for m in keyframes[1:]:
        assert m.previous_index < m.keyframe_index
        chained = keyframes[m.previous_index].T_map_camera @ m.T_previous_keyframe
        assert se3.distance(chained, m.T_map_camera)[0] < 1e-12
        assert np.linalg.eigvalsh(m.information)[0] > 0
        assert m.frame_index % 8 != 4


def test_registrations_in_the_log_give_the_keyframe_poses(sensor_log: Path, tmp_path: Path) -> None:
    """The logged factors, as weighed, are all that the refinement knew: its answer and its information follow."""
    often = TRACKING.model_copy(update={"keyframes": KeyframeConfig(min_overlap=0.95)})
    run_frontend(sensor_log, tmp_path / "frontend.mcap", often)
    keyframes = messages(tmp_path / "frontend.mcap", topics.KEYFRAME)
    factors = messages(tmp_path / "frontend.mcap", topics.KEYFRAME_FACTOR)
    assert len(factors) > len(keyframes) - 1  # some keyframe is registered to more than the one before
    pairs = [
        RelativePose(f.first_index, f.second_index, f.T_first_second, f.weight * f.information)
        for f in factors
    ]
    poses = np.array([m.T_map_camera for m in keyframes])
    again = solve_pose_graph(poses, pairs, 1e9)
    np.testing.assert_allclose(again.T_map_keyframe, poses, atol=1e-7)
    for m in keyframes[1:]:
        relative = again.relative_information(m.previous_index, m.keyframe_index) * again.variance_factor
        np.testing.assert_allclose(
            relative, m.information, rtol=1e-4, atol=1e-4 * np.abs(m.information).max()
        )


def test_times_are_those_of_the_recording(frontend_log: Path) -> None:
    for record in read_log(frontend_log):
        assert record.log_time_ns == record.publish_time_ns + LATENCY_NS
        assert record.publish_time_ns % FRAME_NS == 0
    assert len(messages(frontend_log, topics.MAP)[0].gaussians) == 0


def test_two_runs_write_the_same_log(sensor_log: Path, frontend_log: Path) -> None:
    again = sensor_log.with_name("again.mcap")
    timing = run_frontend(sensor_log, again, TRACKING)
    assert content_digest(again) == content_digest(frontend_log)
    assert set(timing) == {"tracking_s", "refinement_s", "mapping_s", "writing_s"}


def test_map_is_grown_at_the_refined_keyframes(sensor_log: Path) -> None:
    out = sensor_log.with_name("mapped.mcap")
    small = MappingConfig(max_gaussians=300, iterations=2, final_iterations=1, final_iterations_view=0)
    run_frontend(sensor_log, out, TRACKING.model_copy(update={"mapping_enabled": True, "mapping": small}))
    final = messages(out, topics.MAP)
    updates = messages(out, topics.MAP_UPDATE)
    keyframes = messages(out, topics.KEYFRAME)
    assert len(final) == 1
    assert final[0].frame_id == "alpha/map"
    assert 50 < len(final[0].gaussians) <= 300
    assert set(final[0].gaussians.anchors.tolist()) <= {m.keyframe_index for m in keyframes}
    assert sorted(m.keyframe_index for m in updates) == sorted(
        [m.keyframe_index for m in keyframes] + [keyframes[-1].keyframe_index]
    )
    assert updates[-1].total == len(final[0].gaussians)
    (unrefined,) = messages(out, topics.UNREFINED_MAP)
    assert final[0].depth == unrefined.depth == "ray_plane"  # the log's depth is exact
    assert 0.0 < float(log_metadata(out)["depth_noise_m"]) < 0.001
    assert len(unrefined.gaussians) == updates[-2].total
    common = np.intersect1d(unrefined.gaussians.ids, final[0].gaussians.ids)
    assert len(common) > 50  # the refinement replaces some and moves the others
    colors = [m.gaussians.colors[np.isin(m.gaussians.ids, common)] for m in (unrefined, final[0])]
    assert not np.array_equal(*colors)


def test_a_budget_that_is_too_small_is_said(sensor_log: Path) -> None:
    megapixels = 1e-6 * CAMERA.width * CAMERA.height
    mapping = MappingConfig(
        max_gaussians=300,
        iterations=6,
        final_iterations=4,
        final_iterations_view=0,
        keyframe_megapixels_s=15 * megapixels,  # some steps, not all, at keyframes a few frames apart
        final_megapixels_s=2 / (1e-9 * (FRAMES - 1) * FRAME_NS) * megapixels,
    )
    config = TRACKING.model_copy(
        update={
            "mapping_enabled": True,
            "mapping": mapping,
            "keyframes": KeyframeConfig(max_translation_of_depth=0.04),
        }
    )
    said: list[str] = []
    out = sensor_log.with_name("budget.mcap")
    run_frontend(sensor_log, out, config, checkpoints=Checkpoints(say=said.append))
    stamps_ns = [m.stamp_ns for m in messages(out, topics.KEYFRAME)]
    assert len(stamps_ns) > 2
    steps = MappingBudget(mapping, CAMERA, "blended").keyframe_steps(stamps_ns)
    assert steps[0] == 6
    wanted, final = 6 * len(stamps_ns), 4 * len(stamps_ns)
    assert [line for line in said if line.startswith("warning")] == [
        f"warning: alpha: {wanted - sum(steps)} of {wanted} training steps at keyframes are left out "
        "by frontend.mapping.keyframe_megapixels_s",
        f"warning: alpha: {final - 3} of {final} training steps of the final optimization are left out "
        "by frontend.mapping.final_megapixels_s",
    ]


def test_held_out_and_lost_frames_never_support_the_map(frontend_log: Path) -> None:
    keyframes = messages(frontend_log, topics.KEYFRAME)
    nothing = np.zeros((6, 6))
    frames = [
        TrackedFrame(
            frame_index=k,
            stamp_ns=k,
            keyframe_index=0,
            T_keyframe_camera=np.eye(4),
            information=nothing,
            status=Status.LOST if k == 7 else Status.OK,
            overlap=1.0,
            rms_depth_m=0.0,
            rms_gray=0.0,
        )
        for k in range(FRAMES)
    ]
    made = [
        Keyframe(m.stamp_ns, "alpha", k, m.frame_index, np.eye(4), k - 1, np.eye(4), nothing, (1.0, 0.0))
        for k, m in enumerate(keyframes)
    ]
    forbidden = {4, 7, 12, *(m.frame_index for m in keyframes)}
    gain = ViewGain(wall(), "blended", CAMERA, MappingConfig(), 1)
    for count in (0, 3, 100):
        for choice in ("auto", "steady", "spread", "random", "information", "reversed"):
            mapping = MappingConfig(support_views=count, support_choice=choice)
            config = TRACKING.model_copy(update={"mapping": mapping})
            chosen = [f.frame_index for f in supporting_frames(frames, made, config, gain)]
            assert chosen == sorted(set(chosen))
            assert not forbidden & set(chosen)
            assert len(chosen) == min(count, FRAMES - len(forbidden))


def test_where_depth_is_not_exact_the_map_is_trained_on_the_frames_that_move_least() -> None:
    pauses, frames, x = {9, 23}, [], 0.0
    for k in range(32):
        x += 0.0 if k in pauses or k - 1 in pauses else 0.02
        T = np.eye(4)
        T[0, 3] = x
        frames.append(
            TrackedFrame(
                frame_index=k,
                stamp_ns=33_333_333 * k,
                keyframe_index=0,
                T_keyframe_camera=T,
                information=np.zeros((6, 6)),
                status=Status.OK,
                overlap=1.0,
                rms_depth_m=0.0,
                rms_gray=0.0,
            )
        )
    first = Keyframe(0, "alpha", 0, 0, np.eye(4), -1, np.eye(4), np.zeros((6, 6)), (1.0, 0.0))
    config = TRACKING.model_copy(update={"mapping": MappingConfig(support_views=2)})
    chosen = {}
    for depth in DEPTH_KINDS:
        gain = ViewGain(wall(), depth, CAMERA, config.mapping, 1)
        chosen[depth] = [f.frame_index for f in supporting_frames(frames, [first], config, gain)]
    assert chosen == {"blended": sorted(pauses), "ray_plane": [8, 24]}


def test_a_missing_log_is_named(tmp_path: Path) -> None:
    with pytest.raises(DuagError, match=r"none\.mcap"):
        run_frontend(tmp_path / "none.mcap", tmp_path / "frontend.mcap", TRACKING)
    assert list(tmp_path.iterdir()) == []


def test_what_moves_is_not_mapped(tmp_path: Path) -> None:
    """A ball crosses the room, never twice at one place: depth alone keeps it out, without that it leaves a trail."""
    centers = [np.array([-0.5 + 0.15 * k, -0.3, 0.5]) for k in range(FRAMES)]
    with RecordingWriter(tmp_path / "room") as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(FRAMES):
            gray, room = render(walk(k))
            depth, shows = with_ball(room, walk(k), centers[k])
            image = np.repeat(np.where(shows, 0.9, gray)[..., None], 3, axis=2)
            png = cv2.imencode(".png", np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))[1].tobytes()
            robot.add_frame(k * FRAME_NS, png, "png", np.rint(depth / 0.0005).astype(np.uint16))
    left = {}
    for enabled in (True, False):
        config = TRACKING.model_copy(
            update={
                "mapping_enabled": True,
                "mapping": MappingConfig(
                    max_gaussians=3000, iterations=4, final_iterations=2, final_iterations_view=0
                ),
                "keyframes": KeyframeConfig(max_translation_of_depth=0.04),
                "moving": MovingConfig(enabled=enabled, halvings=1, grow_px=2),
            }
        )
        out = tmp_path / f"{enabled}.mcap"
        run_frontend(tmp_path / "room" / "alpha.mcap", out, config)
        gaussians = messages(out, topics.MAP)[0].gaussians
        points = se3.transform(walk(0), gaussians.means.astype(np.float64))
        away = np.linalg.norm(points[:, None] - np.array(centers), axis=2).min(axis=1)
        left[enabled] = int(np.count_nonzero(away < 1.1 * RADIUS_M))
    assert left[False] > 100
    assert left[True] < 0.05 * left[False]


def test_noise_of_depth_is_that_of_frames_which_were_registered_by_it() -> None:
    def frame(
        rms_m: float, status: Status = Status.OK, reason: Reason = Reason.NONE, *, index: int = 0
    ) -> TrackedFrame:
        return TrackedFrame(
            frame_index=index,
            stamp_ns=0,
            keyframe_index=0,
            T_keyframe_camera=np.eye(4),
            information=np.zeros((6, 6)),
            status=status,
            overlap=1.0,
            rms_depth_m=rms_m,
            rms_gray=0.0,
            reason=reason,
        )

    first, lost = frame(0.0), frame(0.5, Status.LOST)
    color_only = frame(0.5, reason=Reason.FROZEN_DEPTH)
    assert depth_noise_m([first, frame(0.006), lost, color_only, frame(0.008), frame(0.007)]) == 0.007
    assert depth_noise_m([first, lost]) is None
    held_out = [frame(0.5, index=k) for k in (4, 12, 20)]
    assert depth_noise_m([frame(0.006), frame(0.007, index=5), *held_out, frame(0.008, index=6)]) == 0.007
