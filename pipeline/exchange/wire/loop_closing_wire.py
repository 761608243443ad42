"""Bytes of loop closing: descriptors, samples of keyframes, the verdict, named keyframes. Strict as `reader`."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.exchange.wire.camera_wire import camera_bytes, read_camera
from duagc.pipeline.exchange.wire.reader import MAX_KEYFRAMES, Reader, motion_bytes, pose_bytes
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.registration import Reference, ReferenceLevel
from duagc.pipeline.registration.descriptors import DIMENSIONS, Descriptors
from duagc.pipeline.registration.features import Features

DIGEST_BYTES = 8
LEAST_METRIC = 1e-12  # 1/m^2: a deviation as large as the largest coordinate


def read_digest(data: bytes) -> bytes:
    """From HELLO.

    Args:
        data: of the message.

    Raises:
        MalformedError: it has another length.
    """
    if len(data) != DIGEST_BYTES:
        raise MalformedError(f"hello: {len(data)} bytes, expected {DIGEST_BYTES}")
    return data


@dataclass(frozen=True)
class DescriptorSet:
    """What a robot sends to its neighbor for place recognition.

    Attributes:
        descriptors: one array per keyframe.
        T_first_keyframe: [n, 4, 4], as seen from its first keyframe.
        drift: [n, 2], accumulated variance of its odometry from keyframe 0 (m^2, rad^2).
        camera: that took its keyframes.
    """

    descriptors: list[Descriptors]
    T_first_keyframe: Array
    drift: Array
    camera: PinholeCamera


_COUNT = struct.Struct("<I")


def write_descriptors(own: DescriptorSet) -> bytes:
    """Bytes of DESCRIPTORS.

    Args:
        own: of all own keyframes.
    """
    return b"".join(
        [
            _COUNT.pack(len(own.descriptors)),
            camera_bytes(own.camera),
            pose_bytes(own.T_first_keyframe),
            array_bytes(own.drift, "float64"),
            array_bytes([len(d) for d in own.descriptors], "uint16"),
            *(array_bytes(d, "uint8") for d in own.descriptors),
        ]
    )


def read_descriptors(data: bytes) -> DescriptorSet:
    """From DESCRIPTORS.

    Args:
        data: of the message.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "descriptors")
    n, camera = _keyframe_count(reader), read_camera(reader)
    T, drift = reader.poses(n), reader.array("float64", (n, 2))
    if n and (drift.min() < 0 or drift.max() > 1e12 or np.diff(drift, axis=0).min(initial=0.0) < 0):
        raise MalformedError("descriptors: the drift of the odometry must grow from zero")
    counts = reader.array("uint16", (n,)).tolist()
    own = DescriptorSet([reader.array("uint8", (count, DIMENSIONS)) for count in counts], T, drift, camera)
    reader.done()
    return own


def _keyframe_count(reader: Reader) -> int:
    (n,) = reader.fields(_COUNT)
    if n > MAX_KEYFRAMES:
        raise MalformedError(f"{reader.what}: {n} keyframes, at most {MAX_KEYFRAMES}")
    return int(n)


def write_indices(indices: list[int]) -> bytes:
    """Bytes of REQUEST and RECTIFIED_REQUEST: keyframe indices.

    Args:
        indices: ascending.
    """
    return array_bytes(indices, "uint32")


