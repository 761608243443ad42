"""A small recording and a finished run of it, written with the real writers; every number in it is known.

A textured wall two meters ahead, seen by robots that move along curved ways. The maps are what the images were
rendered from, the corrected ways are the true ones, so that the ideal values of most metrics are known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from duagc import schemas
from duagc.converters.simulate.ply import write_points
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.exchange.wire.state_wire import PairList, write_pairs
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import Trajectory, write_tum
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.messages import (
    CorrectedKeyframes,
    GaussianInformation,
    GaussianMap,
    Keyframe,
    KeyframeFactor,
    MapUpdate,
    Odometry,
    map_frame,
    pack_pose,
    pack_stamp,
)
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
FRAMES = 21
INTERVAL_NS = 40_000_000
WALL_Z_M = 2.0
SIGMA_M = (0.001, 0.008)  # of the centers across the wall, as the information says, and as it is
DRIFT_M = 0.02  # of the last pose of the odometry
HEADER_BYTES = 34
T_GT_WORLD = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, -0.2, 0.9]))
KEYFRAMES = (0, 3, 6, 9, 13, 16, 19)


@dataclass(frozen=True)
class FakeRun:
    """Folders of the run and of its recording."""

    run: Path
    recording: Path


def way(robot: int) -> np.ndarray:
    """T_world_camera [n, 4, 4] of a robot; the world is the first camera of robot 0."""
    s = np.linspace(0.0, 1.0, FRAMES)
    zero = np.zeros(FRAMES)
    xi = np.stack(
        [0.8 * s + 0.3 * robot, 0.3 * s**2, 0.1 * np.sin(4 * s) + 0.05 * robot, zero, 0.15 * s, zero], axis=1
    )
    return se3.exp(xi)


def wall(seed: int = 0) -> Gaussians:
    """Gaussians on the wall, world frame, smooth colors, centers off by `sigma_m` across it."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-2.4, 3.6, 0.06), np.arange(-2.0, 2.4, 0.06))
    n = x.size
    colors = 0.5 + 0.4 * np.stack([np.sin(5 * x + 1), np.sin(4 * y), np.sin(3 * x + 6 * y)], axis=-1).reshape(
        n, 3
    )
    z = WALL_Z_M + rng.normal(0.0, sigma_m(n))
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n),
        means=np.stack([x.ravel(), y.ravel(), z], axis=1),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.log(np.tile([0.04, 0.04, 0.002], (n, 1))),
        colors=colors,
        opacity_logits=np.full(n, 4.0),
    )


def sigma_m(n: int) -> np.ndarray:
    """Standard deviation of every center across the wall, spread over SIGMA_M."""
    share = np.random.default_rng(7).random(n)
    return SIGMA_M[0] * (SIGMA_M[1] / SIGMA_M[0]) ** share


def information(robot: str, gaussians: Gaussians, known: bool = True) -> GaussianInformation:
    """Position information 1/sigma^2 across the wall and a hundredth of it along; nothing at all if not known."""
    n = len(gaussians)
    geometry = np.zeros((n, 45), dtype=np.float32)
    if known:
        geometry[:, 0] = geometry[:, 9] = 0.01 / sigma_m(n) ** 2
        geometry[:, 17] = 1.0 / sigma_m(n) ** 2
    return GaussianInformation(
        stamp_ns=0,
        robot=robot,
        kind="gauss_newton",
        window="all",
        ids=gaussians.ids,
        geometry=geometry,
        color=np.ones((n, 3), dtype=np.float32),
        opacity=np.ones(n, dtype=np.float32),
        observations=np.full(n, 3, dtype=np.uint32),
        color_sigma=0.02,
        depth_sigma="0.002 z^2",
        deviation_m=np.zeros(n, dtype=np.float32),
        color_pixels_per_sample=1.0,
        depth_pixels_per_sample=1.0,
        overlap=1.0,
    )


