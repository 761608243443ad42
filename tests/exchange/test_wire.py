"""Messages: what is written is read back, and nothing else is accepted."""

import contextlib
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duagc.pipeline.consensus.admm_edge import PosePacket, SharedKeyframes
from duagc.pipeline.exchange.wire import anchors_wire, evidence_wire, loop_closing_wire, state_wire
from duagc.pipeline.exchange.wire.camera_wire import camera_bytes, read_camera
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses
from duagc.pipeline.exchange.wire.reader import Reader
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.network.packets import EVIDENCE_KINDS, Kind, MalformedError, chunk_bytes
from duagc.pipeline.posegraph.cycle_consistency import Proposal
from duagc.pipeline.registration import Reference, ReferenceLevel
from duagc.pipeline.registration.features import Features
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.pipeline.splat.information import pack_symmetric, unpack_symmetric

RNG = np.random.default_rng(5)
TEAM = 4
CAMERA = PinholeCamera(640, 480, 525.25, 525.0, 319.5, 239.5)


@pytest.fixture(autouse=True)
def _same_draws() -> None:
    """What a test draws does not depend on the tests that the same process ran before."""
    RNG.bit_generator.state = np.random.default_rng(5).bit_generator.state


def poses(n: int) -> np.ndarray:
    return se3.exp(RNG.normal(size=(n, 6)))


SHARED = np.array([1, 4, 9], np.int32)


def pose_packet() -> PosePacket:
    T, numbers = poses(3), np.array([3, 4], np.float32)
    quats = np.roll(np.eye(4, dtype=np.float32)[:3], 1, axis=1)
    return PosePacket(7, 2, SHARED, quats, T[:, :3, 3].astype(np.float32), numbers, numbers, True)


def records_of(kind: Kind, n: int) -> np.ndarray:
    """Records in the precision of a kind."""
    out = np.zeros(n, evidence_wire.record_dtype(kind))
    single = records(n)
    for name in out.dtype.names or ():
        out[name] = single[name]
    return out


def as_sent(kind: Kind, sent: np.ndarray) -> np.ndarray:
    """Records as a receiver reads them."""
    return evidence_wire.from_body(kind, evidence_wire.to_body(kind, sent))


