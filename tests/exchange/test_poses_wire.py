"""Poses of a round: what is written is read, whichever component of a quaternion is left out."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.consensus.admm_edge import STEP_M, PosePacket, rounded
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses, write_poses_in_parts
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MalformedError


def poses(rng, n):
    return se3.from_quat_translation(rng.normal(size=(n, 4)), 10 * rng.normal(size=(n, 3)))


def pose_packet(rng, n, wire="fixed", curvature=None):
    quats_wxyz, translations = rounded(poses(rng, n), wire)
    return PosePacket(
        sequence=7,
        version=3,
        keyframes=(2 * np.arange(n)).astype(np.int32),
        quats_wxyz=quats_wxyz,
        translations=translations,
        penalties=np.array([0.5, 0.25], np.float32),
        curvature=curvature,
        converged=True,
    )


@pytest.mark.parametrize(("wire", "atol"), [("fixed", 3e-7), ("float32", 3e-7), ("float64", 1e-15)])
def test_poses_come_back_whichever_component_was_left_out(wire, atol):
    rng = np.random.default_rng(0)
    packet = pose_packet(rng, 41, wire)
    assert len(set(np.argmax(np.abs(packet.quats_wxyz), axis=1).tolist())) == 4
    data = write_poses(packet, 3, 30, decides=True)
    read = read_poses(data, packet.keyframes, from_decider=True)
    np.testing.assert_array_equal(read.keyframes, packet.keyframes[3:33])
    np.testing.assert_array_equal(read.translations, packet.translations[3:33])
    np.testing.assert_array_equal(read.penalties, packet.penalties)
    assert (read.sequence, read.version, read.converged, read.curvature) == (7, 3, True, None)
    dots = np.abs(np.sum(read.quats_wxyz * packet.quats_wxyz[3:33].astype(np.float64), axis=1))
    np.testing.assert_allclose(dots, 1.0, atol=atol)
    angle = so3.log(
        so3.from_quat_wxyz(read.quats_wxyz).swapaxes(1, 2) @ so3.from_quat_wxyz(packet.quats_wxyz[3:33])
    )
    assert np.abs(angle).max() < 10 * atol


def test_a_full_packet_of_poses_fits():
    for wire, n in (("fixed", 37), ("float32", 47), ("float64", 23)):
        packet = pose_packet(np.random.default_rng(1), n, wire)
        assert 1166 - 60 < len(write_poses(packet, 0, n, decides=False)) <= 1166


def test_the_other_end_sends_its_curvature_instead():
    rng, curvature = np.random.default_rng(2), np.array([2.0, 3.0], np.float32)
    packet = pose_packet(rng, 5, curvature=curvature)
    data = write_poses(packet, 0, 5, decides=False)
    np.testing.assert_array_equal(read_poses(data, packet.keyframes, from_decider=False).curvature, curvature)
    with pytest.raises(MalformedError, match="not from this end"):
        read_poses(data, packet.keyframes, from_decider=True)


@pytest.mark.parametrize("n", [1, 47, 48, 130])
def test_parts_hold_every_keyframe_once_and_fit(n):
    packet = pose_packet(np.random.default_rng(3), n)
    parts = write_poses_in_parts(packet, 1140, decides=True)
    assert max(len(part) for part in parts) <= 1140
    read = [read_poses(part, packet.keyframes, from_decider=True).keyframes for part in parts]
    np.testing.assert_array_equal(np.concatenate(read), packet.keyframes)


def test_keyframes_that_are_not_shared_are_refused():
    packet = pose_packet(np.random.default_rng(4), 6)
    with pytest.raises(MalformedError, match="shared"):
        read_poses(write_poses(packet, 0, 6, True), packet.keyframes[:5], True)


def test_fixed_translations_are_as_fine_a_thousand_kilometers_away():
    far = np.array([[999_999.123456789, -999_999.0, 0.0], [-STEP_M, STEP_M, 3 * STEP_M]])
    T = poses(np.random.default_rng(5), 2)
    T[:, :3, 3] = far
    packet = replace(pose_packet(np.random.default_rng(5), 2), translations=rounded(T, "fixed")[1])
    read = read_poses(write_poses(packet, 0, 2, True), packet.keyframes, True).translations
    np.testing.assert_array_equal(read, packet.translations)
    assert np.abs(read - far).max() <= STEP_M / 2


def test_poses_beyond_all_places_are_refused():
    for far in (1.1e6, -1e30):
        packet = replace(pose_packet(np.random.default_rng(6), 2), translations=np.full((2, 3), far))
        with pytest.raises(MalformedError, match="rigid"):
            read_poses(write_poses(packet, 0, 2, True), packet.keyframes, True)


@pytest.mark.parametrize("flags", [8 + 16, 32])
def test_unknown_precisions_are_refused(flags):
    packet = pose_packet(np.random.default_rng(7), 3)
    data = bytearray(write_poses(packet, 0, 3, True))
    data[8] |= flags
    with pytest.raises(MalformedError, match="flags"):
        read_poses(bytes(data), packet.keyframes, True)


@pytest.mark.parametrize(("left_out", "taken"), [(0.5, True), (0.4, False), (0.0, False)])
def test_rotations_whose_largest_component_is_too_small_are_refused(left_out, taken):
    """The largest of four components of a unit quaternion is one half at least."""
    packet = pose_packet(np.random.default_rng(5), 3)
    others = np.sqrt((1 - left_out**2) / 3)
    quats = packet.quats_wxyz.copy()
    quats[1] = [1.0, others, others, others]  # the first is left out
    data = write_poses(replace(packet, quats_wxyz=quats), 0, 3, decides=True)
    if taken:
        read = read_poses(data, packet.keyframes, from_decider=True)
        np.testing.assert_allclose(read.quats_wxyz[1], [left_out, others, others, others], atol=1e-6)
    else:
        with pytest.raises(MalformedError, match="not rigid"):
            read_poses(data, packet.keyframes, from_decider=True)


@pytest.mark.parametrize("wire", ["fixed", "float32", "float64"])
def test_no_part_is_longer_than_its_room(wire):
    packet = pose_packet(np.random.default_rng(6), 40, wire)
    for room_bytes in range(400, 600):
        parts = write_poses_in_parts(packet, room_bytes, decides=True)
        assert max(len(part) for part in parts) <= room_bytes
        assert len(parts) == 1 or len(write_poses(packet, 0, 40, decides=True)) > room_bytes