def read_indices(data: bytes, limit: int) -> list[int]:
    """From REQUEST and RECTIFIED_REQUEST: ascending keyframe indices below `limit`.

    Args:
        data: of the message.
        limit: number of keyframes of the receiver.

    Raises:
        MalformedError: it is not what it should be.
    """
    if len(data) % 4:
        raise MalformedError("request: not a list of indices")
    indices = Reader(data, "request").array("uint32", (len(data) // 4,)).tolist()
    if indices != sorted(set(indices)) or (indices and indices[-1] >= limit):
        raise MalformedError(f"request: indices must ascend and stay below {limit}")
    return indices


# --- the verdict on a pair of robots


@dataclass(frozen=True)
class Verdicts:
    """What the verifier found out about a pair.

    Attributes:
        candidates: pairs of keyframes that were tried.
        verified: those that became loop closures.
        consistent: those that agree.
        joined: the two robots share a frame.
        shared: then, the keyframes of the provider that the verifier copies, and their metric.
    """

    candidates: int
    verified: int
    consistent: int
    joined: bool
    shared: SharedKeyframes


_VERDICTS = struct.Struct("<IIIBI")


def write_verdicts(verdicts: Verdicts) -> bytes:
    """Bytes of CLOSURES.

    Args:
        verdicts: the verdict on a pair of robots.
    """
    n = len(verdicts.shared.keyframes)
    head = (verdicts.candidates, verdicts.verified, verdicts.consistent, verdicts.joined, n)
    return b"".join(
        [
            _VERDICTS.pack(*head),
            array_bytes(verdicts.shared.keyframes, "int32"),
            array_bytes(verdicts.shared.metric, "float32"),
        ]
    )


def read_verdicts(data: bytes, limit: int) -> Verdicts:
    """From CLOSURES about keyframes below `limit`.

    Args:
        data: of the message.
        limit: number of keyframes of the receiver.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "closures")
    candidates, verified, consistent, joined, n = reader.fields(_VERDICTS)
    if joined > 1 or bool(joined) != bool(n) or n > MAX_KEYFRAMES:
        raise MalformedError("closures: joined robots share keyframes, others do not")
    keyframes, metric = reader.array("int32", (n,)), reader.array("float32", (n, 6))
    reader.done()
    if n and (keyframes[0] < 0 or keyframes[-1] >= limit or np.diff(keyframes).min(initial=1) < 1):
        raise MalformedError(f"closures: shared keyframes must ascend and stay below {limit}")
    if n and not (metric.min() >= LEAST_METRIC and metric.max() < 1e15):
        raise MalformedError(f"closures: the metric must be at least {LEAST_METRIC:g} and below 1e15")
    return Verdicts(candidates, verified, consistent, bool(joined), SharedKeyframes(keyframes, metric))


# --- keyframes that known loop closures name


@dataclass(frozen=True)
class NamedKeyframes:
    """Some keyframes of a robot.

    Attributes:
        keyframes: int32 [s], their indices, ascending.
        T_first_keyframe: [s, 4, 4], as seen from its first keyframe.
        drift: [s, 2], accumulated variance of its odometry from keyframe 0 (m^2, rad^2).
    """

    keyframes: NDArray[np.int32]
    T_first_keyframe: Array
    drift: Array


def write_keyframes(named: NamedKeyframes, precision: str) -> bytes:
    """Bytes of KEYFRAMES: 40 per keyframe with poses in float32, 68 in float64.

    Args:
        named: some own keyframes.
        precision: of the poses, float32 or float64.
    """
    return b"".join(
        [
            _COUNT.pack(len(named.keyframes)),
            array_bytes(named.keyframes, "int32"),
            motion_bytes(named.T_first_keyframe, precision),
            array_bytes(named.drift, "float32"),
        ]
    )


def read_keyframes(data: bytes, expected: NDArray[np.int32], precision: str) -> NamedKeyframes:
    """From KEYFRAMES about exactly the keyframes that the loop closures name.

    Args:
        data: of the message.
        expected: int32 [s], indices of these keyframes, ascending.
        precision: of the poses, float32 or float64.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "keyframes")
    (n,) = reader.fields(_COUNT)
    if n != len(expected):
        raise MalformedError(f"keyframes: {n}, the loop closures name {len(expected)}")
    keyframes = reader.array("int32", (n,))
    T = reader.motions(n, precision)
    drift = reader.array("float32", (n, 2)).astype(np.float64)
    reader.done()
    if not np.array_equal(keyframes, expected) or drift.min(initial=0.0) < 0:
        raise MalformedError("keyframes: not those that the loop closures name, or a negative variance")
    return NamedKeyframes(keyframes, T, drift)


# --- one keyframe


@dataclass(frozen=True)
class KeyframeSample:
    """What is needed of a keyframe to verify a loop closure with it.

    Attributes:
        keyframe: its index.
        features: with 3-D points.
        reference: samples for the registration.
    """

    keyframe: int
    features: Features
    reference: Reference


_SAMPLE = struct.Struct("<IHfHBf")
_INT16 = 32767


def write_sample(sample: KeyframeSample) -> bytes:
    """Bytes of SAMPLE; points in steps of the largest coordinate / 32767, normals in bytes, gray in bytes.

    Args:
        sample: of one own keyframe; points in meters, camera frame.
    """
    levels = sample.reference.levels
    feature_scale, feature_points = _shorts(sample.features.points)
    sample_scale, sample_points = _shorts(levels[0].points)
    return b"".join(
        [
            _SAMPLE.pack(
                sample.keyframe,
                len(sample.features),
                feature_scale,
                len(levels[0]),
                len(levels),
                sample_scale,
            ),
            array_bytes(sample.features.descriptors, "uint8"),
            feature_points,
            sample_points,
            array_bytes(np.rint(levels[0].normals * 127), "int8"),
            *(array_bytes(np.rint(np.clip(level.intensities, 0, 1) * 255), "uint8") for level in levels),
        ]
    )


def read_sample(data: bytes, limit: int) -> KeyframeSample:
    """From SAMPLE of a keyframe below `limit`.

    Args:
        data: of the message.
        limit: number of keyframes of the sender.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "sample")
    keyframe, n, feature_scale, m, levels, sample_scale = reader.fields(_SAMPLE)
    if keyframe >= limit:
        raise MalformedError(f"sample: keyframe {keyframe}, expected one below {limit}")
    if not (0 <= feature_scale < 1 and 0 <= sample_scale < 1) or not 1 <= levels <= 8:
        raise MalformedError("sample: impossible scale of points or number of levels")
    features = _features(reader, n, feature_scale)
    sample_points = reader.array("int16", (m, 3)).astype(np.float32) * np.float32(sample_scale)
    normals = reader.array("int8", (m, 3)).astype(np.float32)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if m and length.min() == 0:
        raise MalformedError("sample: a normal of length zero")
    normals = (normals / np.maximum(length, np.float32(1e-6))).astype(np.float32)
    grays = [reader.array("uint8", (m,)).astype(np.float32) / np.float32(255) for _ in range(levels)]
    reader.done()
    reference = Reference(tuple(ReferenceLevel(sample_points, normals, gray) for gray in grays))
    return KeyframeSample(keyframe, features, reference)


@dataclass(frozen=True)
class RectifiedFeatures:
    """Features of the surfaces that a keyframe sees from the side, as if the camera faced them.

    Attributes:
        keyframe: its index.
        features: with 3-D points.
    """

    keyframe: int
    features: Features


_RECTIFIED = struct.Struct("<IHf")


def write_rectified(rectified: RectifiedFeatures) -> bytes:
    """Bytes of RECTIFIED; points as in SAMPLE.

    Args:
        rectified: of one own keyframe; points in meters, camera frame.
    """
    features = rectified.features
    scale, points = _shorts(features.points)
    head = _RECTIFIED.pack(rectified.keyframe, len(features), scale)
    return b"".join([head, array_bytes(features.descriptors, "uint8"), points])


def read_rectified(data: bytes, limit: int) -> RectifiedFeatures:
    """From RECTIFIED of a keyframe below `limit`.

    Args:
        data: of the message.
        limit: number of keyframes of the sender.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "rectified")
    keyframe, n, scale = reader.fields(_RECTIFIED)
    if keyframe >= limit or not 0 <= scale < 1:
        raise MalformedError(
            f"rectified: keyframe {keyframe}, expected one below {limit}, or a scale not below 1"
        )
    features = _features(reader, n, scale)
    reader.done()
    return RectifiedFeatures(keyframe, features)


def _features(reader: Reader, n: int, scale: float) -> Features:
    """The next n features, points in steps of `scale` meters."""
    descriptors = reader.array("uint8", (n, DIMENSIONS))
    return Features(descriptors, reader.array("int16", (n, 3)).astype(np.float32) * np.float32(scale))


def _shorts(points: NDArray[np.float32]) -> tuple[float, bytes]:
    """Step (m) and bytes of points in that step; the step as it will be read back."""
    largest = float(np.abs(points).max(initial=0.0))
    step = np.float32(largest * 1.000001 / _INT16)
    return float(step), array_bytes(np.rint(points / max(step, np.float32(1e-12))), "int16")