def sample() -> loop_closing_wire.KeyframeSample:
    points = RNG.uniform(-2, 3, (30, 3)).astype(np.float32)
    normals = RNG.normal(size=(30, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    levels = tuple(ReferenceLevel(points, normals, RNG.random(30).astype(np.float32)) for _ in range(3))
    features = Features(RNG.integers(0, 256, (9, 128)).astype(np.uint8), points[:9])
    return loop_closing_wire.KeyframeSample(2, features, Reference(levels))


def records(n: int) -> np.ndarray:
    out = np.zeros(n, evidence_wire.RECORD)
    out["id"], out["anchor"] = RNG.permutation(n) + 5, RNG.integers(0, 4, n)
    out["theta"] = RNG.normal(size=(n, 13))
    L3, L6 = (np.tril(RNG.normal(size=(n, size, size))) for size in (3, 6))
    blocks = [pack_symmetric(L @ L.swapaxes(1, 2)) for L in (L3, L6)]
    out["information"] = np.concatenate([*blocks, RNG.uniform(0, 1, (n, 4))], axis=1)
    return out


MESSAGES: dict[str, tuple[bytes, Callable[[bytes], Any]]] = {
    "state": (
        state_wire.write_state(
            state_wire.State(0b1101, 0b101, 3, 0, True, False, np.array([254, 255, 0, 1], np.uint8))
        ),
        lambda d: state_wire.read_state(d, TEAM),
    ),
    "places": (
        loop_closing_wire.write_descriptors(
            loop_closing_wire.DescriptorSet(
                [RNG.integers(0, 256, (n, 128)).astype(np.uint8) for n in (3, 0, 2)],
                poses(3),
                np.array([[0, 0], [1, 1], [1, 3.0]]),
                CAMERA,
            )
        ),
        loop_closing_wire.read_descriptors,
    ),
    "request": (loop_closing_wire.write_indices([1, 5, 6]), lambda d: loop_closing_wire.read_indices(d, 7)),
    "sample": (loop_closing_wire.write_sample(sample()), lambda d: loop_closing_wire.read_sample(d, 3)),
    "closures": (
        loop_closing_wire.write_verdicts(
            loop_closing_wire.Verdicts(
                9,
                5,
                4,
                True,
                SharedKeyframes(np.array([2, 6], np.int32), np.ones((2, 6), np.float32)),
            )
        ),
        lambda d: loop_closing_wire.read_verdicts(d, 7),
    ),
    "poses": (
        write_poses(pose_packet(), 0, 2, False),
        lambda d: read_poses(d, SHARED, False),
    ),
    "frame": (
        state_wire.write_relative_frames(
            state_wire.RelativeFrames(
                1, 2, tuple(Proposal(n, poses(1)[0], (0.01 * n, 0.02), 0.1 * n) for n in (7, 2))
            )
        ),
        lambda d: state_wire.read_relative_frames(d, TEAM),
    ),
    "anchors": (
        anchors_wire.write_anchors(anchors_wire.Anchors(2, poses(4), poses(1)[0], CAMERA)),
        lambda d: anchors_wire.read_anchors(d, TEAM),
    ),
    "voxels": (
        state_wire.write_voxels(3, np.cumsum(RNG.integers(1, 1 << 40, 50))),
        lambda d: state_wire.read_voxels(d, TEAM),
    ),
    "pairs": (
        state_wire.write_pairs(state_wire.PairList(0, 2, 1, np.array([[1, 5], [3, 4]]))),
        lambda d: state_wire.read_pairs(d, TEAM),
    ),
    "evidence": (
        evidence_wire.write_evidence(
            Kind.EVIDENCE, 1, "blended", evidence_wire.to_body(Kind.EVIDENCE, records(15))
        ),
        lambda d: evidence_wire.read_evidence(Kind.EVIDENCE, d, TEAM),
    ),
    "exact evidence": (
        evidence_wire.write_evidence(Kind.EVIDENCE_EXACT, 1, "blended", records(15)),
        lambda d: evidence_wire.read_evidence(Kind.EVIDENCE_EXACT, d, TEAM),
    ),
}


@given(name=st.sampled_from(sorted(MESSAGES)), data=st.data())
@settings(max_examples=250, deadline=None)
def test_readers_refuse_or_read_but_never_fail(name: str, data: st.DataObject) -> None:
    good, read = MESSAGES[name]
    read(good)
    bad = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        bad[data.draw(st.integers(0, len(bad) - 1))] = data.draw(st.integers(0, 255))
    bad = bad[: data.draw(st.integers(len(bad) // 2, len(bad)))] if data.draw(st.booleans()) else bad
    with contextlib.suppress(MalformedError):  # the only error it may raise; a warning fails the test
        read(bytes(bad))


@pytest.mark.parametrize(
    "name", sorted(set(MESSAGES) - {"state"})
)  # the poses of the round may follow a state
@pytest.mark.parametrize("change", [-1, 1])
def test_a_wrong_length_is_refused(name: str, change: int) -> None:
    good, read = MESSAGES[name]
    bad = good[:-1] if change < 0 else good + b"\x01"
    with pytest.raises(MalformedError):
        read(bad)


def test_final_poses_and_voxels_come_back_bit_for_bit() -> None:
    anchors = anchors_wire.Anchors(2, poses(4), poses(1)[0], CAMERA)
    back = anchors_wire.read_anchors(anchors_wire.write_anchors(anchors), TEAM)
    assert np.array_equal(back.T_common_keyframe, anchors.T_common_keyframe)
    assert np.array_equal(back.T_map_first, anchors.T_map_first)
    assert back.camera == CAMERA
    for keys in (np.zeros(0, np.int64), np.array([0, 1, 127, 128, (1 << 60) - 1])):
        assert np.array_equal(state_wire.read_voxels(state_wire.write_voxels(1, keys), TEAM)[1], keys)


@pytest.mark.parametrize(
    ("field", "value"),
    [("width", 0), ("height", 16_385), ("fx", 0.0), ("fx", -5.0), ("fy", 47.0), ("fy", np.inf), ("fy", 1e7),
     ("cx", np.nan), ("cy", -1e5)],
)  # fmt: skip
def test_an_impossible_camera_is_refused(field: str, value: float) -> None:
    data = camera_bytes(replace(CAMERA, **{field: value}))
    with pytest.raises(MalformedError, match="impossible camera"):
        read_camera(Reader(data, "anchors"))


def test_a_sample_comes_back_within_its_quantization() -> None:
    before = sample()
    after = loop_closing_wire.read_sample(loop_closing_wire.write_sample(before), 3)
    assert np.array_equal(after.features.descriptors, before.features.descriptors)
    assert np.abs(after.features.points - before.features.points).max() < 1e-4  # 3 m / 32767
    for a, b in zip(after.reference.levels, before.reference.levels, strict=True):
        assert np.abs(a.points - b.points).max() < 1e-4
        assert (a.normals * b.normals).sum(axis=1).min() > np.cos(0.01)
        assert np.abs(a.intensities - b.intensities).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("kind", sorted(EVIDENCE_KINDS))
@given(n=st.integers(0, 40))
@settings(max_examples=20, deadline=None)
def test_evidence_comes_back_and_every_chunk_is_useful_alone(kind: Kind, n: int) -> None:
    sent = records_of(kind, n)
    data = evidence_wire.write_evidence(kind, 1, "ray_plane", evidence_wire.to_body(kind, sent))
    owner, body, back = evidence_wire.read_evidence(kind, data, TEAM)
    assert owner == 1
    assert np.array_equal(back, as_sent(kind, sent))
    assert evidence_wire.write_evidence(kind, 1, "ray_plane", body) == data  # handed on unchanged
    step = chunk_bytes(kind)
    parts = [
        evidence_wire.read_evidence(kind, data[i : i + step], TEAM)[2] for i in range(0, len(data), step)
    ]
    assert np.array_equal(np.concatenate(parts), back)
    for depth in DEPTH_KINDS:
        data = evidence_wire.write_evidence(kind, 1, depth, body)
        for i in range(0, len(data), step):
            assert evidence_wire.read_evidence_head(kind, data[i : i + step], TEAM) == (1, depth, n)


@pytest.mark.parametrize("depth", [0, 1 + len(DEPTH_KINDS), 0xFFFF])
def test_evidence_of_an_unknown_kind_of_depth_is_refused(depth: int) -> None:
    data = bytearray(evidence_wire.write_evidence(Kind.EVIDENCE_EXACT, 1, "blended", records(3)))
    data[2:4] = depth.to_bytes(2, "little")
    with pytest.raises(MalformedError, match="unknown kind of depth"):
        evidence_wire.read_evidence(Kind.EVIDENCE_EXACT, bytes(data), TEAM)


def test_exact_evidence_is_exact() -> None:
    for kind in (Kind.EVIDENCE_EXACT, Kind.EVIDENCE_DOUBLE):
        sent = records_of(kind, 30)
        assert np.array_equal(as_sent(kind, sent), sent)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [(0, -5.0, "indefinite"), (1, 1e4, "indefinite"), (26, -1e3, "indefinite"), (30, -1e-3, "negative"),
     (28, 1e16, "beyond"), (2, np.nan, "finite"), (6, np.inf, "finite")],
)  # fmt: skip
def test_impossible_information_is_refused(field: int, value: float, reason: str) -> None:
    sent = records(20)
    sent["information"][7, field] = value
    data = evidence_wire.write_evidence(Kind.EVIDENCE_EXACT, 1, "blended", sent)
    with pytest.raises(MalformedError, match=reason):
        evidence_wire.read_evidence(Kind.EVIDENCE_EXACT, data, TEAM)


@pytest.mark.parametrize("kind", sorted(EVIDENCE_KINDS))
@pytest.mark.parametrize("share", [1e-6, 8e-4, 0.06])
def test_what_rounding_makes_indefinite_is_sent_as_it_can_be(kind: Kind, share: float) -> None:
    """Sums of float32 of a house with exact depth, bounded at 100: 8e-4 of it below zero were measured."""
    sent = records_of(kind, 40)
    for block, size in ((slice(0, 6), 3), (slice(6, 27), 6)):
        Q = np.linalg.qr(RNG.normal(size=(20, size, size)))[0]
        values = np.full(size, 100.0)
        values[0] = -100.0 * share
        sent["information"][:20, block] = pack_symmetric((Q * values) @ Q.swapaxes(1, 2))
    before = sent.copy()
    data = evidence_wire.write_evidence(kind, 1, "ray_plane", evidence_wire.to_body(kind, sent))
    back = evidence_wire.read_evidence(kind, data, TEAM)[2]
    assert np.array_equal(sent, before)
    off = np.abs(back["information"].astype(np.float64) - sent["information"]).max(axis=1)
    assert off[:20].max() <= 100 * share * 1.01 + (0.3 if kind is Kind.EVIDENCE else 1e-3)
    if kind is not Kind.EVIDENCE:
        assert not off[20:].any()
        assert (share > 1e-4) == off[:20].any()


def evidence_with_information(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Records whose blocks of information have contrasts up to 1e4, and those blocks."""
    sent = records(n)
    sent["theta"][:, 3:9] = RNG.uniform(-14, 3, (n, 6))
    blocks = []
    for size, scale in ((3, 1e6), (6, 1e3)):
        Q = np.linalg.qr(RNG.normal(size=(n, size, size)))[0]
        blocks.append((Q * (scale * 10 ** RNG.uniform(-4, 0, (n, 1, size)))) @ Q.swapaxes(1, 2))
    sent["information"][:, :27] = np.concatenate([pack_symmetric(b) for b in blocks], axis=1)
    sent["information"][:5] = 0.0
    return sent, blocks[0], blocks[1]


def test_compact_evidence_is_rounded_far_below_its_uncertainty() -> None:
    sent, *blocks = evidence_with_information(200)
    back = as_sent(Kind.EVIDENCE, sent)
    assert np.array_equal(back["id"], sent["id"])
    assert np.array_equal(back["anchor"], sent["anchor"])
    assert np.array_equal(back["theta"][:, :3], sent["theta"][:, :3])
    assert np.abs(back["theta"][:, 3:9] - sent["theta"][:, 3:9]).max() <= 2.0**-11 + 1e-6
    assert np.abs(back["theta"][:, 9:12] - sent["theta"][:, 9:12]).max() <= 2.0**-14 + 1e-6
    assert (back["information"][:5] == 0).all()
    for part, block, size in ((slice(0, 6), blocks[0], 3), (slice(6, 27), blocks[1], 6)):
        read = unpack_symmetric(back["information"][5:, part], size)
        whitened = np.linalg.inv(np.linalg.cholesky(block[5:]))
        ratio = np.linalg.eigvalsh(whitened @ read @ whitened.swapaxes(1, 2))
        assert ratio.min() > 0.9  # 5 % of a standard deviation in the worst direction of a contrast of 1e4
        assert ratio.max() < 1.1
    scalars = back["information"][5:, 27:] / sent["information"][5:, 27:]
    assert np.abs(scalars - 1).max() < 2e-3


def test_compact_information_is_never_negative() -> None:
    sent = records(100)
    sent["information"] = RNG.normal(size=(100, 31)) * 100  # not even semidefinite
    back = as_sent(Kind.EVIDENCE, sent)
    for part, size in ((slice(0, 6), 3), (slice(6, 27), 6)):
        values = np.linalg.eigvalsh(unpack_symmetric(back["information"][:, part], size))
        assert (values[:, 0] >= -1e-5 * np.maximum(values[:, -1], 1e-6)).all()
    assert (back["information"][:, 27:] >= 0).all()


@pytest.mark.parametrize(("least", "taken"), [(1e-11, True), (1e-40, False), (0.0, False)])
def test_a_metric_that_means_nothing_is_refused(least: float, taken: bool) -> None:
    shared = SharedKeyframes(np.array([2, 6], np.int32), np.full((2, 6), least, np.float32))
    data = loop_closing_wire.write_verdicts(loop_closing_wire.Verdicts(9, 5, 4, True, shared))
    with contextlib.nullcontext() if taken else pytest.raises(MalformedError, match="metric"):
        loop_closing_wire.read_verdicts(data, 7)


def test_announced_poses_cost_no_memory_before_they_are_there() -> None:
    tracemalloc.start()
    try:
        with pytest.raises(MalformedError, match="more were announced"):
            Reader(bytes(96), "poses").poses(10**6)
        assert tracemalloc.get_traced_memory()[1] < 10**6
    finally:
        tracemalloc.stop()