def make(
    folder: Path,
    robots: Sequence[str] = ("alpha", "bravo"),
    truth: bool = True,
    joined: bool = True,
    depth_noise: str = "none",
    gain: float = 1.0,
) -> FakeRun:
    """Write the recording and the run.

    truth: with ground truth. joined: whether the robots share a world and talked; otherwise each is alone.
    gain: of the last robot's camera; if not 1, the robots know it.
    """
    recording, run = folder / "recording", folder / "run"
    gains = dict.fromkeys(robots, 1.0) | {robots[-1]: gain}
    _write_recording(recording, robots, truth, depth_noise, gains)
    run.mkdir()
    (run / "config.toml").write_text(
        "seed = 0\n\n[exchange.consensus]\ntolerance = 1e-5\n\n[fusion.refine]\nsteps_per_view = 1\n"
    )
    (run / "timing.json").write_text(
        '{"stages": {"frontend.alpha": {"stage": "frontend", "robot": "alpha", "wall_s": 3.5, "cpu_s": 6.5, '
        '"peak_rss_mb": 210.0}, "exchange": {"stage": "exchange", "robot": null, "wall_s": 1.25, "cpu_s": 1.2, '
        '"peak_rss_mb": 180.0}}}'
    )
    for i, robot in enumerate(robots):
        _write_robot(run / "robots" / robot, robot, i, list(robots) if joined else [robot], joined, gains)
    _write_exchange(run / "exchange.mcap", robots if joined else [], list(robots))
    _write_consensus(run / "consensus.mcap", list(robots), joined)
    return FakeRun(run, recording)


def _peer_colors(robot: str, peer: str, gain: float) -> Any:
    return schemas.new(
        "PeerColors",
        robot=robot,
        peer=peer,
        gain=[gain] * 3,
        offset=[0.0] * 3,
        gain_sigma=[0.01] * 3,
        offset_sigma=[0.002] * 3,
        matches=500,
    )


def _write_recording(
    folder: Path, robots: Sequence[str], truth: bool, depth_noise: str, gains: dict[str, float]
) -> None:
    rasterizer = Rasterizer()
    with RecordingWriter(folder, "wall", {"made": "by the tests"}, "tests") as recording:
        for i, robot in enumerate(robots):
            with recording.robot(robot, CAMERA, 0.001, {"depth_noise": depth_noise}) as log:
                for k, T_world_camera in enumerate(way(i)):
                    render = rasterizer.forward(wall(), CAMERA, se3.inverse(T_world_camera))
                    rgb = np.rint(np.clip(gains[robot] * render.color, 0, 1) * 255).astype(np.uint8)
                    _, png = cv2.imencode(".png", rgb[:, :, ::-1])
                    depth = np.rint(1000 * render.depth / render.alpha).astype(np.uint16)
                    depth[:4] = 0  # a strip without measurement
                    pose = T_GT_WORLD @ T_world_camera if truth else None
                    exact = (
                        np.where(depth > 0, depth + 10, 0).astype(np.uint16)
                        if truth and depth_noise != "none"
                        else None
                    )
                    log.add_frame(
                        k * INTERVAL_NS, png.tobytes(), "png", depth, T_world_camera=pose, exact_depth=exact
                    )
        if truth:
            recording.add_geometry(_write_wall)


def _write_wall(path: Path) -> None:
    """Points on the wall, 5 cm apart."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-5, 5, 0.05), np.arange(-5, 5, 0.05)))
    points = se3.transform(T_GT_WORLD, np.stack([x, y, np.full(len(x), WALL_Z_M)], axis=1))
    normals = np.tile(T_GT_WORLD[:3, 2], (len(x), 1))
    write_points(path, points, normals, np.zeros((len(x), 3), np.uint8))


def _write_robot(
    folder: Path, robot: str, index: int, component: list[str], joined: bool, gains: dict[str, float]
) -> None:
    folder.mkdir(parents=True)
    stamps = np.arange(FRAMES, dtype=np.int64) * INTERVAL_NS
    true = way(index)
    T_map_world = se3.inverse(true[0])
    drift = se3.exp(np.outer(np.linspace(0, 1, FRAMES), [0, DRIFT_M, 0, 0, 0, 0]))
    odometry = T_map_world @ true @ drift
    after = true if joined else T_map_world @ true
    write_tum(folder / "odometry.tum", Trajectory(stamps, odometry))
    write_tum(folder / "trajectory.tum", Trajectory(stamps, after))
    seen = wall().replace(colors=np.float32(gains[robot]) * wall().colors)
    own, fused = seen.transformed(T_map_world), seen if joined else seen.transformed(T_map_world)
    end = int(stamps[-1])
    with LogWriter(folder / "frontend.mcap", robot) as log:
        for k in range(FRAMES):
            status = "lost" if k == 10 else "ok"
            log.write(topics.ODOMETRY.of(robot), _odometry(robot, k, odometry[k], status), int(stamps[k]))
            if k in KEYFRAMES:
                i = KEYFRAMES.index(k)
                log.write(topics.KEYFRAME.of(robot), _keyframe(robot, i, k, odometry, true), int(stamps[k]))
                if i > 0:
                    factor = _factor(robot, i, k, true)
                    log.write(topics.KEYFRAME_FACTOR.of(robot), factor, int(stamps[k]))
                update = MapUpdate(int(stamps[k]), robot, i, 100, 3, 100 * (i + 1), 0.5, 0.2)
                log.write(topics.MAP_UPDATE.of(robot), update, int(stamps[k]))
        dull = own.replace(colors=0.9 * own.colors)
        log.write(topics.UNREFINED_MAP.of(robot), GaussianMap(end, robot, map_frame(robot), dull), end)
        log.write(topics.MAP.of(robot), GaussianMap(end, robot, map_frame(robot), own), end)
    with LogWriter(folder / "information.mcap", robot) as log:
        log.write(topics.INFORMATION.of(robot), information(robot, own), end)
    with LogWriter(folder / "fused.mcap", robot) as log:
        fused_map = GaussianMap(end, robot, "world", fused, information(robot, fused, known=joined))
        log.write(topics.FUSED_MAP.of(robot), fused_map, end)
        if joined:
            log.write(topics.REFINED_MAP.of(robot), GaussianMap(end, robot, "world", fused), end)
        indices = np.arange(len(KEYFRAMES), dtype=np.int32)
        corrected = CorrectedKeyframes(end, robot, component, indices, after[list(KEYFRAMES)])
        log.write(topics.CORRECTED_KEYFRAMES.of(robot), corrected, end)
        for peer in component if set(gains.values()) != {1.0} else ():
            if peer != robot:
                colors = _peer_colors(robot, peer, gains[robot] / gains[peer])
                log.write(topics.PEER_COLORS.of(robot), colors, end)


def _odometry(robot: str, k: int, T_map_camera: np.ndarray, status: str) -> Odometry:
    return Odometry(
        stamp_ns=k * INTERVAL_NS,
        robot=robot,
        frame_index=k,
        held_out=k % 8 == 4,
        keyframe_index=0,
        T_map_camera=T_map_camera,
        T_keyframe_camera=np.eye(4),
        information=np.eye(6),
        status=status,
        overlap=0.9,
        rms_depth_m=0.001,
        rms_color=0.01,
    )


def _keyframe(robot: str, index: int, k: int, odometry: np.ndarray, true: np.ndarray) -> Keyframe:
    """Measured without error from the keyframe before, though the pose in the map drifts."""
    return Keyframe(
        stamp_ns=k * INTERVAL_NS,
        robot=robot,
        keyframe_index=index,
        frame_index=k,
        T_map_camera=odometry[k],
        previous_index=index - 1,
        T_previous_keyframe=se3.inverse(true[KEYFRAMES[max(index - 1, 0)]]) @ true[k],
        information=1e6 * np.eye(6),
        exposure=(0.0, 0.0),
    )


def _factor(robot: str, index: int, k: int, true: np.ndarray) -> KeyframeFactor:
    """The registration behind `_keyframe`."""
    T = se3.inverse(true[KEYFRAMES[index - 1]]) @ true[k]
    return KeyframeFactor(k * INTERVAL_NS, robot, index - 1, index, T, 1e6 * np.eye(6), 1.0)


def _write_exchange(path: Path, talking: Sequence[str], team: list[str]) -> None:
    """Per ordered pair of robots: three messages in four packets of 100 bytes, the last of them lost."""
    totals = {"messages": 0, "packets": 0}
    with LogWriter(path) as log:
        for sender in talking:
            for receiver in talking:
                if sender != receiver:
                    _write_link(log, sender, receiver, team, totals)
        summary = schemas.new(
            "ExchangeSummary",
            team=team,
            rounds=10 if talking else 1,
            converged=True,
            messages=totals["messages"],
            packets_sent=totals["packets"],
            bytes_raw_alternative=123456 if talking else 0,
            bytes_raw_alternative_maps_only=45678 if talking else 0,
        )
        log.write(topics.EXCHANGE_SUMMARY.pattern, summary, 0)


def _write_link(log: LogWriter, sender: str, receiver: str, team: list[str], totals: dict[str, int]) -> None:
    pairs = PairList(0, 1, 1, np.array([[1, 2], [3, 4], [5, 6]]))
    first = 10 * team.index(receiver)
    for i, (kind, payload) in enumerate(
        (("DESCRIPTORS", b"d"), ("EVIDENCE", b"e"), ("PAIRS", write_pairs(pairs)))
    ):
        peer = schemas.new(
            "PeerMessage",
            robot=sender,
            message=first + i,
            kind_name=kind,
            length=len(payload),
            payload=payload,
        )
        log.write(topics.PEER_MESSAGE.of(sender), peer, 0)
        totals["messages"] += 1
        for k in range(2 if kind == "EVIDENCE" else 1):
            packet = schemas.new(
                "PeerPacket",
                robot=sender,
                receiver=receiver,
                sequence=i + k,
                round=2 * i + k,
                message=first + i,
                length=100 - HEADER_BYTES,
                header=bytes(HEADER_BYTES),
                delivered=kind != "PAIRS",
                dropped="lost" if kind == "PAIRS" else "",
            )
            log.write(topics.PEER_PACKET.of(sender), packet, 0)
            totals["packets"] += 1


def _write_consensus(path: Path, team: list[str], joined: bool) -> None:
    """Nine rounds whose change falls by ten in each; agreement in the eighth.

    One closure counts, one is outvoted, one is not consistent, one has too few matches to be measured.
    """
    with LogWriter(path) as log:
        for k in range(9 if joined else 1):
            for robot in team:
                agent = schemas.new(
                    "AgentRound",
                    robot=robot,
                    round=k,
                    members=team if joined else [robot],
                    agreed=joined and k >= 7,
                )
                pack_stamp(agent, k * 10**8)
                log.write(topics.AGENT_ROUND.of(robot), agent, k * 10**8)
                if joined:
                    change = 0.1 * 10.0**-k
                    state = schemas.new(
                        "ConsensusRound", robot=robot, round=k, primal=2 * change, largest_change=change
                    )
                    log.write(topics.CONSENSUS_ROUND.of(robot), state, k * 10**8)
        for i, (verdict, weight, inliers) in enumerate(
            (("outvoted", 0.1, 30), ("kept", 1.0, 30), ("inconsistent", -1.0, 30), ("few_matches", -1.0, 0))
        ):
            if joined:
                closure = schemas.new(
                    "LoopClosureDecision",
                    robot=team[0],
                    peer=team[1],
                    own_keyframe=i,
                    peer_keyframe=i,
                    matches=50,
                    inliers=inliers,
                    verdict=verdict,
                    detail=f"{inliers} of 50 matches agree",
                    measured=weight >= 0,
                    weight=weight,
                )
                if weight >= 0:  # the outvoted one is wrong by 5 cm
                    wrong = se3.exp([0.05 * (verdict == "outvoted"), 0, 0, 0, 0, 0])
                    T_own_peer = se3.inverse(way(0)[KEYFRAMES[i]]) @ way(1)[KEYFRAMES[i]] @ wrong
                    closure.pose_own_peer.CopyFrom(pack_pose(T_own_peer))
                    closure.information.extend(np.diag([1e6] * 6).ravel().tolist())
                log.write(topics.LOOP_CLOSURE_DECISION.of(team[0]), closure, 10**9)
